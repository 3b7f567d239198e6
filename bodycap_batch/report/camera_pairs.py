"""Criteria about two cameras: the distance between the cameras, and their relative rotation on one bone."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

from bodycap_batch.core.percent import format_percent
from bodycap_batch.model.relative_pose import MIN_INSTANTS
from bodycap_batch.model.skeleton_presets import split_side
from bodycap_batch.report.grades import Criterion, Grade, grade_value

_TWISTING_SEGMENT = "ForeArm"
"""Name of the segment that twists along its length.

A camera at the wrist therefore rotates relative to a camera near the elbow.
"""
_GOOD_REACH_SHARE, _FAIR_REACH_SHARE = 0.98, 0.9
"""Minimum fraction of the distances between cameras that are within the body's reach.

The first value is for the grade "good", the second value is for "usable with care". Evidence: none.
"""
_GOOD_UNEXPLAINED_DEG, _FAIR_UNEXPLAINED_DEG = 2.0, 6.0
"""Maximum relative rotation (degrees) of two cameras that the poses' noise does not explain.

The first value is for the grade "good", the second value is for "usable with care". Evidence:
docs/decisions/report.md.
"""


def distance_criteria(reach: Mapping[str, Any] | None, unused: Collection[str]) -> Iterator[Criterion]:
    """Yield the criterion about distances between cameras compared with the body's reach.

    Nothing is yielded if there is no body, because the reach is then unknown. Nothing is yielded if there are
    too few distances. If the fraction is too small to judge single keyframes, the finding says so.

    Args:
        reach: Result of the map's distance check; None if the distances were not checked.
        unused: Names of the cameras that are not part of the body. The fraction includes their distances.
    """
    if not reach or "within_reach" not in reach:
        return
    share = float(reach["within_reach"])
    grade = grade_value(share, _GOOD_REACH_SHARE, _FAIR_REACH_SHARE, more_is_better=True)
    doubt = "" if reach["judged"] else ", even with the best scale"
    if unused and grade is not Grade.GOOD:
        grade = Grade.FAIR
        doubt += f", including cameras that are not part of the body ({' and '.join(sorted(unused))})"
    elif not reach["judged"]:
        doubt += "; the body, the clocks or the map are wrong"
    yield Criterion(
        subject="cameras",
        name="Distances between cameras",
        grade=grade,
        finding=f"{format_percent(share, 1)} of {reach['distances']:,} distances between cameras are "
        f"possible on one body{doubt}",
        rationale="Cameras on one body cannot be farther apart than the body reaches. A small share shows "
        "that the map merges two similar places, even if the map's error in pixels is small.",
        metric="mapping.reach.within_reach",
        value=share,
    )


def shared_segment_criteria(
    relative_poses: Sequence[Mapping[str, Any]],
    mounts: Mapping[str, Mapping[str, Any]],
    unused: Collection[str],
) -> Iterator[Criterion]:
    """Yield the criterion about cameras on one bone.

    A pair of cameras with too few common frames is ignored. Nothing is yielded if no pair remains.

    Args:
        relative_poses: One entry for each pair of cameras, as in ``relative_poses`` of ``metrics.json``.
        mounts: Mount of each camera, by camera name; it holds the ``role`` of the bone.
        unused: Names of the cameras that are not part of the body.
    """
    found = []
    for pair in relative_poses:
        if pair["instants"] < MIN_INSTANTS or pair["spread_deg"] is None or {*pair["cameras"]} & {*unused}:
            continue
        unexplained_deg = _unexplained_spread_deg(pair)
        roles = {split_side(mounts[name]["role"])[1] for name in pair["cameras"] if name in mounts}
        grade = grade_value(unexplained_deg, _GOOD_UNEXPLAINED_DEG, _FAIR_UNEXPLAINED_DEG)
        if _TWISTING_SEGMENT in roles:
            grade = min(grade, Grade.FAIR)
        found.append((grade, unexplained_deg, pair))
    grade, unexplained_deg, worst = max(found, key=lambda entry: entry[:2], default=(Grade.GOOD, 0.0, None))
    if worst is not None:
        noise = float(worst["explained_deg"] or 0.0)
        yield Criterion(
            subject="cameras",
            name="Cameras on one bone",
            grade=grade,
            finding=f"{' and '.join(worst['cameras'])} are turned by {worst['spread_deg']:.1f}° relative to "
            f"their usual positions (median of {worst['instants']:,} frames); the noise of their poses "
            f"explains {noise:.1f}°",
            rationale="Cameras on one bone keep their relative position, except if their straps are soft "
            "or the forearm twists. If these cameras turn by more than the noise of their poses, one "
            "camera is loose or a clock is wrong (offset_s): a clock error of 0.4 s turned a slowly "
            "moving camera by 5°. Up to 2° more than the noise is good; more than 6° is poor.",
            value=unexplained_deg,
        )


def _unexplained_spread_deg(pair: Mapping[str, Any]) -> float:
    """Return the part of a pair's spread (degrees) that the poses' noise does not explain.

    For two cameras that are mounted rigidly, this part is zero.
    """
    if pair["rigid"]:
        return 0.0
    return math.sqrt(max(0.0, pair["spread_deg"] ** 2 - (pair["explained_deg"] or 0.0) ** 2))
