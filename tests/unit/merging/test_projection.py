"""The projection of a motion with slack onto the rigid skeleton."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.merging.projection import project_motion
from bodycap_batch.model.geometry import rotation_angle_rad
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


def test_slack_is_removed() -> None:
    truth = reaching()
    result, clocks = merged(truth)
    projection = project_motion(result, clocks)
    world, true = projection.motion.world_from_joint(), truth.world_from_joint()
    loose = joint_error(result.graph_world_from_joint, true)[:, result.solved].mean()
    rigid = joint_error(world, true)[:, result.solved].mean()
    # The joints of the graph have errors of 4 mm per coordinate, 6.4 mm in all. The root takes their mean,
    # and the rotations, with errors of 0.6° per axis, move the end of a bone of 0.3 m by 4 mm.
    assert rigid < loose
    np.testing.assert_array_equal(
        projection.motion.local_rotation[:, 0], result.graph_world_from_joint[:, 0, :3, :3]
    )
    centres = world[..., :3, 3]
    bones = np.linalg.norm(centres[:, 1:] - centres[:, truth.skeleton.parents[1:]], axis=-1)
    np.testing.assert_allclose(
        bones, np.broadcast_to(np.linalg.norm(truth.skeleton.offsets_m[1:], axis=1), bones.shape)
    )
    assert 0.003 < projection.gap["joints"]["p50_m"] < 0.012


def test_the_sliding_of_standing_feet_is_stated() -> None:
    result, clocks = merged(reaching(), slack_m=0.0, slack_rad=0.0, noise_m=0.0)
    hand = result.skeleton.index_of_role("LeftHand")
    assert hand is not None
    standing = np.zeros(result.observed.shape, dtype=bool)
    standing[10:30, hand] = True
    projection = project_motion(replace(result, standing=standing), clocks)
    moved = np.diff(projection.motion.world_from_joint()[10:30, hand, :3, 3], axis=0)
    slide = projection.gap["feet"][result.skeleton.joints[hand]]
    expected = result.fps * float(np.median(np.linalg.norm(moved, axis=1)))
    assert slide["slide_p50_m_per_s"] == pytest.approx(expected)
    assert "feet" not in project_motion(result, clocks).gap


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

    # 1.1 m/s · 10 ms = 11 mm. The wrong sign doubles the error.
    assert gap(rows) < 1e-6
    assert gap({}) > 0.002
    assert gap({name: 1.0 - row for name, row in rows.items()}) > gap({})


def test_no_camera_and_nothing_solved() -> None:
    truth = reaching(3)
    result, clocks = merged(truth, slack_m=0.0, slack_rad=0.0)
    bare = replace(result, trajectories=(), mounts=(), solved=np.zeros(len(result.solved), dtype=bool))
    projection = project_motion(bare, clocks)
    turned = np.swapaxes(projection.motion.local_rotation, -1, -2) @ truth.local_rotation
    assert rotation_angle_rad(turned).max() < 1e-9
    assert joint_error(projection.motion.world_from_joint(), truth.world_from_joint()).max() < 1e-9
    assert projection.gap == {"cameras": {}}
