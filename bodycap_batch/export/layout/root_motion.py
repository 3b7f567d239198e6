"""Add a T-pose frame, and assign the root motion to a joint or remove its horizontal path."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodycap_batch.config.options import RootMode
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.unique_names import unique_name
from bodycap_batch.export.layout.joint_names import insert_joints, naming_preset
from bodycap_batch.model.geometry import quat_xyzw_from_rotation, so3_exp
from bodycap_batch.model.skeleton import Motion, SkeletonModel, rest_pose

_MIN_HEADING_NORM = 0.1
"""Minimum norm of the heading part (w, z) of a unit quaternion.

With a smaller norm the hips are nearly upside down, and their heading is undefined. Evidence: none.
"""

_HIPS_OFFSET_M = 1e-3
"""Distance (metres) of the hips in front of the floor root, in the rest pose.

Derivation: the hips must not be directly above the floor root, at the tip of the floor root's bone. Blender's
FBX importer would then connect the hips to this bone and ignore the hips' motion.
"""


_ROOT_SIGMA_S = 0.4
"""Standard deviation (seconds) of the Gaussian filter of the floor root's path and heading.

Derivation: strides take 1 to 1.4 s, so that 4 to 20 % of a sway is left; after a stop, the root stands within
a second. A Gaussian does not overshoot.
"""


def floor_root_name(names: str, mode: RootMode) -> str | None:
    """Return the name of the root joint on the floor; None if the motion gets no such joint.

    The mode ``ground`` and some naming presets require this joint.

    Args:
        names: Name of the naming preset.
        mode: The mode of the root motion.
    """
    chosen = naming_preset(names)
    return str(chosen["floor"]) if mode == "ground" or chosen.get("always") else None


def prepend_tpose(motion: Motion) -> Motion:
    """Return the motion with a T-pose added as the first frame.

    The T-pose stands at the horizontal position of the first frame of the motion and faces −Y.
    """
    skeleton = motion.skeleton
    tpose = skeleton.tpose_rotation
    local = np.tile(np.eye(3), (len(skeleton.joints), 1, 1)) if tpose is None else tpose
    root = np.array([*motion.root_in_world_m[0, :2], rest_pose(skeleton)[0, 2, 3]])
    return replace(
        motion,
        start_ns=motion.start_ns - round(1e9 / motion.fps),
        root_in_world_m=np.concatenate([root[None], motion.root_in_world_m]),
        local_rotation=np.concatenate([local[None], motion.local_rotation]),
        observed=np.concatenate([np.zeros((1, len(local)), dtype=bool), motion.observed]),
    )


def apply_root_mode(motion: Motion, mode: RootMode, floor: str | None, *, tpose: bool = False) -> Motion:
    """Return the motion with the root motion that a mode selects.

    ``hips``: the hips hold the whole root motion. ``ground``: a root joint on the floor below the hips holds
    the horizontal path and the heading of the hips without the sway of single steps. The hips hold the rest.
    No existing joint moves in the world. ``in_place``: the horizontal path is removed, so that the hips stay
    above the origin.

    Args:
        motion: The motion, with the hips as its root.
        mode: The mode of the root motion.
        floor: Name of the root joint on the floor; None for no such joint.
        tpose: Whether the first frame is a T-pose.
    """
    if mode == "in_place":
        motion = replace(motion, root_in_world_m=motion.root_in_world_m * [0.0, 0.0, 1.0])
    if floor is None:
        return motion
    heading = np.zeros(len(motion.root_in_world_m))
    path = np.zeros((len(heading), 3))
    if mode == "ground":
        start = int(tpose)
        heading[start:] = _smoothed(heading_rad(motion.local_rotation[start:, 0]), motion.fps)
        path[start:, :2] = _smoothed(motion.root_in_world_m[start:, :2], motion.fps)
        path[:start, :2] = motion.root_in_world_m[:start, :2]
    world_from_floor = so3_exp(heading[:, None] * [0.0, 0.0, 1.0])
    local = motion.local_rotation.copy()
    local[:, 0] = np.swapaxes(world_from_floor, -1, -2) @ local[:, 0]
    hips = np.einsum("tji,tj->ti", world_from_floor, motion.root_in_world_m - path)
    return replace(
        motion,
        skeleton=_skeleton_with_floor_root(motion.skeleton, floor),
        root_in_world_m=path,
        local_rotation=np.concatenate([world_from_floor[:, None], local], axis=1),
        observed=np.concatenate([motion.observed[:, :1], motion.observed], axis=1),
        hips_in_root_m=hips,
    )


def _smoothed(values: FloatArray, fps: float) -> FloatArray:
    """Return values (T,...) after a Gaussian filter over time, which keeps the first and the last value."""
    from scipy.ndimage import gaussian_filter1d

    margin = min(len(values) - 1, round(4.0 * _ROOT_SIGMA_S * fps))
    before = 2.0 * values[:1] - values[margin:0:-1]
    after = 2.0 * values[-1:] - values[-2 : -2 - margin : -1]
    padded = np.concatenate([before, values, after])
    filtered = gaussian_filter1d(padded, _ROOT_SIGMA_S * fps, axis=0, mode="nearest")
    return np.asarray(filtered[margin : margin + len(values)])


def heading_rad(world_from_hips: FloatArray) -> FloatArray:
    """Return the heading (T,) of the hips over time: the twist of their rotation about Z, radians.

    The heading is continuous over time. At a tick with an undefined heading, the latest defined heading is
    returned. At a tick before the first defined heading, the first defined heading is returned.

    Args:
        world_from_hips: (T,3,3) rotation of the hips in the world.
    """
    quat = quat_xyzw_from_rotation(world_from_hips)
    defined = np.hypot(quat[:, 2], quat[:, 3]) > _MIN_HEADING_NORM
    heading = 2.0 * np.arctan2(quat[:, 2], quat[:, 3])
    if not defined.any():
        return np.zeros_like(heading)
    latest = np.maximum.accumulate(np.where(defined, np.arange(len(heading)), np.argmax(defined)))
    return np.asarray(np.unwrap(heading[latest]))


def _skeleton_with_floor_root(skeleton: SkeletonModel, name: str) -> SkeletonModel:
    """Return the skeleton with a root joint on the floor, which becomes the parent of the old root.

    Args:
        skeleton: The skeleton, with the hips as its root.
        name: Name of the new root joint. A number is appended if a joint already has this name.
    """
    offsets = np.concatenate([np.zeros((1, 3)), skeleton.offsets_m])
    offsets[1] = [0.0, -_HIPS_OFFSET_M, rest_pose(skeleton)[0, 2, 3]]
    parents = np.concatenate([[-1], skeleton.parents + 1])
    return insert_joints(skeleton, 0, [unique_name(name, skeleton.joints, "")], parents, offsets)
