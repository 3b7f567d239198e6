"""Judge the result of a job: grade each criterion by bounds. The page gives the reason for the bounds."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from bodycap_batch.core.percent import format_percent
from bodycap_batch.model.camera_clock import ESTIMATED_SOURCES
from bodycap_batch.model.map_diagnostics import MapDiagnostics
from bodycap_batch.report.body_doubts import body_doubt_criteria
from bodycap_batch.report.camera_pairs import distance_criteria, shared_segment_criteria
from bodycap_batch.report.grades import Criterion, Grade, grade_value
from bodycap_batch.report.metric_paths import metric_path

_GOOD_ERROR_PX, _FAIR_ERROR_PX = 1.0, 2.0
"""Maximum mean reprojection error (pixels) for the grades "good" and "usable with care".

With sharp corners and correct intrinsics the error is less than one pixel.
"""
_GOOD_COVERAGE, _FAIR_COVERAGE = 0.98, 0.85
"""Minimum fraction of registered frames of all cameras for the grades "good" and "usable with care".

The `rationale` of the criterion gives the reason.
"""
_GOOD_CAMERA_COVERAGE, _FAIR_CAMERA_COVERAGE = 0.95, 0.75
"""Minimum fraction of registered frames of the worst camera for the grades "good" and "usable with care".

Evidence: none.
"""
_FAIR_FOCAL_ERROR = 0.1
"""Maximum relative error of a focal length for the grade "usable with care".

Evidence: docs/decisions/report.md.
"""
_GOOD_SCALE_SIGMA, _FAIR_SCALE_SIGMA = 0.025, 0.10
"""Maximum relative sigma of the metric scale for the grades "good" and "usable with care".

The `rationale` of the criterion gives the reason.
"""
_BODY_HEIGHT_M = 1.7
"""Body height (metres) with which an error of the scale is shown. Source: `MEAN_HEIGHT_M`."""
_GOOD_RESIDUAL_M, _FAIR_RESIDUAL_M = 0.01, 0.03
"""Maximum 95th percentile (metres) of two distances for the grades "good" and "usable with care".

The first distance is the residual of a camera. The second distance is the distance between bones at a joint.
The `rationale` of each criterion gives the reason.
"""
_GOOD_GAP_S, FAIR_GAP_S = 0.2, 0.6
"""Maximum time (seconds) without a measurement for the grades "good" and "usable with care".

The `rationale` of the criterion gives the reason.
"""
GOOD_MOUNT_DEG, _FAIR_MOUNT_DEG = 4.0, 12.0
"""Maximum sigma (degrees) of a mount's rotation for the grades "good" and "usable with care".

The `rationale` of the criterion gives the reason.
"""
_GOOD_CLOCK_S, _FAIR_CLOCK_S = 0.010, 0.040
"""Maximum sigma (seconds) of an estimated clock offset for the grades "good" and "usable with care".

The `rationale` of the criterion gives the reason.
"""
_GOOD_OBSERVED_SHARE, _FAIR_OBSERVED_SHARE = 0.95, 0.8
"""Minimum fraction of the time in which a joint is measured for the grades "good" and "usable with care".

Evidence: none.
"""
_GOOD_MISPLACED_SHARE, _FAIR_MISPLACED_SHARE = 0.02, 0.1
"""Maximum fraction of the keyframes of the worst camera that contradict the map, for the grades "good" and
"usable with care".

Evidence: docs/decisions/report.md.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """The judgement of a job's result, shown at the top of the page.

    Attributes:
        headline: The judgement in one sentence.
        grade: The worse of the two grades `cameras` and `body`.
        cameras: Grade of the camera paths and the map.
        body: Grade of the body's motion; None if the job asks for no body.
        criteria: All graded criteria.
    """

    headline: str
    grade: Grade
    cameras: Grade
    body: Grade | None
    criteria: tuple[Criterion, ...]


def judge(metrics: Mapping[str, Any] | None, failure: Mapping[str, Any] | None) -> Verdict:
    """Grade the result of a job by the job's own metrics.

    Args:
        metrics: The content of ``metrics.json``; None if the job has no metrics.
        failure: The error that stopped the job; None if the job finished.
    """
    criteria = () if metrics is None else tuple(_criteria(metrics))
    cameras = _worst_grade(criteria, "cameras") if metrics is not None else Grade.NONE
    body = _worst_grade(criteria, "body") if metrics is not None and "merge" in metrics else None
    if failure is not None and body is None:
        body = Grade.NONE
    grade = max(cameras, Grade.GOOD if body is None else body)
    return Verdict(
        headline=_headline(cameras, body, metrics, failure),
        grade=grade,
        cameras=cameras,
        body=body,
        criteria=criteria,
    )


def _worst_grade(criteria: tuple[Criterion, ...], subject: str) -> Grade:
    return max(
        (criterion.grade for criterion in criteria if criterion.subject == subject), default=Grade.NONE
    )


def _headline(
    cameras: Grade, body: Grade | None, metrics: Mapping[str, Any] | None, failure: Mapping[str, Any] | None
) -> str:
    if metrics is None:
        return "The job stopped before there was a result."
    camera_phrases = (
        "are tracked well",
        "are tracked, with gaps or uncertain parts",
        "are tracked poorly",
        "are not tracked",
    )
    first = f"The cameras {camera_phrases[cameras]}"
    elsewhere = cameras_in_own_maps(metrics)
    unknown = unknown_clocks(metrics)
    first = "".join(
        (
            _unknown_clock_sentence([name for name in unknown if name not in elsewhere]),
            _other_place_sentence([name for name in unknown if name in elsewhere]),
            first,
        )
    )
    if failure is not None:
        return f"{first}; the body could not be solved."
    if body is None:
        return f"{first}. The job asked for no body."
    conjunction = "and" if (body == Grade.GOOD) == (cameras == Grade.GOOD) else "but"
    body_phrases = (
        "the motion is good",
        "the motion is usable with care",
        "the motion is poor",
        "there is no motion",
    )
    return f"{first}, {conjunction} {body_phrases[body]}."


def _unknown_clock_sentence(names: Sequence[str]) -> str:
    if not names:
        return ""
    clocks, them = ("clock", "it") if len(names) == 1 else ("clocks", "them")
    return (
        f"The {clocks} of {' and '.join(names)} {'is' if len(names) == 1 else 'are'} unknown, so the body is "
        f"solved without {them}: clap once, or hop once, while all cameras record. "
    )


def _other_place_sentence(names: Sequence[str]) -> str:
    """Return a sentence about cameras with an unknown clock that have a map of their own."""
    if not names:
        return ""
    videos, them = ("the video is", "it") if len(names) == 1 else ("the videos are", "them")
    return (
        f"The map of {' and '.join(names)} has no place in common with the other cameras, and the clock is "
        f"unknown, so the body is solved without {them}: check that {videos} of this recording, let all "
        "cameras see the same places, and clap once while they record. "
    )


def cameras_in_own_maps(metrics: Mapping[str, Any]) -> set[str]:
    """Return the names of the cameras whose map is not the main map.

    Args:
        metrics: The content of ``metrics.json``.
    """
    frames = {model["frame"] for model in metrics.get("models", ())} - {metrics["frame"]}
    return {name for name, camera in metrics["cameras"].items() if camera["frame"] in frames}


def unknown_clocks(metrics: Mapping[str, Any]) -> list[str]:
    """Return the names of the cameras with an unknown clock.

    Args:
        metrics: The content of ``metrics.json``.
    """
    clocks = metrics.get("clocks", {})
    return sorted(name for name, clock in clocks.items() if clock["source"] == "none")


def _criteria(metrics: Mapping[str, Any]) -> Iterator[Criterion]:
    yield from _frame_criteria(metrics)
    yield from _frozen_criteria(metrics["cameras"])
    yield from _map_criteria(metrics)
    if "merge" in metrics:
        yield from _body_criteria(metrics["merge"])
        yield from _clock_criteria(metrics)
        yield from _observed_time_criteria(metrics.get("motion", {}).get("joints", {}))


def _frame_criteria(metrics: Mapping[str, Any]) -> Iterator[Criterion]:
    total = metrics["total"]
    share = float(total["coverage"])
    yield Criterion(
        subject="cameras",
        name="Frames registered",
        grade=grade_value(share, _GOOD_COVERAGE, _FAIR_COVERAGE, more_is_better=True)
        if share > 0.0
        else Grade.NONE,
        finding=f"{total['frames_registered']:,} of {total['frames']:,} frames ({format_percent(share, 1)})",
        rationale="At 98 % or more, only short moments are missing, and the smoothness of the motion "
        "bridges these moments. Below 85 %, more than one frame in seven has no measurement.",
        metric="total.coverage",
        value=share,
    )
    name, worst = min(metrics["cameras"].items(), key=lambda item: item[1]["coverage"], default=("", None))
    if worst is not None and len(metrics["cameras"]) > 1:
        share = float(worst["coverage"])
        yield Criterion(
            subject="cameras",
            name="The worst camera",
            grade=grade_value(share, _GOOD_CAMERA_COVERAGE, _FAIR_CAMERA_COVERAGE, more_is_better=True),
            finding=f"{name}: {worst['frames_registered']:,} of {worst['frames']:,} frames "
            f"({format_percent(share, 1)})",
            rationale="An average over all cameras hides one bad camera. The motion of the limb with this "
            "camera is then bad as well.",
            metric=metric_path("cameras", name, "coverage"),
            value=share,
        )


def _frozen_criteria(cameras: Mapping[str, Mapping[str, Any]]) -> Iterator[Criterion]:
    """Yield the criterion about frozen parts of the videos, if there are any."""
    counts = {name: int(camera.get("status", {}).get("FROZEN", 0)) for name, camera in cameras.items()}
    name = max(counts, key=lambda name: counts[name], default=None)
    if name is None or not counts[name]:
        return
    share = counts[name] / max(int(cameras[name]["frames"]), 1)
    yield Criterion(
        subject="cameras",
        name="Frozen parts",
        grade=max(Grade.FAIR, grade_value(share, 0.0, 1.0 - _FAIR_CAMERA_COVERAGE)),
        finding=f"{name}: {counts[name]:,} frames repeat one picture although the camera moves",
        rationale="A recording that stops for a while often loses time as well: all later frames of this "
        "camera are then too early. Compare the picture with the other cameras after the frozen part.",
        metric=metric_path("cameras", name, "status", "FROZEN"),
        value=float(counts[name]),
    )


def _map_criteria(metrics: Mapping[str, Any]) -> Iterator[Criterion]:
    error = metrics["total"]["mean_reprojection_error_px"]
    if error is not None:
        yield Criterion(
            subject="cameras",
            name="Map error",
            grade=grade_value(float(error), _GOOD_ERROR_PX, _FAIR_ERROR_PX),
            finding=f"the mean reprojection error is {error:.2f} px",
            rationale="Sharp corners are located to about half a pixel. An error above one pixel comes from "
            "the lens, the shutter or blur; above two pixels the map does not fit the pictures. A low value "
            "alone does not prove that the map is right.",
            metric="total.mean_reprojection_error_px",
            value=float(error),
        )
    yield _one_map_criterion(metrics)
    mapping = MapDiagnostics.from_log(metrics.get("mapping", {}))
    yield from _misplaced_criteria(mapping.misplaced, metrics["cameras"])
    merge = metrics.get("merge", {})
    unused = merge.get("unused_cameras", {})
    yield from distance_criteria(mapping.reach, unused)
    yield from shared_segment_criteria(metrics.get("relative_poses", ()), merge.get("mounts", {}), unused)
    misfits, freed = mapping.misfit_factors or {}, mapping.recalibrated
    # A wrong camera model, such as a pinhole model for a wide lens, leaves a larger error than sharp corners
    # have. With such an error, lenses that were estimated together with the map are not treated as corrected.
    yield from _lens_criteria(misfits, freed if error is not None and float(error) <= _GOOD_ERROR_PX else ())


def _one_map_criterion(metrics: Mapping[str, Any]) -> Criterion:
    outside = {name for name, camera in metrics["cameras"].items() if camera["frame"] != metrics["frame"]}
    lost = {name for name, camera in metrics["cameras"].items() if not camera["frames_registered"]}
    unused = outside - lost - cameras_in_own_maps(metrics)
    joined = sorted(metrics.get("merge", {}).get("joined_cameras", {}))
    if outside or lost:
        findings = []
        if separate := (outside | lost) - unused:
            findings.append(f"these cameras are not in the main map: {', '.join(sorted(separate))}")
        if unused:
            findings.append(
                "these cameras are in the main map, but they are not part of the body, so their paths are "
                f"not given in metres: {', '.join(sorted(unused))}"
            )
        grade, finding = Grade.POOR, "; ".join(findings)
    elif joined:
        grade = Grade.FAIR
        finding = (
            "only the body's movement determines the positions of these cameras, because their map has no "
            f"place in common with the main map: {', '.join(joined)}"
        )
    else:
        grade, finding = Grade.GOOD, "all cameras are in one map"
    return Criterion(
        subject="cameras",
        name="One room",
        grade=grade,
        finding=finding,
        rationale="A camera outside the main map has no known position in the room. The body's motion does "
        "not use this camera, unless the body itself determines the camera's position. Such a position is "
        "less accurate.",
    )


def _misplaced_criteria(
    misplaced: Mapping[str, Collection[int]], cameras: Mapping[str, Mapping[str, Any]]
) -> Iterator[Criterion]:
    """Yield the criterion about parts of the map that were left out because they contradict the rest.

    Args:
        misplaced: Frame indices of the keyframes that were left out, by camera name.
        cameras: The metrics of each camera, by camera name.
    """
    shares = {
        name: len(frames) / (len(frames) + int(cameras[name]["keyframes"]))
        for name, frames in misplaced.items()
        if name in cameras and frames
    }
    name, worst = max(shares.items(), key=lambda item: item[1], default=("", None))
    if worst is None:
        return
    yield Criterion(
        subject="cameras",
        name="Parts that contradict the map",
        grade=grade_value(worst, _GOOD_MISPLACED_SHARE, _FAIR_MISPLACED_SHARE),
        finding=f"{name}: {_keyframes_that_contradict(misplaced[name], format_percent(worst, 1))}",
        rationale="The matches of these keyframes do not belong to common points: the part has another scale "
        "or another place. The poses of the frames near these keyframes can be wrong by decimetres, although "
        "their error in pixels is small.",
        value=worst,
    )


def _keyframes_that_contradict(frames: Collection[int], share: str) -> str:
    """Return the sentence about the keyframes that were left out, by their frame indices."""
    if len(frames) == 1:
        frame = min(frames)
        return f"one keyframe ({share}) contradicts the rest of the map and was left out (frame {frame})"
    return (
        f"{len(frames)} keyframes ({share}) contradict the rest of the map and were left out "
        f"(frames {min(frames)} to {max(frames)})"
    )


def _lens_criteria(misfits: Mapping[str, float], freed: Collection[str]) -> Iterator[Criterion]:
    """Yield the criterion about calibrations that the map contradicts.

    Args:
        misfits: Ratio of the focal length that fits the pictures to the given focal length, by camera name.
        freed: Names of the cameras whose intrinsics were estimated together with the map and now fit.
    """
    not_corrected = {name: factor for name, factor in misfits.items() if name not in freed}
    misfits = not_corrected or misfits
    name, worst = max(misfits.items(), key=lambda item: abs(item[1] - 1.0), default=("", None))
    if worst is not None:
        # The map can contradict a lens with a correct focal length. Therefore the grade is never "good".
        grade = (
            max(Grade.FAIR, grade_value(abs(worst - 1.0), 0.0, _FAIR_FOCAL_ERROR))
            if not_corrected
            else Grade.FAIR
        )
        yield Criterion(
            subject="cameras",
            name="Lenses fit the pictures",
            grade=grade,
            finding=f"{name}: the pictures fit {describe_lens_misfit(worst)} than the calibration "
            f"says{'' if not_corrected else '; therefore the lens was estimated together with the map'}",
            rationale="A wrong calibration bends the whole map, although the map's error in pixels is "
            "small. On a walk of 2 m, an error of 25 % in the focal length moved every camera by 9 cm; an "
            "image centre that was wrong by 9 % moved every camera by 16 cm.",
            metric=metric_path("mapping", "misfitting_lenses", name),
            value=float(worst),
        )


def describe_lens_misfit(factor: float) -> str:
    """Describe the lens that fits the pictures, compared with the given lens.

    Args:
        factor: Ratio of the focal length that fits the pictures to the given focal length. The ratio can be
            1 if only the principal point is wrong.
    """
    rounded_percent = round(100 * abs(factor - 1.0))
    if not rounded_percent:
        return "another lens"
    return f"a focal length {rounded_percent} % {'longer' if factor > 1.0 else 'shorter'}"


def _body_criteria(merge: Mapping[str, Any]) -> Iterator[Criterion]:
    if skeleton := merge.get("skeleton"):
        yield Criterion(
            subject="body",
            name="Skeleton file",
            grade=Grade.FAIR if skeleton["warnings"] else Grade.GOOD,
            finding="; ".join((*skeleton["warnings"], *skeleton["notes"])),
            rationale="All lengths of the body come from this file. If a joint, an axis or the unit of "
            "length is understood wrongly, the whole motion is wrong: by 28 to 46 cm on one walk.",
        )
    scale = merge.get("scale", {}).get("relative_sigma")
    if scale is not None:
        yield Criterion(
            subject="body",
            name="Metric scale",
            grade=grade_value(float(scale), _GOOD_SCALE_SIGMA, _FAIR_SCALE_SIGMA),
            finding=f"sizes are known to about {describe_scale_error(float(scale))}",
            rationale="An error of the scale changes all lengths by the same factor. 2.5 % is 1.5 cm for "
            "the length of an arm, about as much as all other errors together. 10 % is the difference "
            "between a short and a tall adult.",
            metric="merge.scale.relative_sigma",
            value=float(scale),
        )
    if still := merge.get("still_cameras"):
        yield Criterion(
            subject="body",
            name="Cameras that stand still",
            grade=Grade.POOR,
            finding="; ".join(
                f"{name} stands still in the room between {float(part['from_s']):.1f} s and "
                f"{float(part['to_s']):.1f} s while the person moves: it fell off or was put down, and this "
                "part is not used"
                for name, part in sorted(still.items())
            ),
            rationale="A camera that is not worn says nothing about its limb. On one walk, a palm's camera "
            "that lay still for the second half made all sizes wrong by 41 %.",
        )
    cameras = merge.get("cameras", {})
    yield from _gap_criteria(cameras)
    residuals = [float(camera["residual_m"]["p95"]) for camera in cameras.values()]
    if residuals:
        yield Criterion(
            subject="body",
            name="Distance between cameras and body",
            grade=grade_value(max(residuals), _GOOD_RESIDUAL_M, _FAIR_RESIDUAL_M),
            finding=f"{100 * max(residuals):.1f} cm for the worst camera (95th percentile)",
            rationale="This is the distance between a camera's position on the solved body and the same "
            "camera's position in the map. 1 cm is a few times the error of a camera's position. 3 cm is "
            "visible: a hand slides on the object that the hand holds.",
        )
    distances = [float(joint["p95"]) for joint in merge.get("joint_gap_m", {}).values()]
    if distances:
        yield Criterion(
            subject="body",
            name="Distance between bones at the joints",
            grade=grade_value(max(distances), _GOOD_RESIDUAL_M, _FAIR_RESIDUAL_M),
            finding=f"{1000 * max(distances):.1f} mm between the two bones at the worst joint (95th "
            "percentile)",
            rationale="If bones do not meet at their joint, a bone length, a mount or the scale is wrong.",
        )
    if merge.get("exchanged_sides"):
        yield Criterion(
            subject="body",
            name="Left and right",
            grade=Grade.POOR,
            finding=str(merge["exchanged_sides"]["says"]),
            rationale="If left and right are exchanged, no body fits the cameras: on one such walk, the "
            "metric scale was wrong by 62 %.",
        )
    if merge.get("inverted_cameras"):
        yield Criterion(
            subject="body",
            name="Cameras upside down",
            grade=Grade.FAIR,
            finding=str(merge["inverted_cameras"]["says"]),
            rationale="The body was solved with the cameras upside down. If they were mounted upright, its "
            "poses are wrong.",
        )
    yield from _mount_criteria(merge.get("mounts", {}))
    yield from body_doubt_criteria(merge)
    yield from _unused_camera_criteria(merge.get("unused_cameras", {}))


def describe_scale_error(relative_sigma: float) -> str:
    """Return the uncertainty of the metric scale in words, as a part of a body height.

    Args:
        relative_sigma: Relative standard deviation of the scale.
    """
    return f"± {100.0 * _BODY_HEIGHT_M * relative_sigma:.0f} cm of body height ({relative_sigma:.1%})"


def _gap_criteria(cameras: Mapping[str, Any]) -> Iterator[Criterion]:
    name, worst = max(cameras.items(), key=lambda item: item[1]["longest_gap_s"], default=("", None))
    if worst is None:
        return
    gap_s = float(worst["longest_gap_s"])
    yield Criterion(
        subject="body",
        name="Longest gap",
        grade=grade_value(gap_s, _GOOD_GAP_S, FAIR_GAP_S),
        finding=f"camera {name} has no measurement for {gap_s:.2f} s",
        rationale="An arm swings forward and back in about a second. The smoothness of the motion bridges a "
        "fifth of a second well. In more than half a second a whole swing can be missing. The time before a "
        "camera's first measurement and after its last measurement also counts as a gap.",
        metric=metric_path("merge", "cameras", name, "longest_gap_s"),
        value=gap_s,
    )


def _clock_criteria(metrics: Mapping[str, Any]) -> Iterator[Criterion]:
    """Yield the criterion about the clocks: unknown, contradicted, or estimated with an uncertainty."""
    clocks, notes = metrics.get("clocks", {}), metrics.get("clock_notes", {})
    names = (*unknown_clocks(metrics), *metrics.get("contradicted_clocks", ()))
    wrong = [f"{name}: {note}" for name in names for note in notes.get(name, ())]
    rationale = (
        "Half a second is half a step. If a camera's clock is wrong by half a second, the limb with this "
        "camera is half a step too early or too late. The metric scale is wrong too: by 28 % on a walk with "
        "two clocks that were wrong by 0.5 and 0.2 s. A hand that moves at 1 m/s is 1 cm off if its clock is "
        "10 ms off. Up to 10 ms is good; more than 40 ms, a frame of a cinema camera, is poor."
    )
    if wrong:
        yield Criterion(
            subject="body",
            name="One clock",
            grade=Grade.POOR,
            finding="; ".join(wrong),
            rationale=rationale,
        )
        return
    estimated = {name: clock for name, clock in clocks.items() if clock["source"] in ESTIMATED_SOURCES}
    name, worst = max(estimated.items(), key=lambda item: item[1]["sigma_s"], default=("", None))
    if worst is not None:
        sigma_s = float(worst["sigma_s"])
        yield Criterion(
            subject="body",
            name="One clock",
            grade=grade_value(sigma_s, _GOOD_CLOCK_S, _FAIR_CLOCK_S),
            finding=f"the clock of {name} is known to {1000 * sigma_s:.0f} ms, from the {worst['source']}",
            rationale=rationale,
            metric=metric_path("clocks", name, "sigma_s"),
            value=sigma_s,
        )


def _mount_criteria(mounts: Mapping[str, Any]) -> Iterator[Criterion]:
    name, worst = max(mounts.items(), key=lambda item: item[1]["sigma_deg"], default=("", None))
    if worst is None:
        return
    sigma = float(worst["sigma_deg"])
    yield Criterion(
        subject="body",
        name="Mounts",
        grade=grade_value(sigma, GOOD_MOUNT_DEG, _FAIR_MOUNT_DEG),
        finding=f"the worst mount ({name}) has an uncertainty of {sigma:.1f}° and "
        f"{100 * worst['sigma_m']:.1f} cm",
        rationale="If a mount is wrong, the bone that carries the camera is wrong by the same angle all the "
        "time. For comparison: an animator who turns a hand by eye makes an error of about 4°. Above 12°, a "
        "palm visibly faces the wrong way.",
        metric=metric_path("merge", "mounts", name, "sigma_deg"),
        value=sigma,
    )


def _unused_camera_criteria(unused: Mapping[str, Any]) -> Iterator[Criterion]:
    if unused:
        yield Criterion(
            subject="body",
            name="Unused cameras",
            grade=Grade.POOR,
            finding="; ".join(f"{name}: {reason}" for name, reason in sorted(unused.items())),
            rationale="The limbs with these cameras are inferred, not measured.",
        )


def _observed_time_criteria(joints: Mapping[str, Any]) -> Iterator[Criterion]:
    shares = {name: float(joint["observed_share"]) for name, joint in joints.items() if joint["observed"]}
    name, share = min(shares.items(), key=lambda item: item[1], default=("", None))
    if share is not None:
        yield Criterion(
            subject="body",
            name="Time measured",
            grade=grade_value(share, _GOOD_OBSERVED_SHARE, _FAIR_OBSERVED_SHARE, more_is_better=True),
            finding=f"the joint that was measured least ({name}) was measured in "
            f"{format_percent(share, 1)} of the motion",
            rationale="If a camera starts late, ends early or is lost for a long time, its limb is inferred. "
            "An average over all joints would hide such a limb.",
            metric=metric_path("motion", "joints", name, "observed_share"),
            value=share,
        )
