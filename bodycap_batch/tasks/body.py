"""The body of a job: its skeleton and where on it the cameras sit."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from bodycap_batch.tasks.stage import Json

if TYPE_CHECKING:
    from bodycap_batch.model.skeleton import Mount, SkeletonModel


def load_body(arguments: Json) -> tuple[SkeletonModel, tuple[Mount, ...]]:
    """Skeleton and mounts of a merge task's arguments."""
    skeleton = _skeleton(arguments)
    return skeleton, tuple(mount_prior(block, skeleton) for block in arguments["mounts"])


def reach_rows(body: Json) -> list[tuple[str, str, float, float]]:
    """How near and how far a job's cameras can be to each other: rows (camera, camera, least, most), metres.

    Args:
        body: Skeleton and mounts, as the merge task takes them.
    """
    from bodycap_batch.model.skeleton_presets import camera_reach

    # A map has no scale, so only proportions matter to it: a stature stated later makes no other map.
    return camera_reach(*load_body({**body, "height_m": None}))


def mount_prior(block: Json, skeleton: SkeletonModel) -> Mount:
    """The prior of one camera's mount: nominal for its place, or what the job measured."""
    import numpy as np

    from bodycap_batch.model.skeleton import Mount
    from bodycap_batch.model.skeleton_presets import STATED_SIGMA_M, STATED_SIGMA_RAD, nominal_mount

    nominal = nominal_mount(block["place"], block["role"], skeleton)
    pose, sigma_deg, sigma_m = (block[name] for name in ("joint_from_cam", "sigma_deg", "sigma_m"))
    usual = (nominal.sigma_rad, nominal.sigma_m) if pose is None else (STATED_SIGMA_RAD, STATED_SIGMA_M)
    return Mount(
        camera=block["camera"],
        role=block["role"],
        joint_from_cam=nominal.joint_from_cam if pose is None else np.array(pose, dtype=np.float64),
        sigma_rad=usual[0] if sigma_deg is None else float(np.radians(sigma_deg)),
        sigma_m=usual[1] if sigma_m is None else sigma_m,
        by_name=pose is None and sigma_deg is None,
    )


def _skeleton(arguments: Json) -> SkeletonModel:
    if arguments["skeleton_file"] is not None:
        from bodycap_batch.formats.bvh import RigOptions, read_rig
        from bodycap_batch.model.skeleton import with_tpose_as_zero_pose

        rig = RigOptions(roles=arguments["skeleton_map"], tpose_frame=arguments["tpose_frame"])
        return with_tpose_as_zero_pose(read_rig(Path(arguments["skeleton_file"]), rig)[0])
    from bodycap_batch.model.skeleton_presets import load_skeleton

    return load_skeleton(arguments["skeleton"], arguments["height_m"])
