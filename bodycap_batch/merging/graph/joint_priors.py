"""Joint priors widened by the variation of the posture in a capture."""

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
"""Time in seconds that a gesture lasts: postures within it are correlated. Evidence: none."""


def widen_joint_priors(
    skeleton: SkeletonModel, bones: Sequence[Bone], world_from_bone: FloatArray, times_ns: IntArray
) -> tuple[Bone, ...]:
    """Widen the rotation priors of joints by what a capture accidentally shows.

    A joint's mean over a capture differs from the rest pose for two reasons. One is the person's systematic
    bias, a ratio of the joint's everyday range. The other is the choice of gestures: it contributes their
    variation divided by the root of their number.

    If the mean is nevertheless farther away, although the prior attracts it, the range is set to that
    deviation. An example is arms that lift all the time. One draw of a normal distribution is most likely if
    sigma equals the draw.

    Args:
        skeleton: The body.
        bones: The graph's bones.
        world_from_bone: (K,B,4,4) poses solved at sampled ticks, none of them in a T-pose.
        times_ns: (K,) the ticks, increasing.
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
    """Return the mean number of ticks (K,) in one gesture, 1 or more."""
    return max(1.0, len(times_ns) / _gesture_count(times_ns))


def _gesture_count(times_ns: IntArray) -> float:
    """Return the number of gestures in the time span of ticks (K,) that contain a tick."""
    duration_ns = round(1e9 * GESTURE_DURATION_S)
    since_ns = times_ns - times_ns[0]
    with_tick = float(len(np.unique(since_ns // duration_ns)))
    return max(1.0, min(float(since_ns[-1]) / duration_ns, with_tick))
