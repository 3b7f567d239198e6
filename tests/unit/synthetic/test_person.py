"""Body, mounts and walk of the synthetic subject."""

from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.core.errors import JobError
from bodycap_batch.formats.bvh import write_bvh
from bodycap_batch.model.geometry import invert, rotation_angle_rad
from bodycap_batch.model.nominal_mounts import nominal_mount
from bodycap_batch.model.skeleton import Motion, forward_kinematics
from bodycap_batch.model.skeleton_presets import load_skeleton, rest_positions
from bodycap_batch.synthetic.clip import load_clip
from bodycap_batch.synthetic.foot_roll import shape_of
from bodycap_batch.synthetic.gait import Walk, WalkStyle
from bodycap_batch.synthetic.moving_body import camera_poses_at
from bodycap_batch.synthetic.person import draw_body, draw_mounts, draw_posture


@pytest.fixture(scope="module")
def walk():
    body = draw_body(1.75, 0.05, np.random.default_rng(3))
    return Walk(body, 12.0, WalkStyle(), np.random.default_rng(4))


def _poses(walk, t_s):
    return forward_kinematics(walk.skeleton, *walk.pose(t_s))


@pytest.mark.parametrize("seed", range(5))
def test_bones_differ_from_nominal_but_the_stature_is_exact(seed):
    body, nominal = draw_body(1.8, 0.05, np.random.default_rng(seed)), load_skeleton("full_body", 1.8)
    heights = rest_positions(body)[:, 2] + np.nan_to_num(body.end_offsets_m)[:, 2]
    assert heights.max() - heights.min() == pytest.approx(1.8, abs=1e-9)
    assert heights.min() == pytest.approx(0.0, abs=1e-9)
    lengths = np.linalg.norm(body.offsets_m[1:], axis=1) / np.linalg.norm(nominal.offsets_m[1:], axis=1)
    # ±5 % for each bone, and at most ±5 % for the scaling to the stature.
    assert 0.95 / 1.05 <= lengths.min() < 0.99
    assert 1.01 < lengths.max() <= 1.05 / 0.95
    left = [i for i, name in enumerate(body.joints) if name.startswith("Left")]
    right = [body.joints.index(body.joints[i].replace("Left", "Right")) for i in left]
    assert np.allclose(body.offsets_m[left], body.offsets_m[right] * [-1, 1, 1])


def test_mounts_have_the_requested_sigmas():
    body, rng = load_skeleton("full_body", 1.75), np.random.default_rng(0)
    nominal = nominal_mount("left_palm", "LeftHand", body).joint_from_cam
    drawn = [draw_mounts(("left_palm",), body, (15.0, 0.05), rng)[0].joint_from_cam for _ in range(600)]
    off = invert(nominal) @ np.array(drawn)
    turned = np.degrees(rotation_angle_rad(off[:, :3, :3]))
    shifted = np.linalg.norm(off[:, :3, 3], axis=1)
    # 600 draws of three axes: the RMS is known to 1/√(2·1800) = 1.7 %, five sigma is 9 %.
    assert np.sqrt(np.mean(turned**2)) == pytest.approx(15.0, rel=0.09)
    assert np.sqrt(np.mean(shifted**2)) == pytest.approx(0.05, rel=0.09)


def test_a_mount_on_a_missing_bone_is_refused(tmp_path):
    body = load_skeleton("full_body", 1.75)
    headless = [i for i, name in enumerate(body.joints) if name != "Head"]
    parents = [body.parents[i] if body.parents[i] < 0 else headless.index(body.parents[i]) for i in headless]
    less = type(body)(
        name="headless",
        joints=tuple(body.joints[i] for i in headless),
        parents=np.array(parents),
        offsets_m=body.offsets_m[headless],
        end_offsets_m=body.end_offsets_m[headless],
        roles=tuple(body.roles[i] for i in headless),
        bvh_channels=tuple(() for _ in headless),
    )
    with pytest.raises(JobError, match="Head"):
        draw_mounts(("head",), less, (0.0, 0.0), np.random.default_rng(0))


def test_the_walker_stands_on_the_floor(walk):
    poses = _poses(walk, np.arange(0, 12, 0.02))
    soles = []
    for side in ("Left", "Right"):
        toe = walk.skeleton.joints.index(f"{side}ToeBase")
        tip = poses[:, toe, :3, :3] @ walk.skeleton.end_offsets_m[toe] + poses[:, toe, :3, 3]
        soles.append(tip[:, 2])
        soles.append(
            poses[:, walk.skeleton.joints.index(f"{side}Foot"), 2, 3]
            - shape_of(walk.skeleton, "Left").height_m
        )
    lowest = np.min(soles, axis=0)
    # The soft minimum of four soles is up to 1 cm · ln 4 below them; the heel of a tilted foot adds a little.
    assert lowest.min() > -0.01
    assert lowest.max() < 0.035


def test_the_walk_turns_steps_aside_and_reaches_at_human_rates(walk):
    t_s = np.arange(0, 12, 1 / 120)
    root, local = walk.pose(t_s)
    speed = np.linalg.norm(np.diff(root[:, :2], axis=0), axis=1) * 120
    assert speed.min() > 0.3
    assert speed.max() < 1.5
    facing = -local[:, 0, :2, 1]
    turned = np.unwrap(np.arctan2(facing[:, 1], facing[:, 0]))
    assert np.degrees(np.ptp(turned)) > 180
    start = root[60, :2] - root[0, :2]
    assert abs(np.cross([*start, 0], [*facing[30], 0])[2]) > 2 * abs(start @ facing[30])
    mounts = draw_mounts(
        ("torso", "left_palm", "right_palm"), walk.skeleton, (15.0, 0.05), np.random.default_rng(1)
    )
    for mount in mounts:
        poses = camera_poses_at(walk, mount, t_s)
        step = poses[:-1, :3, :3].transpose(0, 2, 1) @ poses[1:, :3, :3]
        rate = np.degrees(rotation_angle_rad(step)) * 120
        assert np.percentile(rate, 90) < 120
        assert rate.max() < 180
        assert np.median(rate) > 10
    hand, shoulder = (walk.skeleton.joints.index(name) for name in ("LeftHand", "LeftArm"))
    world = _poses(walk, t_s)[:, :, :3, 3]
    reach = np.linalg.norm((world[:, hand] - world[:, shoulder])[:, :2], axis=1)
    assert reach.min() < 0.25
    assert reach.max() > 0.38


def test_the_motion_is_smooth(walk):
    t_s = np.arange(0, 12, 0.005)
    hands = _poses(walk, t_s)[:, [walk.skeleton.joints.index(f"{s}Hand") for s in ("Left", "Right")]]
    acceleration = np.linalg.norm(np.diff(hands[..., :3, 3], 2, axis=0), axis=-1) / 0.005**2
    # Arms accelerate by a few m/s²; a jump of 1 cm between ticks would be 400.
    assert acceleration.max() < 20


def test_a_longer_capture_continues_the_same_walk():
    body = draw_body(1.75, 0.05, np.random.default_rng(3))
    t_s = np.linspace(0, 5, 20)
    short, long = (Walk(body, s, WalkStyle(), np.random.default_rng(4)).pose(t_s) for s in (6.0, 60.0))
    # More positions change the spline a lap earlier by well below a millimetre.
    assert np.abs(short[0] - long[0]).max() < 1e-3
    assert np.abs(short[1] - long[1]).max() < 1e-3


def test_a_person_who_turns_on_the_spot_hardly_moves():
    body = draw_body(1.75, 0.05, np.random.default_rng(3))
    walk = Walk(body, 8.0, WalkStyle(on_the_spot=True), np.random.default_rng(4))
    t_s = np.linspace(0, 8, 161)
    root = _poses(walk, t_s)[:, 0]
    assert np.ptp(root[:, :2, 3], axis=0).max() < 0.05
    heading = np.degrees(np.unwrap(np.arctan2(root[:, 1, 0], root[:, 0, 0])))
    # 75 degrees to either side within 5 s, and a little from the gait.
    assert 145 < np.ptp(heading) < 155
    assert np.abs(np.diff(heading)).max() / 0.05 < 100


def test_a_t_pose_comes_first():
    body = draw_body(1.75, 0.05, np.random.default_rng(3))
    walk = Walk(body, 8.0, WalkStyle(t_pose_s=2.0), np.random.default_rng(4))
    still = _poses(walk, np.linspace(0, 1.9, 10))
    left, right = (body.joints.index(f"{side}Hand") for side in ("Left", "Right"))
    span = still[:, left, :3, 3] - still[:, right, :3, 3]
    rest = rest_positions(body)
    assert np.allclose(np.linalg.norm(span, axis=1), np.linalg.norm(rest[left] - rest[right]), atol=1e-3)
    assert np.abs(still[:, 0, :2, 3] - still[0, 0, :2, 3]).max() < 1e-6
    later = _poses(walk, np.array([5.0]))
    assert np.linalg.norm(later[0, left, :3, 3] - later[0, right, :3, 3]) < 1.2


def _clip_file(path, frames=41, factor=1.0):
    usual = load_skeleton("full_body", 1.75)
    body = replace(usual, offsets_m=factor * usual.offsets_m, end_offsets_m=factor * usual.end_offsets_m)
    root = factor * np.column_stack([np.linspace(5, 7, frames), np.full(frames, -3.0), np.full(frames, 0.93)])
    local = np.tile(np.eye(3), (frames, len(body.joints), 1, 1))
    write_bvh(
        path,
        Motion(
            skeleton=body,
            fps=20.0,
            start_ns=0,
            root_in_world_m=root,
            local_rotation=local,
            observed=np.ones(local.shape[:2], dtype=bool),
        ),
    )


def test_a_recorded_motion_is_centred_and_interpolated(tmp_path):
    _clip_file(tmp_path / "walk.bvh")
    clip = load_clip(tmp_path / "walk.bvh", 0.5, 1.0)
    root, local = clip.pose(np.array([0.0, 0.525, 1.0]))
    # 1 m/s along x; the part from 0.5 to 1.5 s is centred. The file has 8 digits: 1e-8 m.
    assert np.allclose(root[:, 0], [-0.5, 0.025, 0.5], atol=1e-6)
    assert np.allclose(root[:, 1], 0.0, atol=1e-6)
    assert np.allclose(local, np.eye(3))
    # The lowest joint (the toes) touches the floor.
    poses = forward_kinematics(clip.skeleton, root, local)
    assert poses[:, :, 2, 3].min() == pytest.approx(0.0, abs=1e-6)


def test_a_recorded_body_in_another_unit_of_length_gets_the_size_of_a_person(tmp_path, caplog):
    """Read in centimetres, recordings of CMU show a person with a stature of 31 cm."""
    _clip_file(tmp_path / "small.bvh", factor=0.1772)
    clip = load_clip(tmp_path / "small.bvh", 0.5, 1.0, 1.6)
    usual = load_skeleton("full_body", 1.6)
    assert np.allclose(clip.skeleton.offsets_m[1:], usual.offsets_m[1:], atol=1e-4)
    root, _ = clip.pose(np.array([0.0, 1.0]))
    assert root[1, 0] - root[0, 0] == pytest.approx(1.6 / 1.75, abs=1e-4)
    assert "stature of 0.31 m" in caplog.text


def test_a_motion_that_ends_too_early_is_refused(tmp_path):
    _clip_file(tmp_path / "walk.bvh")
    with pytest.raises(JobError, match=r"lasts 2\.00 s"):
        load_clip(tmp_path / "walk.bvh", 0.0, 5.0)


def test_a_skeleton_without_motion_is_refused(tmp_path):
    _clip_file(tmp_path / "pose.bvh", frames=1)
    with pytest.raises(JobError, match="no motion"):
        load_clip(tmp_path / "pose.bvh", 0.0, 0.01)


def test_postures_differ_as_between_people():
    body, t_s = draw_body(1.75, 0.05, np.random.default_rng(3)), np.array([3.0])
    usual = Walk(body, 6.0, WalkStyle(), np.random.default_rng(4)).pose(t_s)[1][0]
    postures = [draw_posture(1.0, np.random.default_rng(seed)) for seed in range(60)]
    held = [
        Walk(body, 6.0, WalkStyle(posture=each), np.random.default_rng(4)).pose(t_s)[1][0]
        for each in postures
    ]
    turns = np.degrees(rotation_angle_rad(np.swapaxes(usual, -1, -2) @ np.array(held)))
    rms = np.sqrt((turns**2).mean(axis=0))
    # Two or three independent rotations each. The spread of 60 draws of two is known to 6 %.
    for joint, sigmas in (
        ("LeftShoulder", (5.4, 6.2)),
        ("RightArm", (4.2, 5.1, 12.5)),
        ("LeftForeArm", (3.6, 14.7)),
    ):
        assert rms[body.joints.index(joint)] == pytest.approx(np.linalg.norm(sigmas), rel=0.2)
    assert rms[body.joints.index("LeftHand")] == 0.0
    assert set(draw_posture(0.0, np.random.default_rng(0)).values()) == {0.0}
