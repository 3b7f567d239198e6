"""Rigid and similarity transforms on arrays of 4×4 matrices.

Transforms are ``target_from_source``, float64, column vectors. Quaternions are xyzw. scipy takes a second
to import and is imported where it is needed: ``bodycap --help`` and finished jobs do without it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray


def make_transform(rotation: npt.ArrayLike, translation: npt.ArrayLike) -> FloatArray:
    """Stack (...,3,3) rotations and (...,3) translations into (...,4,4)."""
    rotation = np.asarray(rotation, dtype=np.float64)
    translation = np.asarray(translation, dtype=np.float64)
    lead = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    out = np.zeros((*lead, 4, 4))
    out[..., :3, :3] = rotation
    out[..., :3, 3] = translation
    out[..., 3, 3] = 1.0
    return out


def invert(target_from_source: FloatArray) -> FloatArray:
    """Invert rigid transforms (...,4,4)."""
    rotation_t = np.swapaxes(target_from_source[..., :3, :3], -1, -2)
    translation = -np.einsum("...ij,...j->...i", rotation_t, target_from_source[..., :3, 3])
    return make_transform(rotation_t, translation)


def transform_points(target_from_source: FloatArray, x_in_source: FloatArray) -> FloatArray:
    """Apply one (4,4) transform to points (...,3), or (N,4,4) to (N,3)."""
    rotated = np.einsum("...ij,...j->...i", target_from_source[..., :3, :3], x_in_source)
    return np.asarray(rotated + target_from_source[..., :3, 3])


def quat_xyzw_from_rotation(rotation: FloatArray) -> FloatArray:
    """Convert (...,3,3) rotations to unit quaternions (...,4), w ≥ 0."""
    from scipy.spatial.transform import Rotation

    flat = rotation.reshape(-1, 3, 3)
    if len(flat) == 0:
        return np.zeros((*rotation.shape[:-2], 4))
    quat = Rotation.from_matrix(flat).as_quat(canonical=True)
    return np.asarray(quat.reshape(*rotation.shape[:-2], 4))


def continuous_quat_xyzw(rotation: FloatArray) -> FloatArray:
    """Convert rotations over time (T,...,3,3) to quaternions (T,...,4) whose sign never jumps."""
    quat = quat_xyzw_from_rotation(rotation)
    flips = np.where((quat[1:] * quat[:-1]).sum(axis=-1) < 0.0, -1.0, 1.0)
    quat[1:] *= np.cumprod(flips, axis=0)[..., None]
    return quat


def rotation_from_quat_xyzw(quat_xyzw: npt.ArrayLike) -> FloatArray:
    """Convert quaternions (...,4) (any norm but zero) to (...,3,3) rotations."""
    from scipy.spatial.transform import Rotation

    quat = np.asarray(quat_xyzw, dtype=np.float64)
    if quat.size == 0:
        return np.zeros((*quat.shape[:-1], 3, 3))
    matrix = Rotation.from_quat(quat.reshape(-1, 4)).as_matrix()
    return np.asarray(matrix.reshape(*quat.shape[:-1], 3, 3))


def so3_exp(rotvec_rad: npt.ArrayLike) -> FloatArray:
    """Rotation vectors (...,3) to rotations (...,3,3)."""
    from scipy.spatial.transform import Rotation

    vec = np.asarray(rotvec_rad, dtype=np.float64)
    matrix = Rotation.from_rotvec(vec.reshape(-1, 3)).as_matrix()
    return np.asarray(matrix.reshape(*vec.shape[:-1], 3, 3))


def so3_log(rotation: FloatArray) -> FloatArray:
    """Rotations (...,3,3) to rotation vectors (...,3), angle ≤ π."""
    from scipy.spatial.transform import Rotation

    vec = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_rotvec()
    return np.asarray(vec.reshape(*rotation.shape[:-2], 3))


def rotation_angle_rad(rotation: FloatArray) -> FloatArray:
    """Geodesic angle (...) of rotations (...,3,3)."""
    return np.asarray(np.linalg.norm(so3_log(rotation), axis=-1))


def nearest_rotation(matrix: FloatArray) -> FloatArray:
    """The rotations nearest to matrices (...,3,3) in the Frobenius norm.

    Applied to a sum of rotations this is their chordal mean.

    Source: Umeyama, "Least-squares estimation of transformation parameters between two point
        patterns", PAMI 1991; Hartley et al., "Rotation averaging", IJCV 2013.
    """
    u, _, vt = np.linalg.svd(matrix)
    sign = np.ones(matrix.shape[:-1])
    sign[..., 2] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    return np.asarray((u * sign[..., None, :]) @ vt)


def skew(vector: FloatArray) -> FloatArray:
    """Vectors (...,3) to matrices (...,3,3) whose product with w is the cross product vector × w."""
    x, y, z = (vector[..., axis] for axis in range(3))
    zero = np.zeros_like(x)
    rows = [zero, -z, y, z, zero, -x, -y, x, zero]
    return np.stack(rows, axis=-1).reshape(*vector.shape, 3)


def se3_adjoint(target_from_source: FloatArray) -> FloatArray:
    """Adjoints (...,6,6) of rigid transforms, rotation before translation.

    A small motion ξ of the source frame, (rotation, translation) in its own axes, is the motion Ad ξ in the
    axes of the target.

    Source: Barfoot, "State estimation for robotics", 2017, with the order of the two halves exchanged.
    """
    rotation = target_from_source[..., :3, :3]
    out = np.zeros((*rotation.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = rotation
    out[..., 3:, :3] = skew(target_from_source[..., :3, 3]) @ rotation
    return out


def interpolate_pose(start: FloatArray, end: FloatArray, alpha: npt.ArrayLike) -> FloatArray:
    """Interpolate rigid transforms (...,4,4): slerp for rotation, linear for translation.

    Args:
        start: target_from_source at alpha 0.
        end: target_from_source at alpha 1.
        alpha: Fraction(s), broadcast against the leading axes.
    """
    weight = np.asarray(alpha, dtype=np.float64)[..., None]
    delta = so3_log(np.swapaxes(start[..., :3, :3], -1, -2) @ end[..., :3, :3])
    rotation = start[..., :3, :3] @ so3_exp(weight * delta)
    translation = (1.0 - weight) * start[..., :3, 3] + weight * end[..., :3, 3]
    return make_transform(rotation, translation)


def poses_at(
    times_ns: IntArray, poses: FloatArray, at_ns: IntArray, *, max_gap_ns: int, snap_ns: int = 0
) -> tuple[FloatArray, BoolArray]:
    """Interpolate timed poses between their two neighbours.

    Args:
        times_ns: (N,) increasing.
        poses: (N,4,4).
        at_ns: (M,) wanted times.
        max_gap_ns: Where the neighbours are further apart than this, there is no pose.
        snap_ns: A pose this near in time is taken as it is, even outside the range or in a gap.

    Returns:
        (M,4,4) poses, identity where there is none, and (M,) where there is one.
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
    """target_from_source as scale · rotation · x + translation."""

    scale: float
    rotation: FloatArray
    translation: FloatArray

    def apply(self, x_in_source: FloatArray) -> FloatArray:
        """Map points (...,3)."""
        return np.asarray(self.scale * x_in_source @ self.rotation.T + self.translation)

    def apply_to_poses(self, source_from_body: FloatArray) -> FloatArray:
        """Map poses (...,4,4): rotation turned, position scaled, turned and moved."""
        return make_transform(
            self.rotation @ source_from_body[..., :3, :3],
            self.apply(source_from_body[..., :3, 3]),
        )

    def after(self, first: Similarity) -> Similarity:
        """Return this transform applied to what `first` gives."""
        return Similarity(
            self.scale * first.scale, self.rotation @ first.rotation, self.apply(first.translation)
        )

    def inverse(self) -> Similarity:
        """Return source_from_target."""
        rotation = self.rotation.T
        return Similarity(1.0 / self.scale, rotation, -(rotation @ self.translation) / self.scale)


def align_points(x_in_source: FloatArray, x_in_target: FloatArray, *, with_scale: bool = True) -> Similarity:
    """Least-squares similarity (or rigid) transform between matched points (N,3).

    Raises:
        ValueError: Fewer than three points, or all in one place.

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
