"""Cameras beside each other: on one body, and on one bone of it."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

from bodycap_batch.core.percent import format_percent
from bodycap_batch.model.relative_pose import MIN_INSTANTS
from bodycap_batch.model.skeleton_presets import split_side
from bodycap_batch.report.grades import Criterion, Grade, graded

_TWISTS = "ForeArm"
"""A bone that is turned along its length: a camera at the wrist turns against one near the elbow."""


def of_reach(reach: Mapping[str, Any] | None, unused: Collection[str]) -> Iterator[Criterion]:
    """Distances between cameras against the body's reach; None without a body, whose reach is unknown then.

    A share too small to judge single keyframes by is a finding all the same; too few distances are none.

    Args:
        reach: What the map was checked for.
        unused: Cameras that turned out to be no part of the body; they were counted.
    """
    if not reach or "within_reach" not in reach:
        return
    share = float(reach["within_reach"])
    grade = graded(share, 0.98, 0.9, more_is_better=True)
    doubt = "" if reach["judged"] else " at most, whatever the scale"
    if unused and grade is not Grade.GOOD:
        grade = Grade.FAIR
        doubt += f", those of {' and '.join(sorted(unused))} among them, which no body was found to carry"
    elif not reach["judged"]:
        doubt += ": body, clocks or map do not suit each other"
    yield Criterion(
        about="cameras",
        name="Cameras within the body's reach",
        grade=grade,
        says=f"{format_percent(share, 1)} of {reach['distances']:,} distances between cameras{doubt}",
        why="Cameras on one body cannot be further apart than it reaches: a map folded over two places "
        "that look alike shows here although its error in pixels is small.",
        metric="mapping.reach.within_reach",
        value=share,
    )


def of_shared_segments(
    relative: Sequence[Mapping[str, Any]], mounts: Mapping[str, Mapping[str, Any]], unused: Collection[str]
) -> Iterator[Criterion]:
    """Cameras on one bone beside each other; without enough common frames nothing is known of them.

    Args:
        relative: One pair each, as ``relative_poses`` of ``metrics.json`` tells them.
        mounts: By camera, with the ``role`` of the bone.
        unused: Cameras that turned out to be no part of the body.
    """
    found = []
    for each in relative:
        if each["instants"] < MIN_INSTANTS or each["spread_deg"] is None or {*each["cameras"]} & {*unused}:
            continue
        beyond = _unexplained_deg(each)
        roles = {split_side(mounts[name]["role"])[1] for name in each["cameras"] if name in mounts}
        grade = graded(beyond, 2.0, 6.0)
        found.append((min(grade, Grade.FAIR) if _TWISTS in roles else grade, beyond, each))
    grade, beyond, worst = max(found, key=lambda one: one[:2], default=(Grade.GOOD, 0.0, None))
    if worst is not None:
        noise = float(worst["explained_deg"] or 0.0)
        yield Criterion(
            about="cameras",
            name="Cameras on one bone",
            grade=grade,
            says=f"{' and '.join(worst['cameras'])} are turned by {worst['spread_deg']:.1f}° against their "
            f"usual places (median of {worst['instants']:,} frames); their poses' noise makes {noise:.1f}°",
            why="They keep their places beside each other, but for soft straps and a forearm's twist. Where "
            "more than noise turns them, one has come loose, or a clock is off (offset_s): 0.4 s made 5° of "
            "a camera that was moved slowly. Up to 2° beyond noise are good, more than 6° poor.",
            value=beyond,
        )


def _unexplained_deg(pair: Mapping[str, Any]) -> float:
    """What the poses' noise leaves of a pair's spread; nothing where the two are in step, as a rig's are."""
    if pair["rigid"]:
        return 0.0
    return math.sqrt(max(0.0, pair["spread_deg"] ** 2 - (pair["explained_deg"] or 0.0) ** 2))
