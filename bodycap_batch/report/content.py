"""Collect the content of the page, section by section. The templates only arrange this content."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from bodycap_batch.core.percent import format_percent
from bodycap_batch.model.measured_parts import BODY_PARTS, PartState, part_states
from bodycap_batch.model.merge_data import MergeResult, filled_joints
from bodycap_batch.report.advice import recommend_changes
from bodycap_batch.report.drawn_scene import DrawnScene, common_times_s
from bodycap_batch.report.figures.before_after import draw_before_and_after, find_unoptimised_bones
from bodycap_batch.report.figures.camera_landmark_matrix import draw_camera_landmark_matrix
from bodycap_batch.report.figures.camera_timeline import draw_camera_timeline, draw_coverage
from bodycap_batch.report.figures.motion_curves import Take, draw_motion_curves
from bodycap_batch.report.figures.pictogram import draw_pictogram
from bodycap_batch.report.figures.shared_landmarks import draw_shared_landmarks
from bodycap_batch.report.figures.time_axis import MAX_COLUMNS, column_count
from bodycap_batch.report.grades import Grade
from bodycap_batch.report.loss_causes import CAUSES, LossCause
from bodycap_batch.report.loss_diagnosis import DiagnosedLoss, count_frames_by_cause
from bodycap_batch.report.metric_tables import headline_figures, make_tables
from bodycap_batch.report.packing import PageBudget
from bodycap_batch.report.report_inputs import ReportInputs
from bodycap_batch.report.result_links import describe_files
from bodycap_batch.report.verdict import Verdict

_SHEET_PICTURES = 24
"""Maximum number of pictures of lost frames on the page: six rows of four pictures on a wide screen."""
_LISTED_LOSSES = 6
"""Maximum number of lost intervals in the list below the verdict: it fits on the screen of a phone."""
_WHOLE_SHARE = 0.95
"""Share of ticks from which a part of the body counts as measured or as not measured. Evidence: none."""
_PROGRESS_AT_FAILURE = {
    "check": "no video was read",
    "keyframes": "the videos were opened; the selection of keyframes was not finished",
    "map": "the keyframes were selected; the map could not be built",
    "registration": "the map was built; the registration of frames was not finished",
    "merge": "the map and the camera paths are finished; the body could not be solved",
    "fill": "the body was solved; the joints without cameras could not be posed",
}


def page_content(
    inputs: ReportInputs,
    verdict: Verdict,
    scene: DrawnScene,
    losses: Sequence[DiagnosedLoss],
    colours: dict[str, str],
    budget: PageBudget,
) -> dict[str, Any]:
    """Return the variables of the templates.

    Args:
        inputs: The results of the job.
        verdict: The verdict about these results.
        scene: Maps and camera paths of the 3D viewer.
        losses: The lost intervals of all cameras, with their causes.
        colours: Colour ``#rrggbb`` of each camera, by camera name.
        budget: The budget of the page. It records how many items of each kind are shown.

    Returns:
        The value of each template variable, by variable name.
    """
    return {
        "name": inputs.name,
        "person": None if inputs.merge is None else _person(inputs.merge),
        "curves": _motion_curves(inputs, budget),
        "files": describe_files(inputs.files),
        "left_out": (inputs.metrics or {}).get("left_out", ()),
        "verdict": verdict,
        "grades": Grade,
        "failure": inputs.failure,
        "progress": _progress_at_failure(inputs),
        "figures": list(headline_figures(inputs.metrics)) if inputs.metrics is not None else [],
        "recommendations": recommend_changes(inputs, verdict) if _needs_change(verdict) else [],
        "tables": make_tables(inputs),
        "scene": scene,
        "places": {name: place.replace("_", " ") for name, place in inputs.places_from_motion.items()},
        "has_viewer": scene.has_content,
        "has_shade": inputs.capture is not None
        and not all(camera.shows_only_room for camera in inputs.capture.cameras),
        "has_body": inputs.merge is not None,
        "cameras": _cameras(inputs, losses, colours, budget),
        "has_slips": inputs.merge is not None
        and any(mount.slip is not None for mount in inputs.merge.mounts),
        "missing": _missing(inputs, losses, colours),
        "causes": {cause.value: rule for cause, (rule, _) in CAUSES.items()},
        "lost_pictures": _lost_pictures(losses, budget.scaled(_SHEET_PICTURES)),
        "loss_count": len(losses),
        "matrix": draw_camera_landmark_matrix(inputs, colours, budget.share),
        "shared": draw_shared_landmarks(inputs),
        "bodies": draw_before_and_after(inputs, colours),
        "before": _distances_before_optimisation(inputs),
        "thinned": budget.thinned_lines(),
    }


def _needs_change(verdict: Verdict) -> bool:
    """Return True if the grade or the coverage can be better. A good and complete result needs no change."""
    coverage = verdict.coverage
    return verdict.grade > Grade.GOOD or coverage is None or bool(coverage.advice)


def _person(merge: MergeResult) -> dict[str, Any]:
    """Return the pictogram, the shares of ticks in each state of each part, and how the rest is posed."""
    motion = merge.motion
    filled = filled_joints(merge)
    parts = []
    for name, values in part_states(motion).items():
        measured, partly = float((values == 2).mean()), float((values == 1).mean())
        state = PartState.MEASURED if measured >= _WHOLE_SHARE else PartState.PARTLY
        if measured + partly <= 1.0 - _WHOLE_SHARE:
            is_filled = filled[[role in BODY_PARTS[name] for role in motion.skeleton.roles]].all()
            state = PartState.FILLED if is_filled else PartState.UNMEASURED
        parts.append({"name": name, "measured": measured, "partly": partly, "state": state})
    states = {part["name"]: part["state"] for part in parts}
    seen = (PartState.MEASURED, PartState.PARTLY)
    return {
        "pictogram": draw_pictogram(motion, filled),
        "parts": parts,
        "filled": [part["name"] for part in parts if part["state"] == PartState.FILLED],
        "unmeasured": [part["name"] for part in parts if part["state"] == PartState.UNMEASURED],
        "sure_steps": _share_of_sure_steps(merge),
        "one_block": states.get("chest") in seen and states.get("pelvis") not in seen,
    }


def _share_of_sure_steps(merge: MergeResult) -> float | None:
    """Return the share of ticks at which the motion determines the filled steps; None without filled legs."""
    fill = merge.fill
    if fill is None or not fill.standing.any():
        return None
    return float(fill.is_sure.mean())


def _motion_curves(inputs: ReportInputs, budget: PageBudget) -> str:
    """Draw the joint angles and foot contacts of the body; "" without a body."""
    merge = inputs.merge
    if merge is None:
        return ""
    take = Take(name=inputs.name, motion=merge.motion, start_s=merge.motion.start_ns / 1e9)
    times = take.times_s()
    return draw_motion_curves([take], (float(times[0]), float(times[-1])), budget.share)


def _progress_at_failure(inputs: ReportInputs) -> str:
    stage = str((inputs.failure or {}).get("stage", ""))
    return _PROGRESS_AT_FAILURE.get(stage, "")


def _cameras(
    inputs: ReportInputs, losses: Sequence[DiagnosedLoss], colours: dict[str, str], budget: PageBudget
) -> list[dict[str, Any]]:
    """Return the content of each camera's section."""
    span = _time_span(inputs)
    causes = count_frames_by_cause(losses)
    used = _cameras_of_body(inputs)
    sections = []
    if budget.share < 1.0:
        budget.record("points of each curve over time", column_count(budget.share), MAX_COLUMNS)
    for name in inputs.cameras:
        camera_losses = [diagnosed.loss for diagnosed in losses if diagnosed.loss.camera == name]
        path = inputs.path(name)
        sections.append(
            {
                "name": name,
                "tone": colours[name],
                "timeline": draw_camera_timeline(
                    inputs, name, span, camera_losses, inputs.max_gap_s if name in used else 0.0, budget.share
                ),
                "frames": 0 if path is None else len(path.status),
                "registered": 0 if path is None else int(path.registered.sum()),
                "losses": len(camera_losses),
                "notes": () if inputs.capture is None else inputs.capture.camera(name).notes,
                "causes": [(cause.value, frames) for cause, frames in causes.get(name, {}).items()],
            }
        )
    return sections


def _missing(
    inputs: ReportInputs, losses: Sequence[DiagnosedLoss], colours: dict[str, str]
) -> dict[str, Any]:
    """Return a bar of the poses over time for each camera, and the longest lost intervals with their causes.

    Empty if no frame is lost.
    """
    if not losses:
        return {}
    span, used = _time_span(inputs), _cameras_of_body(inputs)
    bars = []
    for name in inputs.cameras:
        path = inputs.path(name)
        if path is not None and len(path.times_ns):
            own = [diagnosed.loss for diagnosed in losses if diagnosed.loss.camera == name]
            times_s = common_times_s(inputs, name, path.times_ns)
            bridged_s = inputs.max_gap_s if name in used else 0.0
            bars.append(
                {
                    "name": name,
                    "tone": colours[name],
                    "share": float(path.registered.mean()),
                    "bar": draw_coverage(path, times_s, span, own, bridged_s),
                }
            )
    longest = sorted(losses, key=lambda diagnosed: -diagnosed.loss.frame_count)[:_LISTED_LOSSES]
    return {
        "bars": bars,
        "start": _clock_text(span[0]),
        "end": _clock_text(span[1]),
        "more": len(losses) - len(longest),
        "other": any(each.cause is LossCause.OTHER_MAP for each in losses),
        "turn": any(each.cause is LossCause.ROTATION_ONLY for each in losses),
        "intervals": [
            {
                "time": f"{_clock_text(each.loss.start_s)} to {_clock_text(each.loss.end_s)}",
                "camera": each.loss.camera,
                "frames": each.loss.frame_count,
                "cause": each.cause.value,
            }
            for each in sorted(longest, key=lambda each: (each.loss.start_s, each.loss.camera))
        ],
    }


def _clock_text(time_s: float) -> str:
    """Return a time as minutes, seconds and tenths: 1:02.5."""
    tenths = round(10 * time_s)
    return f"{'-' if tenths < 0 else ''}{abs(tenths) // 600}:{abs(tenths) % 600 / 10:04.1f}"


def _cameras_of_body(inputs: ReportInputs) -> set[str]:
    """Return the names of the cameras whose gaps the motion of the body bridges."""
    return set() if inputs.merge is None else {mount.camera for mount in inputs.merge.mounts}


def _time_span(inputs: ReportInputs) -> tuple[float, float]:
    """Return the earliest and the latest common time (seconds) of the frames of all cameras."""
    ends: list[float] = []
    for name in inputs.cameras:
        path = inputs.path(name)
        if path is not None and len(path.times_ns):
            times = common_times_s(inputs, name, path.times_ns)
            ends += [float(times[0]), float(times[-1])]
        elif inputs.capture is not None:
            common = inputs.capture.camera(name).common_times_ns() * 1e-9
            ends += [float(common[0]), float(common[-1])] if len(common) else []
    return (min(ends), max(ends)) if ends else (0.0, 1.0)


def _lost_pictures(losses: Sequence[DiagnosedLoss], most: int) -> list[dict[str, Any]]:
    """Return the longest lost intervals that have a picture, sorted by start time.

    Args:
        losses: The lost intervals of all cameras.
        most: Maximum number of intervals to return.
    """
    with_picture = sorted(
        (diagnosed for diagnosed in losses if diagnosed.appearance is not None),
        key=lambda diagnosed: -diagnosed.loss.frame_count,
    )
    chosen = sorted(
        with_picture[:most], key=lambda diagnosed: (diagnosed.loss.start_s, diagnosed.loss.camera)
    )
    return [
        {
            "camera": diagnosed.loss.camera,
            "start": diagnosed.loss.start_s,
            "frames": diagnosed.loss.frame_count,
            "reason": diagnosed.loss.reason.value,
            "cause": diagnosed.cause.value,
            "facts": _facts(diagnosed),
            "picture": diagnosed.appearance.picture,
        }
        for diagnosed in chosen
        if diagnosed.appearance is not None
    ]


def _facts(diagnosed: DiagnosedLoss) -> str:
    parts = []
    if np.isfinite(diagnosed.loss.sharpness):
        parts.append(f"sharpness {format_percent(diagnosed.loss.sharpness)}")
    if np.isfinite(diagnosed.loss.turn_deg):
        parts.append(f"turned {diagnosed.loss.turn_deg:.0f}° per frame")
    if diagnosed.appearance is not None:
        parts.append(f"{diagnosed.appearance.corners} corners")
    return ", ".join(parts)


def _distances_before_optimisation(inputs: ReportInputs) -> list[dict[str, Any]]:
    """Return how far the optimisation moved the joint of each bone with a camera.

    Before the optimisation, only the poses and the assumed mount of the bone's camera determine the joint's
    position. The distance from this position to the solved position is computed for each tick.

    Returns:
        An entry for each bone, with the median and the 95th percentile of the distance, metres.
    """
    merge = inputs.merge
    if merge is None:
        return []
    rows = []
    world_from_joint = merge.motion.world_from_joint()
    for bone in find_unoptimised_bones(inputs):
        distances = bone.distance_m(world_from_joint)
        rows.append(
            {
                "camera": bone.camera,
                "joint": merge.skeleton.joints[bone.joint],
                "median": float(np.median(distances)),
                "high": float(np.percentile(distances, 95)),
            }
        )
    return rows
