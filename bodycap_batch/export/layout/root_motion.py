"""Where the body's travel goes: onto the hips, onto a root on the floor, or nowhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodycap_batch.config.options import RootMode
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.export.layout.joint_names import naming_preset
from bodycap_batch.model.geometry import quat_xyzw_from_rotation, so3_exp
from bodycap_batch.model.skeleton import Motion, SkeletonModel, rest_pose

_MIN_HEADING_NORM = 0.1
"""Below this the hips are near upside down and have no heading: the one before is kept."""

_HIPS_OFFSET_M = 1e-3
"""At rest the hips stand this little before the root: right above it, at the tip of its bone, Blender's FBX
importer takes them for fixed to it and ignores their motion."""


def floor_root_name(names: str, mode: RootMode) -> str | None:
    """Name of the root on the floor where the preset or the mode asks for one."""
    chosen = naming_preset(names)
    return str(chosen["floor"]) if mode == "ground" or chosen.get("always") else None


def prepend_tpose(motion: Motion) -> Motion:
    """Put the T-pose before the first frame: standing where the motion begins, facing the front (−Y)."""
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


def apply_root_mode(motion: Motion, mode: RootMode, floor: str | None) -> Motion:
    """Put the travel where the mode wants it.

    ``hips``: all of it on the hips. ``ground``: the root on the floor below the hips has their path and
    heading, the hips keep their height and the rest of their rotation; no joint moves in the world.
    ``in_place``: the hips do not leave the vertical through the origin.

    Args:
        motion: The motion, its root the hips.
        mode: Where the travel goes.
        floor: Name of a root on the floor, or None without one.
    """
    if mode == "in_place":
        motion = replace(motion, root_in_world_m=motion.root_in_world_m * [0.0, 0.0, 1.0])
    if floor is None:
        return motion
    turn = np.zeros(len(motion.root_in_world_m))
    path = np.zeros((len(turn), 3))
    if mode == "ground":
        turn = heading_rad(motion.local_rotation[:, 0])
        path[:, :2] = motion.root_in_world_m[:, :2]
    world_from_floor = so3_exp(turn[:, None] * [0.0, 0.0, 1.0])
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


def heading_rad(world_from_hips: FloatArray) -> FloatArray:
    """Turn (T,) about the vertical: the twist of each rotation (T,3,3) about Z, continuous."""
    quat = quat_xyzw_from_rotation(world_from_hips)
    known = np.hypot(quat[:, 2], quat[:, 3]) > _MIN_HEADING_NORM
    turn = 2.0 * np.arctan2(quat[:, 2], quat[:, 3])
    if not known.any():
        return np.zeros_like(turn)
    latest = np.maximum.accumulate(np.where(known, np.arange(len(turn)), np.argmax(known)))
    return np.asarray(np.unwrap(turn[latest]))


def _skeleton_with_floor_root(skeleton: SkeletonModel, name: str) -> SkeletonModel:
    """The skeleton with a root on the floor, below its first root."""
    free, number = name, 2
    while free in skeleton.joints:
        free, number = f"{name}{number}", number + 1
    offsets = np.concatenate([np.zeros((1, 3)), skeleton.offsets_m])
    offsets[1] = [0.0, -_HIPS_OFFSET_M, rest_pose(skeleton)[0, 2, 3]]
    tpose = skeleton.tpose_rotation
    return SkeletonModel(
        name=skeleton.name,
        joints=(free, *skeleton.joints),
        parents=np.concatenate([[-1], skeleton.parents + 1]),
        offsets_m=offsets,
        end_offsets_m=np.concatenate([np.full((1, 3), np.nan), skeleton.end_offsets_m]),
        roles=("", *skeleton.roles),
        bvh_channels=((), *skeleton.bvh_channels),
        tpose_rotation=None if tpose is None else np.concatenate([np.eye(3)[None], tpose]),
    )
