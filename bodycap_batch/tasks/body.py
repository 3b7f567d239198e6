"""Load the body of a job: its skeleton and the mounts of its cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodycap_batch.formats.bvh import RigOptions, read_rig
from bodycap_batch.model.nominal_mounts import STATED_SIGMA_M, STATED_SIGMA_RAD, camera_reach, nominal_mount
from bodycap_batch.model.skeleton import Mount, SkeletonModel, with_tpose_as_zero_pose, without_outer_joints
from bodycap_batch.model.skeleton_presets import load_skeleton
from bodycap_batch.tasks.inputs import BodyInput, MountInput


def load_body(body: BodyInput) -> tuple[SkeletonModel, tuple[Mount, ...]]:
    """Return the skeleton of a body and the mount prior of each camera."""
    skeleton = _load_skeleton(body)
    return skeleton, tuple(mount_prior(mount, skeleton) for mount in body.mounts)


def camera_distances(body: BodyInput) -> list[tuple[str, str, float, float]]:
    """Return the smallest and largest distance that the body permits between each pair of cameras.

    Returns:
        Rows (first camera, second camera, smallest distance, largest distance), in metres.
    """
    # The map's scale is unknown, so mapping uses only the ratios of these distances. The stature is removed,
    # so that the map stays the same if the user adds the stature to the job later.
    return camera_reach(*load_body(replace(body, height_m=None)))


def mount_prior(mount: MountInput, skeleton: SkeletonModel) -> Mount:
    """Return the prior of a camera's mount.

    A pose given in the job replaces the nominal pose of the named place. Standard deviations given in the job
    replace the defaults. The defaults for a given pose differ from the defaults for a nominal pose.
    """
    nominal = nominal_mount(mount.place, mount.role, skeleton)
    pose, sigma_deg, sigma_m = mount.joint_from_cam, mount.sigma_deg, mount.sigma_m
    default = (nominal.sigma_rad, nominal.sigma_m) if pose is None else (STATED_SIGMA_RAD, STATED_SIGMA_M)
    return Mount(
        camera=mount.camera,
        role=mount.role,
        joint_from_cam=nominal.joint_from_cam if pose is None else np.array(pose, dtype=np.float64),
        sigma_rad=default[0] if sigma_deg is None else float(np.radians(sigma_deg)),
        sigma_m=default[1] if sigma_m is None else sigma_m,
        by_name=pose is None and sigma_deg is None,
    )


def _load_skeleton(body: BodyInput) -> SkeletonModel:
    if body.skeleton_file is not None:
        rig = RigOptions(roles=body.skeleton_map, tpose_frame=body.tpose_frame, height_m=body.height_m)
        skeleton, _ = read_rig(body.skeleton_file.path, rig)
        return without_outer_joints(with_tpose_as_zero_pose(skeleton))

    assert body.skeleton is not None
    return load_skeleton(body.skeleton, body.height_m)
