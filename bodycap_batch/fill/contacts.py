"""Which feet stand at each tick: a hidden semi-Markov model of steps, solved by Viterbi's algorithm.

The states are: both feet stand still, the left or the right foot stands alone, both feet stand between two
steps, and no foot stands. Each state except the first has a distribution of its duration. The evidence of a
tick is linear in the signals of the trunk and the hands, and is limited, so that one wrong tick does not
decide.

Source: S. Z. Yu, "Hidden semi-Markov models", Artificial Intelligence 174, 2010.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.fill.trunk_signals import ORDINARY_SPEED_M_PER_S, TrunkSignals, oscillation_amplitude
from bodycap_batch.model.gravity import GRAVITY_M_S2

STAND, LEFT, RIGHT, LEFT_TO_RIGHT, RIGHT_TO_LEFT, FLIGHT_LEFT, FLIGHT_RIGHT, FLIGHT_BOTH = range(8)
"""The states. The names of the flights say which foot left the floor last."""
_STATES = 8
"""Number of states. Derivation: the count of the names above."""
_STANDING = np.array(
    [[1, 1], [1, 0], [0, 1], [1, 1], [1, 1], [0, 0], [0, 0], [0, 0]],
    dtype=bool,
)
"""By state, whether the left and the right foot stand."""

_REPEAT_COST = 5.0
"""Cost (nats) of two successive steps with the same foot. Evidence: none."""
_HOP_COST = 6.0
"""Cost (nats) of a flight that ends on the foot that it started from, or on both. Evidence: none."""
_RUN_COST = 3.0
"""Cost (nats) of a flight between two steps. Evidence: none."""
_START_COST = 1.0
"""Cost (nats) of a change between standing and stepping. Evidence: none."""

_EVIDENCE_HZ = 10.0
"""Independent samples of evidence per second. Derivation: the signals have no frequencies above 4 Hz."""
_RISE_SCALE = 2.4
"""Acceleration (m/s²) of the trunk that is one nat of evidence for both feet on the floor, and downward for
one foot. Derivation: a rise and fall of ± 2.4 cm at 1.6 steps a second. Evidence:
docs/decisions/filling.md."""
_SWAY_SCALE = 0.5
"""Acceleration (m/s²) of the hips to the left that is one nat of evidence that the right foot stands alone.
Derivation: a sway of ± 1.6 cm at 0.8 strides a second, halved because the trunk's lean disturbs it."""
_TWIST_SCALE = 0.35
"""Rate (rad/s) of the trunk's yaw to the left that is one nat of evidence that the right foot stands alone.
Derivation: a yaw of ± 4° at 0.8 strides a second."""
_ARM_SCALE = 1.0
"""Velocity (m/s) of the left hand relative to the right hand, forward, that is one nat of evidence that the
left foot stands alone. Derivation: an arm swing of ± 10 cm for each hand at 0.8 strides a second."""
_LAG_S = 0.03
"""Time (s) by which the signals of the trunk follow the contacts of the feet. Evidence:
docs/decisions/filling.md."""
_MAX_EVIDENCE = 1.5
"""Maximum evidence (nats) of one signal at one tick. Evidence: none."""
_FLIGHT_SIGMA = 3.0
"""Standard deviation (m/s²) of the trunk's acceleration around free fall during a flight. Evidence: none."""
_FLIGHT_MARGIN = 4.0
"""Evidence (nats) against a flight at a tick without vertical acceleration beyond this. Evidence: none."""

_STILL_SPEED = 0.06
"""Speed (m/s) below which a person is taken to stand rather than to step. Evidence:
docs/decisions/filling.md."""
_STEPPING_SPEED = 0.24
"""Speed (m/s) above which a person must step. Evidence: as `_STILL_SPEED`."""
_SITTING_RATIO = 1.5
"""Maximum ratio of the horizontal to the vertical speed of hips that move onto a chair or up from it, over
standing feet. Derivation: to sit down, the hips move backward by 0.3 to 0.45 m and downward by 0.35 to 0.4 m;
the two movements do not have the same course."""
_UPRIGHT_SHARE = 0.95
"""Height of the hips, as a share of that on straight legs, below which a person may be sitting down.
Derivation: a walking person is above it."""
_TURN_RADIUS_M = 0.25
"""Radius (metres) by which the rate of a turn on the spot is converted to a speed. Evidence: none."""

_STEP_HZ_AT_1_3 = 1.85
"""Steps per second at 1.3 m/s. Source: D. W. Grieve, R. J. Gear, "The relationships between length of stride,
step frequency, time of swing and speed of walking for children and adults", Ergonomics 9, 1966."""
_STEP_HZ_EXPONENT = 0.42
"""Exponent of speed in the number of steps per second. Source: as `_STEP_HZ_AT_1_3`."""
_MIN_CADENCE_SPEED = 0.35
"""Minimum speed (m/s) for which the number of steps per second is computed. Evidence: none."""
_ASIDE_SHARE = 0.4
"""Share of the speed that is not forward, above which the steps are steps aside or back. Evidence: none."""
_ASIDE_STEP_S = 0.65
"""Maximum time (s) between two steps aside or back: they are shorter and quicker than slow steps forward.
Evidence: none."""
_DOUBLE_SHARE = 0.24
"""Share of a step during which both feet stand, at 1.3 m/s. Source: M. P. Murray, A. B. Drought, R. C. Kory,
"Walking patterns of normal men", Journal of Bone and Joint Surgery 46-A, 1964."""
_DOUBLE_SHARE_PER_SPEED = -0.13
"""Change of this share for each m/s of speed. Source: as `_STEP_HZ_AT_1_3`."""
_SINGLE_LOG_SIGMA = 0.22
"""Standard deviation of the logarithm of the time on one foot. Evidence: none."""
_DOUBLE_LOG_SIGMA = 0.45
"""Standard deviation of the logarithm of the time on both feet between two steps. Evidence: none."""
_FIRMNESS = 1.6
"""Ratio of the spread of durations among people to that of one person in one walk. Evidence:
docs/decisions/filling.md."""
_MIN_INTERVALS = 3
"""Minimum number of times between steps that determine the rhythm of a walk. Evidence: none."""
_MAX_IRREGULARITY = 0.25
"""Maximum standard deviation of the logarithm of these times, of a walk with a rhythm. Derivation: slightly
more than `_SINGLE_LOG_SIGMA`."""
_SINGLE_S = (0.2, 1.0)
"""Minimum and maximum time (s) on one foot. Evidence: none."""
_DOUBLE_S = (0.03, 0.6)
"""Minimum and maximum time (s) on both feet between two steps. Evidence: none."""
_FLIGHT_S = (0.08, 0.7)
"""Minimum and maximum time (s) of a flight. Derivation: a jump of 0.6 m takes 0.7 s."""

_SURE_NATS = 1.0
"""Evidence (nats) for the side of a certain step. Evidence: none."""
_MAX_CONTRADICTION_NATS = 1.5
"""Maximum evidence (nats) of one signal against the side of a certain step. Evidence: none."""
_SURE_SPEED = 0.15
"""Minimum mean speed (m/s) of a certain step. Derivation: the first step from standing has half of the speed
of a slow walk."""
_ORDINARY_DURATION = (0.45, 1.15)
"""Minimum and maximum time on one foot of a certain step, as a ratio to the expected time between two steps.
Derivation: the expected time on one foot is 0.6 to 0.9 of it; three sigmas of `_SINGLE_LOG_SIGMA` are
wider."""
_MAX_SINKING_M = 0.06
"""Maximum distance (metres) of the hips from their median height during a certain step. Derivation: twice the
rise and fall of an ordinary walk. A person who bows or crouches is outside."""
_MAX_TWIST = 1.2
"""Maximum rate (rad/s) of the trunk's yaw with the stride during a certain step. Derivation: three times
`_TWIST_SCALE`, rounded up."""
_MIN_ALTERNATION = 0.8
"""Minimum share of a signal that alternates with the sides around a certain step, for the best one of sway,
yaw and arms. Derivation: what does not alternate is less than half of what does. Evidence:
docs/decisions/filling.md."""
_MAX_IRREGULAR_TWIST = 0.25
"""Maximum root mean square (rad/s) of the part of the trunk's yaw rate that does not alternate, around a
certain step. Derivation: `_TWIST_SCALE` / √2, the root mean square of the part that alternates in an ordinary
walk. Evidence: docs/decisions/filling.md."""
_RHYTHM_STEPS = 2
"""Number of steps before and after a step that decide whether the signals around this step alternate.
Evidence: none."""
_SAMPLES_PER_STEP = 12
"""Number of samples of a signal per step in this comparison. Derivation: the signals have no frequencies
above 2.5 Hz."""
_RESTLESS_M_PER_S2 = 0.8
"""Amplitude of the vertical acceleration of the trunk above which a person who does not move away may step in
place. Derivation: a rise and fall of ± 0.7 cm at 1.7 steps a second; a walking person has ± 1 cm or more."""
_RESTLESS_HZ = 0.5
"""Cutoff frequency (Hz) of this amplitude. Derivation: less than a third of the frequency of steps."""
_MIN_STEPS = 2
"""Minimum number of successive steps that can be certain. Evidence: none."""
_YAW = 1
"""Column of the yaw rate in the alternating signals."""
_TINY = 1e-9
"""Smallest power of a signal that is not zero. Origin: against a division by zero."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Contacts:
    """Which feet stand.

    Attributes:
        state: (T,) number of the state.
        standing: (T,2) True if the left or right foot stands.
        is_sure: (T,) False if the signals do not determine the side or the time of the step at this tick.
        single_s: (T,) expected time on one foot at the speed of this tick, seconds.
        double_s: (T,) expected time on both feet between two steps, seconds.
    """

    state: IntArray
    standing: BoolArray
    is_sure: BoolArray
    single_s: FloatArray
    double_s: FloatArray


@dataclass(frozen=True, slots=True)
class _Evidence:
    """Log-likelihoods at T ticks.

    Attributes:
        by_state: (T,S) log-likelihood of each state.
        by_signal: (T,3) evidence of sway, yaw and arms that the left foot rather than the right one stands
            alone.
    """

    by_state: FloatArray
    by_signal: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class _Rhythm:
    """The expected durations at T ticks.

    Attributes:
        period_s: (T,) time between two steps, seconds.
        share: (T,) share of this time during which both feet stand.
        firmness: (T,) ratio by which the spread of durations is smaller than that among people.
    """

    period_s: FloatArray
    share: FloatArray
    firmness: FloatArray

    def at(self, tick: int) -> tuple[float, float, float]:
        """Return the period, the share and the firmness at a tick."""
        return float(self.period_s[tick]), float(self.share[tick]), float(self.firmness[tick])


@dataclass(frozen=True, slots=True, kw_only=True)
class _StepSignals:
    """What decides whether a step is ordinary, at T ticks.

    Attributes:
        fps: Ticks per second.
        period_s: (T,) expected time between two steps, seconds.
        speed: (T,) speed of the slow path, m/s.
        sinking: (T,) height of the slow path over its median, metres.
        alternating: (T,3) signals that change their sign from step to step in a walk: acceleration of the
            sway (m/s²), rate of the trunk's yaw without the slow heading (rad/s), and velocity of the left
            hand relative to the right hand (m/s).
        is_restless: (T,) True if the trunk rises and falls as with steps.
    """

    fps: float
    period_s: FloatArray
    speed: FloatArray
    sinking: FloatArray
    alternating: FloatArray
    is_restless: BoolArray


def find_contacts(signals: TrunkSignals, standing_m: float | None = None) -> Contacts:
    """Return which feet stand at each tick, from the signals of the trunk and the hands.

    Args:
        signals: The signals of the trunk and the hands.
        standing_m: Height (metres) of the hips of a standing person in the world; None if it is unknown, for
            example because the floor was not measured.
    """
    stride = max(1, round(signals.fps / 30.0))
    ticks = len(signals.heading_rad)
    chosen = np.arange(0, ticks, stride)
    evidence = _evidence(signals, signals.fps / stride, standing_m)
    coarse = _Evidence(
        _advanced(evidence.by_state, signals.fps)[chosen], _advanced(evidence.by_signal, signals.fps)[chosen]
    )
    period_s, share = _step_period_s(signals), _double_share(signals)
    rhythm = _Rhythm(period_s=period_s[chosen], share=share[chosen], firmness=np.ones(len(chosen)))
    found = _viterbi(coarse.by_state, rhythm, signals.fps / stride)
    # The second pass expects the person's own rhythm, which the first pass has found.
    rhythm = _own_rhythm(found, rhythm, signals.fps / stride)
    found = _viterbi(coarse.by_state, rhythm, signals.fps / stride)
    height = signals.slow_hips_m[:, 2]
    ordinary = _StepSignals(
        fps=signals.fps / stride,
        period_s=period_s[chosen],
        speed=signals.speed_m_per_s()[chosen],
        sinking=(height - np.median(height))[chosen],
        alternating=np.column_stack([signals.sway_m_per_s2, signals.twist_rad_per_s, signals.arm_m_per_s])[
            chosen
        ],
        is_restless=(
            oscillation_amplitude(signals.rise_m_per_s2, _RESTLESS_HZ, signals.fps) > _RESTLESS_M_PER_S2
        )[chosen],
    )
    sure = _sure_ticks(found, coarse, ordinary)
    nearest = np.minimum(np.round(np.arange(ticks) / stride).astype(np.int64), len(chosen) - 1)
    state = found[nearest]
    return Contacts(
        state=state,
        standing=_STANDING[state],
        is_sure=sure[nearest],
        single_s=(1.0 - share) * period_s,
        double_s=share * period_s,
    )


def _advanced(values: FloatArray, fps: float) -> FloatArray:
    """Return values (T,...) as they are `_LAG_S` later, interpolated between ticks."""
    last = len(values) - 1
    at = np.minimum(np.arange(len(values)) + _LAG_S * fps, last)
    before = np.minimum(at.astype(np.int64), max(last - 1, 0))
    after = np.minimum(before + 1, last)
    alpha = (at - before).reshape(-1, *([1] * (values.ndim - 1)))
    return np.asarray((1.0 - alpha) * values[before] + alpha * values[after])


def _speed_away(signals: TrunkSignals, standing_m: float | None) -> FloatArray:
    """Return the speed (T,) of the hips over the floor, without what sitting down and standing up explain.

    A person who sits down moves the hips backward and down, and one who stands up moves them forward and up.
    """
    speed = signals.speed_m_per_s()
    if standing_m is None:
        return speed
    velocity, forward = signals.velocity_m_per_s[:, :2], signals.forward()
    rising = signals.velocity_m_per_s[:, 2]
    along = (velocity * forward).sum(axis=1)
    low = signals.slow_hips_m[:, 2] < _UPRIGHT_SHARE * standing_m
    explained = np.where(low & (along * rising > 0.0), _SITTING_RATIO * np.abs(rising), 0.0)
    rest = np.sign(along) * np.maximum(np.abs(along) - explained, 0.0)
    return np.asarray(np.linalg.norm(velocity + (rest - along)[:, None] * forward, axis=1))


def _evidence(signals: TrunkSignals, coarse_fps: float, standing_m: float | None) -> _Evidence:
    weight = _EVIDENCE_HZ / coarse_fps

    def limited(values: FloatArray) -> FloatArray:
        return np.asarray(_MAX_EVIDENCE * np.tanh(values / _MAX_EVIDENCE))

    single = limited(-signals.rise_m_per_s2 / _RISE_SCALE)
    by_signal = np.column_stack(
        [
            limited(-signals.sway_m_per_s2 / _SWAY_SCALE),
            limited(-signals.twist_rad_per_s / _TWIST_SCALE),
            limited(signals.arm_m_per_s / _ARM_SCALE),
        ]
    )
    side = by_signal.sum(axis=1)
    speed = np.hypot(_speed_away(signals, standing_m), _TURN_RADIUS_M * signals.yaw_rate_rad_per_s)
    spread = 0.5 * (_STEPPING_SPEED - _STILL_SPEED)
    middle = 0.5 * (_STEPPING_SPEED + _STILL_SPEED)
    stepping = np.clip((speed - middle) / spread, -2.0, 4.0)
    flight = -0.5 * ((signals.rise_m_per_s2 + GRAVITY_M_S2) / _FLIGHT_SIGMA) ** 2 + _FLIGHT_MARGIN
    out = np.zeros((len(speed), _STATES))
    out[:, STAND] = -stepping
    out[:, LEFT] = 0.5 * (single + side)
    out[:, RIGHT] = 0.5 * (single - side)
    out[:, LEFT_TO_RIGHT] = out[:, RIGHT_TO_LEFT] = -0.5 * single
    out[:, FLIGHT_LEFT] = out[:, FLIGHT_RIGHT] = out[:, FLIGHT_BOTH] = np.clip(flight, -8.0, None)
    return _Evidence(weight * out, weight * by_signal)


def _step_period_s(signals: TrunkSignals) -> FloatArray:
    """Return the expected time (T,) between two steps, seconds."""
    speed = np.maximum(signals.speed_m_per_s(), _MIN_CADENCE_SPEED)
    period = 1.0 / (_STEP_HZ_AT_1_3 * (speed / ORDINARY_SPEED_M_PER_S) ** _STEP_HZ_EXPONENT)
    forward = (signals.velocity_m_per_s[:, :2] * signals.forward()).sum(axis=1)
    is_aside = forward < (1.0 - _ASIDE_SHARE) * speed
    return np.asarray(np.where(is_aside, np.minimum(period, _ASIDE_STEP_S), period))


def _own_rhythm(state: IntArray, rhythm: _Rhythm, fps: float) -> _Rhythm:
    """Return the rhythm of each walk from its steps, relative to what people do at its speed."""
    period, firmness = rhythm.period_s.copy(), rhythm.firmness.copy()
    bounds = np.flatnonzero(np.diff(state, prepend=-1))
    steps = bounds[np.isin(state[bounds], (LEFT, RIGHT)) & (bounds > 0)]
    walks = np.cumsum(state == STAND)
    for walk in np.unique(walks[steps]):
        own = steps[walks[steps] == walk]
        if len(own) <= _MIN_INTERVALS:
            continue
        ratios = np.diff(own) / fps / rhythm.period_s[own[:-1]]
        if np.std(np.log(ratios)) > _MAX_IRREGULARITY:
            continue
        ticks = (walks == walk) & (state != STAND)
        period[ticks] *= float(np.median(ratios))
        firmness[ticks] = _FIRMNESS
    return _Rhythm(period_s=period, share=rhythm.share, firmness=firmness)


def _double_share(signals: TrunkSignals) -> FloatArray:
    """Return the expected share (T,) of a step during which both feet stand."""
    share = _DOUBLE_SHARE + _DOUBLE_SHARE_PER_SPEED * (signals.speed_m_per_s() - ORDINARY_SPEED_M_PER_S)
    return np.asarray(np.clip(share, 0.08, 0.4))


def _transition_costs() -> FloatArray:
    """Return the cost (S,S) of each change of state, from rows to columns; infinite for impossible ones."""
    cost = np.full((_STATES, _STATES), np.inf)
    cost[STAND, [LEFT, RIGHT]] = _START_COST
    cost[STAND, FLIGHT_BOTH] = _HOP_COST
    for own, other, between, flight in (
        (LEFT, RIGHT, LEFT_TO_RIGHT, FLIGHT_LEFT),
        (RIGHT, LEFT, RIGHT_TO_LEFT, FLIGHT_RIGHT),
    ):
        cost[own, between] = 0.0
        cost[own, STAND] = _START_COST
        cost[own, flight] = _RUN_COST
        cost[between, other] = 0.0
        cost[between, own] = _REPEAT_COST
        cost[flight, other] = 0.0
        cost[flight, [own, STAND]] = _HOP_COST
    cost[FLIGHT_BOTH, STAND] = 0.0
    cost[FLIGHT_BOTH, [LEFT, RIGHT]] = _HOP_COST
    return cost


def _viterbi(log_likelihood: FloatArray, rhythm: _Rhythm, fps: float) -> IntArray:
    """Return the most likely state (T,) at each tick."""
    ticks = len(log_likelihood)
    cumulated = np.concatenate([np.zeros((1, _STATES)), np.cumsum(log_likelihood, axis=0)])
    cost = _transition_costs()
    durations = [_durations(state, fps) for state in range(_STATES)]
    # `entered[t, s]` is the best score of a sequence whose segment of state s starts at tick t.
    entered = np.full((ticks + 1, _STATES), -np.inf)
    entered[0] = [0.0, *([-1.0] * (_STATES - 1))]
    came_from = np.full((ticks + 1, _STATES), -1, dtype=np.int64)
    left_at = np.full((ticks + 1, _STATES), -1, dtype=np.int64)
    ended = np.full((ticks + 1, _STATES), -np.inf)
    for tick in range(1, ticks + 1):
        at = tick - 1
        for state in range(_STATES):
            if state == STAND:
                # Standing has no preferred duration: a segment grows by one tick at a time.
                grown = ended[tick - 1, STAND] + log_likelihood[at, STAND]
                new = entered[tick - 1, STAND] + log_likelihood[at, STAND]
                ended[tick, STAND] = max(grown, new)
                left_at[tick, STAND] = left_at[tick - 1, STAND] if grown >= new else tick - 1
                continue
            lengths = durations[state]
            lengths = lengths[lengths <= tick]
            # A segment that the recording cuts off may be shorter than the minimum.
            if tick < durations[state][0] or tick == ticks:
                lengths = np.arange(1, min(tick, durations[state][-1]) + 1)
            scores = (
                entered[tick - lengths, state]
                + cumulated[tick, state]
                - cumulated[tick - lengths, state]
                + _log_duration(state, lengths / fps, rhythm.at(at), tick - lengths, tick == ticks)
            )
            best = int(np.argmax(scores))
            ended[tick, state] = scores[best]
            left_at[tick, state] = tick - lengths[best]
        if tick < ticks:
            options = ended[tick][:, None] - cost
            came_from[tick] = np.argmax(options, axis=0)
            entered[tick] = options.max(axis=0)
    return _trace_back(ended[ticks], left_at, came_from, ticks)


def _trace_back(last: FloatArray, left_at: IntArray, came_from: IntArray, ticks: int) -> IntArray:
    out = np.zeros(ticks, dtype=np.int64)
    state, end = int(np.argmax(last)), ticks
    while end > 0:
        start = int(left_at[end, state])
        out[start:end] = state
        state, end = int(came_from[start, state]), start
    return out


def _durations(state: int, fps: float) -> IntArray:
    low, high = {
        LEFT: _SINGLE_S, RIGHT: _SINGLE_S, LEFT_TO_RIGHT: _DOUBLE_S, RIGHT_TO_LEFT: _DOUBLE_S,
    }.get(state, _FLIGHT_S)  # fmt: skip
    return np.arange(max(1, round(low * fps)), max(2, round(high * fps)) + 1)


def _log_duration(
    state: int, seconds: FloatArray, rhythm: tuple[float, float, float], starts: IntArray, is_last: bool
) -> FloatArray:
    """Return the log-likelihood (N,) of durations; 0 for segments that the recording cuts off."""
    period_s, share, firmness = rhythm
    if state in (LEFT, RIGHT):
        mean, sigma = (1.0 - share) * period_s, _SINGLE_LOG_SIGMA / firmness
    elif state in (LEFT_TO_RIGHT, RIGHT_TO_LEFT):
        mean, sigma = share * period_s, _DOUBLE_LOG_SIGMA / firmness
    else:
        return np.zeros(len(seconds))
    deviation = np.log(seconds / mean) / sigma
    cut = (starts == 0) | is_last
    return np.asarray(np.where(cut & (deviation < 0.0), 0.0, -0.5 * deviation**2))


def _sure_ticks(state: IntArray, evidence: _Evidence, signals: _StepSignals) -> BoolArray:
    """Return whether the signals determine the state at each tick (T,).

    A step is certain if it is one of two or more successive steps of an ordinary walk: evidence for its side
    without a strong contradiction, an ordinary duration, a trunk that neither sinks nor twists much, and
    signals that alternate with the sides. Standing is certain if the trunk does not rise and fall as with
    steps, as it does on a treadmill.
    """
    out = ~((state == STAND) & signals.is_restless)
    bounds = [0, *(np.flatnonzero(np.diff(state)) + 1).tolist(), len(state)]
    walks: list[list[tuple[int, int]]] = [[]]
    for start, end in itertools.pairwise(bounds):
        if state[start] == STAND:
            walks.append([])
        else:
            walks[-1].append((start, end))
    for walk in walks:
        singles = [each for each in walk if state[each[0]] in (LEFT, RIGHT)]
        kept = [each for each in singles if each[0] > 0 and each[1] < len(state)]
        sure = np.zeros(len(singles), dtype=bool)
        if len(kept) >= _MIN_STEPS:
            support = _mean_of_three(np.array([_support(state, evidence, *each) for each in kept]))
            ordinary = np.array([_is_ordinary(signals, *each) for each in kept])
            ordinary &= _do_signals_alternate(signals.alternating, kept)
            ordinary &= support.sum(axis=1) >= _SURE_NATS
            ordinary &= support.min(axis=1) >= -_MAX_CONTRADICTION_NATS
            padded = np.concatenate([[False], ordinary, [False]])
            ordinary &= padded[:-2] | padded[2:]
            first = singles.index(kept[0])
            sure[first : first + len(kept)] = ordinary
            # A step that the recording cuts off is as certain as its neighbour.
            sure[:first], sure[first + len(kept) :] = ordinary[0], ordinary[-1]
        middles = np.array([0.5 * (start + end) for start, end in singles])
        for start, end in walk:
            nearest = np.argsort(np.abs(middles - 0.5 * (start + end)))[: 1 if (start, end) in singles else 2]
            out[start:end] = bool(len(nearest)) and bool(sure[nearest].all())
    return np.asarray(out)


def _support(state: IntArray, evidence: _Evidence, start: int, end: int) -> FloatArray:
    """Return the evidence (3,) of each signal for the side of one time on one foot."""
    sign = 1.0 if state[start] == LEFT else -1.0
    return np.asarray(sign * evidence.by_signal[start:end].sum(axis=0))


def _mean_of_three(values: FloatArray) -> FloatArray:
    """Return the mean (N,K) of each row of values (N,K) and its neighbours.

    The sides of successive steps alternate, so the evidence for one step is evidence for the others.
    """
    padded = np.concatenate([np.zeros((1, values.shape[1])), values, np.zeros((1, values.shape[1]))])
    counts = np.full(len(values), 3.0)
    counts[0] -= 1.0
    counts[-1] -= 1.0
    return np.asarray((padded[:-2] + padded[1:-1] + padded[2:]) / counts[:, None])


def _is_ordinary(signals: _StepSignals, start: int, end: int) -> bool:
    """Return whether duration, speed and trunk of one time on one foot are those of an ordinary walk."""
    own = slice(start, end)
    duration = (end - start) / signals.fps / (signals.period_s[own].mean())
    return bool(
        _ORDINARY_DURATION[0] <= duration <= _ORDINARY_DURATION[1]
        and signals.speed[own].mean() >= _SURE_SPEED
        and np.abs(signals.sinking[own]).max() <= _MAX_SINKING_M
        and np.abs(signals.alternating[own, _YAW]).max() <= _MAX_TWIST
    )


def _do_signals_alternate(signals: FloatArray, steps: list[tuple[int, int]]) -> BoolArray:
    """Return (N,) True where the signals around each of N successive steps alternate with the sides.

    In a walk, sway, yaw and arms are the mirror image of what they were one step before. In a dance they are
    not, even if Viterbi's algorithm finds sides that fit the signals. Two steps cannot be compared with
    others: then only a yaw that varies as little as in a walk is required.

    Args:
        signals: (T,3) acceleration of the sway, rate of the yaw and velocity of the arms.
        steps: First tick and end of the N times on one foot of one walk.
    """
    middles = np.array([0.5 * (start + end - 1) for start, end in steps])
    ticks = np.arange(len(signals))
    out = np.zeros(len(steps), dtype=bool)
    for index in range(len(steps)):
        near = middles[max(index - _RHYTHM_STEPS, 0) : index + _RHYTHM_STEPS + 1]
        if len(near) <= _MIN_STEPS:
            start, end = steps[index]
            out[index] = signals[start:end, _YAW].std() <= _MAX_IRREGULAR_TWIST
            continue
        steps_on = np.arange((len(near) - 1) * _SAMPLES_PER_STEP + 1) / _SAMPLES_PER_STEP
        at = np.interp(steps_on, np.arange(len(near)), near)
        values = np.column_stack([np.interp(at, ticks, signal) for signal in signals.T])
        before, after = values[:-_SAMPLES_PER_STEP], values[_SAMPLES_PER_STEP:]
        power = 0.5 * (before**2 + after**2).mean(axis=0)
        alternation = -(before * after).mean(axis=0) / np.maximum(power, _TINY)
        irregular = np.sqrt(0.5 * ((before + after) ** 2).mean(axis=0))
        out[index] = alternation.max() >= _MIN_ALTERNATION and irregular[_YAW] <= _MAX_IRREGULAR_TWIST
    return out
