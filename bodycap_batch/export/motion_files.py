"""The motion as files: whole or reduced hierarchy, written, read back and compared."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from bodycap_batch.config.options import ExportOptions
from bodycap_batch.core.arrays import BoolArray
from bodycap_batch.core.errors import JobError, StoreError
from bodycap_batch.formats.bvh import read_bvh, write_bvh
from bodycap_batch.formats.c3d import LabelledPoints
from bodycap_batch.formats.gltf import read_glb, write_glb
from bodycap_batch.formats.usd import read_usd, write_usd
from bodycap_batch.model.geometry import rotation_angle_rad
from bodycap_batch.model.skeleton import Motion, SkeletonModel

POSITION_TOLERANCE_M = 1e-4
ANGLE_TOLERANCE_DEG = 0.01


def write_verified_bvh(path: Path, motion: Motion, options: ExportOptions) -> Path:
    """Write a BVH, verify that it holds the motion, return its path.

    Raises:
        StoreError: The file cannot be written, or differs by more than 0.1 mm or 0.01° when read back.
    """
    write_bvh(path, motion, units=options.units, euler_order=options.euler_order)
    _verify(path, motion, lambda file: read_bvh(file, units=options.units)[1])
    return path


def write_verified_glb(path: Path, motion: Motion) -> Path:
    """Write a GLB, verify that it holds the motion, return its path. Raises as `write_verified_bvh`."""
    write_glb(path, motion)
    _verify(path, motion, read_glb)
    return path


def write_verified_usd(path: Path, motion: Motion) -> Path:
    """Write a USD stage, verify that it holds the motion, return its path. Raises as `write_verified_bvh`."""
    write_usd(path, motion)
    _verify(path, motion, read_usd)
    return path


def points_from_motion(motion: Motion) -> LabelledPoints:
    """The joint centres as named points."""
    return LabelledPoints(
        names=motion.skeleton.joints, fps=motion.fps, x_in_world_m=motion.world_from_joint()[..., :3, 3]
    )


def _verify(path: Path, motion: Motion, read: Callable[[Path], Motion | None]) -> None:
    """Remove and refuse a file that does not hold the motion."""
    try:
        position_m, angle_deg = motion_difference(read(path), motion)
    except JobError as error:
        path.unlink(missing_ok=True)
        raise StoreError(f"cannot be read back: {error.message}", path=path, hint="check the disk") from error
    if not (position_m <= POSITION_TOLERANCE_M and angle_deg <= ANGLE_TOLERANCE_DEG):
        path.unlink(missing_ok=True)
        raise StoreError(
            f"the motion read back differs by {position_m * 1000:.3g} mm and {angle_deg:.3g}°",
            path=path,
            hint="check the disk; if it is sound, this is a bug worth reporting",
        )


def motion_difference(back: Motion | None, motion: Motion) -> tuple[float, float]:
    """Largest difference of joint centres (m) and orientations (deg); infinite where they cannot match."""
    same = back is not None and sorted(back.skeleton.joints) == sorted(motion.skeleton.joints)
    if back is None or not same or len(back.root_in_world_m) != len(motion.root_in_world_m):
        return np.inf, np.inf
    if abs(back.fps / motion.fps - 1.0) > 1e-6:
        return np.inf, np.inf
    order = [back.skeleton.joints.index(name) for name in motion.skeleton.joints]
    written, found = motion.world_from_joint(), back.world_from_joint()[:, order]
    position = np.linalg.norm(written[..., :3, 3] - found[..., :3, 3], axis=-1)
    turned = np.swapaxes(written[..., :3, :3], -1, -2) @ found[..., :3, :3]
    return float(position.max()), float(np.rad2deg(rotation_angle_rad(turned).max()))


def without_unsolved_branches(motion: Motion, solved: BoolArray) -> Motion:
    """Drop what hangs off the solved joints without being solved; ancestors of solved joints stay.

    Args:
        motion: The whole humanoid.
        solved: (J,) the graph's joints.
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
    """The kept joints; a joint that lost its children ends where the first of them was."""
    chosen = np.flatnonzero(kept)
    place = {int(joint): index for index, joint in enumerate(chosen)}
    ends = np.array(skeleton.end_offsets_m)
    parents = skeleton.parents.tolist()
    for joint in chosen.tolist():
        children = [child for child, parent in enumerate(parents) if parent == joint]
        if children and not kept[children].any():
            ends[joint] = skeleton.offsets_m[children[0]]
    return SkeletonModel(
        name=skeleton.name,
        joints=tuple(skeleton.joints[joint] for joint in chosen),
        parents=np.array([place.get(parents[joint], -1) for joint in chosen.tolist()]),
        offsets_m=skeleton.offsets_m[chosen],
        end_offsets_m=ends[chosen],
        roles=tuple(skeleton.roles[joint] for joint in chosen),
        bvh_channels=tuple(skeleton.bvh_channels[joint] for joint in chosen),
        tpose_rotation=None if skeleton.tpose_rotation is None else skeleton.tpose_rotation[chosen],
    )
