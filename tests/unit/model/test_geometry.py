"""Transforms: against scipy, against their inverses, and errors for invalid input."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from bodycap_batch.model.geometry import (
    Similarity,
    align_points,
    interpolate_pose,
    invert,
    make_transform,
    nearest_rotation,
    poses_at,
    quat_xyzw_from_rotation,
    rotation_angle_rad,
    rotation_from_quat_xyzw,
    se3_adjoint,
    skew,
    so3_exp,
    so3_log,
    so3_right_jacobian,
    transform_points,
)

SEEDS = st.integers(0, 2**32 - 1)


def random_poses(count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return make_transform(
        Rotation.random(count, random_state=rng).as_matrix(), rng.normal(scale=3.0, size=(count, 3))
    )


def random_similarity(seed: int) -> Similarity:
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=rng).as_matrix()
    return Similarity(float(np.exp(rng.normal())), rotation, rng.normal(scale=5.0, size=3))


def test_inverse_and_points() -> None:
    poses = random_poses(20, 0)
    np.testing.assert_allclose(invert(poses) @ poses, np.tile(np.eye(4), (20, 1, 1)), atol=1e-12)
    points = np.random.default_rng(1).normal(size=(20, 3))
    expected = (poses @ np.concatenate([points, np.ones((20, 1))], axis=1)[..., None])[:, :3, 0]
    np.testing.assert_allclose(transform_points(poses, points), expected, atol=1e-12)
    np.testing.assert_allclose(
        transform_points(poses[0], points)[3], poses[0, :3, :3] @ points[3] + poses[0, :3, 3]
    )


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seed=SEEDS)
def test_quaternions_and_rotation_vectors_go_both_ways(seed: int) -> None:
    rotation = random_poses(5, seed)[:, :3, :3]
    quats = quat_xyzw_from_rotation(rotation)
    assert (quats[:, 3] >= 0).all()
    np.testing.assert_allclose(rotation_from_quat_xyzw(-2.0 * quats), rotation, atol=1e-12)
    vectors = so3_log(rotation)
    assert (np.linalg.norm(vectors, axis=1) <= np.pi + 1e-12).all()
    np.testing.assert_allclose(so3_exp(vectors), rotation, atol=1e-12)
    np.testing.assert_allclose(rotation_angle_rad(rotation), np.linalg.norm(vectors, axis=1))


def test_empty_arrays_keep_their_shape() -> None:
    assert quat_xyzw_from_rotation(np.zeros((0, 3, 3))).shape == (0, 4)
    assert rotation_from_quat_xyzw(np.zeros((0, 4))).shape == (0, 3, 3)


def test_interpolation_is_slerp_and_line() -> None:
    first, second = random_poses(2, 5)
    slerp = Slerp([0, 1], Rotation.from_matrix(np.stack([first[:3, :3], second[:3, :3]])))
    for alpha in (0.0, 0.3, 1.0):
        middle = interpolate_pose(first, second, alpha)
        np.testing.assert_allclose(middle[:3, :3], slerp(alpha).as_matrix(), atol=1e-12)
        np.testing.assert_allclose(middle[:3, 3], (1 - alpha) * first[:3, 3] + alpha * second[:3, 3])


def test_poses_at_refuses_gaps_and_ends() -> None:
    times = np.array([0, 10, 20, 100, 110])
    poses = make_transform(np.tile(np.eye(3), (5, 1, 1)), np.stack([times, 0 * times, 0 * times], axis=1))
    at = np.array([-5, 0, 4, 20, 21, 60, 99, 105, 112])
    found_poses, found = poses_at(times, poses, at, max_gap_ns=10)
    assert found.tolist() == [False, True, True, True, False, False, False, True, False]
    np.testing.assert_allclose(found_poses[found, 0, 3], at[found])
    np.testing.assert_array_equal(found_poses[~found], np.tile(np.eye(4), (5, 1, 1)))
    snapped, near = poses_at(times, poses, at, max_gap_ns=10, snap_ns=2)
    assert near.tolist() == [False, True, True, True, True, False, True, True, True]
    np.testing.assert_allclose(snapped[[4, 6, 8], 0, 3], [20, 100, 110])


def test_poses_at_with_one_pose_or_none() -> None:
    pose = random_poses(1, 0)
    _, found = poses_at(np.array([5]), pose, np.array([4, 5, 6]), max_gap_ns=100)
    assert found.tolist() == [False, True, False]
    _, found = poses_at(np.zeros(0, dtype=np.int64), np.zeros((0, 4, 4)), np.array([4]), max_gap_ns=100)
    assert found.tolist() == [False]


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seed=SEEDS)
def test_similarity_inverse_and_alignment(seed: int) -> None:
    similarity = random_similarity(seed)
    points = np.random.default_rng(seed).normal(size=(6, 3))
    moved = similarity.apply(points)
    np.testing.assert_allclose(similarity.inverse().apply(moved), points, atol=1e-9)
    found = align_points(points, moved)
    assert found.scale == pytest.approx(similarity.scale, rel=1e-9)
    np.testing.assert_allclose(found.rotation, similarity.rotation, atol=1e-8)
    np.testing.assert_allclose(found.apply(points), moved, atol=1e-8)
    poses = random_poses(4, seed)
    np.testing.assert_allclose(similarity.apply_to_poses(poses)[:, :3, 3], similarity.apply(poses[:, :3, 3]))
    np.testing.assert_allclose(
        similarity.apply_to_poses(poses)[:, :3, :3], similarity.rotation @ poses[:, :3, :3]
    )


def test_rigid_alignment_keeps_scale_and_never_mirrors() -> None:
    points = np.random.default_rng(0).normal(size=(10, 3))
    rigid = align_points(points, 2.0 * points, with_scale=False)
    assert rigid.scale == 1.0
    np.testing.assert_allclose(rigid.rotation, np.eye(3), atol=1e-9)
    mirrored = align_points(points, points * [1, 1, -1])
    assert np.linalg.det(mirrored.rotation) == pytest.approx(1.0)


def test_alignment_beats_any_other() -> None:
    """For noisy points, no nearby similarity has a smaller residual."""
    rng = np.random.default_rng(3)
    points = rng.normal(size=(30, 3))
    target = random_similarity(1).apply(points) + rng.normal(scale=0.1, size=(30, 3))
    best = align_points(points, target)
    residual = ((best.apply(points) - target) ** 2).sum()
    for _ in range(50):
        other = Similarity(
            best.scale * (1 + 1e-3 * rng.normal()),
            so3_exp(1e-3 * rng.normal(size=3)) @ best.rotation,
            best.translation + 1e-3 * rng.normal(size=3),
        )
        assert ((other.apply(points) - target) ** 2).sum() > residual


def test_alignment_refuses_too_little() -> None:
    with pytest.raises(ValueError, match="3 matched points"):
        align_points(np.zeros((2, 3)), np.zeros((2, 3)))
    with pytest.raises(ValueError, match="coincide"):
        align_points(np.zeros((5, 3)), np.ones((5, 3)))


@given(SEEDS)
def test_the_nearest_rotation_is_a_rotation_and_beats_its_neighbours(seed: int) -> None:
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(5, 3, 3))
    found = nearest_rotation(matrix)
    assert np.allclose(found @ np.swapaxes(found, -1, -2), np.eye(3), atol=1e-12)
    assert np.allclose(np.linalg.det(found), 1.0)
    other = found @ so3_exp(rng.normal(scale=0.1, size=(5, 3)))
    distance = np.linalg.norm(matrix - found, axis=(-2, -1))
    assert (distance <= np.linalg.norm(matrix - other, axis=(-2, -1)) + 1e-12).all()


def test_the_nearest_rotation_to_a_rotation_is_itself() -> None:
    rotation = random_poses(4, 7)[:, :3, :3]
    assert np.allclose(nearest_rotation(3.0 * rotation), rotation)


@given(SEEDS)
def test_skew_is_the_cross_product(seed: int) -> None:
    first, second = np.random.default_rng(seed).normal(size=(2, 4, 3))
    assert np.allclose(np.einsum("nij,nj->ni", skew(first), second), np.cross(first, second))


def test_the_adjoint_moves_a_small_motion_to_other_axes() -> None:
    """T exp(ξ) = exp(Ad ξ) T, up to the square of a motion of 1e-6."""
    pose = random_poses(1, 3)[0]
    motion = np.array([1.0, -2.0, 0.5, 3.0, 1.0, -1.0]) * 1e-6

    def small(step: np.ndarray) -> np.ndarray:
        return make_transform(so3_exp(step[:3]), step[3:])

    assert np.allclose(pose @ small(motion), small(se3_adjoint(pose) @ motion) @ pose, atol=1e-10)


@pytest.mark.parametrize("angle", [0.0, 1e-5, 0.3, 2.5])
def test_the_right_jacobian_turns_small_changes_of_a_rotation_vector(angle: float) -> None:
    vector = angle * np.array([0.6, -0.48, 0.64])
    for step in 1e-6 * np.eye(3):
        turned = so3_log(so3_exp(vector).T @ so3_exp(vector + step))
        assert turned == pytest.approx(so3_right_jacobian(vector) @ step, abs=1e-10)
