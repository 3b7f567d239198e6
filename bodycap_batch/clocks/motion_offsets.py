"""Measure the clocks of cameras from their motion in one map.

The score of `motion_score` is the logarithm of the likelihood of each offset of a pair of cameras. Cameras
are added to the reference camera one after the other, the clearest first: the scores of a camera with all of
those before it are summed. An offset is accepted only if it is much more likely than all offsets far from it
together, and if its score is higher than that of unrelated motions.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bodycap_batch.clocks.joint_offsets import (
    CRYSTAL_SIGMA_PPM,
    MAX_DRIFT_PPM,
    ClockPair,
    solve_clocks,
)
from bodycap_batch.clocks.motion_score import (
    LIMB_WEIGHTS_HZ,
    TRUNK_WEIGHTS_HZ,
    MotionScore,
    mean_square_distance,
    motion_score,
)
from bodycap_batch.clocks.motion_signals import STEP_S, CameraPath, MotionSignals, motion_signals
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.camera_clock import ClockRelation
from bodycap_batch.model.scene import Trajectory

MIN_COMMON_S = 2.0
"""Least time in which both cameras were localised, seconds. Evidence: none."""
_MIN_COMMON_SHARE = 0.25
"""Least common time, as a share of the shorter path. Evidence: none."""
_NEAR_S = 0.25
"""Maximum difference, seconds, of offsets that belong to one peak. Origin: half of a quick step."""
_MIN_LOG_ODDS = 10.0
"""Least logarithm of the likelihood of the peak over that of all other offsets. Evidence:
docs/decisions/clocks.md."""
_MIN_SCORE = 10.0
"""Least score of an accepted offset. Evidence: none."""
_MAX_SIGMA_S = 0.040
"""Maximum standard deviation of an accepted offset, seconds. Evidence: docs/decisions/clocks.md."""
_MIN_EDGE_S = 0.1
"""Least difference, seconds, of an accepted offset from the end of those that are possible. Nearer to it, the
true peak may be beyond the end. Evidence: none."""
_SIGMA_FACTOR = 1.1
"""Ratio of the error of an offset to the width of its peak. Evidence: docs/decisions/clocks.md."""
_LIMB_LAG_SIGMA_S = 0.010
"""Standard deviation, seconds, of an offset that more motion does not reduce: a limb may follow the trunk or
move ahead of it. Evidence: docs/decisions/clocks.md."""
_LEG_LAG_SIGMA_S = 0.040
"""The same for a camera on a leg, which moves ahead of the trunk or behind it by up to half a step. Evidence:
docs/decisions/clocks.md."""
_LEG_ROLES = ("UpLeg", "Leg", "Foot")
"""Ends of the roles of the bones of a leg."""
_MAX_CLOCK_SIGMA_S = 0.06
"""Maximum standard deviation of the clock of a camera in the common solution, seconds."""
_FINE_S = 0.005
"""Time between the offsets at which a peak is evaluated, seconds."""
_GRID_S = 0.01
"""Time between the offsets at which added scores are evaluated, seconds."""
_MIN_DRIFT_SPAN_S = 60.0
"""Least common time, seconds, from which the drift is measured."""
_WINDOW_S = 20.0
"""Duration of the windows from which the drift is measured, seconds. Evidence: none."""
_WINDOW_REACH_S = 0.3
"""Maximum difference, seconds, of the offset of a window from that of the whole recording."""
_MAX_PAIR_SIGMA_S = 0.1
"""Maximum width, seconds, of the peak of a pair that is used in the common solution. A wider peak contains no
information within `_NEAR_S`."""
_MIN_LAGS, _MIN_WINDOW_LAGS, _MIN_WINDOWS = 2, 4, 3
"""Minimum number of offsets with a score of a pair and of a window, and minimum number of windows of a drift.
Origin: a line, a cubic spline, and a residual."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionCurve:
    """The score of a pair of cameras for all offsets.

    Attributes:
        first: Name of the first camera.
        second: Name of the second camera.
        signals: Signals of both.
        weights_hz: Weights of the parts of the score.
        limb_lag_s: Standard deviation of the offset that more motion does not reduce, seconds.
        scores: The scores.
    """

    first: str
    second: str
    signals: tuple[MotionSignals, MotionSignals] = field(repr=False)
    weights_hz: tuple[float, ...]
    limb_lag_s: float
    scores: MotionScore = field(repr=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionClocks:
    """The clocks of cameras from their motion.

    Attributes:
        reference: Name of the reference camera.
        clocks: Clock of each camera that is connected to the reference camera, with that camera.
        curves: The score of each pair of cameras with enough common time.
        reasons: Why a camera has no clock, by camera.
    """

    reference: str
    clocks: dict[str, ClockRelation]
    curves: tuple[MotionCurve, ...]
    reasons: dict[str, str]


@dataclass(frozen=True, slots=True)
class _Peak:
    """The highest peak of a curve.

    Attributes:
        lag_s: Mean offset of the peak, seconds.
        width_s: Standard deviation of the peak, seconds.
        score: Highest score.
        log_odds: Logarithm of the likelihood of the peak over that of all other offsets.
        edge_s: Difference of the highest score from the nearest end of the offsets, seconds.
        limb_lag_s: Standard deviation of the offset that more motion does not reduce, seconds.
    """

    lag_s: float
    width_s: float
    score: float
    log_odds: float
    edge_s: float
    limb_lag_s: float

    def problem(self) -> str:
        """Return why the offset is not determined; empty if it is."""
        if self.edge_s < _MIN_EDGE_S:
            return "the best offset is at the end of the offsets that are possible"
        if self.log_odds < _MIN_LOG_ODDS:
            return "several offsets suit the motion equally well: it repeats, or there is too little of it"
        if self.score < _MIN_SCORE:
            return "the motions resemble each other no more than unrelated motions do"
        if self.sigma_s > _MAX_SIGMA_S:
            return f"the motion determines the offset only to ± {self.sigma_s:.2f} s"
        return ""

    @property
    def sigma_s(self) -> float:
        """Standard deviation of the offset, seconds."""
        return float(np.hypot(_SIGMA_FACTOR * self.width_s, self.limb_lag_s))


def _limb_lag_s(path: CameraPath) -> float:
    return _LEG_LAG_SIGMA_S if path.role.endswith(_LEG_ROLES) else _LIMB_LAG_SIGMA_S


def _pair_curves(
    paths: Sequence[CameraPath], signals: Mapping[str, MotionSignals | None]
) -> list[MotionCurve]:
    """Return the scores of all pairs with enough common time, in the axes of a camera on the trunk."""
    curves = []
    # A camera on the trunk is the first of its pairs.
    ordered = sorted(paths, key=lambda path: not path.is_on_trunk)
    for first, second in itertools.combinations(ordered, 2):
        one, two = signals[first.camera], signals[second.camera]
        if one is None or two is None:
            continue
        weights_hz = TRUNK_WEIGHTS_HZ if first.is_on_trunk else LIMB_WEIGHTS_HZ
        least_s = max(MIN_COMMON_S, _MIN_COMMON_SHARE * min(one.present_s, two.present_s))
        found = motion_score(one, two, weights_hz, least_s)
        if len(found.lags_s) >= _MIN_LAGS:
            curves.append(
                MotionCurve(
                    first=first.camera,
                    second=second.camera,
                    signals=(one, two),
                    weights_hz=weights_hz,
                    limb_lag_s=max(_limb_lag_s(first), _limb_lag_s(second)),
                    scores=found,
                )
            )
    return curves


def _find_peak(lags_s: FloatArray, score: FloatArray, step_s: float, limb_lag_s: float) -> _Peak:
    """Return the highest peak of scores (L,) at offsets (L,) that are `step_s` apart."""
    best = int(score.argmax())
    near = np.abs(lags_s - lags_s[best]) <= _NEAR_S
    height = float(score[best])
    likelihood = np.exp(score - height)
    inside, outside = float(likelihood[near].sum()), float(likelihood[~near].sum())
    lag_s = float(likelihood[near] @ lags_s[near]) / inside
    variance = float(likelihood[near] @ (lags_s[near] - lag_s) ** 2) / inside
    # No other offset: the peak is compared with one typical offset.
    rivals = max(float(np.log(max(outside, 1e-300))), -height - float(np.log(step_s)))
    log_odds = float(np.log(inside)) - rivals
    edge_s = float(min(lags_s[best] - lags_s[0], lags_s[-1] - lags_s[best]))
    return _Peak(lag_s, float(np.sqrt(variance)), height, log_odds, edge_s, limb_lag_s)


def _refined(curve: MotionCurve, lag_s: float) -> ClockPair | None:
    """Return offset, drift and their standard deviations near an offset; None if it is no clear peak."""
    scores, (least_s, most_s) = curve.scores, curve.scores.lags_s[[0, -1]]
    if not least_s <= lag_s <= most_s:
        return None
    first, second = curve.signals
    near = np.arange(max(lag_s - _NEAR_S, least_s), min(lag_s + _NEAR_S, most_s) + 1e-9, _FINE_S)
    peak = _find_peak(near, scores.at(near), _FINE_S, curve.limb_lag_s)
    start_s = max(second.first_step * STEP_S, first.first_step * STEP_S - peak.lag_s)
    end_s = min(
        (second.first_step + second.count) * STEP_S,
        (first.first_step + first.count) * STEP_S - peak.lag_s,
    )
    pair = ClockPair(
        first=curve.first,
        second=curve.second,
        accepted=True,
        pivot_s=0.5 * (start_s + end_s),
        offset_s=peak.lag_s,
        sigma_s=peak.sigma_s,
        evidence=peak.score,
    )
    if float(np.interp(peak.lag_s, scores.lags_s, scores.common_s)) >= _MIN_DRIFT_SPAN_S:
        pair = _with_drift(curve, pair, start_s, end_s)
    is_clear = pair.sigma_s <= _MAX_PAIR_SIGMA_S and abs(pair.offset_s - lag_s) < _NEAR_S
    return pair if is_clear else None


def _with_drift(curve: MotionCurve, pair: ClockPair, start_s: float, end_s: float) -> ClockPair:
    """Measure offset and drift from windows along the common time."""
    first, second = curve.signals
    square = mean_square_distance(first, second)
    grid = np.arange(-_WINDOW_REACH_S, _WINDOW_REACH_S + 1e-9, _FINE_S)
    middles, curves = [], []
    edges = np.linspace(start_s, end_s, max(3, round((end_s - start_s) / _WINDOW_S)) + 1)
    reach = _WINDOW_REACH_S + 2 * STEP_S
    limits = pair.offset_s - reach, pair.offset_s + reach
    for begin, end in itertools.pairwise(edges.tolist()):
        part = second.part(*(round(time / STEP_S) - second.first_step for time in (begin, end)))
        around = (begin + limits[0], end + limits[1])
        other = first.part(*(round(time / STEP_S) - first.first_step for time in around))
        found = motion_score(other, part, curve.weights_hz, MIN_COMMON_S, limits, square)
        lags = found.lags_s
        if (
            len(lags) < _MIN_WINDOW_LAGS
            or lags[0] > limits[0] + 2 * STEP_S
            or lags[-1] < limits[1] - 2 * STEP_S
        ):
            continue
        middles.append(0.5 * (begin + end))
        curves.append(found.at(pair.offset_s + grid))
    if len(middles) < _MIN_WINDOWS:
        return pair
    return _fit_drift(pair, np.array(middles), np.array(curves), grid, curve.limb_lag_s)


def _fit_drift(
    pair: ClockPair, times_s: FloatArray, curves: FloatArray, grid: FloatArray, limb_lag_s: float
) -> ClockPair:
    """Fit a line through the windows: the sum of their scores along it is the greatest.

    Args:
        pair: The pair with its offset.
        times_s: (W,) middles of the windows on the second camera's clock, seconds.
        curves: (W,L) scores of the windows at the offsets of the pair plus `grid`.
        grid: (L,) differences from the offset of the pair, seconds.
        limb_lag_s: Standard deviation of the lag of the limb, seconds.
    """
    # The lag of a limb differs between the windows, so that no window is more exact than it.
    spread = np.exp(-0.5 * (np.subtract.outer(grid, grid) / limb_lag_s) ** 2)
    likelihood = np.exp(curves - curves.max(axis=1)[:, None]) @ spread
    curves = np.log(likelihood + 1e-12)
    pivot_s = float(times_s.mean())
    slopes = np.arange(-MAX_DRIFT_PPM, MAX_DRIFT_PPM + 1e-9, 2.0)
    centres = grid[np.abs(grid) <= 0.5 * _WINDOW_REACH_S]
    total = np.zeros((len(slopes), len(centres)))
    for time_s, curve in zip(times_s.tolist(), curves, strict=True):
        at = centres[None] + 1e-6 * slopes[:, None] * (time_s - pivot_s)
        total += np.interp(at, grid, curve)
    total -= 0.5 * (slopes[:, None] / CRYSTAL_SIGMA_PPM) ** 2
    likelihood = np.exp(total - total.max())
    likelihood /= likelihood.sum()
    by_slope, by_centre = likelihood.sum(axis=1), likelihood.sum(axis=0)
    drift, shift = float(by_slope @ slopes), float(by_centre @ centres)
    drift_sigma = float(np.sqrt(by_slope @ (slopes - drift) ** 2))
    width_s = float(np.sqrt(by_centre @ (centres - shift) ** 2))
    return replace(
        pair,
        pivot_s=pivot_s,
        offset_s=pair.offset_s + shift,
        sigma_s=float(np.hypot(_SIGMA_FACTOR * width_s, limb_lag_s)),
        drift_ppm=drift,
        drift_sigma_ppm=_SIGMA_FACTOR * drift_sigma,
        drift_measured=True,
    )


def motion_clocks(paths: Sequence[CameraPath], reference: str) -> MotionClocks:
    """Measure the clocks of all cameras from their motion.

    Args:
        paths: Paths of the cameras in one gauge.
        reference: Name of the reference camera.
    """
    signals = {path.camera: motion_signals(path) for path in paths}
    curves = _pair_curves(paths, signals)
    offsets_s, reasons = _offsets_from(reference, signals, curves)
    pairs = [
        _refined(curve, offsets_s[curve.second] - offsets_s[curve.first])
        for curve in curves
        if curve.first in offsets_s and curve.second in offsets_s
    ]
    starts = {path.camera: path.times_ns[0] * 1e-9 for path in paths if len(path.times_ns)}
    starts.setdefault(reference, 0.0)
    floors = {path.camera: _limb_lag_s(path) for path in paths}
    clear = [pair for pair in pairs if pair is not None]
    solved = solve_clocks(reference, clear, starts, floors, "motion")
    for name in offsets_s:
        clock = solved.clocks.get(name)
        if clock is None:
            reasons[name] = "the motion does not determine the offset near the common solution"
        elif clock.sigma_at(starts[name]) > _MAX_CLOCK_SIGMA_S:
            del solved.clocks[name]
            reasons[name] = f"the motion determines the offset only to ± {clock.sigma_at(starts[name]):.2f} s"
    return MotionClocks(reference=reference, clocks=solved.clocks, curves=tuple(curves), reasons=reasons)


def _offsets_from(
    reference: str, signals: Mapping[str, MotionSignals | None], curves: Sequence[MotionCurve]
) -> tuple[dict[str, float], dict[str, str]]:
    """Add cameras to the reference camera, the clearest peak of added scores first.

    Returns:
        The offset of each camera with a clear peak, seconds, and the reasons of the others.
    """
    offsets_s, reasons = {reference: 0.0}, {}
    while True:
        others = [name for name in signals if name not in offsets_s]
        peaks = {name: _peak_of(name, offsets_s, curves) for name in others}
        clear = [(peak.log_odds, name) for name, peak in peaks.items() if peak and not peak.problem()]
        if not clear:
            break
        name = max(clear)[1]
        found = peaks[name]
        assert found is not None  # it is clear
        offsets_s[name] = found.lag_s
    for name, peak in peaks.items():
        if peak is not None:
            reasons[name] = peak.problem()
        elif signals[name] is None:
            reasons[name] = f"{name} was localised in too few frames"
        else:
            reasons[name] = f"it was not localised together with the others for {MIN_COMMON_S:g} s"
    return offsets_s, reasons


def _peak_of(name: str, offsets_s: Mapping[str, float], curves: Sequence[MotionCurve]) -> _Peak | None:
    """Return the peak of the added scores of a camera with all cameras whose offset is known."""
    terms = [
        (curve, offsets_s[curve.first], 1.0)
        for curve in curves
        if curve.second == name and curve.first in offsets_s
    ]
    terms += [
        (curve, offsets_s[curve.second], -1.0)
        for curve in curves
        if curve.first == name and curve.second in offsets_s
    ]
    if not terms:
        return None
    ends = [known_s + sign * curve.scores.lags_s[[0, -1]] for curve, known_s, sign in terms]
    grid = np.arange(np.min(ends), np.max(ends) + _GRID_S, _GRID_S)
    total = sum(
        (curve.scores.at(sign * (grid - known_s)) for curve, known_s, sign in terms), np.zeros(len(grid))
    )
    return _find_peak(grid, total, _GRID_S, min(curve.limb_lag_s for curve, _, _ in terms))


def clocks_from_paths(
    trajectories: Sequence[Trajectory], roles: Mapping[str, str], reference: str
) -> MotionClocks:
    """Measure the clocks of cameras from their registered trajectories.

    Args:
        trajectories: The trajectory of each camera, on its own clock.
        roles: Role of the bone that each camera is mounted on, by camera name; "" if it is unknown.
        reference: Name of the reference camera. Cameras in other maps have no clock.
    """
    gauges = {path.camera: path.gauge for path in trajectories}
    same_map = [path for path in trajectories if path.gauge == gauges.get(reference)]
    paths = [
        CameraPath(
            camera=path.camera,
            role=roles.get(path.camera, ""),
            times_ns=path.times_ns[path.localised],
            map_from_cam=path.gauge_from_cam[path.localised],
        )
        for path in same_map
    ]
    found = motion_clocks(paths, reference)
    others = {name for name, gauge in gauges.items() if gauge != gauges.get(reference)}
    separate = dict.fromkeys(others, f"its map has no place in common with that of {reference}")
    return replace(found, reasons={**found.reasons, **separate})
