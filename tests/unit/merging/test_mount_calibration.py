"""The mounts of a body whose elbow is no perfect hinge."""

from __future__ import annotations

import numpy as np
import pytest

from bodycap_batch.merging.body.bones import kinematic_chain
from bodycap_batch.merging.body_calibration.mount_calibration_graph import CalibrationGraph
from bodycap_batch.merging.body_calibration.samples import take_samples
from bodycap_batch.merging.body_calibration.scale import estimate_scale
from bodycap_batch.merging.cameras.track import CameraTrack
from bodycap_batch.model.geometry import rotation_angle_rad, so3_exp
from bodycap_batch.model.nominal_mounts import NOMINAL_SIGMA_M, nominal_mount
from bodycap_batch.model.skeleton import forward_kinematics
from tests.bodies import reaching

ROLES = {
    "torso": "Spine1",
    "left_upper_arm": "LeftArm",
    "left_palm": "LeftHand",
    "right_palm": "RightHand",
}


@pytest.mark.parametrize("sideways_deg", [0.0, 6.0, 12.0])
def test_an_elbow_that_swings_sideways_hardly_moves_mounts(sideways_deg: float) -> None:
    motion = reaching(240)
    skeleton = motion.skeleton
    local = np.array(motion.local_rotation)
    elbow = skeleton.index_of_role("LeftForeArm")
    # The root mean square of a sine is its amplitude / √2.
    sway = np.radians(sideways_deg) * np.sqrt(2.0) * np.sin(np.arange(240) / 7.0)
    local[:, elbow] = so3_exp(np.outer(sway, [0.0, 1.0, 0.0])) @ local[:, elbow]
    poses = forward_kinematics(skeleton, motion.root_in_world_m, local)
    bones = kinematic_chain(skeleton, ROLES.values())
    index = {bone.role: number for number, bone in enumerate(bones)}
    mounts = {camera: nominal_mount(camera, role, skeleton) for camera, role in ROLES.items()}
    tracks = [
        CameraTrack(
            camera=camera,
            bone=index[role],
            frames=np.arange(240),
            times_ns=np.round(np.arange(240) * (1e9 / 30.0)).astype(np.int64),
            map_from_cam=poses[:, skeleton.index_of_role(role)] @ mounts[camera].joint_from_cam,
            sigma_rad=np.full(240, 0.005),
            sigma_map=np.full(240, 0.004),
        )
        for camera, role in ROLES.items()
    ]
    graph = CalibrationGraph(skeleton, bones, take_samples(tracks, 1.0, 30), mounts, 1.0, lambda: None)
    graph.solve(1.0)
    graph.widen_joint_priors()
    found = estimate_scale(graph, 1.0)
    # The poses are exact, so that only the priors of posture and mounts pull. With tight hinges, an elbow
    # that swings by 12° turned the mount of the upper arm by 18°, and moved that of the palm by 11 cm.
    assert abs(np.log(found.scale)) < found.sigma_log
    for camera, mount in mounts.items():
        off = mount.joint_from_cam[:3, :3].T @ graph.mounts[camera][:3, :3]
        assert np.degrees(rotation_angle_rad(off)) < 4.0
        # Nearer than the prior knows a mount.
        moved_m = np.linalg.norm(mount.joint_from_cam[:3, 3] - graph.mounts[camera][:3, 3])
        assert moved_m < NOMINAL_SIGMA_M
