"""Adjust keyframes of rolling shutters together with their velocities and readout times.

Between two frames, a hand turns otherwise than a smooth path through the poses of the frames. An adjustment
with the velocities of this path moves poses and points until they agree with the wrong velocities. So the
velocities are unknowns of the adjustment, too. The path gives their expected values. The same holds for a
wrong readout time: it is an unknown that all keyframes of a camera have in common.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.mapping.reconstruction.reduced_system import POINT_DAMPING, CommonPoints, NormalEquations
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
_CONVERGED = 1e-3
"""Relative change of the cost at which an adjustment ends. Evidence: docs/decisions/mapping.md."""
_LENGTHS = (1.0, 1.5, 2.25, 3.4, 5.0)
"""Lengths of a step that are tried, one after another. Evidence: docs/decisions/mapping.md."""
_MAX_ITERATIONS = 8
"""Maximum number of steps with one width of the loss. Evidence: none."""
_MIN_NOISE_RATIO = 0.1
"""Smallest noise that residuals can show, as a ratio of the expected noise. It only prevents a division by
zero."""
_MIN_LEFT_RATIO = 0.1
"""Smallest ratio of the residuals that poses and points do not absorb. It only prevents a division by
zero."""
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
        readout: (K,) number of the readout time of the camera of each keyframe, one of R. Turns and shifts
            are proportional to it. A camera without a rolling shutter has any number; its delays are 0.
        informative: (K,) True if the expected motion of the keyframe is exact enough to determine the
            readout time.
        common_points: The points that pairs of keyframes have in common.
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
    readout: IntArray
    informative: BoolArray
    common_points: CommonPoints

    @property
    def informative_observations(self) -> BoolArray:
        """Mask (M,) of the observations that determine a readout time."""
        return np.asarray((self.delay_s != 0.0) & self.informative[self.keyframe])


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionErrors:
    """Expected errors of the velocities of the path, along each axis, and of the readout times.

    Attributes:
        rate: (K,) of the angular velocity of each keyframe, rad/s.
        rate_change: (K,) of the change of the angular velocity in a frame interval, rad/s.
        velocity: (K,) of the velocity, map units per second.
        readout_ratio: (R,) expected ratio of each readout time to that of the observations.
        readout: (R,) expected error of this ratio.
    """

    rate: FloatArray
    rate_change: FloatArray
    velocity: FloatArray
    readout_ratio: FloatArray
    readout: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class RollingMap:
    """Keyframes with velocities, and points.

    Attributes:
        cam_from_map: (K,4,4) poses of the keyframes at the exposure of the middle row.
        points: (P,3) points in the map frame.
        velocities: (K,9) corrections of the angular velocity (rad/s), of its change in a frame interval
            (rad/s) and of the velocity in the camera frame (map units per second).
        readout_ratio: (R,) ratio of each readout time to that of the observations. It does not change the
            displacements by the corrections of the velocities. If it did, a longer readout time would make
            the same displacements cheaper, and all estimates would be too long.
    """

    cam_from_map: FloatArray
    points: FloatArray
    velocities: FloatArray
    readout_ratio: FloatArray

    def moved(self, step: FloatArray, point_step: FloatArray, readout_step: FloatArray) -> RollingMap:
        """Return the map after steps of the keyframes (K,15), of the points (P,3) and of the ratios (R,)."""
        return RollingMap(
            cam_from_map=make_transform(so3_exp(step[:, :3]), step[:, 3:6]) @ self.cam_from_map,
            points=self.points + point_step,
            velocities=self.velocities + step[:, 6:],
            readout_ratio=self.readout_ratio + readout_step,
        )


def adjust_with_velocities(
    seen: RowObservations, start: RollingMap, errors: MotionErrors, width_px: float
) -> RollingMap:
    """Minimise the residuals of all observations over poses, velocities, readout times and points.

    The loss is that of Cauchy. The gauge is free. Intrinsics are constant.

    Args:
        seen: The observations.
        start: The map so far.
        errors: The expected errors of the velocities of the path and of the readout times.
        width_px: Width of the loss, px. A large one keeps observations that disagree because the start is
            wrong.

    Source: Hedborg et al., "Rolling shutter bundle adjustment", CVPR 2012, for velocities in an adjustment;
        Triggs et al., "Bundle adjustment: a modern synthesis", 2000, section 6, for the reduced system.
    """
    prior = _prior(seen, errors)
    found = start
    cost, damping = _cost(seen, found, prior, width_px), _FIRST_DAMPING
    for _ in range(_MAX_ITERATIONS):
        system = _normal_equations(seen, found, prior, width_px)
        while True:
            moved, new_cost = _moved(found, system, damping, lambda each: _cost(seen, each, prior, width_px))
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


def readout_errors(
    seen: RowObservations, found: RollingMap, errors: MotionErrors, width_px: float
) -> FloatArray:
    """Return the standard deviations (R,) of the ratios of the readout times of an adjusted map.

    They follow from the scatter of the influences of single keyframes, because the residuals of a keyframe
    have common errors and its velocities may be wrong. A standard deviation is infinite if the adjustment
    does not determine it.

    Args:
        seen: The observations.
        found: The adjusted map.
        errors: The expected errors of the adjustment.
        width_px: Width of the loss of the adjustment, px.

    Source: Liang, Zeger, "Longitudinal data analysis using generalized linear models", 1986, for the variance
        of an estimate from clusters.
    """
    prior = _prior(seen, errors)
    system = _normal_equations(seen, found, prior, width_px, expected=True)
    count = len(system.by_common)
    out = np.full(count, np.inf)
    factored = system.factored(_MIN_DAMPING)
    if factored is None:
        return out
    residual, valid = _residuals(seen, found)
    by_keyframe, by_point = _derivatives(seen, found, valid)
    weight = _weights(residual, valid, width_px)
    force = residual * weight[:, None]
    # Without common errors, the errors of the observations alone would make this variance.
    variance = 0.5 * float((force**2).sum()) / max(float((weight**2).sum()), 1e-12)
    left, places = _left_ratio(system, int(valid.sum())), system.places()
    for number in range(count):
        unit = np.zeros(len(system.gradient))
        unit[number - count] = 1.0
        own, points = factored.solve(unit, np.zeros_like(system.point_gradient))
        change = np.einsum("mdi,mi->md", by_keyframe, own[places][seen.keyframe])
        change += np.einsum("mdi,mi->md", by_point, points[seen.point])
        influence = np.bincount(seen.keyframe, (change * force).sum(axis=1), minlength=len(places))
        # An expected velocity is an observation, too. So is an expected readout time.
        expected = prior.by_keyframe[:, 6:] * found.velocities
        influence += (own[places[:, 6:_UNKNOWNS]] * expected).sum(axis=1)
        readout = own[number - count] * seen.noise_px
        scatter = (influence**2).sum() / left + readout**2 * system.by_common[number]
        out[number] = np.sqrt(max(scatter, own[number - count] * variance))
    return out


def usual_residual_px(seen: RowObservations, found: RollingMap) -> float:
    """Return the median absolute residual, px; at least a part of the noise."""
    return max(_MIN_NOISE_RATIO * seen.noise_px, float(np.median(np.abs(_residuals(seen, found)[0]))))


def velocity_squares(
    seen: RowObservations, found: RollingMap, errors: MotionErrors
) -> tuple[FloatArray, FloatArray]:
    """Return the mean squares (K,3) of the corrections of the velocities, and the variances (K,3) of them.

    They are means over the three axes: of angular velocity, (rad/s) squared; of its change in a frame
    interval, the same; and of velocity. The points are taken as known.
    """
    width_px = usual_residual_px(seen, found)
    system = _normal_equations(seen, found, _prior(seen, errors), width_px)
    own = system.own[:, :_UNKNOWNS, :_UNKNOWNS].copy()
    axes = np.arange(_UNKNOWNS)
    own[:, axes, axes] *= 1.0 + _MIN_DAMPING
    pose = axes[:6]
    own[:, pose, pose] += POINT_DAMPING * np.maximum(own[:, pose, pose].max(axis=1, keepdims=True), 1.0)
    variance = seen.noise_px**2 * np.linalg.inv(own)[:, axes, axes][:, 6:]
    square = found.velocities**2
    return square.reshape(-1, 3, 3).mean(axis=2), variance.reshape(-1, 3, 3).mean(axis=2)


def correction_ratios(seen: RowObservations, found: RollingMap) -> FloatArray:
    """Return how wrong the velocities of the paths usually are (R,), as a ratio of the displacements.

    It is the median displacement by the corrections of the velocities, divided by the median displacement by
    the readout time; 0 for a readout time that displaces nothing.
    """
    rows = seen.keyframe
    turn, correction = _turns(seen, found)
    turned, corrected = np.linalg.norm(turn, axis=1), np.linalg.norm(correction, axis=1)
    out = np.zeros(len(found.readout_ratio))
    for number in range(len(out)):
        own = (seen.readout[rows] == number) & seen.informative_observations
        usual = float(np.median(turned[own])) if own.any() else 0.0
        out[number] = float(np.median(corrected[own])) / usual if usual else 0.0
    return out


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


@dataclass(frozen=True, slots=True, kw_only=True)
class _Prior:
    """Weights of the expected errors, in px squared, and the expected ratios of the readout times.

    Attributes:
        by_keyframe: (K,15) weights; 0 for the pose.
        by_readout: (R,) weights.
        readout_ratio: (R,) expected ratios.
    """

    by_keyframe: FloatArray
    by_readout: FloatArray
    readout_ratio: FloatArray

    def cost(self, found: RollingMap) -> float:
        """Return the cost of the deviations from the expected motion, px squared."""
        own = float((self.by_keyframe[:, 6:] * found.velocities**2).sum())
        return own + float((self.by_readout * (found.readout_ratio - self.readout_ratio) ** 2).sum())


def _prior(seen: RowObservations, errors: MotionErrors) -> _Prior:
    by_keyframe = np.zeros((len(errors.rate), _UNKNOWNS))
    for part, sigma in zip(
        np.split(by_keyframe[:, 6:], 3, axis=1),
        (errors.rate, errors.rate_change, errors.velocity),
        strict=True,
    ):
        part[:] = (seen.noise_px / sigma[:, None]) ** 2
    return _Prior(
        by_keyframe=by_keyframe,
        by_readout=(seen.noise_px / errors.readout) ** 2,
        readout_ratio=errors.readout_ratio,
    )


def _cost(seen: RowObservations, found: RollingMap, prior: _Prior, width_px: float) -> float:
    squared = (_residuals(seen, found)[0] ** 2).sum(axis=1)
    return float((width_px**2 * np.log1p(squared / width_px**2)).sum()) + prior.cost(found)


def _at_exposure(
    seen: RowObservations, found: RollingMap
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the points in the cameras at their exposure and at the middle row, and the turns between.

    Returns:
        Points (M,3) at the exposure, points (M,3) at the middle row, rotation vectors (M,3) and rotations
        exposure_from_middle (M,3,3).
    """
    k = seen.keyframe
    ratio = _ratios(seen, found)
    delay = seen.delay_s[:, None]
    pose = found.cam_from_map[k]
    at_middle = np.einsum("mij,mj->mi", pose[:, :3, :3], found.points[seen.point]) + pose[:, :3, 3]
    turn = np.add(*_turns(seen, found))
    rotation = so3_exp(-turn)
    velocity = found.velocities[k, 6:]
    in_cam = np.einsum("mij,mj->mi", rotation, at_middle - ratio * seen.shift - delay * velocity)
    return in_cam, at_middle, turn, rotation


def _turns(seen: RowObservations, found: RollingMap) -> tuple[FloatArray, FloatArray]:
    """Return the expected rotation vectors (M,3) until the exposures, and their corrections (M,3), rad."""
    k = seen.keyframe
    delay = seen.delay_s[:, None]
    rate, change = np.split(found.velocities[k, :6], 2, axis=1)
    correction = delay * rate + (0.5 / seen.interval_s[k][:, None]) * delay**2 * change
    return _ratios(seen, found) * seen.turn, correction


def _ratios(seen: RowObservations, found: RollingMap) -> FloatArray:
    """Return the ratios (M,1) of the readout times, 1 for keyframes that do not determine it."""
    k = seen.keyframe
    return np.asarray(np.where(seen.informative[k], found.readout_ratio[seen.readout[k]], 1.0)[:, None])


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


def _moved(
    found: RollingMap, system: NormalEquations, damping: float, cost: Callable[[RollingMap], float]
) -> tuple[RollingMap | None, float]:
    """Return the map after a step, and its cost; None and infinity if there is no step with this damping.

    A robust loss makes steps too short, so the step is made longer as long as this reduces the cost. A cost
    takes much less time than a step.
    """
    factored = system.factored(damping)
    if factored is None:
        return None, np.inf
    own, points = factored.solve(-system.gradient, -system.point_gradient)
    keyframes, ratios = np.split(own, [_UNKNOWNS * len(system.own)])
    step = keyframes.reshape(-1, _UNKNOWNS), points, ratios
    best, least = None, np.inf
    for length in _LENGTHS:
        moved = found.moved(*(length * each for each in step))
        current = cost(moved)
        if not current < least:
            break
        best, least = moved, current
    return best, least


def _normal_equations(
    seen: RowObservations, found: RollingMap, prior: _Prior, width_px: float, *, expected: bool = False
) -> NormalEquations:
    """Return the equations of a step. The common unknowns are the ratios of the readout times.

    Args:
        seen: The observations.
        found: The map so far.
        prior: The expected motion.
        width_px: Width of the loss, px.
        expected: True for blocks of the expected second derivatives of the cost, which an error needs; False
            for those of the weighted squares. These are larger, and a step with them is safer.
    """
    residual, valid = _residuals(seen, found)
    by_keyframe, by_point = _derivatives(seen, found, valid)
    weight = _weights(residual, valid, width_px)
    # The derivative of w·r along r is w² - w·(1 - w), and w across it. Their mean is w².
    curvature = weight**2 if expected else weight
    count, size = len(prior.by_keyframe), _UNKNOWNS + 1
    order = np.argsort(seen.keyframe, kind="stable")
    bounds = np.searchsorted(seen.keyframe[order], np.arange(count + 1))
    own, sums = np.zeros((count, size, size)), np.zeros((count, size))
    for number in range(count):
        rows = order[bounds[number] : bounds[number + 1]]
        flat = by_keyframe[rows].reshape(-1, size)
        own[number] = (flat * np.repeat(curvature[rows], 2)[:, None]).T @ flat
        sums[number] = flat.T @ (residual[rows] * weight[rows, None]).ravel()
    own[:, np.arange(_UNKNOWNS), np.arange(_UNKNOWNS)] += prior.by_keyframe
    sums[:, 6:_UNKNOWNS] += prior.by_keyframe[:, 6:] * found.velocities
    by_readout = prior.by_readout * (found.readout_ratio - prior.readout_ratio)
    np.add.at(by_readout, seen.readout, sums[:, _UNKNOWNS])
    weighted = by_point * curvature[:, None, None]
    blocks, point_gradient = np.zeros((len(found.points), 3, 3)), np.zeros((len(found.points), 3))
    np.add.at(blocks, seen.point, np.einsum("mdi,mdj->mij", weighted, by_point))
    np.add.at(point_gradient, seen.point, np.einsum("mdi,md->mi", by_point, residual * weight[:, None]))
    return NormalEquations(
        keyframe=seen.keyframe,
        point=seen.point,
        common_points=seen.common_points,
        common=seen.readout,
        own=own,
        gradient=np.concatenate([sums[:, :_UNKNOWNS].ravel(), by_readout]),
        by_common=prior.by_readout,
        by_point=blocks,
        point_gradient=point_gradient,
        mixed=np.swapaxes(weighted, 1, 2) @ by_keyframe,
    )


def _left_ratio(system: NormalEquations, count: int) -> float:
    """Return the ratio of the residuals of observations that poses and points do not absorb.

    Args:
        system: The equations.
        count: Number of observations.
    """
    unknowns = 6 * len(system.own) + 3 * len(system.by_point) + len(system.by_common)
    return max(1.0 - unknowns / max(2 * count, 1), _MIN_LEFT_RATIO)


def _weights(residual: FloatArray, valid: BoolArray, width_px: float) -> FloatArray:
    """Return the weights (M,) of residuals (M,2) with a Cauchy loss."""
    return np.asarray(valid / (1.0 + (residual**2).sum(axis=1) / width_px**2))


def _derivatives(seen: RowObservations, found: RollingMap, valid: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of the residuals.

    Returns:
        The derivatives (M,2,16) with respect to the keyframes and the ratio of their readout time, and
        (M,2,3) with respect to the points.
    """
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
    k = seen.keyframe
    delay = seen.delay_s[:, None, None]
    by_ratio = np.einsum("mdi,mi->md", by_turn, seen.turn) - np.einsum("mdi,mi->md", by_middle, seen.shift)
    by_ratio *= seen.informative[k][:, None]
    by_keyframe = np.concatenate(
        [
            -by_middle @ skew(at_middle),
            by_middle,
            by_turn * delay,
            by_turn * (0.5 / seen.interval_s[k][:, None, None] * delay**2),
            -by_middle * delay,
            by_ratio[:, :, None],
        ],
        axis=2,
    )
    return by_keyframe, by_middle @ found.cam_from_map[k][:, :3, :3]
