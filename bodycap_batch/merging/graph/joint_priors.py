"""Joint priors that are widened by the variation of the posture in a capture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.merging.body.bones import Bone, anatomical_axes
from bodycap_batch.merging.graph.error_modes import POSTURE_BIAS_SHARE
from bodycap_batch.model.geometry import so3_log
from bodycap_batch.model.skeleton import SkeletonModel

GESTURE_DURATION_S = 4.0
"""Duration (seconds) of a gesture. Postures within one gesture are correlated. Evidence: none."""


def widen_joint_priors(
    skeleton: SkeletonModel, bones: Sequence[Bone], world_from_bone: FloatArray, times_ns: IntArray
) -> tuple[Bone, ...]:
    """Widen the rotation priors of joints, because a capture contains only a limited number of gestures.

    The mean rotation of a joint over a capture differs from the rest pose for two reasons. The first is the
    person's systematic bias, a fraction of the joint's everyday range. The second is the random choice of
    gestures in the capture. The sigma of this second contribution is the standard deviation of the rotations,
    divided by the square root of the number of gestures.

    Sometimes the mean rotation differs from the rest pose by more than these two reasons explain. An example
    is a person who lifts the arms all the time. The function then widens the everyday range until the sigma
    of the bias equals the difference. This value of the sigma makes the difference most likely.

    Args:
        skeleton: The body.
        bones: The graph's bones.
        world_from_bone: (K,B,4,4) solved poses at sampled ticks. No tick is part of a T-pose.
        times_ns: (K,) times of the ticks, increasing.
    """
    few = 1.0 / _gesture_count(times_ns)
    out = []
    for index, bone in enumerate(bones):
        if bone.parent < 0:
            out.append(bone)
            continue
        parent_rotation = np.swapaxes(world_from_bone[:, bone.parent, :3, :3], 1, 2)
        parent_from_bone = parent_rotation @ world_from_bone[:, index, :3, :3]
        axes = anatomical_axes(skeleton, bone.role)
        off = so3_log(bone.mean_rotation.T @ parent_from_bone) @ axes
        usual = np.diagonal(axes.T @ bone.rotation_covariance @ axes)
        widened = usual + off.var(axis=0) * few / POSTURE_BIAS_SHARE**2
        variances = np.diag(np.maximum(widened, (off.mean(axis=0) / POSTURE_BIAS_SHARE) ** 2))
        out.append(replace(bone, rotation_covariance=axes @ variances @ axes.T))
    return tuple(out)


def samples_per_gesture(times_ns: IntArray) -> float:
    """Return the mean number of ticks per gesture for ticks at times (K,); at least 1."""
    return max(1.0, len(times_ns) / _gesture_count(times_ns))


def _gesture_count(times_ns: IntArray) -> float:
    """Return the number of gestures in the time span of ticks (K,), without gestures that have no tick."""
    duration_ns = round(1e9 * GESTURE_DURATION_S)
    since_ns = times_ns - times_ns[0]
    with_tick = float(len(np.unique(since_ns // duration_ns)))
    return max(1.0, min(float(since_ns[-1]) / duration_ns, with_tick))
