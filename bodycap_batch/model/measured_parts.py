"""Which parts of the body the cameras measured, over time."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise

import numpy as np

from bodycap_batch.core.arrays import BoolArray, IntArray
from bodycap_batch.model.skeleton import Motion

BODY_PARTS: dict[str, tuple[str, ...]] = {
    "head": ("Head",),
    "chest": ("Spine1",),
    "pelvis": ("Hips",),
    "left arm": ("LeftArm", "LeftForeArm", "LeftHand"),
    "right arm": ("RightArm", "RightForeArm", "RightHand"),
    "left leg": ("LeftUpLeg", "LeftLeg", "LeftFoot"),
    "right leg": ("RightUpLeg", "RightLeg", "RightFoot"),
}
"""Roles of the joints of each part of the body, by name of the part."""

_MIN_SPAN_S = 0.1
"""Seconds of a change of state that is not a span of its own. Evidence: none; nobody sees a shorter span."""

_WHOLE_SHARE = 0.95
"""Share of ticks from which a part counts as measured, or as not measured. Evidence: none."""


class PartState(StrEnum):
    """How much of a part of the body the cameras measured."""

    MEASURED = "measured"
    PARTLY = "partly measured"
    UNMEASURED = "not measured"
    FILLED = "filled with a plausible motion"


_STATES = (PartState.UNMEASURED, PartState.PARTLY, PartState.MEASURED)


@dataclass(frozen=True, slots=True, kw_only=True)
class PartSpan:
    """Successive ticks in which a part of the body has one state.

    Attributes:
        part: Name of the part, a key of `BODY_PARTS`.
        state: The state of the part.
        first: First tick.
        last: Last tick.
    """

    part: str
    state: PartState
    first: int
    last: int


class JointSource(StrEnum):
    """Where the motion of a joint comes from."""

    MEASURED = "measured"
    FILLED = "filled"


def joint_sources(motion: Motion) -> tuple[JointSource, ...]:
    """Return the source of each joint (J): measured if a camera measured it at any tick, else filled."""
    measured = np.any(motion.observed, axis=0).tolist()
    return tuple(JointSource.MEASURED if each else JointSource.FILLED for each in measured)


def filled_branches(motion: Motion) -> BoolArray:
    """Return which joints (J,) are filled and carry no measured joint: legs, neck and head without cameras.

    Their poses can change without any change of a measured joint.
    """
    carries = np.array(np.any(motion.observed, axis=0))
    parents = motion.skeleton.parents.tolist()
    for joint in range(len(parents) - 1, 0, -1):
        carries[parents[joint]] |= carries[joint]
    return np.asarray(~carries)


def part_states(motion: Motion) -> dict[str, IntArray]:
    """Return the state (T,) of each part of the body: 0 unmeasured, 1 partly measured, 2 measured.

    Parts without a joint in the skeleton are left out.
    """
    out: dict[str, IntArray] = {}
    for part, roles in BODY_PARTS.items():
        joints = [j for j, role in enumerate(motion.skeleton.roles) if role in roles]
        if joints:
            seen = motion.observed[:, joints]
            out[part] = np.asarray(seen.any(axis=1), dtype=np.int64) + seen.all(axis=1).astype(np.int64)
    return out


def overall_state(measured: float, seen: float, *, is_filled: bool) -> PartState:
    """Return the state of a part of the body, or of a joint, over the whole motion.

    Args:
        measured: Share of ticks at which all of it was measured.
        seen: Share of ticks at which some of it was measured.
        is_filled: True if it was filled with a plausible motion.
    """
    if measured >= _WHOLE_SHARE:
        return PartState.MEASURED
    if seen > 1.0 - _WHOLE_SHARE:
        return PartState.PARTLY
    return PartState.FILLED if is_filled else PartState.UNMEASURED


def part_spans(motion: Motion) -> list[PartSpan]:
    """Return the spans of all parts of the body, in the order of the parts and of time.

    A change of state for less than 0.1 s is counted to the span before it.
    """
    least = max(1, round(_MIN_SPAN_S * motion.fps))
    spans: list[PartSpan] = []
    for part, states in part_states(motion).items():
        bounds = [0, *(np.flatnonzero(np.diff(states)) + 1).tolist(), len(states)]
        runs = [[int(states[a]), a, b - 1] for a, b in pairwise(bounds) if b > a]
        kept: list[list[int]] = []
        for state, first, last in runs:
            if kept and (last - first + 1 < least or kept[-1][0] == state):
                kept[-1][2] = last
            else:
                kept.append([state, first, last])
        spans += [PartSpan(part=part, state=_STATES[s], first=a, last=b) for s, a, b in kept]
    return spans
