"""A moving skeleton as straight bones at any instant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, set_array
from bodycap_batch.model.skeleton import Motion
from bodycap_batch.model.skeleton_presets import split_side


@dataclass(frozen=True, slots=True, kw_only=True)
class Bones:
    """All bones at one instant.

    Attributes:
        ends_in_world: (B,2,3) near and far end, metres.
        observed: (B,) True where cameras measured the joint that turns the bone.
    """

    ends_in_world: FloatArray
    observed: BoolArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Body:
    """A motion's bones on its constant-rate timeline.

    Attributes:
        joint: (B,) index of the joint that turns each bone.
        side: (B,) "Left", "Right" or "" of each bone.
        times_ns: (T,) common time of each tick.
        ends_in_world: (T,B,2,3) near and far end, metres.
        observed: (T,B) True where cameras measured the joint.
    """

    joint: IntArray
    side: tuple[str, ...]
    times_ns: IntArray
    ends_in_world: FloatArray
    observed: BoolArray

    def __post_init__(self) -> None:
        bones, ticks = len(self.side), len(self.times_ns)
        set_array(self, "joint", (bones,), np.int64)
        set_array(self, "times_ns", (ticks,), np.int64)
        set_array(self, "ends_in_world", (ticks, bones, 2, 3))
        set_array(self, "observed", (ticks, bones), np.bool_)

    def at(self, common_ns: int) -> Bones | None:
        """The bones at a common time, between two ticks interpolated; None outside the motion.

        A bone counts as observed where both ticks are.
        """
        ticks = len(self.times_ns)
        if not ticks or not self.times_ns[0] <= common_ns <= self.times_ns[-1]:
            return None
        after = min(int(np.searchsorted(self.times_ns, common_ns)), ticks - 1)
        before = max(after - 1, 0)
        span = int(self.times_ns[after] - self.times_ns[before])
        alpha = (common_ns - int(self.times_ns[before])) / span if span else 1.0
        ends = (1.0 - alpha) * self.ends_in_world[before] + alpha * self.ends_in_world[after]
        return Bones(ends_in_world=ends, observed=self.observed[before] & self.observed[after])


def body_of(motion: Motion) -> Body:
    """The bones of a motion: one to every child of a joint, and to the end of a joint without children."""
    skeleton = motion.skeleton
    world_from_joint = motion.world_from_joint()
    centres = world_from_joint[..., :3, 3]
    children = [joint for joint in range(1, len(skeleton.joints)) if np.any(skeleton.offsets_m[joint])]
    owners = [int(skeleton.parents[joint]) for joint in children]
    tips = np.flatnonzero(np.isfinite(skeleton.end_offsets_m).all(axis=1)).tolist()
    pairs = [
        np.stack([centres[:, owner], centres[:, joint]], axis=1)
        for owner, joint in zip(owners, children, strict=True)
    ]
    for joint in tips:
        tip = world_from_joint[:, joint, :3, :3] @ skeleton.end_offsets_m[joint] + centres[:, joint]
        pairs.append(np.stack([centres[:, joint], tip], axis=1))
    joints = np.array([*owners, *tips], dtype=np.int64)
    return Body(
        joint=joints,
        side=tuple(_side(skeleton.roles[child] or skeleton.joints[child]) for child in [*children, *tips]),
        times_ns=motion.times_ns(),
        ends_in_world=np.stack(pairs, axis=1) if pairs else np.zeros((len(centres), 0, 2, 3)),
        observed=motion.observed[:, joints],
    )


def _side(name: str) -> str:
    return split_side(name)[0]
