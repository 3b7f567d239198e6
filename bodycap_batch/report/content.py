"""Collect the content of the page, section by section. The templates only arrange this content."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.model.measured_parts import BODY_PARTS, PartState, overall_state, part_states
from bodycap_batch.model.merge_data import MergeResult, filled_joints
from bodycap_batch.report.advice import recommend_changes
from bodycap_batch.report.drawn_scene import DrawnScene, common_times_s
from bodycap_batch.report.figures.before_after import draw_before_and_after, find_unoptimised_bones
from bodycap_batch.report.figures.camera_landmark_matrix import draw_camera_landmark_matrix
from bodycap_batch.report.figures.camera_timeline import draw_camera_timeline, draw_coverage
from bodycap_batch.report.figures.motion_curves import Take, draw_motion_curves
from bodycap_batch.report.figures.pictogram import draw_pictogram
from bodycap_batch.report.figures.shared_landmarks import draw_shared_landmarks
from bodycap_batch.report.figures.time_axis import MAX_COLUMNS, Span, column_count
from bodycap_batch.report.frame_losses import MAX_LOSS_PICTURES
from bodycap_batch.report.grades import Grade
from bodycap_batch.report.loss_causes import CAUSES, LossCause, LostSpan
from bodycap_batch.report.metric_tables import headline_figures, make_tables
from bodycap_batch.report.packing import PageBudget
from bodycap_batch.report.report_inputs import ReportInputs
from bodycap_batch.report.result_links import describe_files
from bodycap_batch.report.verdict import Verdict

_LISTED_LOSSES = 6
"""Maximum number of lost intervals in the list below the verdict: it fits on the screen of a phone."""
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
    losses: Sequence[LostSpan],
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
    merge, capture = inputs.merge, inputs.capture
    span_s = _time_span(inputs)
    return {
        "name": inputs.name,
        "person": None if merge is None else _person(merge),
        "curves": "" if merge is None else _motion_curves(inputs.name, merge, budget),
        "files": describe_files(inputs.files),
        "left_out": (inputs.metrics or {}).get("left_out", ()),
        "verdict": verdict,
        "grades": Grade,
        "failure": inputs.failure,
        "progress": _PROGRESS_AT_FAILURE.get(str((inputs.failure or {}).get("stage", "")), ""),
        "figures": list(headline_figures(inputs.metrics)) if inputs.metrics is not None else [],
        "recommendations": recommend_changes(inputs, verdict) if _needs_change(verdict) else [],
        "tables": make_tables(inputs),
        "scene": scene,
        "places": {name: place.replace("_", " ") for name, place in inputs.places_from_motion.items()},
        "has_viewer": scene.has_content,
        "has_shade": capture is not None and not all(camera.shows_only_room for camera in capture.cameras),
        "has_body": merge is not None,
        "cameras": _cameras(inputs, losses, span_s, colours, budget),
        "has_slips": merge is not None and any(mount.slip is not None for mount in merge.mounts),
        "span_s": span_s,
        "losses": losses,
        "longest_losses": _longest(losses, _LISTED_LOSSES),
        "loss_kinds": {loss.cause for loss in losses},
        "loss_causes": LossCause,
        "causes": {cause.value: rule for cause, (rule, _) in CAUSES.items()},
        "lost_pictures": _longest(
            [loss for loss in losses if loss.appearance is not None], budget.scaled(MAX_LOSS_PICTURES)
        ),
        "matrix": draw_camera_landmark_matrix(inputs, colours, budget.share),
        "shared": draw_shared_landmarks(inputs),
        "bodies": draw_before_and_after(inputs, colours),
        "before": _distances_before_optimisation(inputs),
        "thinned": budget.thinned_lines(),
    }


def _longest(losses: Sequence[LostSpan], most: int) -> list[LostSpan]:
    """Return the longest lost spans, at most `most` of them, in the order of time."""
    longest = sorted(losses, key=lambda loss: -loss.frames)[:most]
    return sorted(longest, key=lambda loss: (loss.from_s, loss.camera))


def _needs_change(verdict: Verdict) -> bool:
    """Return True if the grade or the coverage can be better. A good and complete result needs no change."""
    coverage = verdict.coverage
    return verdict.grade > Grade.GOOD or coverage is None or bool(coverage.advice)


def _person(merge: MergeResult) -> dict[str, Any]:
    """Return the pictogram, the shares of ticks in each state of each part, and how the rest is posed."""
    motion, filled, fill = merge.motion, filled_joints(merge), merge.fill
    parts: dict[str, dict[str, Any]] = {}
    for name, values in part_states(motion).items():
        measured, partly = float((values == 2).mean()), float((values == 1).mean())
        is_filled = bool(filled[[role in BODY_PARTS[name] for role in motion.skeleton.roles]].all())
        state = overall_state(measured, measured + partly, is_filled=is_filled)
        parts[name] = {"name": name, "measured": measured, "partly": partly, "state": state}

    def named(*states: PartState) -> list[str]:
        return [name for name, part in parts.items() if part["state"] in states]

    seen = named(PartState.MEASURED, PartState.PARTLY)
    return {
        "pictogram": draw_pictogram(motion, filled),
        "parts": parts.values(),
        "filled": named(PartState.FILLED),
        "unmeasured": named(PartState.UNMEASURED),
        # the share of ticks at which the motion determines the filled steps; None without filled legs
        "sure_steps": None if fill is None or not fill.standing.any() else float(fill.is_sure.mean()),
        "one_block": "chest" in seen and "pelvis" not in seen,
    }


def _motion_curves(name: str, merge: MergeResult, budget: PageBudget) -> str:
    """Draw the joint angles and foot contacts of the body."""
    take = Take(name=name, motion=merge.motion, start_s=merge.motion.start_ns / 1e9)
    times = take.times_s()
    return draw_motion_curves([take], (float(times[0]), float(times[-1])), budget.share)


def _cameras(
    inputs: ReportInputs,
    losses: Sequence[LostSpan],
    span_s: Span,
    colours: dict[str, str],
    budget: PageBudget,
) -> list[dict[str, Any]]:
    """Return the content of each camera's section, and its bar of the poses over time."""
    in_body = set() if inputs.merge is None else {mount.camera for mount in inputs.merge.mounts}
    sections = []
    if budget.share < 1.0:
        budget.record("points of each curve over time", column_count(budget.share), MAX_COLUMNS)
    for name in inputs.cameras:
        own = [loss for loss in losses if loss.camera == name]
        bridged_s = inputs.max_gap_s if name in in_body else 0.0
        path = inputs.path(name)
        bar = ""
        registered: BoolArray = np.zeros(0, dtype=np.bool_)
        if path is not None and len(path.times_ns):
            bar = draw_coverage(path, common_times_s(inputs, name, path.times_ns), span_s, own, bridged_s)
            registered = path.registered
        frames_by_cause: Counter[str] = Counter()
        for loss in own:
            frames_by_cause[loss.cause.value] += loss.frames
        sections.append(
            {
                "name": name,
                "tone": colours[name],
                "timeline": draw_camera_timeline(inputs, name, span_s, own, bridged_s, budget.share),
                "bar": bar,
                "frames": len(registered),
                "registered": int(registered.sum()),
                "losses": len(own),
                "notes": () if inputs.capture is None else inputs.capture.camera(name).notes,
                "causes": frames_by_cause,
            }
        )
    return sections


def _time_span(inputs: ReportInputs) -> Span:
    """Return the earliest and the latest common time (seconds) of the frames of all cameras."""
    ends: list[float] = []
    for name in inputs.cameras:
        path = inputs.path(name)
        times: FloatArray = np.zeros(0)
        if path is not None and len(path.times_ns):
            times = common_times_s(inputs, name, path.times_ns)
        elif inputs.capture is not None:
            times = np.asarray(inputs.capture.camera(name).common_times_ns() * 1e-9, dtype=np.float64)
        ends += times[[0, -1]].tolist() if len(times) else []
    return (min(ends), max(ends)) if ends else (0.0, 1.0)


def _distances_before_optimisation(inputs: ReportInputs) -> list[dict[str, Any]]:
    """Return how far the optimisation moved the joint of each bone with a camera.

    Before the optimisation, only the poses and the assumed mount of the bone's camera determine the joint's
    position. The distance from this position to the solved position is computed for each tick.

    Returns:
        An entry for each bone, with the median and the 95th percentile of the distance, metres.
    """
    if inputs.merge is None:
        return []
    world_from_joint, joints = inputs.merge.motion.world_from_joint(), inputs.merge.skeleton.joints
    rows = []
    for bone in find_unoptimised_bones(inputs):
        median, high = np.percentile(bone.distance_m(world_from_joint), [50, 95]).tolist()
        rows.append({"camera": bone.camera, "joint": joints[bone.joint], "median": median, "high": high})
    return rows
