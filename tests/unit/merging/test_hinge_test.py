"""Violated hinges: detected if cameras on both sides of the joint observe them, and loosened."""

import numpy as np
import pytest

from bodycap_batch.merging.body.bones import hinges, kinematic_chain
from bodycap_batch.merging.body_calibration.hinge_test import FREE_SIGMA_M, observable_hinges
from bodycap_batch.merging.body_calibration.mount_calibration_graph import CalibrationGraph
from bodycap_batch.merging.body_calibration.samples import take_samples
from bodycap_batch.merging.cameras.track import CameraTrack
from bodycap_batch.merging.reporting.advice import describe_hinge
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.model.nominal_mounts import nominal_mount
from bodycap_batch.model.skeleton import forward_kinematics
from bodycap_batch.model.skeleton_presets import load_skeleton
from tests.bodies import reaching

ROLES = {
    "torso": "Spine1",
    "left_upper_arm": "LeftArm",
    "left_palm": "LeftHand",
    "right_palm": "RightHand",
}


def _calibrated(sideways_rad: float) -> CalibrationGraph:
    """Calibrate a body with a left elbow that swings sideways by this sigma. The mounts are nominal."""
    motion = reaching(240)
    skeleton = motion.skeleton
    local = np.array(motion.local_rotation)
    elbow = skeleton.index_of_role("LeftForeArm")
    sway = sideways_rad * np.sqrt(2.0) * np.sin(np.arange(240) / 7.0)
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
    calibration = CalibrationGraph(skeleton, bones, take_samples(tracks, 1.0, 30), mounts, 1.0, lambda: None)
    calibration.solve(1.0)
    return calibration


def test_an_elbow_that_swings_sideways_is_loosened():
    calibration = _calibrated(np.radians(15.0))
    assert calibration.test_hinges()
    (role,) = (
        calibration.hinge_violation_m()
    )  # the right elbow has no camera above it, so its hinge is not observable
    assert role == "LeftForeArm"
    # 15 degrees are 6.5 cm at the wrist of a straight forearm of 25 cm, 5 cm in the distances; the elbow is
    # bent, and the mounts take part of it.
    assert 0.015 < calibration.hinge_violation_m()[role] < 0.06


def test_an_elbow_that_keeps_to_its_hinge_changes_nothing():
    calibration = _calibrated(0.0)
    before, mounts = calibration.poses(), dict(calibration.mounts)
    assert not calibration.test_hinges()
    assert calibration.hinge_violation_m() == {}
    assert (calibration.poses() == before).all()
    assert all((calibration.mounts[camera] == mount).all() for camera, mount in mounts.items())


@pytest.mark.parametrize(
    ("cameras", "tested"),
    [
        (("Spine1", "LeftHand"), 0),
        (("Spine1", "LeftArm"), 0),
        (("Spine1", "LeftArm", "LeftHand"), 1),
        (("Spine1", "LeftArm", "LeftForeArm", "LeftHand", "RightHand"), 1),
    ],
)
def test_only_cameras_on_both_sides_contradict_a_hinge(cameras, tested):
    skeleton = load_skeleton("upper_body", 1.75)
    bones = kinematic_chain(skeleton, cameras)
    measured = {number for number, bone in enumerate(bones) if bone.role in cameras}
    assert len(observable_hinges(hinges(skeleton, bones), measured)) == tested


def test_a_violated_hinge_is_described_with_advice():
    sentence = describe_hinge("LeftForeArm", FREE_SIGMA_M)
    assert "left elbow moves 10.0 cm" in sentence
    assert "; to reduce this, strap" in sentence
    # A palm's clock that is 60 ms off looks like a violated hinge as well.
    assert "check the cameras' clocks (offset_s)" in sentence
    assert "right knee" in describe_hinge("RightLeg", 0.02)
