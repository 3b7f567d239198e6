"""Verify files with the motion by reading them back, and arrange the motion for them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.core.errors import JobError, StoreError
from bodycap_batch.formats.c3d import LabelledPoints
from bodycap_batch.formats.fbx.writer import POSITION_TOLERANCE_M
from bodycap_batch.model.geometry import rotation_angle_rad
from bodycap_batch.model.skeleton import Motion, SkeletonModel

ANGLE_TOLERANCE_DEG = 0.01
"""Maximum accepted angle (degrees) between the orientations of a joint in the file and in the motion.

Derivation: a rotation by this angle moves the end of a bone of 0.6 m by 0.1 mm.
"""

_RATE_TOLERANCE = 1e-6
"""Maximum accepted relative difference of the frame rate.

Derivation: it is larger than the rounding of BVH's Frame Time with ten decimals at 240 Hz.
"""


def points_from_motion(
    motion: Motion, measured: BoolArray | None = None, sigma_m: FloatArray | None = None
) -> LabelledPoints:
    """Return the joint centres of a motion as labelled points in the world.

    Args:
        motion: The motion, with J joints.
        measured: (J,) False for a joint that no camera measured; None if all joints are measured.
        sigma_m: (T,J) standard deviation per axis of each joint's centre, metres; None if it is unknown.
    """
    return LabelledPoints(
        names=motion.skeleton.joints,
        fps=motion.fps,
        x_in_world_m=motion.world_from_joint()[..., :3, 3],
        measured=measured,
        observed=motion.observed,
        sigma_m=sigma_m,
    )


def sigma_in_layout(motion: Motion, animated: Motion, sigma_m: FloatArray) -> FloatArray:
    """Return the standard deviations (T,K) of the joints in the layout of the files for animation.

    A joint is found by its role, else by its name; joints that the layout adds have NaN. A frame has the
    standard deviation of the nearest tick; a T-pose before the motion has NaN.

    Args:
        motion: The solved motion, with J joints.
        animated: The same motion in the layout of the files, with K joints and T frames.
        sigma_m: (ticks of the solved motion,J) standard deviations, metres.
    """
    body, shown = motion.skeleton, animated.skeleton
    ticks = np.rint((animated.times_ns() - motion.start_ns) * 1e-9 * motion.fps).astype(np.int64)
    inside = (ticks >= 0) & (ticks < len(sigma_m))
    out = np.full((len(ticks), len(shown.joints)), np.nan)
    for joint, (name, role) in enumerate(zip(shown.joints, shown.roles, strict=True)):
        source = body.index_of_role(role) if role else None
        if source is None and name in body.joints:
            source = body.joints.index(name)
        if source is not None:
            out[inside, joint] = sigma_m[ticks[inside], source]
    return out


def verified(path: Path, motion: Motion, read: Callable[[Path], Motion | None]) -> list[Path]:
    """Read a written file back, compare its motion with the written motion, and return the path in a list.

    A file that cannot be read, or that differs too much, is deleted.

    Raises:
        StoreError: The file cannot be read, or its motion differs too much.
    """
    try:
        position_m, angle_deg = motion_difference(read(path), motion)
    except JobError as error:
        path.unlink(missing_ok=True)
        raise StoreError(
            f"the written file cannot be read: {error.message}", path=path, hint="check the disk for errors"
        ) from error
    if not (position_m <= POSITION_TOLERANCE_M and angle_deg <= ANGLE_TOLERANCE_DEG):
        path.unlink(missing_ok=True)
        raise StoreError(
            f"the motion in the written file differs from the solved motion by {position_m * 1000:.3g} mm "
            f"and {angle_deg:.3g}°",
            path=path,
            hint="check the disk; if the disk has no errors, report this as a bug",
        )
    return [path]


def motion_difference(back: Motion | None, motion: Motion) -> tuple[float, float]:
    """Return the largest difference of joint centres (metres) and the largest difference of orientations (°).

    Both differences are infinite if there is no motion in the file, or if joint names, number of ticks or
    frame rate differ.

    Args:
        back: The motion that was read back; None if the file contains no motion.
        motion: The motion that was written.
    """
    same = back is not None and sorted(back.skeleton.joints) == sorted(motion.skeleton.joints)
    if back is None or not same or len(back.root_in_world_m) != len(motion.root_in_world_m):
        return np.inf, np.inf
    if abs(back.fps / motion.fps - 1.0) > _RATE_TOLERANCE:
        return np.inf, np.inf
    order = [back.skeleton.joints.index(name) for name in motion.skeleton.joints]
    expected, actual = motion.world_from_joint(), back.world_from_joint()[:, order]
    distance = np.linalg.norm(expected[..., :3, 3] - actual[..., :3, 3], axis=-1)
    rotation = np.swapaxes(expected[..., :3, :3], -1, -2) @ actual[..., :3, :3]
    return float(distance.max()), float(np.rad2deg(rotation_angle_rad(rotation).max()))


def without_unsolved_branches(motion: Motion, solved: BoolArray) -> Motion:
    """Return the motion of the solved joints and their ancestors only.

    Args:
        motion: The motion of all joints of the skeleton.
        solved: (J,) True for the joints that the motion graph solved.
    """
    skeleton = motion.skeleton
    kept = np.array(solved, copy=True)
    kept[0] = True
    for joint in range(len(kept) - 1, 0, -1):
        if kept[joint]:
            kept[skeleton.parents[joint]] = True
    chosen = np.flatnonzero(kept)
    return replace(
        motion,
        skeleton=_sub_skeleton(skeleton, kept),
        local_rotation=motion.local_rotation[:, chosen],
        observed=motion.observed[:, chosen],
    )


def _sub_skeleton(skeleton: SkeletonModel, kept: BoolArray) -> SkeletonModel:
    """Return the skeleton without the removed joints.

    If all children of a joint are removed, the joint's bone ends where the first child was.

    Args:
        skeleton: The skeleton with all joints.
        kept: (J,) True for each joint that is kept.
    """
    chosen = np.flatnonzero(kept)
    new_index = {int(joint): index for index, joint in enumerate(chosen)}
    ends = np.array(skeleton.end_offsets_m)
    parents = skeleton.parents.tolist()
    for joint in chosen.tolist():
        children = [child for child, parent in enumerate(parents) if parent == joint]
        if children and not kept[children].any():
            ends[joint] = skeleton.offsets_m[children[0]]
    return SkeletonModel(
        name=skeleton.name,
        joints=tuple(skeleton.joints[joint] for joint in chosen),
        parents=np.array([new_index.get(parents[joint], -1) for joint in chosen.tolist()]),
        offsets_m=skeleton.offsets_m[chosen],
        end_offsets_m=ends[chosen],
        roles=tuple(skeleton.roles[joint] for joint in chosen),
        bvh_channels=tuple(skeleton.bvh_channels[joint] for joint in chosen),
        tpose_rotation=None if skeleton.tpose_rotation is None else skeleton.tpose_rotation[chosen],
    )
