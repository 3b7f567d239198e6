"""Find the times at which a delivered path breaks: its rotation folds, it leaps, or its scale jumps.

A break at frame t lies between the frames t−1 and t. Every measurement that spans a break contradicts the
delivered path, and none confirms it there. So a single wrong measurement among many right ones is no break.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.evaluate.three_view import Legs

_MIN_SCALE_JUMP = float(np.tan(np.deg2rad(5.0)))
"""Minimum change of the logarithm of the scale that is wrong: 5 degrees of the direction to a point, after a
way as long as the distance to it."""
_SCALE_SIGMAS = 5.0
"""Number of standard deviations of a scale jump. Evidence: 3 for one jump at a known time; the largest of the
jumps of some hundred times exceeds 4."""
_MAX_LOG_SIGMA = 0.3
"""Maximum standard deviation of the logarithm of a ratio of legs that is used."""
_POSITION_SIGMA_DEG = 0.15
"""Standard deviation of a delivered position, as a parallax (degrees): 5 mm at a distance of 2 m. A short leg
is longer or shorter by it, which is no jump of the scale. Evidence: docs/decisions/tracks.md."""
_COMMON_SHARE = 0.4
"""Part of this deviation that neighbouring positions have in common: more legs of one length do not make it
smaller. Evidence: docs/decisions/tracks.md."""
_MIN_PARALLAX_DEG = 1.0
"""Minimum parallax (degrees) of both legs of a ratio that is used. With less, errors of corners, which hands
and pyramid levels give in common, are a large part of a leg, and have one sign."""
_MIN_RATIOS = 4
"""Minimum number of ratios that measure a scale jump."""
_MIN_EFFECT = 0.5
"""Minimum part of a jump that such a ratio shows. Of one that shows less, a small error is a large jump: with
5 %, four ratios of a smooth path were a jump by a factor of 44,000."""


def contradicted_times(
    wrong: Sequence[tuple[int, int]], right: Sequence[tuple[int, int]], count: int, minimum: int
) -> list[int]:
    """Return the fewest times that explain wrong measurements.

    Args:
        wrong: First and last frame of each measurement that contradicts the path.
        right: First and last frame of each measurement that confirms it.
        count: Number of frames.
        minimum: Minimum number of wrong measurements beyond that of right ones across a break.
    """
    confirmed, left, found = _spanning(right, count), list(wrong), []
    while left:
        score = _spanning(left, count) - confirmed
        best = np.flatnonzero(score == score.max())
        time = int(best[len(best) // 2])
        if score[time] < minimum:
            break
        found.append(time)
        left = [(first, last) for first, last in left if not first < time <= last]
    return sorted(found)


def _spanning(intervals: Sequence[tuple[int, int]], count: int) -> IntArray:
    """Return the number (count + 1,) of intervals of frames that span each time."""
    change = np.zeros(count + 2, dtype=np.int64)
    for first, last in intervals:
        change[first + 1] += 1
        change[last + 1] -= 1
    return np.cumsum(change)[:-1]


def scale_jumps(
    legs: Sequence[tuple[tuple[int, int, int], Legs]], centres: FloatArray, breaks: Sequence[int]
) -> list[int]:
    """Return the times at which the scale of a path jumps.

    Every measured ratio of two legs that spans a time is an estimate of the jump there: the share of each
    leg that lies after the time gives the change of the delivered ratio by a jump. Their evidence is
    combined by least squares, and the time with the most significant jump is taken first.

    Args:
        legs: Frames and measured legs of the triples whose shape the pictures confirm or contradict.
        centres: (N,3) delivered camera centres.
        breaks: Times at which the path breaks otherwise. No ratio across them is used.
    """
    step = np.nan_to_num(np.linalg.norm(np.diff(centres, axis=0), axis=1))
    way = np.concatenate([[0.0], np.cumsum(step)])
    frames, difference, sigma, shared = [], [], [], []
    for triple, measured in legs:
        lengths = np.linalg.norm(np.diff(centres[list(triple)], axis=0), axis=1)
        value, deviation = measured.log_ratio
        spanned = any(triple[0] < time <= triple[2] for time in breaks)
        parallax = measured.parallax * np.linalg.norm(measured.translations, axis=1)
        is_seen = min(lengths) > 0 and min(parallax) > np.deg2rad(_MIN_PARALLAX_DEG)
        if is_seen and deviation < _MAX_LOG_SIGMA and not spanned:
            frames.append(triple)
            difference.append(np.log(lengths[1] / lengths[0]) - value)
            sigma.append(deviation)
            shared.append(_ratio_sigma(parallax))
    if not frames:
        return []
    spread, common = np.array(sigma), np.array(shared)
    gaps = np.diff(np.array(frames), axis=1)[:, 0]
    for gap in np.unique(gaps):
        # The stated deviations leave out what neighbouring frames have in common, so the data correct them.
        normalised = np.abs(np.array(difference)[gaps == gap]) / np.hypot(spread, common)[gaps == gap]
        spread[gaps == gap] *= max(1.0, 1.48 * float(np.median(normalised)))
    return _jumps(np.array(frames), np.array(difference), spread, common, way)


def _ratio_sigma(parallax: FloatArray) -> float:
    """Return the deviation of the logarithm of a ratio of two legs (2,) through delivered positions."""
    ends, middle = 1.0 / parallax, np.sum(1.0 / parallax)
    return float(np.deg2rad(_POSITION_SIGMA_DEG) * np.sqrt(np.sum(ends**2) + middle**2))


def _jumps(
    frames: IntArray, difference: FloatArray, sigma: FloatArray, common: FloatArray, way: FloatArray
) -> list[int]:
    best, strongest = 0, 0.0
    for time in range(int(frames.min()) + 1, int(frames.max()) + 1):
        spans = (frames[:, 0] < time) & (time <= frames[:, 2])
        spans[spans] = _effect(way[frames[spans]], way[time - 1]) >= _MIN_EFFECT
        if np.count_nonzero(spans) < _MIN_RATIOS:
            continue
        effect = _effect(way[frames[spans]], way[time - 1])
        gaps = frames[spans, 1] - frames[spans, 0]
        jump, deviation = _jump(effect, difference[spans], sigma[spans], common[spans], gaps)
        if abs(jump) > _MIN_SCALE_JUMP and abs(jump) / deviation > strongest:
            best, strongest = time, abs(jump) / deviation
    if strongest < _SCALE_SIGMAS:
        return []
    found = [best]
    for side in (frames[:, 2] < best, frames[:, 0] >= best):
        if side.any():
            found += _jumps(frames[side], difference[side], sigma[side], common[side], way)
    return sorted(found)


def _effect(way: FloatArray, at: float) -> FloatArray:
    """Return the part (M,) of a jump at one place of the way by which delivered ratios (M,3) are larger."""
    legs = np.maximum(np.diff(way, axis=1), 1e-12)
    after = np.clip((way[:, 1:] - at) / legs, 0.0, 1.0)
    return np.asarray(after[:, 1] - after[:, 0])


def _jump(
    effect: FloatArray, difference: FloatArray, sigma: FloatArray, common: FloatArray, gaps: IntArray
) -> tuple[float, float]:
    """Return the jump of the logarithm of the scale at one place of the way, and its standard deviation.

    Args:
        effect: (M,) the part of the jump by which each ratio is larger.
        difference: (M,) delivered minus measured logarithm of each ratio.
        sigma: (M,) standard deviation of each measured logarithm.
        common: (M,) standard deviation of each delivered logarithm. A share of it is common to one gap.
        gaps: (M,) number of frames of each leg.
    """
    estimates, total = difference / effect, np.hypot(sigma, common) / effect
    order = np.argsort(estimates)
    share = np.cumsum(1.0 / total[order] ** 2)
    jump = float(estimates[order[np.searchsorted(share, share[-1] / 2)]])
    for _ in range(5):
        weight = 1.0 / (1.0 + ((estimates - jump) / total / 3.0) ** 2) ** 2 / total**2
        means, information = [], []
        for gap in np.unique(gaps):
            own = np.where(gaps == gap, weight, 0.0)
            together = _COMMON_SHARE * float(np.sum(own * common / effect) / own.sum())
            means.append(float(np.sum(own * estimates) / own.sum()))
            information.append(1.0 / (1.0 / own.sum() + together**2))
        jump = float(np.average(means, weights=information))
    return jump, float(1.0 / np.sqrt(np.sum(information)))
