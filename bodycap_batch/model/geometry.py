"""Rotations, rigid transforms and similarities on arrays.

A transform is named ``target_from_source``. It is a 4×4 float64 matrix that multiplies column vectors.
Quaternions are in the order x, y, z, w. scipy is imported inside the functions because the import takes a
second. ``bodycap --help`` and finished jobs do not need scipy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray


def make_transform(rotation: npt.ArrayLike, translation: npt.ArrayLike) -> FloatArray:
    """Combine rotations (...,3,3) and translations (...,3) to rigid transforms (...,4,4).

    The leading axes of rotations and translations are broadcast against each other.
    """
    rotation = np.asarray(rotation, dtype=np.float64)
    translation = np.asarray(translation, dtype=np.float64)
    lead = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    out = np.zeros((*lead, 4, 4))
    out[..., :3, :3] = rotation
    out[..., :3, 3] = translation
    out[..., 3, 3] = 1.0
    return out


def invert(target_from_source: FloatArray) -> FloatArray:
    """Return the inverses source_from_target of rigid transforms (...,4,4)."""
    rotation_t = np.swapaxes(target_from_source[..., :3, :3], -1, -2)
    translation = -np.einsum("...ij,...j->...i", rotation_t, target_from_source[..., :3, 3])
    return make_transform(rotation_t, translation)


def transform_points(target_from_source: FloatArray, x_in_source: FloatArray) -> FloatArray:
    """Transform points from the source frame to the target frame.

    Args:
        target_from_source: One transform (4,4) for all points, or one transform per point (N,4,4).
        x_in_source: Points in the source frame: (...,3) for one transform, (N,3) for one transform per point.
    """
    rotated = np.einsum("...ij,...j->...i", target_from_source[..., :3, :3], x_in_source)
    return np.asarray(rotated + target_from_source[..., :3, 3])


def quat_xyzw_from_rotation(rotation: FloatArray) -> FloatArray:
    """Convert rotations (...,3,3) to unit quaternions (...,4) with w ≥ 0."""
    from scipy.spatial.transform import Rotation

    flat = rotation.reshape(-1, 3, 3)
    if len(flat) == 0:
        return np.zeros((*rotation.shape[:-2], 4))
    quat = Rotation.from_matrix(flat).as_quat(canonical=True)
    return np.asarray(quat.reshape(*rotation.shape[:-2], 4))


def continuous_quat_xyzw(rotation: FloatArray) -> FloatArray:
    """Convert rotations over time (T,...,3,3) to unit quaternions (T,...,4) with continuous signs.

    The sign of each quaternion is chosen such that its dot product with the previous one is not negative.
    """
    quat = quat_xyzw_from_rotation(rotation)
    flips = np.where((quat[1:] * quat[:-1]).sum(axis=-1) < 0.0, -1.0, 1.0)
    quat[1:] *= np.cumprod(flips, axis=0)[..., None]
    return quat


def rotation_from_quat_xyzw(quat_xyzw: npt.ArrayLike) -> FloatArray:
    """Convert quaternions (...,4) to rotations (...,3,3). The norm may have any value except zero."""
    from scipy.spatial.transform import Rotation

    quat = np.asarray(quat_xyzw, dtype=np.float64)
    if quat.size == 0:
        return np.zeros((*quat.shape[:-1], 3, 3))
    matrix = Rotation.from_quat(quat.reshape(-1, 4)).as_matrix()
    return np.asarray(matrix.reshape(*quat.shape[:-1], 3, 3))


def so3_exp(rotvec_rad: npt.ArrayLike) -> FloatArray:
    """Convert rotation vectors (...,3), radians, to rotations (...,3,3)."""
    from scipy.spatial.transform import Rotation

    vec = np.asarray(rotvec_rad, dtype=np.float64)
    matrix = Rotation.from_rotvec(vec.reshape(-1, 3)).as_matrix()
    return np.asarray(matrix.reshape(*vec.shape[:-1], 3, 3))


def so3_log(rotation: FloatArray) -> FloatArray:
    """Convert rotations (...,3,3) to rotation vectors (...,3), radians, with angles up to π."""
    from scipy.spatial.transform import Rotation

    vec = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_rotvec()
    return np.asarray(vec.reshape(*rotation.shape[:-2], 3))


def pose_vectors(pose: FloatArray) -> FloatArray:
    """Return the rotation vectors (radians) and translations (N,6) of rigid transforms (N,4,4)."""
    return np.hstack([so3_log(pose[:, :3, :3]), pose[:, :3, 3]])


def so3_right_jacobian(rotvec_rad: FloatArray) -> FloatArray:
    """Return the right Jacobians (...,3,3) of rotation vectors (...,3), radians.

    A small change δ of a rotation vector φ turns the rotation by the right Jacobian times δ, in the axes of
    the source frame: exp(φ + δ) = exp(φ) exp(J δ).

    Source: Sola, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics", 2018.
    """
    angle = np.linalg.norm(rotvec_rad, axis=-1)[..., None, None]
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 0.5, (1.0 - np.cos(safe)) / safe**2)
    second = np.where(small, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    cross = skew(rotvec_rad)
    return np.asarray(np.eye(3) - first * cross + second * (cross @ cross))


def rotation_angle_rad(rotation: FloatArray) -> FloatArray:
    """Return the angles (...), radians, of rotations (...,3,3)."""
    return np.asarray(np.linalg.norm(so3_log(rotation), axis=-1))


def nearest_rotation(matrix: FloatArray) -> FloatArray:
    """Return the rotations that are nearest to matrices (...,3,3) in the Frobenius norm.

    If a matrix is a sum of rotations, the nearest rotation is the chordal mean of these rotations.

    Source: Umeyama, "Least-squares estimation of transformation parameters between two point
        patterns", PAMI 1991; Hartley et al., "Rotation averaging", IJCV 2013.
    """
    u, _, vt = np.linalg.svd(matrix)
    sign = np.ones(matrix.shape[:-1])
    sign[..., 2] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    return np.asarray((u * sign[..., None, :]) @ vt)


def skew(vector: FloatArray) -> FloatArray:
    """Return the skew-symmetric matrices (...,3,3) of vectors (...,3): ``skew(v) @ w`` is v × w."""
    x, y, z = (vector[..., axis] for axis in range(3))
    zero = np.zeros_like(x)
    rows = [zero, -z, y, z, zero, -x, -y, x, zero]
    return np.stack(rows, axis=-1).reshape(*vector.shape, 3)


def se3_adjoint(target_from_source: FloatArray) -> FloatArray:
    """Return the adjoint matrices Ad (...,6,6) of rigid transforms (...,4,4).

    A motion is a vector of six numbers, with rotation before translation. A small motion ξ in the axes of the
    source frame equals the motion Ad ξ in the axes of the target frame.

    Source: T. Barfoot, "State estimation for robotics", 2017. The book puts translation before rotation.
    """
    rotation = target_from_source[..., :3, :3]
    out = np.zeros((*rotation.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = rotation
    out[..., 3:, :3] = skew(target_from_source[..., :3, 3]) @ rotation
    return out


def interpolate_rotation(start: FloatArray, end: FloatArray, alpha: npt.ArrayLike) -> FloatArray:
    """Interpolate between rotations (...,3,3) by slerp.

    Args:
        start: (...,3,3) rotations at alpha 0.
        end: (...,3,3) rotations at alpha 1.
        alpha: Fractions of the way from `start` to `end`, 0 to 1. They are broadcast against the leading axes
            of the rotations.
    """
    weight = np.asarray(alpha, dtype=np.float64)[..., None]
    return np.asarray(start @ so3_exp(weight * so3_log(np.swapaxes(start, -1, -2) @ end)))


def interpolate_pose(start: FloatArray, end: FloatArray, alpha: npt.ArrayLike) -> FloatArray:
    """Interpolate between rigid transforms (...,4,4): rotations by slerp, translations linearly.

    Args:
        start: (...,4,4) transforms target_from_source at alpha 0.
        end: (...,4,4) transforms target_from_source at alpha 1.
        alpha: Fractions of the way from `start` to `end`, 0 to 1. They are broadcast against the leading axes
            of the transforms.
    """
    weight = np.asarray(alpha, dtype=np.float64)[..., None]
    rotation = interpolate_rotation(start[..., :3, :3], end[..., :3, :3], alpha)
    translation = (1.0 - weight) * start[..., :3, 3] + weight * end[..., :3, 3]
    return make_transform(rotation, translation)


def poses_at(
    times_ns: IntArray, poses: FloatArray, at_ns: IntArray, *, max_gap_ns: int, snap_ns: int = 0
) -> tuple[FloatArray, BoolArray]:
    """Interpolate timed poses at the requested times, between the previous and the next given pose.

    Args:
        times_ns: (N,) times of the given poses, nanoseconds, increasing.
        poses: (N,4,4) given poses.
        at_ns: (M,) requested times, nanoseconds.
        max_gap_ns: Maximum time, nanoseconds, between two neighbouring given poses for interpolation between
            them.
        snap_ns: Maximum time, nanoseconds, between a requested time and the nearest given pose. It is used
            only for requested times that are in a longer gap than `max_gap_ns`, or outside the range of
            `times_ns`. Poses are not interpolated at these times. Instead, the nearest given pose is returned
            unchanged if it is within this limit.

    Returns:
        The poses (M,4,4) at the requested times, and a mask (M,) that is True where there is a pose. Where
        there is no pose, the identity is returned.
    """
    out = np.tile(np.eye(4), (len(at_ns), 1, 1))
    if len(times_ns) == 0:
        return out, np.zeros(len(at_ns), dtype=bool)
    last = len(times_ns) - 1
    after = np.minimum(np.maximum(np.searchsorted(times_ns, at_ns), 1), last)
    before = np.maximum(after - 1, 0)
    start, end = times_ns[before], times_ns[after]
    gap = np.maximum(end - start, 1)
    inside = (at_ns >= start) & (at_ns <= end) & (gap <= max_gap_ns)
    near = np.minimum(np.abs(at_ns - start), np.abs(at_ns - end)) <= snap_ns
    alpha = np.clip((at_ns - start) / gap, 0.0, 1.0)
    alpha = np.where(inside, alpha, np.round(alpha))
    found = inside | near
    if found.any():
        out[found] = interpolate_pose(poses[before[found]], poses[after[found]], alpha[found])
    return out, np.asarray(found)


@dataclass(frozen=True, slots=True)
class Similarity:
    """A similarity transform: x_in_target = scale · rotation · x_in_source + translation.

    Attributes:
        scale: Scale factor, in target units per source unit.
        rotation: (3,3) rotation.
        translation: (3,) translation, in target units.
    """

    scale: float
    rotation: FloatArray
    translation: FloatArray

    def apply(self, x_in_source: FloatArray) -> FloatArray:
        """Transform points (...,3) from the source frame to the target frame."""
        return np.asarray(self.scale * x_in_source @ self.rotation.T + self.translation)

    def apply_to_poses(self, source_from_body: FloatArray) -> FloatArray:
        """Convert poses source_from_body (...,4,4) to poses target_from_body (...,4,4).

        The orientations are rotated, and the positions are transformed like points.
        """
        return make_transform(
            self.rotation @ source_from_body[..., :3, :3],
            self.apply(source_from_body[..., :3, 3]),
        )

    def after(self, first: Similarity) -> Similarity:
        """Return the composition that applies `first`, and then this transform."""
        return Similarity(
            self.scale * first.scale, self.rotation @ first.rotation, self.apply(first.translation)
        )

    def inverse(self) -> Similarity:
        """Return the inverse transform, source_from_target."""
        rotation = self.rotation.T
        return Similarity(1.0 / self.scale, rotation, -(rotation @ self.translation) / self.scale)


def align_points(x_in_source: FloatArray, x_in_target: FloatArray, *, with_scale: bool = True) -> Similarity:
    """Estimate the similarity target_from_source by least squares from corresponding points.

    Args:
        x_in_source: (N,3) points in the source frame, N ≥ 3.
        x_in_target: (N,3) coordinates of the same points in the target frame.
        with_scale: True to estimate the scale. Otherwise the scale is 1, and the transform is rigid.

    Raises:
        ValueError: There are fewer than three points, the shapes differ, or all source points coincide.

    Source: Umeyama, "Least-squares estimation of transformation parameters between two point
        patterns", PAMI 1991.
    """
    if len(x_in_source) < 3 or x_in_source.shape != x_in_target.shape:
        raise ValueError(f"needs 3 matched points or more, got {x_in_source.shape}")
    mean_source, mean_target = x_in_source.mean(axis=0), x_in_target.mean(axis=0)
    centred_source, centred_target = x_in_source - mean_source, x_in_target - mean_target
    variance = float((centred_source**2).sum() / len(x_in_source))
    if variance <= 0.0:
        raise ValueError("all source points coincide")
    u, singular, vt = np.linalg.svd(centred_target.T @ centred_source / len(x_in_source))
    sign = np.ones(3)
    if np.linalg.det(u) * np.linalg.det(vt) < 0:
        sign[2] = -1.0
    rotation = (u * sign) @ vt
    scale = float((singular * sign).sum() / variance) if with_scale else 1.0
    return Similarity(scale, rotation, mean_target - scale * rotation @ mean_source)
