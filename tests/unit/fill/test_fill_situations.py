"""The fill stage in other situations than a walk: no invented steps, no sole in the floor, no jumps."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.fill import fill_motion
from bodycap_batch.fill.foot_paths import FootPath, foot_path
from bodycap_batch.fill.leg_geometry import leg_geometry
from bodycap_batch.fill.leg_poses import pose_leg
from bodycap_batch.fill.standing_height import HeightSigmas
from bodycap_batch.merging.body.bones import kinematic_chain
from bodycap_batch.merging.body.completion import complete_skeleton
from bodycap_batch.model.fill_data import FillResult, Footsteps
from bodycap_batch.model.geometry import rotation_angle_rad, so3_exp
from bodycap_batch.model.skeleton import Motion
from bodycap_batch.model.skeleton_presets import load_skeleton

FPS = 30.0
STANDING_M = 0.53 * 1.75 * 0.985
"""Height (metres) of the hips of the standing person."""
STEP_S = 0.55


@dataclass(frozen=True, slots=True, kw_only=True)
class Trunk:
    """What the trunk does at T ticks: position of the hips (m), yaw and forward lean (radians)."""

    hips_m: FloatArray
    yaw_rad: FloatArray
    lean_rad: FloatArray


def still(seconds: float, height_m: float = STANDING_M) -> Trunk:
    """Return a trunk that sways as a standing person does."""
    time = np.arange(round(seconds * FPS)) / FPS
    sway = 0.006 * np.column_stack([np.sin(1.9 * time), np.sin(1.3 * time + 1.0)])
    return Trunk(
        hips_m=np.column_stack([sway, np.full(len(time), height_m)]), yaw_rad=0.0 * time, lean_rad=0.0 * time
    )


def smooth(x: FloatArray) -> FloatArray:
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(x**3 * (10.0 - 15.0 * x + 6.0 * x * x))


def times(trunk: Trunk) -> FloatArray:
    return np.arange(len(trunk.yaw_rad)) / FPS


def walking_waves(time: FloatArray) -> FloatArray:
    """Return the sway and the rise (T,3) of a walking trunk, metres. The left foot lands at time 0."""
    stride = np.pi * time / STEP_S
    return np.column_stack([0.018 * np.sin(stride), 0.0 * time, -0.015 * np.cos(2.0 * stride - 0.6)])


def filled(trunk: Trunk, *, swing: float = 0.0) -> FillResult:
    """Return the filled motion of a person whose trunk and arms are measured."""
    body = load_skeleton("upper_body", 1.75)
    time = times(trunk)
    zero = 0.0 * time
    local = np.tile(np.eye(3), (len(time), len(body.joints), 1, 1))
    local[:, 0] = so3_exp(np.column_stack([zero, zero, trunk.yaw_rad])) @ so3_exp(
        np.column_stack([trunk.lean_rad, zero, zero])
    )
    stride = np.pi * time / STEP_S
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        ahead = so3_exp(np.column_stack([sign * swing * np.cos(stride), zero, zero]))
        local[:, body.roles.index(side + "Arm")] = ahead @ so3_exp(np.array([0.0, sign * 1.4, 0.0]))
    whole = Motion(
        skeleton=body, fps=FPS, start_ns=0, root_in_world_m=trunk.hips_m, local_rotation=local,
        observed=np.ones((len(time), len(body.joints)), dtype=bool),
    )  # fmt: skip
    bones = kinematic_chain(body, {"Spine1", "LeftHand", "RightHand"})
    poses, solved = complete_skeleton(
        body, bones, whole.world_from_joint()[:, [bone.joint for bone in bones]]
    )
    rotation = poses[..., :3, :3]
    merged = rotation.copy()
    merged[:, 1:] = np.swapaxes(rotation[:, body.parents[1:]], -1, -2) @ rotation[:, 1:]
    motion = Motion(
        skeleton=body, fps=FPS, start_ns=0, root_in_world_m=poses[:, 0, :3, 3], local_rotation=merged,
        observed=np.tile(solved, (len(time), 1)),
    )  # fmt: skip
    result = fill_motion(
        motion,
        solved,
        heights=HeightSigmas(0.01, 0.06),
        mode="plausible",
        context=StageContext(work_dir=Path()),
    )
    after = result.motion.world_from_joint()
    np.testing.assert_allclose(after[:, solved], poses[:, solved], atol=1e-9)
    return result


def soles(result: FillResult) -> tuple[FloatArray, FloatArray]:
    """Return the lowest point of each foot (T,2) in the world, metres, and the ankles (T,2,3)."""
    body = result.motion.skeleton
    poses = result.motion.world_from_joint()
    legs = leg_geometry(body)
    assert legs is not None
    low, ankles = [], []
    for number, side in enumerate(("Left", "Right")):
        ankle, toe = (body.roles.index(side + part) for part in ("Foot", "ToeBase"))
        tip = poses[:, toe, :3, 3] + poses[:, toe, :3, :3] @ body.end_offsets_m[toe]
        heel = poses[:, ankle, :3, 3] + poses[:, ankle, :3, :3] @ legs[number].heel_m
        low.append(np.min([heel[:, 2], poses[:, toe, 2, 3], tip[:, 2]], axis=0))
        ankles.append(poses[:, ankle, :3, 3])
    return np.stack(low, axis=1), np.stack(ankles, axis=1)


def certain_steps(result: FillResult) -> int:
    """Return the number of certain steps."""
    steps = result.report.footsteps
    count = 0
    for side in (0, 1):
        own = np.flatnonzero(steps.side == side)
        for first, second in itertools.pairwise(own):
            middle = int(0.5 * (steps.end_tick[first] + steps.start_tick[second]))
            count += bool(result.report.is_sure[middle])
    return count


def check_feet(result: FillResult) -> None:
    """Check that no sole is in the floor, that standing feet do not slip, and that nothing jumps."""
    low, ankle = soles(result)
    assert np.isfinite(result.motion.local_rotation).all()
    assert low.min() > -0.005
    speed = np.linalg.norm(np.diff(ankle, axis=0), axis=-1) * FPS
    # A swinging foot moves at 4 m/s or less.
    assert speed.max() < 5.0
    standing = result.report.standing
    for side in (0, 1):
        both = standing[1:, side] & standing[:-1, side] & (low[1:, side] < 0.01) & (low[:-1, side] < 0.01)
        flat = both & (np.abs(np.diff(ankle[:, side, 2])) < 1e-4)
        level = np.linalg.norm(np.diff(ankle[:, side, :2], axis=0), axis=-1) * FPS
        assert level[flat].max(initial=0.0) < 0.02


def test_a_standing_person_who_shifts_the_weight_takes_no_step() -> None:
    trunk = still(8.0)
    trunk.hips_m[:, 0] += 0.04 * np.sin(2.0 * np.pi * times(trunk) / 3.0)
    result = filled(trunk)
    check_feet(result)
    assert len(result.report.footsteps.side) == 2
    assert result.report.standing.all()


@pytest.mark.parametrize("angle", [-180.0, -90.0, 60.0])
def test_turning_on_the_spot_turns_the_feet_without_certain_steps(angle: float) -> None:
    trunk = still(6.0)
    trunk.yaw_rad[:] = np.radians(angle) * smooth((times(trunk) - 1.5) / 3.0)
    result = filled(trunk)
    check_feet(result)
    assert certain_steps(result) == 0
    steps = result.report.footsteps
    assert np.degrees(steps.heading_rad[-2:].mean()) == pytest.approx(angle, abs=20.0)
    low, _ = soles(result)
    assert low.max() < 0.06, "the feet are not lifted as in a march"


@pytest.mark.parametrize("direction", [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0)], ids=["left", "right", "back"])
def test_steps_aside_and_back_follow_the_hips(direction: tuple[float, float]) -> None:
    trunk = still(7.0)
    time = times(trunk)
    trunk.hips_m[:, :2] += np.outer(1.6 * smooth((time - 1.5) / 4.0), direction)
    trunk.hips_m[:] += walking_waves(time) * smooth((time - 1.5) / 0.5)[:, None] * (time < 5.5)[:, None]
    result = filled(trunk)
    check_feet(result)
    _, ankle = soles(result)
    middle = ankle[-1].mean(axis=0)
    assert np.hypot(*(middle[:2] - trunk.hips_m[-1, :2])) < 0.2
    assert 4 <= len(result.report.footsteps.side) <= 14


def test_a_person_who_starts_and_stops_stands_before_and_after() -> None:
    trunk = still(8.0)
    time = times(trunk)
    trunk.hips_m[:, 1] -= 1.2 * (np.cumsum(smooth((time - 1.5) / 1.2) - smooth((time - 5.3) / 1.2)) / FPS)
    on = smooth((time - 1.5) / 0.6) - smooth((time - 5.9) / 0.6)
    trunk.hips_m[:] += walking_waves(time) * on[:, None]
    result = filled(trunk, swing=0.0)
    check_feet(result)
    report = result.report
    assert report.standing[:40].all()
    assert report.standing[-30:].all()
    assert 6 <= certain_steps(result) <= 11
    _, ankle = soles(result)
    assert np.linalg.norm(ankle[-1, 0, :2] - ankle[-1, 1, :2]) < 0.45


@pytest.mark.parametrize("rise", [0.16, -0.16], ids=["up", "down"])
def test_feet_follow_a_person_on_stairs(rise: float) -> None:
    """Six steps of 16 cm: the feet stand at the height of straight or slightly bent legs, not in the air."""
    trunk = still(9.0)
    time = times(trunk)
    share = np.clip((time - 2.0) / (6.0 * STEP_S), 0.0, 1.0)
    start = 0.0 if rise > 0.0 else -6.0 * rise
    trunk.hips_m[:, 1] -= 6.0 * 0.28 * share
    trunk.hips_m[:, 2] += start + 6.0 * rise * share
    on = ((time > 2.0) & (time < 2.0 + 6.0 * STEP_S)).astype(float)
    trunk.hips_m[:] += walking_waves(time - 2.0) * on[:, None]
    result = filled(trunk)
    check_feet(result)
    low, ankle = soles(result)
    legs = leg_geometry(result.motion.skeleton)
    assert legs is not None
    # Before and after the stairs both feet stand below the hips on their own level.
    for tick, level in ((20, start), (-15, start + 6.0 * rise)):
        assert low[tick] == pytest.approx([level, level], abs=0.05)
    nearest = (trunk.hips_m[:, None, 2] - ankle[..., 2]).max(axis=1)
    assert nearest.max() < legs[0].length_m + 0.02
    assert np.isin(certain_steps(result), range(8))


@pytest.mark.parametrize("height", [0.75, 0.6], ids=["crouching", "sitting"])
def test_a_person_who_sits_down_bends_the_knees_over_standing_feet(height: float) -> None:
    trunk = still(6.0)
    down = smooth((times(trunk) - 1.5) / 1.2) - smooth((times(trunk) - 4.0) / 1.2)
    trunk.hips_m[:, 2] -= (1.0 - height) * STANDING_M * down
    trunk.hips_m[:, 1] += 0.15 * down
    trunk.lean_rad[:] = 0.35 * np.sin(np.pi * down)
    result = filled(trunk)
    check_feet(result)
    assert certain_steps(result) == 0
    low, _ = soles(result)
    assert low.max() < 0.05
    body = result.motion.skeleton
    poses = result.motion.world_from_joint()[..., :3, 3]
    hip, knee = (poses[105, body.roles.index("Left" + part)] for part in ("UpLeg", "Leg"))
    assert knee[1] < hip[1] - 0.1, "the knee points forward, to -y"


@pytest.mark.parametrize("seated_s", [1.5, 6.0])
def test_a_person_who_sits_down_on_a_chair_leaves_the_feet(seated_s: float) -> None:
    """The hips move backward by 35 cm. Feet that stepped back and forward again would be a clear error."""
    trunk = still(4.5 + seated_s)
    time = times(trunk)
    down = smooth((time - 1.5) / 1.2) - smooth((time - 2.0 - seated_s) / 1.2)
    trunk.hips_m[:, 2] -= 0.4 * STANDING_M * down
    trunk.hips_m[:, 1] += 0.35 * down
    trunk.lean_rad[:] = 0.5 * np.sin(np.pi * down)
    result = filled(trunk)
    check_feet(result)
    assert len(result.report.footsteps.side) == 2, "both feet stand all the time"
    _, ankle = soles(result)
    body = result.motion.skeleton
    poses = result.motion.world_from_joint()[..., :3, 3]
    seated = round((2.0 + 0.5 * seated_s + 0.6) * FPS)
    hip, knee = (poses[seated, body.roles.index("Left" + part), 1] for part in ("UpLeg", "Leg"))
    assert knee < hip - 0.25, "the thigh points forward, to -y"
    # Before and after, the feet stand below the hips.
    for tick in (10, -10):
        assert np.abs(ankle[tick, :, 1] - trunk.hips_m[tick, 1]).max() < 0.1


def test_a_jump_lifts_both_feet_and_lands_on_the_floor() -> None:
    trunk = still(5.0)
    time = times(trunk)
    dip = np.exp(-(((time - 2.0) / 0.18) ** 2)) + 0.7 * np.exp(-(((time - 2.85) / 0.18) ** 2))
    flight = np.clip(1.0 - ((time - 2.43) / 0.25) ** 2, 0.0, None)
    trunk.hips_m[:, 2] += -0.2 * dip + 0.31 * flight
    result = filled(trunk)
    check_feet(result)
    low, _ = soles(result)
    top = int(2.43 * FPS)
    assert low[top].min() > 0.1
    assert low[:40].max() < 0.02
    assert low[-30:].max() < 0.02
    assert certain_steps(result) == 0


def test_a_walk_on_a_treadmill_has_no_certain_steps() -> None:
    trunk = still(8.0)
    time = times(trunk)
    trunk.hips_m[:] += walking_waves(time)
    result = filled(trunk, swing=0.3)
    check_feet(result)
    assert certain_steps(result) == 0
    assert result.report.is_sure.mean() < 0.3


@pytest.mark.parametrize("lean", [np.pi / 2.0, -np.pi / 2.0], ids=["prone", "supine"])
def test_a_person_who_lies_has_legs_along_the_trunk(lean: float) -> None:
    trunk = still(4.0, 0.15)
    trunk.lean_rad[:] = lean
    result = filled(trunk)
    check_feet(result)
    report = result.report
    assert not report.is_sure.any()
    assert not report.standing.any()
    body = result.motion.skeleton
    poses = result.motion.world_from_joint()[60, :, :3, 3]
    up = poses[body.roles.index("Spine1")] - poses[0]
    leg = poses[body.roles.index("LeftFoot")] - poses[body.roles.index("LeftUpLeg")]
    assert -up @ leg > 0.9 * np.linalg.norm(up) * np.linalg.norm(leg)
    assert poses[:, 2].min() > -0.02
    rotations = result.motion.world_from_joint()[60, :, :3, :3]
    chest, head = (rotations[body.roles.index(role)] for role in ("Spine1", "Head"))
    np.testing.assert_allclose(head, chest, atol=0.02)


def test_the_head_of_a_person_who_bows_is_raised_but_not_beyond_the_neck() -> None:
    trunk = still(5.0)
    trunk.lean_rad[:] = np.radians(85.0) * np.sin(np.pi * smooth((times(trunk) - 1.0) / 3.0)) ** 2
    result = filled(trunk)
    check_feet(result)
    assert certain_steps(result) == 0
    roles = result.motion.skeleton.roles
    rotations = result.motion.world_from_joint()[..., :3, :3]
    chest, head = (rotations[:, roles.index(role)] for role in ("Spine1", "Head"))
    between = np.degrees(rotation_angle_rad(np.swapaxes(chest, -1, -2) @ head))
    assert between.max() < 60.0
    assert between.max() > 30.0
    assert np.degrees(rotation_angle_rad(head[20:21])) < 5.0


def test_a_person_who_kneels_down_takes_no_step() -> None:
    trunk = still(6.0)
    down = smooth((times(trunk) - 1.5) / 1.5)
    trunk.hips_m[:, 2] -= 0.46 * STANDING_M * down
    result = filled(trunk)
    check_feet(result)
    assert certain_steps(result) == 0
    assert not result.report.is_sure[-60:].any()


def test_planted_feet_stay_where_they_are_in_a_gap_of_the_trunk() -> None:
    """The trunk's path jumps by some centimetres after a gap: standing feet stay."""
    trunk = still(6.0)
    trunk.hips_m[90:, :2] += 0.05
    result = filled(trunk)
    check_feet(result)
    assert len(result.report.footsteps.side) == 2


def test_a_person_who_bows_until_the_head_is_below_the_hips_keeps_the_heading() -> None:
    """A chest that is bent by more than 90° faces backward; the pelvis and the knees do not turn around."""
    trunk = still(5.0)
    trunk.lean_rad[:] = np.radians(125.0) * np.sin(np.pi * smooth((times(trunk) - 1.0) / 3.0)) ** 2
    result = filled(trunk)
    rotation = result.motion.world_from_joint()[:, 0, :3, :3]
    turn = np.degrees(rotation_angle_rad(np.swapaxes(rotation[:-1], -1, -2) @ rotation[1:]))
    assert turn.max() < 10.0
    assert rotation[:, 0, 0].min() > 0.9, "the left side of the pelvis stays on the left"


def test_knees_do_not_jump_if_the_trunk_turns_around_over_standing_feet() -> None:
    legs = leg_geometry(load_skeleton("upper_body", 1.75))
    assert legs is not None
    leg = legs[0]
    yaw = np.radians(np.arange(0.0, 361.0, 5.0))
    zero = 0.0 * yaw
    pelvis = so3_exp(np.column_stack([zero, zero, yaw]))
    path = FootPath(
        ankle_m=np.zeros((len(yaw), 3)), heading_rad=zero, pitch_rad=zero, toe_rad=zero, knee_rad=zero,
    )  # fmt: skip
    hip = np.tile([0.05, 0.1, 0.9 * leg.length_m], (len(yaw), 1))
    thigh = pose_leg(leg, hip, path, pelvis).thigh
    turn = np.degrees(rotation_angle_rad(np.swapaxes(thigh[:-1], -1, -2) @ thigh[1:]))
    # The knee does not turn faster than the pelvis, by 5° from tick to tick.
    assert turn.max() < 5.0


def test_a_foot_does_not_spin_with_a_person_who_spins_between_two_steps() -> None:
    legs = leg_geometry(load_skeleton("upper_body", 1.75))
    assert legs is not None
    ankle = legs[0].ankle_height_m
    steps = Footsteps(
        side=np.array([0, 0]), start_tick=np.array([0, 20]), end_tick=np.array([10, 30]),
        ankle_in_world_m=np.array([[0.0, 0.0, ankle], [0.0, -0.4, ankle]]),
        heading_rad=np.array([0.1, 0.1 + 2.0 * np.pi + 0.5]), is_sure=np.array([False, False]),
    )  # fmt: skip
    path = foot_path(steps, 0, legs[0], None, np.zeros((30, 3)), FPS)
    assert path is not None
    turned = np.abs(np.angle(np.exp(1j * np.diff(path.heading_rad))))
    assert turned.sum() == pytest.approx(0.5, abs=0.01)
