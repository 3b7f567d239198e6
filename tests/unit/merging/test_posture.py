"""The posture of a capture: level and direction of a walk, standing, a T-pose, and wider joint priors."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from bodycap_batch.merging.body.bones import anatomical_axes, kinematic_chain
from bodycap_batch.merging.body.t_pose import arm_span, find_t_pose, with_t_pose_prior
from bodycap_batch.merging.body.trunk_lean import modal_direction
from bodycap_batch.merging.cameras.track import CameraTrack
from bodycap_batch.merging.graph.error_modes import POSTURE_BIAS_SHARE
from bodycap_batch.merging.graph.joint_priors import GESTURE_DURATION_S, widen_joint_priors
from bodycap_batch.merging.graph.posture import find_posture, vertical_from_path
from bodycap_batch.model.geometry import make_transform, so3_exp
from bodycap_batch.model.skeleton import forward_kinematics
from bodycap_batch.model.skeleton_presets import load_skeleton, rest_positions

FPS = 30.0
ROLES = ("Spine1", "LeftHand", "RightHand")
CAMERAS = dict(zip(ROLES, ("torso", "left_palm", "right_palm"), strict=True))
TILT = so3_exp([0.5, -0.3, 0.2])


def _track(poses, bone=0, camera="torso"):
    count = len(poses)
    return CameraTrack(
        camera=camera,
        bone=bone,
        frames=np.arange(count),
        times_ns=np.round(np.arange(count) * (1e9 / FPS)).astype(np.int64),
        map_from_cam=poses,
        sigma_rad=np.full(count, 0.005),
        sigma_map=np.full(count, 0.005),
    )


def _circle(seconds=20.0):
    """Return poses on a level circle of 1.5 m with a walker's bounce, facing forward, in a tilted map."""
    t = np.arange(0.0, seconds, 1.0 / FPS)
    angle = 2 * np.pi * t / 10.0
    centre = np.column_stack([1.5 * np.cos(angle), 1.5 * np.sin(angle), 1.2 + 0.02 * np.sin(11.0 * t)])
    turn = so3_exp(np.outer(angle + np.pi, [0.0, 0.0, 1.0]))
    poses = make_transform(turn, centre)
    return make_transform(TILT, np.zeros(3)) @ poses


def test_a_walk_gives_the_vertical_of_a_tilted_map():
    path = _circle()[:, :3, 3]
    rng = np.random.default_rng(0)
    body = so3_exp([0.2, 0.1, 0.0]) @ TILT[:, 2]
    up = vertical_from_path(path + rng.normal(scale=0.005, size=path.shape), body)
    # The bounce averages out over 35 steps: 2 cm / (1 m of width x sqrt(35)) is 0.2 degrees.
    assert np.degrees(np.arccos(up @ TILT[:, 2])) < 0.5
    assert vertical_from_path(path, -body) @ TILT[:, 2] < 0.0  # the body gives the sign


def test_bending_down_in_between_does_not_tilt_the_walk():
    path = _circle()[:, :3, 3]
    path[100:160] -= 0.45 * TILT[:, 2]
    up = vertical_from_path(path, TILT[:, 2])
    assert np.degrees(np.arccos(up @ TILT[:, 2])) < 0.5


@pytest.mark.parametrize("kind", ["straight", "stairs", "short"])
def test_a_path_without_a_level_gives_no_vertical(kind):
    path = _circle()[:, :3, 3]
    if kind == "straight":
        path = np.outer(np.arange(300.0) / 100.0, TILT[:, 0])
    elif kind == "stairs":
        path = path + np.outer(np.repeat(np.arange(20), 30) * 0.35, TILT[:, 2])
    else:
        path = path[:20]
    assert vertical_from_path(path, TILT[:, 2]) is None


def test_the_walking_direction_follows_the_path_and_ignores_side_steps():
    poses = _circle()
    sideways = slice(200, 260)
    poses[sideways, :3, :3] = poses[sideways, :3, :3] @ so3_exp([0.0, 0.0, 0.5 * np.pi])
    track = _track(poses)
    posture = find_posture(track, track.times_ns, TILT[:, 2], None)
    assert not posture.walking[sideways].any()
    inner = np.r_[30:190, 270:560]
    assert posture.walking[inner].all()
    angle = 2 * np.pi * track.times_ns[inner] * 1e-9 / 10.0
    tangent = np.column_stack([-np.sin(angle), np.cos(angle), 0.0 * angle]) @ TILT.T
    # The chord over half a second has the direction of the tangent; the bounce is projected out.
    assert_allclose(posture.walking_direction[inner], tangent, atol=1e-3)


def _bending(seconds=20.0):
    """Return a chest half a metre above hips that bend by up to 70 degrees every 5 s, in a tilted map."""
    t = np.arange(0.0, seconds, 1.0 / FPS)
    bend = np.radians(70.0) * (0.5 - 0.5 * np.cos(2 * np.pi * t / 5.0)) ** 2
    turn = so3_exp(np.outer(bend, [1.0, 0.0, 0.0]))
    centre = turn[:, :, 2] * 0.5 + [0.0, 0.0, 0.9]
    return make_transform(TILT, np.zeros(3)) @ make_transform(turn, centre), bend


def test_a_person_who_lifts_things_stands_upright_in_between():
    poses, bend = _bending()
    track = _track(poses)
    posture = find_posture(track, track.times_ns, TILT[:, 2], None)
    assert not posture.walking.any()
    assert 0.1 < posture.standing.mean() < 0.5
    # 2 cm below the highest position, half a metre above the hips, is a bend of arccos(1 - 0.04), 16 degrees.
    assert np.degrees(bend[posture.standing].max()) < 17.0
    assert not find_posture(track, track.times_ns, None, None).standing.any()
    # The mean direction leans by 26 degrees; the modal one does not.
    assert np.degrees(np.arccos(modal_direction(poses[:, :3, 2]) @ TILT[:, 2])) < 10.0


def test_a_constant_lean_is_never_upright():
    time = np.arange(0.0, 20.0, 1.0 / FPS)
    lean = np.radians(30.0 + 8.0 * np.sin(time))
    turn = so3_exp(np.outer(lean, [1.0, 0.0, 0.0]))
    track = _track(make_transform(TILT, np.zeros(3)) @ make_transform(turn, 0.5 * turn[:, :, 2]))
    assert not find_posture(track, track.times_ns, TILT[:, 2], None).standing.any()


def test_a_bent_walk_does_not_count_as_upright():
    poses = _circle()
    bent = np.arange(len(poses)) % 150 > 110
    poses[bent, :3, 3] -= 0.3 * TILT[:, 2]
    track = _track(poses)
    posture = find_posture(track, track.times_ns[::5], TILT[:, 2], None)
    assert posture.walking.sum() > 50
    assert not posture.walking[bent[::5]].any()
    assert not posture.standing.any()


def test_a_few_steps_aside_are_not_a_walk():
    poses, _ = _bending()
    steps = np.clip(np.arange(len(poses)) - 300, 0, 20)
    poses[:, :3, 3] += np.outer(steps, 0.04 * TILT[:, 0])
    track = _track(poses)
    posture = find_posture(track, track.times_ns, TILT[:, 2], None)
    assert not posture.walking.any()
    assert posture.standing.any()


def test_random_headings_give_no_walking_direction():
    poses = _circle()
    rng = np.random.default_rng(1)
    poses[:, :3, :3] = poses[:, :3, :3] @ so3_exp(np.outer(rng.uniform(-np.pi, np.pi, len(poses)), [0, 0, 1]))
    track = _track(poses)
    posture = find_posture(track, track.times_ns, TILT[:, 2], None)
    assert np.isnan(posture.walking_direction).all()
    assert posture.walking.any()


def _posed_tracks(arm_deg, still=True):
    """Return three seconds of arms lowered by an angle from the horizontal, then two of hanging arms."""
    skeleton = load_skeleton("upper_body", 1.75)
    bones = kinematic_chain(skeleton, ROLES)
    count = 150
    local = np.tile(np.eye(3), (count, len(skeleton.joints), 1, 1))
    lowered = np.where(np.arange(count) < 90, arm_deg, 80.0)
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        arm = skeleton.roles.index(side + "Arm")
        local[:, arm] = so3_exp(np.outer(np.radians(sign * lowered), [0.0, 1.0, 0.0]))
    root = np.tile([0.0, 0.0, 0.93], (count, 1))
    if not still:
        root[:, 1] -= np.arange(count) / FPS
        wave = so3_exp(np.outer(1.2 * np.sin(np.arange(count) / 3.0), [0.0, 0.0, 1.0]))
        local[:, skeleton.roles.index("LeftArm")] = wave
    world = forward_kinematics(skeleton, root, local)
    forward = make_transform(np.eye(3), [0.0, -0.12, 0.07])
    tracks = [
        _track(
            world[:, skeleton.roles.index(role)] @ (forward if role == "Spine1" else np.eye(4)),
            [bone.role for bone in bones].index(role),
            CAMERAS[role],
        )
        for role in ROLES
    ]
    return skeleton, bones, tracks


def test_a_t_pose_is_found_while_it_stands():
    skeleton, bones, tracks = _posed_tracks(0.0)
    span = arm_span(bones, skeleton)
    wrists = rest_positions(skeleton)[[skeleton.roles.index("LeftHand"), skeleton.roles.index("RightHand")]]
    # 0.2 m replace the width of the shoulders, which is 0.26 of the stature.
    assert span < wrists[0, 0] - wrists[1, 0] < 1.35 * span
    found = find_t_pose(bones, tracks, span)
    assert found is not None
    # The arms fall within one frame; speeds are taken over a third of a second.
    assert found[0] == 0
    assert 2.6e9 < found[1] < 3.0e9


def test_a_t_pose_is_found_in_any_gauge():
    skeleton, bones, tracks = _posed_tracks(0.0)
    moved = []
    for track in tracks:
        poses = make_transform(TILT, np.zeros(3)) @ track.map_from_cam
        poses[:, :3, 3] *= 7.0
        moved.append(replace(track, map_from_cam=poses))
    assert find_t_pose(bones, moved, 7.0 * arm_span(bones, skeleton)) == find_t_pose(
        bones, tracks, arm_span(bones, skeleton)
    )


@pytest.mark.parametrize("arm_deg", [45.0, 80.0, -60.0])
def test_other_arm_positions_are_not_a_t_pose(arm_deg):
    skeleton, bones, tracks = _posed_tracks(arm_deg)
    assert find_t_pose(bones, tracks, arm_span(bones, skeleton)) is None


def test_stretched_arms_in_motion_are_not_a_t_pose():
    skeleton, bones, tracks = _posed_tracks(0.0, still=False)
    assert find_t_pose(bones, tracks, arm_span(bones, skeleton)) is None


def test_the_t_pose_of_a_rig_that_rests_in_it_is_its_zero_pose():
    skeleton = load_skeleton("full_body", 1.75)
    bones = kinematic_chain(skeleton, ("Hips", "LeftHand", "RightHand", "Head", "LeftFoot", "RightFoot"))
    for bone in with_t_pose_prior(skeleton, bones):
        assert_allclose(bone.mean_rotation, np.eye(3), atol=1e-12)
        assert np.linalg.eigvalsh(bone.rotation_covariance).min() > 0.0


def test_the_t_pose_of_a_rig_whose_arms_hang_lifts_them():
    skeleton = load_skeleton("upper_body", 1.75)
    offsets = np.array(skeleton.offsets_m)
    for side in ("Left", "Right"):
        for part in ("ForeArm", "Hand"):
            joint = skeleton.roles.index(side + part)
            offsets[joint] = [0.0, 0.0, -np.linalg.norm(offsets[joint])]
    ends = np.where(np.isfinite(skeleton.end_offsets_m), skeleton.end_offsets_m, np.nan)
    hanging = replace(skeleton, offsets_m=offsets, end_offsets_m=ends)
    bones = {bone.role: bone for bone in with_t_pose_prior(hanging, kinematic_chain(hanging, ROLES))}
    lifted = bones["LeftArm"].mean_rotation @ bones["LeftForeArm"].offset_m
    assert_allclose(lifted, [np.linalg.norm(lifted), 0.0, 0.0], atol=1e-9)
    lifted = bones["RightArm"].mean_rotation @ bones["RightForeArm"].offset_m
    assert_allclose(lifted, [-np.linalg.norm(lifted), 0.0, 0.0], atol=1e-9)


@pytest.mark.parametrize(
    ("times_s", "few"),
    [
        (np.linspace(5.0, 7.0, 20), 1.0),
        (np.linspace(5.0, 5.0 + 10.0 * GESTURE_DURATION_S, 20), 0.1),
        # Two short times a long time apart show two gestures.
        (np.concatenate([np.linspace(0.0, 1.0, 10), np.linspace(60.0, 61.0, 10)]), 0.5),
    ],
)
def test_variation_in_a_capture_widens_a_joints_prior(times_s, few):
    skeleton = load_skeleton("upper_body", 1.75)
    bones = kinematic_chain(skeleton, ROLES)
    elbow = [bone.role for bone in bones].index("LeftForeArm")
    axes = anatomical_axes(skeleton, "LeftForeArm")
    # Thirty degrees to either side of a posture that is twenty degrees from the rest pose.
    flexion = np.radians(20.0 + 30.0 * np.tile([1.0, -1.0], 10))
    poses = np.tile(np.eye(4), (20, len(bones), 1, 1))
    for index, bone in enumerate(bones):
        if bone.parent >= 0:
            turn = so3_exp(np.outer(flexion if index == elbow else 0.0 * flexion, axes[:, 2]))
            poses[:, index, :3, :3] = poses[:, bone.parent, :3, :3] @ bone.mean_rotation @ turn
    wider = widen_joint_priors(skeleton, bones, poses, np.round(1e9 * times_s).astype(np.int64))
    grown = axes.T @ (wider[elbow].rotation_covariance - bones[elbow].rotation_covariance) @ axes
    expected = np.diag([0.0, 0.0, few * np.radians(30.0) ** 2 / POSTURE_BIAS_SHARE**2])
    assert_allclose(grown, expected, atol=1e-9)
    for index, (bone, other) in enumerate(zip(bones, wider, strict=True)):
        assert index == elbow or np.allclose(bone.rotation_covariance, other.rotation_covariance)
        assert (bone.mean_rotation == other.mean_rotation).all()


@pytest.mark.parametrize(("off_deg", "sigma_deg"), [(15.0, 40.0), (50.0, 100.0)])
def test_a_joint_far_from_its_rest_pose_all_the_time_has_that_range(off_deg, sigma_deg):
    skeleton = load_skeleton("upper_body", 1.75)
    bones = kinematic_chain(skeleton, ROLES)
    elbow = [bone.role for bone in bones].index("LeftForeArm")
    axes = anatomical_axes(skeleton, "LeftForeArm")
    poses = np.tile(np.eye(4), (20, len(bones), 1, 1))
    for index, bone in enumerate(bones):
        if bone.parent >= 0:
            turn = so3_exp(np.radians(off_deg if index == elbow else 0.0) * axes[:, 2])
            poses[:, index, :3, :3] = poses[:, bone.parent, :3, :3] @ bone.mean_rotation @ turn
    wider = widen_joint_priors(skeleton, bones, poses, np.arange(20) * 1_000_000_000)
    sigma = np.degrees(np.sqrt(np.diagonal(axes.T @ wider[elbow].rotation_covariance @ axes)))
    # The bias is half of a range: 50 degrees of bias need a range of 100, 15 lie within the usual 40.
    assert_allclose(sigma, [40.0, 40.0, sigma_deg], atol=1e-6)
