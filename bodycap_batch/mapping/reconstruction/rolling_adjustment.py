"""Adjust keyframes of rolling shutters together with their velocities.

Between two frames, a hand turns otherwise than a smooth path through the poses of the frames. An adjustment
with the velocities of this path moves poses and points until they agree with the wrong velocities. So the
velocities are unknowns of the adjustment, too. The path gives their expected values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import make_transform, skew, so3_exp, so3_right_jacobian
from bodycap_batch.model.reprojection_derivatives import projection_jacobian

_UNKNOWNS = 15
"""Number of unknowns of a keyframe: turn and shift of its pose, angular velocity, the change of the angular
velocity in a frame interval, velocity; three each."""
_FIRST_DAMPING = 1e-4
"""First damping of a step, as a ratio of the diagonal. Evidence: none."""
_MIN_DAMPING = 1e-8
"""Smallest damping of a step, as a ratio of the diagonal. Evidence: none."""
_MAX_DAMPING = 1e3
"""An adjustment ends if no step with this damping reduces the cost. Evidence: none."""
_DAMPING_FACTOR = 10.0
"""Factor of the damping after a step, or after a step that is not taken. Evidence: none."""
_CONVERGED = 1e-4
"""Relative change of the cost at which an adjustment ends. Origin: that of the robust adjustment."""
_MAX_ITERATIONS = 8
"""Maximum number of steps with one width of the loss. Evidence: none."""
_POINT_DAMPING = 1e-9
"""Damping of a point, as a fraction of the trace of its information. It only prevents a singular matrix."""
_NOT_SEEN_PX = 1e3
"""Residual (px) of a point that has no projection."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RowObservations:
    """Observations of points by keyframes, and the expected motion of the cameras until they are exposed.

    K is the number of keyframes, M the number of observations.

    Attributes:
        lenses: The camera models.
        lens: (K,) index of the camera model of each keyframe.
        keyframe: (M,) keyframe of each observation.
        point: (M,) observed point.
        px: (M,2) detected pixel.
        delay_s: (M,) time of the exposure minus the time of the keyframe, seconds.
        turn: (M,3) expected rotation vector from the camera at the exposure to the camera at the time of the
            keyframe, rad.
        shift: (M,3) expected motion of the camera until the exposure, in its frame at the time of the
            keyframe, map units.
        noise_px: Standard deviation of an observation, px.
        interval_s: (K,) frame interval of the camera of each keyframe, seconds.
    """

    lenses: Sequence[Camera]
    lens: IntArray
    keyframe: IntArray
    point: IntArray
    px: FloatArray
    delay_s: FloatArray
    turn: FloatArray
    shift: FloatArray
    noise_px: float
    interval_s: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class VelocityErrors:
    """Expected errors of the velocities of the path, along each axis.

    Attributes:
        rate: (K,) of the angular velocity of each keyframe, rad/s.
        rate_change: (K,) of the change of the angular velocity in a frame interval, rad/s.
        velocity: (K,) of the velocity, map units per second.
    """

    rate: FloatArray
    rate_change: FloatArray
    velocity: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class RollingMap:
    """Keyframes with velocities, and points.

    Attributes:
        cam_from_map: (K,4,4) poses of the keyframes at the exposure of the middle row.
        points: (P,3) points in the map frame.
        velocities: (K,9) corrections of the angular velocity (rad/s), of its change in a frame interval
            (rad/s) and of the velocity in the camera frame (map units per second).
    """

    cam_from_map: FloatArray
    points: FloatArray
    velocities: FloatArray

    def moved(self, step: FloatArray, point_step: FloatArray) -> RollingMap:
        """Return the map after steps of the keyframes (K,15) and of the points (P,3)."""
        return RollingMap(
            cam_from_map=make_transform(so3_exp(step[:, :3]), step[:, 3:6]) @ self.cam_from_map,
            points=self.points + point_step,
            velocities=self.velocities + step[:, 6:],
        )


def adjust_with_velocities(
    seen: RowObservations, start: RollingMap, errors: VelocityErrors, widths_px: Sequence[float]
) -> RollingMap:
    """Minimise the residuals of all observations over poses, velocities and points, with a Cauchy loss.

    The gauge is free. Intrinsics and readout times are constant.

    Args:
        seen: The observations.
        start: The map so far.
        errors: The expected errors of the velocities of the path.
        widths_px: Widths of the loss, px, one after the other. Large ones first keep observations that
            disagree because the start is wrong. A width of 0 stands for the median absolute residual.

    Source: Hedborg et al., "Rolling shutter bundle adjustment", CVPR 2012, for velocities in an adjustment;
        Triggs et al., "Bundle adjustment: a modern synthesis", 2000, section 6, for the reduced system.
    """
    found = start
    for width_px in widths_px:
        width = width_px or max(0.1 * seen.noise_px, float(np.median(np.abs(_residuals(seen, found)[0]))))
        found = _adjust(seen, found, errors, width)
    return found


def px_at_mid_row(seen: RowObservations, found: RollingMap) -> FloatArray:
    """Return the observed pixels (M,2) moved to the instant of the middle row.

    They are the projections of the points at this instant plus the residuals of the adjustment, which are
    not turned with the camera. A point without a projection keeps its detected pixel.
    """
    k = seen.keyframe
    residual, seen_at = _residuals(seen, found)
    pose = found.cam_from_map[k]
    in_cam = np.einsum("mij,mj->mi", pose[:, :3, :3], found.points[seen.point]) + pose[:, :3, 3]
    with np.errstate(invalid="ignore", divide="ignore"):
        px = _project(seen, in_cam[:, :2] / in_cam[:, 2:]) - residual
    good = seen_at & (in_cam[:, 2] > 0.0) & np.isfinite(px).all(axis=1)
    return np.where(good[:, None], px, seen.px)


def _adjust(seen: RowObservations, found: RollingMap, errors: VelocityErrors, width_px: float) -> RollingMap:
    """Return the map after Levenberg-Marquardt steps with one width of the loss."""
    prior = np.zeros((len(found.cam_from_map), _UNKNOWNS))
    for part, sigma in zip(
        np.split(prior[:, 6:], 3, axis=1), (errors.rate, errors.rate_change, errors.velocity), strict=True
    ):
        part[:] = (seen.noise_px / sigma[:, None]) ** 2
    cost, damping = _cost(seen, found, prior, width_px), _FIRST_DAMPING
    for _ in range(_MAX_ITERATIONS):
        system = _Normal.create(seen, found, prior, width_px)
        while True:
            step = system.solve(damping)
            moved = None if step is None else found.moved(*step)
            new_cost = np.inf if moved is None else _cost(seen, moved, prior, width_px)
            if new_cost < cost or damping > _MAX_DAMPING:
                break
            damping *= _DAMPING_FACTOR
        if moved is None or not new_cost < cost:
            return found
        change, cost, found = (cost - new_cost) / cost, new_cost, moved
        damping = max(damping / _DAMPING_FACTOR, _MIN_DAMPING)
        if change < _CONVERGED:
            break
    return found


def _cost(seen: RowObservations, found: RollingMap, prior: FloatArray, width_px: float) -> float:
    squared = (_residuals(seen, found)[0] ** 2).sum(axis=1)
    loss = width_px**2 * np.log1p(squared / width_px**2)
    return float(loss.sum() + (prior[:, 6:] * found.velocities**2).sum())


def _at_exposure(
    seen: RowObservations, found: RollingMap
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the points in the cameras at their exposure and at the middle row, and the turns between.

    Returns:
        Points (M,3) at the exposure, points (M,3) at the middle row, rotation vectors (M,3) and rotations
        exposure_from_middle (M,3,3).
    """
    k, delay = seen.keyframe, seen.delay_s[:, None]
    pose = found.cam_from_map[k]
    at_middle = np.einsum("mij,mj->mi", pose[:, :3, :3], found.points[seen.point]) + pose[:, :3, 3]
    rate, change, velocity = np.split(found.velocities[k], 3, axis=1)
    turn = seen.turn + delay * rate + (0.5 / seen.interval_s[k][:, None]) * delay**2 * change
    rotation = so3_exp(-turn)
    in_cam = np.einsum("mij,mj->mi", rotation, at_middle - seen.shift - delay * velocity)
    return in_cam, at_middle, turn, rotation


def _project(seen: RowObservations, rays: FloatArray) -> FloatArray:
    """Return the pixels (M,2) of rays (M,2)."""
    px = np.empty((len(rays), 2))
    lens_of = seen.lens[seen.keyframe]
    for number, lens in enumerate(seen.lenses):
        own = np.flatnonzero(lens_of == number)
        px[own] = lens.project(np.column_stack([rays[own], np.ones(len(own))]))
    return px


def _residuals(seen: RowObservations, found: RollingMap) -> tuple[FloatArray, BoolArray]:
    """Return projected minus observed pixels (M,2), and a mask (M,) of the points that have a projection."""
    in_cam = _at_exposure(seen, found)[0]
    in_front = in_cam[:, 2] > 0.0
    residual = _project(seen, in_cam[:, :2] / np.where(in_front, in_cam[:, 2], 1.0)[:, None]) - seen.px
    valid = np.asarray(in_front & np.isfinite(residual).all(axis=1))
    return np.where(valid[:, None], residual, _NOT_SEEN_PX), valid


@dataclass(frozen=True, slots=True, kw_only=True)
class _Normal:
    """The weighted normal equations of one step, with the points still to be eliminated.

    Attributes:
        keyframe: (M,) keyframe of each observation.
        point: (M,) point of each observation.
        own: (K,15,15) blocks of the keyframes, with the prior.
        gradient: (K,15) gradient of half the cost with respect to the keyframes.
        by_point: (P,3,3) blocks of the points.
        point_gradient: (P,3) gradient with respect to the points.
        mixed: (M,15,3) blocks of keyframe and point of each observation.
    """

    keyframe: IntArray
    point: IntArray
    own: FloatArray
    gradient: FloatArray
    by_point: FloatArray
    point_gradient: FloatArray
    mixed: FloatArray

    @staticmethod
    def create(seen: RowObservations, found: RollingMap, prior: FloatArray, width_px: float) -> _Normal:
        residual, valid = _residuals(seen, found)
        by_keyframe, by_point = _derivatives(seen, found, valid)
        weight = valid / (1.0 + (residual**2).sum(axis=1) / width_px**2)
        order = np.argsort(seen.keyframe, kind="stable")
        bounds = np.searchsorted(seen.keyframe[order], np.arange(len(prior) + 1))
        own = np.zeros((len(prior), _UNKNOWNS, _UNKNOWNS))
        gradient = np.zeros((len(prior), _UNKNOWNS))
        gradient[:, 6:] = prior[:, 6:] * found.velocities
        for number in range(len(prior)):
            rows = order[bounds[number] : bounds[number + 1]]
            flat = by_keyframe[rows].reshape(-1, _UNKNOWNS)
            weighted = flat * np.repeat(weight[rows], 2)[:, None]
            own[number] = weighted.T @ flat + np.diag(prior[number])
            gradient[number] += weighted.T @ residual[rows].ravel()
        weighted = by_point * weight[:, None, None]
        blocks, point_gradient = np.zeros((len(found.points), 3, 3)), np.zeros((len(found.points), 3))
        np.add.at(blocks, seen.point, np.einsum("mdi,mdj->mij", weighted, by_point))
        np.add.at(point_gradient, seen.point, np.einsum("mdi,md->mi", weighted, residual))
        return _Normal(
            keyframe=seen.keyframe,
            point=seen.point,
            own=own,
            gradient=gradient,
            by_point=blocks,
            point_gradient=point_gradient,
            mixed=np.einsum("mdi,mdj->mij", by_keyframe, weighted),
        )

    def solve(self, damping: float) -> tuple[FloatArray, FloatArray] | None:
        """Return the steps (K,15) of the keyframes and (P,3) of the points; None if there is no step."""
        from scipy.linalg import LinAlgError, cho_factor, cho_solve
        from scipy.sparse import csr_array

        count, size = self.gradient.shape
        axes = np.arange(3)
        diagonal = self.by_point[:, axes, axes]
        damped = self.by_point.copy()
        trace = diagonal.sum(axis=1, keepdims=True)
        damped[:, axes, axes] += damping * diagonal + _POINT_DAMPING * np.maximum(trace, 1.0)
        half = np.linalg.cholesky(np.linalg.inv(damped))
        mixed = self.mixed @ half[self.point]
        rows = np.broadcast_to(size * self.keyframe[:, None, None] + np.arange(size)[:, None], mixed.shape)
        columns = np.broadcast_to(3 * self.point[:, None, None] + axes, mixed.shape)
        coupling = csr_array(
            (mixed.ravel(), (rows.ravel(), columns.ravel())), shape=(size * count, 3 * len(half))
        )
        reduced = (coupling @ coupling.T).toarray()
        np.negative(reduced, out=reduced)
        for number, block in enumerate(self.own):
            place = slice(size * number, size * number + size)
            own = np.diag(block)
            reduced[place, place] += block + np.diag(damping * own + _POINT_DAMPING * max(own.max(), 1.0))
        from_points = np.einsum("pij,pi->pj", half, self.point_gradient).ravel()
        try:
            factor = cho_factor(reduced, overwrite_a=True, check_finite=False)
        except LinAlgError:
            return None
        step = cho_solve(factor, coupling @ from_points - self.gradient.ravel(), check_finite=False)
        point_step = -np.einsum("pij,pj->pi", half, (from_points + coupling.T @ step).reshape(-1, 3))
        return step.reshape(count, size), point_step


def _derivatives(seen: RowObservations, found: RollingMap, valid: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of the residuals with respect to keyframes (M,2,15) and points (M,2,3)."""
    in_cam, at_middle, turn, rotation = _at_exposure(seen, found)
    depth = np.where(valid, in_cam[:, 2], 1.0)
    rays = in_cam[:, :2] / depth[:, None]
    px_from_ray = np.empty((len(rays), 2, 2))
    lens_of = seen.lens[seen.keyframe]
    for number, lens in enumerate(seen.lenses):
        own = np.flatnonzero(lens_of == number)
        px_from_ray[own] = projection_jacobian(lens, rays[own])
    px_from_ray[~(valid & np.isfinite(px_from_ray).all(axis=(1, 2)))] = 0.0
    ray_from_cam = np.zeros((len(rays), 2, 3))
    ray_from_cam[:, 0, 0] = ray_from_cam[:, 1, 1] = 1.0
    ray_from_cam[:, :, 2] = -rays
    by_exposed = px_from_ray @ ray_from_cam / depth[:, None, None]
    by_middle = by_exposed @ rotation
    by_turn = by_exposed @ skew(in_cam) @ so3_right_jacobian(turn)
    delay = seen.delay_s[:, None, None]
    by_keyframe = np.concatenate(
        [
            -by_middle @ skew(at_middle),
            by_middle,
            by_turn * delay,
            by_turn * (0.5 / seen.interval_s[seen.keyframe][:, None, None] * delay**2),
            -by_middle * delay,
        ],
        axis=2,
    )
    return by_keyframe, by_middle @ found.cam_from_map[seen.keyframe][:, :3, :3]
