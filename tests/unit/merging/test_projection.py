"""The projection of a motion with slack onto the rigid skeleton."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.merging.projection.project import initial_motion, project_motion, projection_problem
from bodycap_batch.merging.projection.rigid_motion_solver import (
    RigidMotion,
    StandingJoint,
    cost,
    normal_equations,
    retract,
    solve_rigid_motion,
    windows,
)
from bodycap_batch.model.geometry import rotation_angle_rad
from bodycap_batch.model.skeleton import forward_kinematics
from tests.bodies import merged, reaching


def joint_error(motion_world: np.ndarray, true_world: np.ndarray) -> np.ndarray:
    return np.linalg.norm(motion_world[..., :3, 3] - true_world[..., :3, 3], axis=-1)


def test_a_rigid_graph_does_not_change() -> None:
    truth = reaching()
    result, clocks = merged(truth, slack_m=0.0, slack_rad=0.0, noise_m=0.0)
    projection = project_motion(result, clocks)
    assert joint_error(projection.motion.world_from_joint(), truth.world_from_joint()).max() < 1e-9
    assert projection.gap["joints"]["p95_m"] < 1e-9
    assert projection.gap["cameras"]["left_palm"]["p95_m"] < 1e-9


def test_slack_is_removed_and_the_cameras_reduce_the_error() -> None:
    truth = reaching()
    result, clocks = merged(truth)
    projection = project_motion(result, clocks)
    world, true = projection.motion.world_from_joint(), truth.world_from_joint()
    loose = joint_error(result.graph_world_from_joint, true)[:, result.solved].mean()
    rigid = joint_error(world, true)[:, result.solved].mean()
    # The joints of the graph have errors of 4 mm per coordinate, 6.4 mm in all; cameras have smaller ones.
    assert rigid < 0.65 * loose
    centres = world[..., :3, 3]
    bones = np.linalg.norm(centres[:, 1:] - centres[:, truth.skeleton.parents[1:]], axis=-1)
    np.testing.assert_allclose(
        bones, np.broadcast_to(np.linalg.norm(truth.skeleton.offsets_m[1:], axis=1), bones.shape)
    )
    assert 0.003 < projection.gap["joints"]["p50_m"] < 0.012


def test_unsolved_joints_keep_their_rotations() -> None:
    truth = reaching()
    result, clocks = merged(truth)
    motion = project_motion(result, clocks).motion
    for role in ("LeftUpLeg", "RightLeg", "Neck", "Head"):
        joint = truth.skeleton.index_of_role(role)
        assert joint is not None
        expected = result.graph_world_from_joint[:, truth.skeleton.parents[joint]]
        local = np.swapaxes(expected[:, :3, :3], -1, -2) @ result.graph_world_from_joint[:, joint, :3, :3]
        np.testing.assert_allclose(motion.local_rotation[:, joint], local, atol=1e-12)
        assert not motion.observed[:, joint].any()


@pytest.mark.parametrize("wrong_by_s", [0.0, 0.24])
def test_the_clock_offset_has_a_sign(wrong_by_s: float) -> None:
    """A clock offset of 0.12 s is applied; with the opposite sign, an error of 0.24 s, the gap is large."""
    truth = reaching()
    result, clocks = merged(truth, noise_m=0.0, slack_m=0.0, slack_rad=0.0, offset_s=0.12)
    clocks = {name: replace(clock, offset_s=clock.offset_s - wrong_by_s) for name, clock in clocks.items()}
    gap = project_motion(result, clocks).gap["cameras"]["torso"]["p50_m"]
    # 1.1 m/s · 0.24 s = 26 cm
    assert gap < 1e-9 if wrong_by_s == 0.0 else gap > 0.15


def test_rolling_shutter_has_a_sign() -> None:
    """For a readout time of 20 ms, poses from the top rows are 10 ms before the frame time."""
    truth = reaching()
    result, clocks = merged(truth, noise_m=0.0, slack_m=0.0, slack_rad=0.0, offset_s=-0.01)
    clocks = {name: replace(clock, offset_s=0.0, rolling_shutter_s=0.02) for name, clock in clocks.items()}
    rows = {name: np.zeros(len(truth.root_in_world_m)) for name in clocks}

    def gap(row_fraction: dict[str, np.ndarray]) -> float:
        return float(project_motion(result, clocks, row_fraction).gap["cameras"]["torso"]["p50_m"])

    # 1.1 m/s · 10 ms = 11 mm; the solve absorbs a part of it. The wrong sign doubles the error.
    assert gap(rows) < 1e-6
    assert gap({}) > 0.002
    assert gap({name: 1.0 - row for name, row in rows.items()}) > gap({})


def test_a_gross_camera_error_does_not_move_the_body() -> None:
    truth = reaching()
    result, clocks = merged(truth)
    poses = result.trajectories[1].gauge_from_cam.copy()
    poses[30:34, :3, 3] += 0.6
    paths = (
        result.trajectories[0],
        replace(result.trajectories[1], gauge_from_cam=poses),
        result.trajectories[2],
    )
    clean = project_motion(result, clocks).motion.world_from_joint()
    pulled = project_motion(replace(result, trajectories=paths), clocks).motion.world_from_joint()
    # 60 cm are 120 sigmas; the robust loss leaves an influence below the noise
    assert joint_error(pulled, clean).max() < 0.01


def test_the_correction_does_not_jitter() -> None:
    """White noise of the cameras must not become jitter, measured by a hand's second difference."""
    truth = reaching(120)
    result, clocks = merged(truth, slack_m=0.0, slack_rad=0.0, noise_m=0.005)
    hand = truth.skeleton.index_of_role("LeftHand")
    rough = np.diff(project_motion(result, clocks).motion.world_from_joint()[:, hand, :3, 3], n=2, axis=0)
    smooth = np.diff(truth.world_from_joint()[:, hand, :3, 3], n=2, axis=0)
    # white noise of 5 mm per coordinate has a second difference of 5 · √6 = 12 mm
    assert np.std(rough - smooth) < 0.003


@pytest.mark.parametrize("sigma_m", [None, 0.02, 0.001])
def test_gradient_and_optimum(sigma_m: float | None) -> None:
    """The analytic gradient is that of the cost, and no small step from the solution reduces the cost.

    A hand is held over three of five steps, loosely and so tightly that it slips.
    """
    truth = reaching(6)
    result, clocks = merged(truth, noise_m=0.004)
    problem = projection_problem(result, clocks)
    if sigma_m is not None:
        hand = truth.skeleton.index_of_role("LeftHand")
        assert hand is not None
        held = np.array([True, True, False, False, True])
        problem = replace(problem, standing=(StandingJoint(joint=hand, held=held, sigma_m=sigma_m),))
    rotation = result.graph_world_from_joint[..., :3, :3]
    local = rotation.copy()
    for joint in range(1, len(truth.skeleton.joints)):
        local[:, joint] = np.swapaxes(rotation[:, truth.skeleton.parents[joint]], -1, -2) @ rotation[:, joint]
    start = RigidMotion(root=truth.root_in_world_m.copy(), local=local)
    rng = np.random.default_rng(1)
    # a start away from the graph, so that the change of the correction over time contributes
    away = 3e-3 * rng.normal(size=(6, 3 + 3 * len(problem.solved)))
    start = retract(problem, start, away)
    gradient = normal_equations(problem, start, problem.ancestor_matrix()).gradient
    for _ in range(5):
        step = rng.normal(size=gradient.shape)
        change = cost(problem, retract(problem, start, 1e-6 * step)) - cost(
            problem, retract(problem, start, -1e-6 * step)
        )
        # The derivative of the logarithm is approximated by the identity; the errors here are up to 0.03 rad.
        assert change / 2e-6 == pytest.approx(2.0 * float((gradient * step).sum()), rel=0.03)
    found = solve_rigid_motion(problem, start)
    best = cost(problem, found)
    assert best < cost(problem, start)
    for _ in range(20):
        step = 1e-3 * rng.normal(size=gradient.shape)
        assert cost(problem, retract(problem, found, step)) > best


@pytest.mark.parametrize("standing", [False, True])
def test_the_correction_does_not_depend_on_the_rate(standing: bool) -> None:
    """At 30 and at 60 ticks per second, with the same camera frames, the corrected motions are equal.

    The graph of a body that stands still sways by 2 cm; cameras, and a planted hand, say otherwise.
    """
    paths, motions = None, []
    for fps in (30.0, 60.0):
        moving = reaching(round(118 * fps / 30.0) + 1, fps=fps)
        still = replace(
            moving,
            root_in_world_m=np.zeros_like(moving.root_in_world_m),
            local_rotation=np.repeat(moving.local_rotation[:1], len(moving.local_rotation), axis=0),
        )
        result, clocks = merged(still, slack_m=0.0, slack_rad=0.0, noise_m=0.0)
        paths = paths or (result.trajectories[:1] if standing else result.trajectories)
        graph = result.graph_world_from_joint.copy()
        graph[..., 0, 3] += 0.02 * np.sin(4e-9 * (result.times_ns() - result.start_ns))[:, None]
        held = np.zeros(graph.shape[:2], dtype=bool)
        held[:, result.skeleton.index_of_role("LeftHand")] = standing
        result = replace(result, graph_world_from_joint=graph, trajectories=paths, standing=held)
        centres = project_motion(result, clocks).motion.world_from_joint()[..., :3, 3]
        motions.append(centres[:, result.solved])
    coarse, fine = motions
    moved = (coarse - coarse.mean(axis=0)).std()
    assert moved > 0.003
    # The sampling of a sway of 0.6 Hz leaves 0.01. With equal weights of all ticks it was 0.08 to 0.09.
    assert (fine[::2] - coarse).std() < 0.03 * moved


def test_a_standing_foot_also_stands_in_the_rigid_motion() -> None:
    moving = reaching()
    count = len(moving.root_in_world_m)
    still = replace(
        moving,
        root_in_world_m=np.repeat(moving.root_in_world_m[:1], count, axis=0),
        local_rotation=np.repeat(moving.local_rotation[:1], count, axis=0),
    )
    result, clocks = merged(still)
    hand = still.skeleton.index_of_role("LeftHand")
    assert hand is not None
    standing = np.zeros((count, len(still.skeleton.joints)), dtype=bool)
    standing[:, hand] = True
    free, held = (project_motion(each, clocks) for each in (result, replace(result, standing=standing)))
    slide = [
        np.linalg.norm(np.diff(each.motion.world_from_joint()[:, hand, :3, 3], axis=0), axis=1).mean()
        for each in (free, held)
    ]
    assert slide[1] < 0.5 * slide[0]
    feet = held.gap["feet"][still.skeleton.joints[hand]]
    assert feet["slide_p50_m_per_s"] == pytest.approx(still.fps * slide[1], rel=0.3)
    assert "feet" not in free.gap
    # The gap to the cameras grows only because the motion no longer follows their noise.
    assert held.gap["cameras"]["left_palm"]["p95_m"] < 1.2 * free.gap["cameras"]["left_palm"]["p95_m"]


def test_a_long_motion_is_solved_in_windows_as_in_one_piece() -> None:
    result, clocks = merged(reaching(120), noise_m=0.005)
    standing = np.zeros((120, len(result.skeleton.joints)), dtype=bool)
    standing[50:70, result.skeleton.index_of_role("LeftHand")] = True
    standing[10:30, result.skeleton.index_of_role("RightHand")] = True
    result = replace(result, standing=standing)
    problem, start = projection_problem(result, clocks), initial_motion(result)
    whole = solve_rigid_motion(problem, start)
    # Three windows of 40 ticks, each with 25 ticks more on both sides: 65, 90 and 65 ticks.
    pieces = solve_rigid_motion(problem, start, window_ticks=40, overlap_s=25 / 30)
    centres = [
        forward_kinematics(result.skeleton, motion.root, motion.local)[..., :3, 3]
        for motion in (whole, pieces)
    ]
    # The influence of a tick falls by a tenth per tick, and faster at ticks with camera poses.
    assert 0.0 < np.abs(centres[1] - centres[0]).max() < 1e-4


def test_windows_cover_all_ticks() -> None:
    assert windows(120, 2000) == [(0, 120)]
    assert windows(120, 40) == [(0, 40), (40, 80), (80, 120)]
    assert windows(121, 40) == [(0, 30), (30, 60), (60, 91), (91, 121)]


def test_no_camera_and_nothing_solved() -> None:
    truth = reaching(3)
    result, clocks = merged(truth, slack_m=0.0, slack_rad=0.0)
    bare = replace(result, trajectories=(), mounts=(), solved=np.zeros(len(result.solved), dtype=bool))
    projection = project_motion(bare, clocks)
    turned = np.swapaxes(projection.motion.local_rotation, -1, -2) @ truth.local_rotation
    assert rotation_angle_rad(turned).max() < 1e-9
    assert joint_error(projection.motion.world_from_joint(), truth.world_from_joint()).max() < 1e-9
    assert projection.gap == {"cameras": {}}
