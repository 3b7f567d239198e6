"""Measure the difference between the clocks of cameras from their motion in one map.

The score of `motion_score` is the logarithm of the likelihood of each offset. An offset is accepted only if
it is much more likely than all offsets far from it together, and if its score is higher than that of
unrelated motions. The scores of all pairs are added: cameras join into groups, the clearest pair first.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bodycap_batch.clocks.clock_pair import CRYSTAL_SIGMA_PPM, ClockPair
from bodycap_batch.clocks.joint_offsets import JointClock, JointClocks, solve_clocks
from bodycap_batch.clocks.motion_score import (
    LIMB_WEIGHTS_HZ,
    TRUNK_WEIGHTS_HZ,
    mean_square_distance,
    motion_score,
)
from bodycap_batch.clocks.motion_signals import STEP_S, CameraPath, MotionSignals, motion_signals
from bodycap_batch.core.arrays import FloatArray

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
_MAX_DRIFT_PPM = 150.0
"""Maximum drift, ppm. Origin: twice the tolerance of crystals, with some room for cold and heat."""
_MAX_PAIR_SIGMA_S = 0.1
"""Maximum width, seconds, of the peak of a pair that is used in the common solution. A wider peak contains no
information within `_NEAR_S`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionOffset(ClockPair):
    """What the motion of two cameras says about their clocks.

    `sigma_s` contains that of a limb which lags behind the trunk.

    Attributes:
        evidence: Score of the offset: logarithm of its likelihood relative to a typical offset.
        log_odds: Logarithm of the likelihood of this peak over that of all other offsets.
        common_s: Time in which both cameras were localised, seconds.
        curve_lags_s: (L,) offsets of the curve, seconds; None if there is none.
        curve: (L,) score of each offset.
    """

    log_odds: float = 0.0
    common_s: float = 0.0
    curve_lags_s: FloatArray | None = field(default=None, repr=False)
    curve: FloatArray | None = field(default=None, repr=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionClocks:
    """The clocks of cameras from their motion.

    Attributes:
        reference: Name of the reference camera.
        clocks: Clock of each camera that is connected to the reference camera, with that camera.
        pairs: What each pair of cameras gives alone.
        reasons: Why a camera has no clock, by camera.
        dropped: Pairs that contradict the others, with the difference in seconds.
    """

    reference: str
    clocks: dict[str, JointClock]
    pairs: tuple[MotionOffset, ...]
    reasons: dict[str, str]
    dropped: tuple[tuple[MotionOffset, float], ...] = ()


def measure_motion_offset(
    first: CameraPath, second: CameraPath, limits_s: tuple[float, float] | None = None
) -> MotionOffset:
    """Measure the difference between the clocks of two cameras.

    Args:
        first: Path of the first camera.
        second: Path of the second camera, in the same gauge.
        limits_s: Least and greatest offset, seconds; None for all offsets with enough common time.
    """
    signals = motion_signals(first), motion_signals(second)
    curve = _pair_curve(first, second, *signals, limits_s)
    return _measured(curve)


@dataclass(frozen=True, slots=True)
class _Curve:
    """The score of a pair for all offsets.

    Attributes:
        first: Path of the first camera.
        second: Path of the second camera.
        signals: Signals of both; None if a path is too short.
        lags_s: (L,) offsets, seconds.
        common_s: (L,) common times, seconds.
        score: (L,) scores.
    """

    first: CameraPath
    second: CameraPath
    signals: tuple[MotionSignals, MotionSignals] | None
    lags_s: FloatArray
    common_s: FloatArray
    score: FloatArray

    @property
    def limb_lag_s(self) -> float:
        """Standard deviation of the offset that more motion does not reduce, seconds."""
        return max(_limb_lag_s(self.first), _limb_lag_s(self.second))

    def at(self, lags_s: FloatArray) -> FloatArray:
        """Return the score at offsets (K,), seconds; 0 where it is unknown."""
        from scipy.interpolate import CubicSpline

        out = np.zeros(len(lags_s))
        if len(self.lags_s) < 2:
            return out
        inside = (lags_s >= self.lags_s[0]) & (lags_s <= self.lags_s[-1])
        out[inside] = CubicSpline(self.lags_s, self.score)(lags_s[inside])
        return out


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


def _pair_curve(
    first: CameraPath,
    second: CameraPath,
    first_signals: MotionSignals | None,
    second_signals: MotionSignals | None,
    limits_s: tuple[float, float] | None,
) -> _Curve:
    """Return the scores of a pair. The axes are those of the camera on the trunk."""
    if first_signals is None or second_signals is None:
        return _Curve(first, second, None, *np.zeros((3, 0)))
    least = _MIN_COMMON_SHARE * min(first_signals.present_s, second_signals.present_s)
    weights = TRUNK_WEIGHTS_HZ if first.is_on_trunk or second.is_on_trunk else LIMB_WEIGHTS_HZ
    signals = first_signals, second_signals
    # All offsets are evaluated, because the score is relative to that of a typical one.
    if second.is_on_trunk and not first.is_on_trunk:
        found = motion_score(second_signals, first_signals, weights, max(MIN_COMMON_S, least))
        lags, common, score = -found.lags_s[::-1], found.common_s[::-1], found.score[::-1]
    else:
        found = motion_score(first_signals, second_signals, weights, max(MIN_COMMON_S, least))
        lags, common, score = found.lags_s, found.common_s, found.score
    low, high = limits_s or (-np.inf, np.inf)
    inside = (lags >= low) & (lags <= high)
    return _Curve(first, second, signals, lags[inside], common[inside], score[inside])


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


def _measured(curve: _Curve) -> MotionOffset:
    """Return the result of a pair alone."""
    pair = MotionOffset(first=curve.first.camera, second=curve.second.camera)
    short = _short_reason(curve)
    if short:
        return replace(pair, reason=short)
    fine = np.arange(curve.lags_s[0], curve.lags_s[-1], _GRID_S)
    if len(fine) < 2:
        return replace(pair, reason="the searched offsets are too few")
    peak = _find_peak(fine, curve.at(fine), _GRID_S, curve.limb_lag_s)
    pair = replace(
        pair,
        reason=peak.problem(),
        accepted=not peak.problem(),
        evidence=peak.score,
        log_odds=peak.log_odds,
        curve_lags_s=curve.lags_s,
        curve=curve.score,
    )
    return _refined(curve, pair, peak.lag_s)


def _short_reason(curve: _Curve) -> str:
    """Return why a pair has no scores; empty if it has."""
    if curve.signals is None:
        short = curve.first if motion_signals(curve.first) is None else curve.second
        return f"{short.camera} was localised in too few frames"
    if len(curve.lags_s) < 2:
        return f"the cameras were localised together for less than {MIN_COMMON_S:g} s"
    return ""


def _refined(curve: _Curve, pair: MotionOffset, lag_s: float) -> MotionOffset:
    """Return the pair with offset, drift and their standard deviations near an offset."""
    assert curve.signals is not None
    first, second = curve.signals
    near = np.arange(
        max(lag_s - _NEAR_S, curve.lags_s[0]), min(lag_s + _NEAR_S, curve.lags_s[-1]) + 1e-9, _FINE_S
    )
    peak = _find_peak(near, curve.at(near), _FINE_S, curve.limb_lag_s)
    common_s = float(np.interp(peak.lag_s, curve.lags_s, curve.common_s))
    start_s = max(second.first_step * STEP_S, first.first_step * STEP_S - peak.lag_s)
    end_s = min(
        (second.first_step + second.count) * STEP_S,
        (first.first_step + first.count) * STEP_S - peak.lag_s,
    )
    pair = replace(
        pair,
        pivot_s=0.5 * (start_s + end_s),
        offset_s=peak.lag_s,
        sigma_s=peak.sigma_s,
        common_s=common_s,
    )
    if common_s < _MIN_DRIFT_SPAN_S:
        return pair
    return _with_drift(curve, pair, start_s, end_s)


def _with_drift(curve: _Curve, pair: MotionOffset, start_s: float, end_s: float) -> MotionOffset:
    """Measure offset and drift from windows along the common time."""
    assert curve.signals is not None
    first, second = curve.signals
    is_turned = curve.second.is_on_trunk and not curve.first.is_on_trunk
    weights = TRUNK_WEIGHTS_HZ if curve.first.is_on_trunk or curve.second.is_on_trunk else LIMB_WEIGHTS_HZ
    square = mean_square_distance(first, second)
    grid = np.arange(-_WINDOW_REACH_S, _WINDOW_REACH_S + 1e-9, _FINE_S)
    middles, curves = [], []
    edges = np.linspace(start_s, end_s, max(3, round((end_s - start_s) / _WINDOW_S)) + 1)
    for begin, end in itertools.pairwise(edges.tolist()):
        steps = [round(time / STEP_S) - second.first_step for time in (begin, end)]
        part = second.part(*steps)
        reach = _WINDOW_REACH_S + 2 * STEP_S
        steps = [
            round((time + pair.offset_s) / STEP_S) - first.first_step for time in (begin - reach, end + reach)
        ]
        other = first.part(*steps)
        limits = pair.offset_s - reach, pair.offset_s + reach
        if is_turned:
            found = motion_score(part, other, weights, MIN_COMMON_S, (-limits[1], -limits[0]), square)
            lags, score = -found.lags_s[::-1], found.score[::-1]
        else:
            found = motion_score(other, part, weights, MIN_COMMON_S, limits, square)
            lags, score = found.lags_s, found.score
        if len(lags) < 4 or lags[0] > limits[0] + 2 * STEP_S or lags[-1] < limits[1] - 2 * STEP_S:
            continue
        window = _Curve(curve.first, curve.second, curve.signals, lags, found.common_s, score)
        middles.append(0.5 * (begin + end))
        curves.append(window.at(pair.offset_s + grid))
    if len(middles) < 3:
        return pair
    return _fit_drift(pair, np.array(middles), np.array(curves), grid, curve.limb_lag_s)


def _fit_drift(
    pair: MotionOffset, times_s: FloatArray, curves: FloatArray, grid: FloatArray, limb_lag_s: float
) -> MotionOffset:
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
    slopes = np.arange(-_MAX_DRIFT_PPM, _MAX_DRIFT_PPM + 1e-9, 2.0)
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


def motion_clocks(
    paths: Sequence[CameraPath],
    reference: str,
    priors: Mapping[tuple[str, str], tuple[float, float]] | None = None,
) -> MotionClocks:
    """Measure the clocks of all cameras from their motion.

    Args:
        paths: Paths of the cameras in one gauge.
        reference: Name of the reference camera.
        priors: Least and greatest offset, seconds, by (first, second) camera; other offsets are not searched.
    """
    limits = dict(priors or {})
    limits.update({(two, one): (-high, -low) for (one, two), (low, high) in limits.items()})
    signals = {path.camera: motion_signals(path) for path in paths}
    curves = {
        (one.camera, two.camera): _pair_curve(
            one, two, signals[one.camera], signals[two.camera], limits.get((one.camera, two.camera))
        )
        for one, two in itertools.combinations(paths, 2)
    }
    pairs = {names: _measured(curve) for names, curve in curves.items()}
    group, reasons, dropped = _group_of(reference, [path.camera for path in paths], curves, pairs)
    used = []
    for (one, two), curve in curves.items():
        if one in group and two in group:
            lag_s = group[two] - group[one]
            if len(curve.lags_s) < 2 or not curve.lags_s[0] <= lag_s <= curve.lags_s[-1]:
                continue
            near = _refined(curve, pairs[one, two], lag_s)
            if near.sigma_s <= _MAX_PAIR_SIGMA_S and abs(near.offset_s - lag_s) < _NEAR_S:
                used.append(near)
    starts = {path.camera: path.times_ns[0] * 1e-9 for path in paths if len(path.times_ns)}
    starts.setdefault(reference, 0.0)
    floors = {path.camera: _limb_lag_s(path) for path in paths}
    solved: JointClocks[MotionOffset] = solve_clocks(reference, used, starts, floors)
    for name in group:
        clock = solved.clocks.get(name)
        if clock is None:
            reasons[name] = "the motion does not determine the offset near the common solution"
        elif clock.sigma_at(starts[name]) > _MAX_CLOCK_SIGMA_S:
            del solved.clocks[name]
            reasons[name] = f"the motion determines the offset only to ± {clock.sigma_at(starts[name]):.2f} s"
    return MotionClocks(
        reference=reference,
        clocks=solved.clocks,
        pairs=tuple(pairs.values()),
        reasons=reasons,
        dropped=(*dropped, *solved.dropped),
    )


def _group_of(
    reference: str,
    names: Sequence[str],
    curves: Mapping[tuple[str, str], _Curve],
    pairs: Mapping[tuple[str, str], MotionOffset],
) -> tuple[dict[str, float], dict[str, str], list[tuple[MotionOffset, float]]]:
    """Join cameras into groups, the clearest peak of added scores first.

    Returns:
        The offset of each camera in the group of the reference camera, reasons of the others, and pairs that
        are accepted alone and contradict the groups.
    """
    groups = [{name: 0.0} for name in names]
    peaks: dict[tuple[int, int], _Peak | None] = {}
    while True:
        peaks = {
            (i, j): _joint_peak(groups[i], groups[j], curves)
            for i, j in itertools.combinations(range(len(groups)), 2)
        }
        clear = [(peak.log_odds, at) for at, peak in peaks.items() if peak is not None and not peak.problem()]
        if not clear:
            break
        i, j = max(clear)[1]
        peak = peaks[i, j]
        assert peak is not None
        groups[i].update({name: offset + peak.lag_s for name, offset in groups[j].items()})
        del groups[j]
    own = next(index for index, group in enumerate(groups) if reference in group)
    group = groups[own]
    contradictions = []
    for (one, two), pair in pairs.items():
        if pair.accepted and one in group and two in group:
            difference = pair.offset_s - (group[two] - group[one])
            if abs(difference) > _NEAR_S:
                contradictions.append((pair, difference))
    reasons = {}
    for index, other in enumerate(groups):
        if index == own:
            continue
        found = peaks[min(own, index), max(own, index)]
        for name in other:
            reasons[name] = (
                found.problem()
                if found is not None
                else f"it was not localised together with the others for {MIN_COMMON_S:g} s"
            )
    return {name: offset - group[reference] for name, offset in group.items()}, reasons, contradictions


def _joint_peak(
    one: Mapping[str, float], two: Mapping[str, float], curves: Mapping[tuple[str, str], _Curve]
) -> _Peak | None:
    """Return the peak of the added scores of two groups; its lag is added to the offsets of the second."""
    terms = []
    for (first, second), curve in curves.items():
        if len(curve.lags_s) < 2:
            continue
        if first in one and second in two:
            terms.append((curve, one[first] - two[second], 1.0))
        elif first in two and second in one:
            terms.append((curve, two[first] - one[second], -1.0))
    if not terms:
        return None
    low = min(min(sign * (curve.lags_s[[0, -1]] + shift)) for curve, shift, sign in terms)
    high = max(max(sign * (curve.lags_s[[0, -1]] + shift)) for curve, shift, sign in terms)
    grid = np.arange(low, high + _GRID_S, _GRID_S)
    total = sum((curve.at(sign * grid - shift) for curve, shift, sign in terms), np.zeros(len(grid)))
    return _find_peak(grid, total, _GRID_S, min(curve.limb_lag_s for curve, _, _ in terms))
