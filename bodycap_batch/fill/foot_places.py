"""Where each foot stands, from the path of the hips and the times of the steps.

Source: Y. Wang, M. Srinivasan, "Stepping in the direction of the fall", Biology Letters 10, 2014: the place
is linear in the state of the hips at the middle of the time on this foot.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, runs
from bodycap_batch.fill.contacts import LEFT, RIGHT, STAND, Contacts
from bodycap_batch.fill.leg_geometry import LegGeometry
from bodycap_batch.fill.trunk_signals import TrunkSignals
from bodycap_batch.model.fill_data import Footsteps

_BEHIND_M = 0.01
"""Distance (metres) of the ankle behind the middle of the hips when the hips pass the foot. Derivation: the
pressure under a foot lies between heel and ball, in front of the ankle."""
_EARLY_SHARE = 0.05
"""Time by which the hips pass the foot before the middle of the time on this foot, as a share of the time
between two steps. Evidence: docs/decisions/filling.md."""
_WALKING_WIDTH = 0.115
"""Distance between the paths of the two ankles while walking, as a ratio to the length of the leg. Source:
J. M. Donelan, R. Kram, A. D. Kuo, "Mechanical and metabolic determinants of the preferred step width in human
walking", Proceedings of the Royal Society B 268, 2001: 0.12 times the leg length."""
_STANDING_WIDTH = 0.2
"""Distance between the ankles while standing, as a ratio to the length of the leg. Source: W. E. McIlroy,
B. E. Maki, "Preferred placement of the feet during quiet stance", Clinical Biomechanics 12, 1997: 17 cm."""
_MIN_WIDTH = 0.06
"""Minimum distance sideways between a foot that is put down and the standing foot, as a ratio to the length
of the leg. Derivation: half of `_WALKING_WIDTH`."""
_TOE_OUT_RAD = np.radians(7.0)
"""Angle by which the toes point outward. Source: as `_STANDING_WIDTH`, halved: 14° between the feet."""
_LOW_SHARE = 0.9
"""Height of the hips, as a share of that of a standing person, below which the person crouches or sits.
Derivation: a walking person is above 0.95."""
_CROUCHING_AHEAD = 0.45
"""Distance by which the feet are placed ahead of the hips, as a ratio to the distance by which the hips are
lower than `_LOW_SHARE`. Derivation: the ankles of a person on a chair are some 15 cm ahead of the hips."""
_STRAIGHT_SHARE = 0.985
"""Distance between hip and ankle of a standing person, as a share of the length of the leg. Derivation: a
knee that is bent by 15°, as in M. P. Murray and others, 1964."""
_MIN_RAISED_M = 0.12
"""Minimum height (metres) of a stair or another raised floor. Derivation: a stair has 15 to 20 cm; the error
of the height of hips and floor is up to 10 cm in the recordings of the benchmark `body`."""
_MIN_RAISED_S = 2.0
"""Minimum time (s) on stairs or another raised floor. Derivation: a jump takes 0.7 s, and three stairs
take 1 s."""
_LEVEL_PERCENTILE = 10.0
"""Percentile of these distances that belongs to the level floor. Evidence: none."""
_MAX_SHIFT_M = 0.22
"""Distance (metres) that the hips may move over standing feet before a foot takes a step. Derivation: the
length of a foot from the ankle to the ball, with a margin."""
_SITTING_BACK = 1.0
"""Distance that the hips may move backward over standing feet while they sink, in addition to `_MAX_SHIFT_M`,
as a ratio to the distance by which they are lower than those of a standing person. Derivation: on a chair the
hips are about 0.4 m lower than in standing, and a thigh of 0.42 m behind the knees."""
_MIN_UPRIGHT_S = 0.3
"""Minimum time (s) for which a person stands upright before or after sitting on a chair, if this time
determines where the feet stand. Evidence: none."""
_MAX_TURN_RAD = np.radians(35.0)
"""Angle by which the trunk may turn over standing feet before a foot takes a step. Evidence: none."""
_ADJUSTING_S = 0.4
"""Time (s) of a step that brings a foot back below the hips. Evidence: none."""


@dataclass(slots=True)
class _Stance:
    """A period in which a foot stands."""

    side: int
    start: int
    end: int
    is_sure: bool


def place_feet(
    contacts: Contacts,
    signals: TrunkSignals,
    legs: tuple[LegGeometry, LegGeometry],
    floor_m: float,
) -> Footsteps:
    """Return the periods in which each foot stands, and where it stands.

    If the hips leave standing feet, further steps are inserted. They are never certain.
    """
    stances: list[_Stance] = []
    for side in (0, 1):
        sunk_m = _sunk_m(signals, legs[side], floor_m)
        stances += _split_long_stances(_stances(contacts, side), contacts, signals, sunk_m)
    stances.sort(key=lambda each: (each.start, each.side))
    places = [_place(each, contacts, signals, legs[each.side], floor_m) for each in stances]
    out = np.array([place for place, _ in places]).reshape(-1, 2)
    _keep_apart(out, stances, signals, 0.5 * (legs[0].length_m + legs[1].length_m))
    excess = np.array([_excess_m(each, contacts, signals, legs[each.side], floor_m) for each in stances])
    ankles = np.array([legs[each.side].ankle_height_m for each in stances])
    heights = floor_m + _raised_m(excess, stances, signals.fps) + ankles
    return Footsteps(
        side=np.array([each.side for each in stances], dtype=np.int64),
        start_tick=np.array([each.start for each in stances], dtype=np.int64),
        end_tick=np.array([each.end for each in stances], dtype=np.int64),
        ankle_in_world_m=np.column_stack([out, heights]).reshape(-1, 3),
        heading_rad=np.array([heading for _, heading in places]).reshape(-1),
        is_sure=np.array([each.is_sure for each in stances], dtype=bool),
    )


def _keep_apart(places: FloatArray, stances: list[_Stance], signals: TrunkSignals, leg_m: float) -> None:
    """Move places (N,2) outward where a foot would be put down across the other foot, which still stands.

    Source: A. L. Hof, "The 'extrapolated center of mass' concept suggests a simple control of balance in
    walking", Human Movement Science 27, 2008: a foot is placed outward of the path by a margin.
    """
    left = signals.left()
    for index, stance in enumerate(stances):
        outward = (1.0 if stance.side == 0 else -1.0) * left[stance.start]
        for other in range(index):
            if stances[other].side == stance.side or stances[other].end <= stance.start:
                continue
            width = float((places[index] - places[other]) @ outward)
            places[index] += max(_MIN_WIDTH * leg_m - width, 0.0) * outward


def _stances(contacts: Contacts, side: int) -> list[_Stance]:
    return [
        _Stance(side, start, end, bool(contacts.is_sure[start:end].all()))
        for start, end in runs(contacts.standing[:, side])
    ]


def _sunk_m(signals: TrunkSignals, leg: LegGeometry, floor_m: float) -> FloatArray:
    """Return how far (T,) the hips are below those of a person who is not upright; 0 if upright, metres."""
    standing_m = leg.length_m + leg.ankle_height_m
    sunk_m = standing_m - (signals.slow_hips_m[:, 2] - floor_m)
    return np.asarray(np.where(sunk_m > (1.0 - _LOW_SHARE) * standing_m, sunk_m, 0.0))


def _split_long_stances(
    stances: list[_Stance], contacts: Contacts, signals: TrunkSignals, sunk_m: FloatArray
) -> list[_Stance]:
    """Insert steps into periods of standing in which the hips move away from the feet or turn.

    A person who sits down moves the hips backward, and one who stands up moves them forward, over feet that
    stay. `sunk_m` (T,) states how far the hips are below those of a standing person.
    """
    out: list[_Stance] = []
    hips, heading = signals.slow_hips_m[:, :2], signals.heading_rad
    forward = signals.forward()
    gap = max(2, round(_ADJUSTING_S * signals.fps))
    for stance in stances:
        start = stance.start
        still = contacts.state[stance.start : stance.end] == STAND
        if not still.any():
            out.append(stance)
            continue
        anchor = stance.start + int(np.argmax(still))
        tick = anchor
        sure = stance.is_sure
        # The left foot steps first: both feet must not leave the floor at the same time.
        delay = gap * stance.side
        while tick < stance.end:
            shift = hips[tick] - hips[anchor]
            along = float(shift @ forward[anchor])
            usual = np.clip(along, -_SITTING_BACK * sunk_m[tick], _SITTING_BACK * sunk_m[anchor])
            moved = np.hypot(*(shift - usual * forward[anchor])) > _MAX_SHIFT_M
            turned = abs(heading[tick] - heading[anchor]) > _MAX_TURN_RAD
            if (moved or turned) and tick + delay + 2 * gap < stance.end:
                lift = tick + delay
                if lift > start:
                    out.append(_Stance(stance.side, start, lift, False))
                start = lift + gap
                anchor, sure = start, False
                tick = start
            tick += 1
        out.append(_Stance(stance.side, start, stance.end, sure))
    return out


def _place(
    stance: _Stance, contacts: Contacts, signals: TrunkSignals, leg: LegGeometry, floor_m: float
) -> tuple[FloatArray, float]:
    """Return the position (2,) of the ankle and the direction of the foot of a period of standing."""
    ticks = np.arange(stance.start, stance.end)
    state = contacts.state[stance.start : stance.end]
    outward = 1.0 if stance.side == 0 else -1.0
    still: BoolArray = state == STAND
    if still.any():
        chosen = ticks[still]
        upright = chosen[_sunk_m(signals, leg, floor_m)[chosen] == 0.0]
        if len(upright) >= _MIN_UPRIGHT_S * signals.fps:
            # A person who sits down leaves the feet where the person stood.
            chosen = upright
        # A foot that stands for long was placed at the start and is lifted at the end: the middle is robust.
        width = _STANDING_WIDTH
        base = np.median(signals.hips_m[chosen, :2], axis=0)
        heading = float(np.median(signals.heading_rad[chosen]))
        hips_m = float(np.median(signals.hips_m[chosen, 2])) - floor_m
        ahead_m = _CROUCHING_AHEAD * max(_LOW_SHARE * (leg.length_m + leg.ankle_height_m) - hips_m, 0.0)
    else:
        width, ahead_m = _WALKING_WIDTH, 0.0
        base, heading = _passing_hips(stance, contacts, signals)
    left = np.array([np.cos(heading), np.sin(heading)])
    forward = np.array([np.sin(heading), -np.cos(heading)])
    place = base + 0.5 * outward * width * leg.length_m * left + (ahead_m - _BEHIND_M) * forward
    return place, heading + outward * _TOE_OUT_RAD


def _excess_m(
    stance: _Stance, contacts: Contacts, signals: TrunkSignals, leg: LegGeometry, floor_m: float
) -> float:
    """Return how far (metres) above the floor a straight leg ends while its foot stands."""
    ticks = np.arange(stance.start, stance.end)
    state = contacts.state[stance.start : stance.end]
    chosen = ticks[state == STAND]
    if len(chosen) == 0:
        chosen = ticks[state == (LEFT if stance.side == 0 else RIGHT)]
    if len(chosen) == 0:
        chosen = ticks
    hips_m = float(np.median(signals.slow_hips_m[chosen, 2]))
    return hips_m - floor_m - _STRAIGHT_SHARE * leg.length_m - leg.ankle_height_m


def _raised_m(excess_m: FloatArray, stances: list[_Stance], fps: float) -> FloatArray:
    """Return the heights (N,) of the stairs below N successive feet over the floor, metres; 0 for the floor.

    A foot stands higher if its straight leg does not reach the floor, as those of its neighbours for some
    time. In a jump they do not reach the floor for a short time.
    """
    out = np.zeros(len(excess_m))
    if len(out) == 0:
        return out
    over = excess_m - np.clip(np.percentile(excess_m, _LEVEL_PERCENTILE), 0.0, _MIN_RAISED_M)
    for is_raised, group in itertools.groupby(range(len(out)), key=lambda index: over[index] > _MIN_RAISED_M):
        own = list(group)
        seconds = (max(stances[index].end for index in own) - stances[own[0]].start) / fps
        if is_raised and seconds >= _MIN_RAISED_S:
            out[own] = over[own]
    return out


def _passing_hips(stance: _Stance, contacts: Contacts, signals: TrunkSignals) -> tuple[FloatArray, float]:
    """Return the mean position (2,) and heading of the hips while the foot stands alone.

    Where the recording cuts off this time, it is completed by its expected duration, and the path of the hips
    is continued with its velocity.
    """
    ticks = np.arange(stance.start, stance.end)
    state = contacts.state[stance.start : stance.end]
    alone = ticks[state == (LEFT if stance.side == 0 else RIGHT)]
    last = len(contacts.state) - 1
    first, end = (int(alone[0]), int(alone[-1]) + 1) if len(alone) else (stance.start, stance.end)
    expected = contacts.single_s[[stance.start, stance.end - 1]] * signals.fps
    both = contacts.double_s[[stance.start, stance.end - 1]] * signals.fps
    if stance.start == 0 and (first == 0 or not len(alone)):
        # Without a time alone, the recording starts while both feet stand, at the end of this stance.
        stop = end if len(alone) else stance.end - both[0]
        first, end = min(first, round(stop - expected[0])), round(stop)
    elif stance.end > last and (end > last or not len(alone)):
        begin = first if len(alone) else stance.start + both[1]
        first, end = round(begin), max(end, round(begin + expected[1]))
    at = np.arange(first, max(end, first + 1))
    inside = np.clip(at, 0, last)
    beyond = ((at - inside) / signals.fps)[:, None]
    early = _EARLY_SHARE * (contacts.single_s + contacts.double_s)[inside, None]
    path = signals.slow_hips_m[inside, :2] + (beyond - early) * signals.velocity_m_per_s[inside, :2]
    return np.asarray(path.mean(axis=0)), float(signals.heading_rad[inside].mean())
