"""Estimate how certain the poses of a map's keyframes are: marginal covariances of the adjustment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.mapping.reconstruction.camera_motion import CameraMotion
from bodycap_batch.model.geometry import invert, skew, transform_points
from bodycap_batch.model.reprojection_derivatives import (
    common_error_ratio,
    picture_cells,
    pose_derivatives,
    projection_jacobian,
    weighted_hessians,
)
from bodycap_batch.model.scene import Map

_MAX_KEYFRAMES = 300
"""Maximum number of keyframes in one system of equations. Of a larger map, evenly spaced keyframes are used.
The covariances are then too large rather than too small, because fewer keyframes see each point. Origin: 100
MB of memory and some seconds. With the velocities of rolling shutters, it takes six times the memory.
Evidence: none."""
_MIN_OBSERVATIONS = 12
"""Minimum number of observations of a keyframe whose covariance is computed. Evidence: none."""
_DAMPING = 1e-9
"""Damping of a point, as a fraction of the trace of its information. It only prevents a singular matrix."""


def keyframe_covariances(
    scene_map: Map, adjusted_px: FloatArray, motions: Mapping[str, CameraMotion] | None = None
) -> FloatArray:
    """Return the covariances (K,6,6) of the keyframes' poses; see `Map.keyframe_covariance`.

    The points are unknown too, so their errors are contained. So are the velocities of keyframes with rolling
    shutters, within their expected errors, and the readout times, within their standard deviations; a readout
    time that is not determined is taken as 0. If the velocities were not adjusted together with the map, the
    covariances are too small: they are those of an adjustment that weights the observations by these errors.

    The gauge is the one in which the mean variance of all keyframes is least. The noise is the reduced
    chi-squared of all observations. It contains large errors, whose influence on the map the robust loss
    reduces: the advantage of this loss is not counted, because it does not reduce errors that neighbouring
    observations have in common. The result is multiplied by the ratio by which such common errors increase
    the variance in the pictures. Evidence: docs/decisions/mapping.md.

    Args:
        scene_map: The map.
        adjusted_px: (M,2) pixels to which the map was adjusted: corrected for a rolling shutter.
        motions: The motions of the cameras with rolling shutters, by camera name.

    Returns:
        The covariances, in the unit of the gauge. Zero rows if the map does not determine them.

    Source: Triggs et al., "Bundle adjustment: a modern synthesis", 2000, sections 6 and 9.
    """
    count = len(scene_map.keyframe_camera)
    chosen = _chosen_keyframes(scene_map)
    system = _Observations.create(scene_map, adjusted_px, chosen, motions or {})
    redundancy = 2 * len(system.point) - 6 * len(chosen) - 3 * system.point_count + 7
    seen = np.bincount(system.keyframe, minlength=len(chosen))
    if len(chosen) < 2 or redundancy <= 0 or not seen.all():
        return np.zeros((0, 6, 6))
    variance_px2 = float((system.residual**2).sum()) / redundancy * _growth(system, len(chosen))
    own = _marginal_blocks(system, scene_map, chosen, variance_px2)
    if own is None:
        return np.zeros((0, 6, 6))
    covariance = own[_nearest_chosen(scene_map, chosen)] * variance_px2
    return covariance.reshape(count, 6, 6)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Observations:
    """The observations of the chosen keyframes, linearised at the map.

    Attributes:
        keyframe: (M,) number of the observing keyframe among the chosen keyframes.
        point: (M,) number of the observed point; points that one chosen keyframe sees are left out.
        point_count: Number of these points.
        rays: (M,2) rays x/z, y/z of the projected points.
        residual: (2,M) projected minus observed pixel.
        by_pose: (2,6,M) derivative with respect to a left perturbation of cam_from_map.
        by_point: (2,3,M) derivative with respect to the point.
        by_velocity: (2,V,M) derivative with respect to the velocities of the keyframe, in their expected
            errors; V is 0 without rolling shutters.
        by_readout: (2,R,M) derivative with respect to the readout times, in their standard deviations.
        depth: Median depth of the points.
    """

    keyframe: IntArray
    point: IntArray
    point_count: int
    rays: FloatArray
    residual: FloatArray
    by_pose: FloatArray
    by_point: FloatArray
    by_velocity: FloatArray
    by_readout: FloatArray
    depth: float

    @staticmethod
    def create(
        scene_map: Map, adjusted_px: FloatArray, chosen: IntArray, motions: Mapping[str, CameraMotion]
    ) -> _Observations:
        number = np.full(len(scene_map.keyframe_camera), -1)
        number[chosen] = np.arange(len(chosen))
        used: BoolArray = number[scene_map.obs_keyframe] >= 0
        seen = np.bincount(scene_map.obs_point[used], minlength=len(scene_map.points))
        rows = np.flatnonzero(used & (seen[scene_map.obs_point] > 1))
        cam_from_map = invert(scene_map.map_from_cam)[scene_map.obs_keyframe[rows]]
        in_cam = transform_points(cam_from_map, scene_map.points[scene_map.obs_point[rows]])
        in_front = in_cam[:, 2] > 0.0
        rows, cam_from_map, in_cam = rows[in_front], cam_from_map[in_front], in_cam[in_front]
        px, px_from_ray = np.empty((len(rows), 2)), np.empty((len(rows), 2, 2))
        rays = in_cam[:, :2] / in_cam[:, 2:]
        names = np.array(scene_map.keyframe_camera)[scene_map.obs_keyframe[rows]]
        for name, lens in scene_map.cameras.items():
            own = np.flatnonzero(names == name)
            px[own], px_from_ray[own] = lens.project(in_cam[own]), projection_jacobian(lens, rays[own])
        residual = px - adjusted_px[rows]
        valid = np.isfinite(residual).all(axis=1) & np.isfinite(px_from_ray).all(axis=(1, 2))
        rows, rays, residual, in_cam = rows[valid], rays[valid], residual[valid], in_cam[valid]
        derivatives = pose_derivatives(
            rays[:, 0], rays[:, 1], 1.0 / in_cam[:, 2], px_from_ray[valid].transpose(1, 2, 0)
        )
        points, point = np.unique(scene_map.obs_point[rows], return_inverse=True)
        by_velocity, by_readout = _motion_derivatives(scene_map, rows, derivatives, motions)
        return _Observations(
            keyframe=number[scene_map.obs_keyframe[rows]],
            point=np.ravel(point),
            point_count=len(points),
            rays=rays,
            residual=residual.T,
            by_pose=derivatives,
            by_point=np.einsum("dim,mij->djm", derivatives[:, 3:], cam_from_map[valid, :3, :3]),
            by_velocity=by_velocity,
            by_readout=by_readout,
            depth=float(np.median(in_cam[:, 2])) if len(in_cam) else 1.0,
        )


def _motion_derivatives(
    scene_map: Map, rows: IntArray, by_pose: FloatArray, motions: Mapping[str, CameraMotion]
) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of residuals with respect to velocities and readout times, in expected errors.

    Until its row is exposed, the camera moves away from its pose. So another velocity changes the pixel like
    another pose. Cameras with equal readout times have one readout time in common.

    Args:
        scene_map: The map.
        rows: (M,) observations of the map.
        by_pose: (2,6,M) derivatives with respect to the pose at the middle row.
        motions: The motions of the cameras with rolling shutters, by camera name.

    Returns:
        The derivatives (2,9,M) with respect to angular velocity, its change and velocity, or (2,0,M) without
        rolling shutters, and the derivatives (2,R,M) with respect to the readout times.
    """
    names = np.array(scene_map.keyframe_camera)[scene_map.obs_keyframe[rows]]
    frame = scene_map.keyframe_frame[scene_map.obs_keyframe[rows]]
    readouts = sorted({(each.readout_s, each.readout_sigma_s) for each in motions.values()})
    by_velocity = np.zeros((2, 9 if motions else 0, len(rows)))
    by_readout = np.zeros((2, len(readouts), len(rows)))
    for name, motion in motions.items():
        own = np.flatnonzero(names == name)
        until = motion.until_exposure(frame[own], scene_map.obs_px[rows[own]])
        errors = motion.errors(frame[own]).T
        by_turn, by_shift = by_pose[:, :3, own], by_pose[:, 3:, own]
        by_velocity[:, :3, own] = by_turn * (until.delay_s * errors[0])
        by_velocity[:, 3:6, own] = by_turn * (0.5 / motion.interval_s * until.delay_s**2 * errors[1])
        by_velocity[:, 6:, own] = by_shift * (until.delay_s * errors[2])
        by_motion = np.einsum("dim,mi->dm", by_turn, until.turn) + np.einsum(
            "dim,mi->dm", by_shift, until.shift
        )
        number = readouts.index((motion.readout_s, motion.readout_sigma_s))
        by_readout[:, number, own] = by_motion * (motion.readout_sigma_s / motion.readout_s)
    return by_velocity, by_readout


def _chosen_keyframes(scene_map: Map) -> IntArray:
    """Return the rows of at most `_MAX_KEYFRAMES` keyframes with enough observations, evenly spaced."""
    seen = np.bincount(scene_map.obs_keyframe, minlength=len(scene_map.keyframe_camera))
    usable = np.flatnonzero(seen >= _MIN_OBSERVATIONS)
    if len(usable) <= _MAX_KEYFRAMES:
        return usable
    return np.asarray(usable[np.linspace(0, len(usable) - 1, _MAX_KEYFRAMES).round().astype(np.int64)])


def _nearest_chosen(scene_map: Map, chosen: IntArray) -> IntArray:
    """Return, for each keyframe (K,), the number of the chosen keyframe of its camera nearest in time."""
    names = np.array(scene_map.keyframe_camera)
    out = np.zeros(len(names), dtype=np.int64)
    for name in np.unique(names).tolist():
        rows = np.flatnonzero(names == name)
        candidates = np.flatnonzero(names[chosen] == name)
        candidates = candidates if len(candidates) else np.arange(len(chosen))
        frames = scene_map.keyframe_frame[chosen[candidates]]
        apart = np.abs(scene_map.keyframe_frame[rows][:, None] - frames)
        out[rows] = candidates[apart.argmin(axis=1)]
    return out


def _marginal_blocks(
    system: _Observations, scene_map: Map, chosen: IntArray, variance_px2: float
) -> FloatArray | None:
    """Return the marginal covariances (C,6,6) for 1 px of noise; None if the system is singular.

    Args:
        system: The observations.
        scene_map: The map.
        chosen: (C,) rows of the chosen keyframes.
        variance_px2: Variance of the noise, px squared, with which the expected errors of the motion are
            weighted.
    """
    from scipy.linalg.lapack import dpotrf, dpotri
    from scipy.sparse import csr_array

    unit = np.repeat([1.0, 1.0 / system.depth], 3)
    # In units of the depth, rotations and translations have variances of the same size.
    by_own = np.concatenate([system.by_pose / unit[None, :, None], system.by_velocity], axis=1)
    size, common = by_own.shape[1], system.by_readout.shape[1]
    count = size * len(chosen)
    order = np.argsort(system.keyframe, kind="stable")
    bounds = np.searchsorted(system.keyframe[order], np.arange(len(chosen) + 1))
    by_point = np.zeros((system.point_count, 3, 3))
    np.add.at(by_point, system.point, np.einsum("dim,djm->mij", system.by_point, system.by_point))
    by_point += _DAMPING * np.einsum("pii->p", by_point)[:, None, None] * np.eye(3)
    half = np.linalg.cholesky(np.linalg.inv(by_point))
    by_all = np.concatenate([by_own, system.by_readout], axis=1)
    mixed = np.einsum("dim,djm->mij", by_all, system.by_point) @ half[system.point]
    places = np.concatenate(
        [
            size * system.keyframe[:, None] + np.arange(size),
            np.broadcast_to(count + np.arange(common), (len(system.keyframe), common)),
        ],
        axis=1,
    )
    rows = np.broadcast_to(places[:, :, None], mixed.shape)
    columns = np.broadcast_to(3 * system.point[:, None, None] + np.arange(3), mixed.shape)
    coupling = csr_array(
        (mixed.ravel(), (rows.ravel(), columns.ravel())), shape=(count + common, 3 * system.point_count)
    )
    reduced = (coupling @ coupling.T).toarray()
    np.negative(reduced, out=reduced)
    del mixed, rows, columns, coupling
    expected = np.r_[np.zeros(6), np.full(size - 6, variance_px2)]
    last = slice(count, count + common)
    reduced[last, last] += variance_px2 * np.eye(common)
    for number in range(len(chosen)):
        seen = order[bounds[number] : bounds[number + 1]]
        own = by_all[:, :, seen].transpose(0, 2, 1).reshape(-1, size + common)
        hessian = own.T @ own
        block = slice(size * number, size * number + size)
        reduced[block, block] += hessian[:size, :size] + np.diag(expected)
        reduced[block, last] += hessian[:size, size:]
        reduced[last, block] += hessian[size:, :size]
        reduced[last, last] += hessian[size:, size:]
    gauge = _gauge_directions(scene_map.map_from_cam[chosen]) * np.tile(unit, len(chosen))[:, None]
    poses = (size * np.arange(len(chosen))[:, None] + np.arange(6)).ravel()
    free = np.zeros((count + common, 7))
    free[poses] = np.linalg.qr(gauge)[0]
    weight = float(np.diag(reduced)[poses].mean())
    reduced += weight * (free @ free.T)
    # The matrix is symmetric, so its transpose is the same matrix in the order that needs no copy.
    factor, failed = dpotrf(reduced.T, lower=1, overwrite_a=1)
    if failed:
        return None
    inverse, failed = dpotri(factor, lower=1, overwrite_c=1)  # only the lower triangle
    if failed:
        return None
    blocks = np.empty((len(chosen), 6, 6))
    for number in range(len(chosen)):
        rows_of = slice(size * number, size * number + 6)
        lower = np.tril(inverse[rows_of, rows_of])
        blocks[number] = lower + np.tril(lower, -1).T - free[rows_of] @ free[rows_of].T / weight
    return np.asarray(blocks / np.outer(unit, unit))


def _gauge_directions(map_from_cam: FloatArray) -> FloatArray:
    """Return the changes (6C,7) of the poses that turn, shift and scale the whole map.

    They are left perturbations of cam_from_map, rotation first.
    """
    cam_from_map = invert(map_from_cam)
    rotation, translation = cam_from_map[:, :3, :3], cam_from_map[:, :3, 3]
    out = np.zeros((len(map_from_cam), 6, 7))
    out[:, :3, :3] = -rotation
    out[:, 3:, :3] = -skew(translation) @ rotation
    out[:, 3:, 3:6] = -rotation
    out[:, 3:, 6] = translation
    return out.reshape(-1, 7)


def _growth(system: _Observations, count: int) -> float:
    """Return the ratio (at least 1) by which common errors in the pictures increase the variance.

    It is the median over the keyframes. The points are taken as known.
    """
    order = np.argsort(system.keyframe, kind="stable")
    keyframe, residual = system.keyframe[order], system.residual[:, order]
    jacobian, weight = system.by_pose[:, :, order], np.ones(len(order))
    starts = np.searchsorted(keyframe, np.arange(count))
    hessians = weighted_hessians(jacobian, weight, starts)
    redundancy = np.maximum(2 * np.bincount(keyframe, minlength=count) - 6, 1)
    variance = np.bincount(keyframe, (residual**2).sum(axis=0), minlength=count) / redundancy
    solvable = np.linalg.matrix_rank(hessians) == 6
    inverse = np.linalg.inv(np.where(solvable[:, None, None], hessians, np.eye(6)))
    inverse[~solvable] = np.nan
    cell = picture_cells(system.rays[order])
    common = common_error_ratio(residual, jacobian, weight, cell, keyframe, inverse)
    ratio = common / np.maximum(variance, np.finfo(float).tiny)
    known = ratio[np.isfinite(ratio)]
    return max(1.0, float(np.median(known))) if len(known) else 1.0
