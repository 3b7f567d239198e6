"""Poses that their neighbours speak against, or that nothing confirms."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, runs

_MIN_SIGMAS = 8.0
_MIN_SCALE_RATIO = 10.0
"""A jump stands out of the bends of the path around it, whatever the scale and the speed."""
_MIN_NEIGHBOUR_RESPONSE = 0.5
"""How much of a frame's bend its two neighbours' bends undo: all of it at a jump, nothing at a jerk."""
_SLOW_SPAN_NS, _MIN_NEIGHBOUR_RESPONSE_SLOW = 90_000_000, 0.8
"""The share where both neighbours are so far apart, as below 22 Hz: a gesture there and back bends as few
frames there as a jump does, its neighbours less. Of 256 of them, of 12 and 20 cm within 0.2 to 0.4 s, seen at
10 to 20 Hz, 0.5 refuses 131 frames, 0.8 refuses 34; of single wrong poses at 10 and 15 Hz it misses up to 7 %
more."""
_GAP_MIN_SIGMAS = 4.0
_GAP_MIN_SCALE_RATIO = 5.0
"""The same for the ends of lost stretches. On 14 results with truth six of some 150 such ends bend the path
so much: five beside poses that are off by 6 to 16 cm, one beside a pose off by 3 cm."""
_RUN_LENGTHS = (2, 3)
_MAX_RUN_SPAN_NS = 140_000_000
"""From the frame before a run to the one behind it, three poses at 30 Hz: in longer ones a body gets there
and back."""
_MIN_KINK_RATIO = 2.0
"""A body that stops dead leaves the line between before and after, too: wrong poses by so many times more."""
_MAX_EXTRAPOLATION_RATIO = 0.5
"""Of that offset, by which the pose behind the run may miss where the way before it leads: a path that steps
aside for good has nothing to be judged by."""
_SECOND_MIN_RESPONSE, _FIRST_MAX_RESPONSE, _SECOND_MAX_RESPONSE = 0.25, 0.45, 1.0
"""Answers of the third pose's bend to the second's: between 0.25 and 0.45 either of the first two may be
wrong, beyond 1 neither is."""
_SCALE_WINDOW = 12
ISOLATED_INLIER_FACTOR = 4
"""x"""
_MAX_ISOLATED_RUN = 2
_MIN_ISOLATING_GAP = 3


def find_outlier_poses(centres: FloatArray, sigma: FloatArray, times_ns: IntArray) -> BoolArray:
    """Frames, up to three in a row, whose centre leaves the line between its neighbours as nothing near does.

    The bend of a frame is its offset from the middle of the frames before and after it. A jump bends itself
    by its full height and both neighbours by half of it, the other way; a body that stops dead or starts with
    a jerk bends one frame and its neighbours hardly. Beside a lost stretch one side is all there is to judge
    by, and more poses are wrong. What takes longer than 0.14 s there and back is motion, unless one frame
    alone shows it.

    Args:
        centres: (N,3) camera centres; NaN where there is no pose.
        sigma: (N,) standard deviation of the centre beside its neighbours', same unit; NaN likewise.
        times_ns: (N,) of the frames, rising.

    Returns:
        (N,) True where the pose is to be refused. Scaling the map changes nothing.
    """
    size = np.linalg.norm(_second_differences(centres, sigma)[0], axis=1)
    runs = np.zeros(len(centres), dtype=bool)
    for length in _RUN_LENGTHS:
        runs |= _outlier_runs(centres, sigma, times_ns, size, length)
    # Beside one of several wrong poses a right one would be blamed.
    centres = np.where(runs[:, None], np.nan, centres)
    backwards = _outliers_after_gaps(centres[::-1], sigma[::-1])[::-1]
    ends = _outliers_after_gaps(centres, sigma) | backwards
    return np.asarray(runs | _single_outliers(centres, sigma, times_ns) | ends)


def _single_outliers(centres: FloatArray, sigma: FloatArray, times_ns: IntArray) -> BoolArray:
    """Frames (N,) that leave the line between their neighbours by themselves."""
    offset, noise = _second_differences(centres, sigma)
    size = np.linalg.norm(offset, axis=1)
    out = np.zeros(len(centres), dtype=bool)
    # Without both neighbours' own bends the wrong one of the three could be blamed.
    frames = 1 + _run_starts(np.isfinite(size), 3)
    highest = np.maximum(size[frames - 1], size[frames + 1])
    frames = frames[(size[frames] > _MIN_SIGMAS * noise[frames]) & (size[frames] >= highest)]
    response = -np.sum((offset[frames - 1] + offset[frames + 1]) * offset[frames], axis=1)
    is_slow = times_ns[frames + 1] - times_ns[frames - 1] > _SLOW_SPAN_NS
    min_response = np.where(is_slow, _MIN_NEIGHBOUR_RESPONSE_SLOW, _MIN_NEIGHBOUR_RESPONSE)
    for frame in frames[response >= min_response * size[frames] ** 2].tolist():
        out[frame] = size[frame] > _MIN_SCALE_RATIO * _local_scale(
            size, frame - 1, frame + 2, _SCALE_WINDOW - 1
        )
    return out


def _outlier_runs(
    centres: FloatArray, sigma: FloatArray, times_ns: IntArray, size: FloatArray, length: int
) -> BoolArray:
    """Frames (N,) of runs of so many poses that all leave the way from before the run to behind it.

    Args:
        centres: (N,3).
        sigma: (N,).
        times_ns: (N,).
        bend: (N,) every frame's own.
        length: How many poses.
    """
    out = np.zeros(len(centres), dtype=bool)
    steps = length + 1
    first = 2 + _run_starts(np.asarray(np.isfinite(centres).all(axis=1)), length + 4)
    first = first[times_ns[first + length] - times_ns[first - 1] <= _MAX_RUN_SPAN_NS]
    before, behind, run = first - 1, first + length, first[:, None] + np.arange(length)
    baseline = centres[behind] - centres[before]
    line = np.arange(1, steps)[:, None] / steps * baseline[:, None]
    distance = np.linalg.norm(centres[run] - centres[before][:, None] - line, axis=2)
    noise = np.sqrt(sigma[run] ** 2 + 0.5 * (sigma[before] ** 2 + sigma[behind] ** 2)[:, None])
    start, end = centres[before] - centres[before - 1], centres[behind + 1] - centres[behind]
    kink = 0.25 * steps * np.linalg.norm(end - start, axis=1)
    extrapolation_error = np.linalg.norm(baseline - 0.5 * steps * (start + end), axis=1)
    smallest = distance.min(axis=1)
    candidate = (distance > _MIN_SIGMAS * noise).all(axis=1) & (
        smallest > np.maximum(_MIN_KINK_RATIO * kink, extrapolation_error / _MAX_EXTRAPOLATION_RATIO)
    )
    for row in np.flatnonzero(candidate).tolist():
        # What a steady bend amounts to over the run.
        local = _local_scale(size, before[row], behind[row] + 1, _SCALE_WINDOW) * 0.25 * steps**2
        out[run[row]] |= smallest[row] > _MIN_SCALE_RATIO * local
    return out


def _local_scale(size: FloatArray, start: int, stop: int, window: int) -> float:
    """Median bend of `window` frames on either side of start:stop; infinite where too few are known."""
    nearby = np.concatenate([size[max(0, start - window) : start], size[stop : stop + window]])
    return float(np.nanmedian(nearby)) if np.isfinite(nearby).sum() >= _SCALE_WINDOW // 2 else np.inf


def _run_starts(known: BoolArray, length: int) -> IntArray:
    """First ones of so many known frames in a row."""
    if len(known) < length:
        return np.zeros(0, dtype=np.int64)
    rows = np.lib.stride_tricks.sliding_window_view(known, length)
    return np.flatnonzero(rows.all(axis=1))


def _second_differences(centres: FloatArray, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Offsets (N,3) from the middle of both neighbours, and the standard deviation (N,) of such a one."""
    offset, noise = np.full((len(centres), 3), np.nan), np.full(len(centres), np.nan)
    if len(centres) >= 3:
        offset[1:-1] = centres[1:-1] - 0.5 * (centres[:-2] + centres[2:])
        noise[1:-1] = np.sqrt(sigma[1:-1] ** 2 + 0.25 * (sigma[:-2] ** 2 + sigma[2:] ** 2))
    return offset, noise


def _outliers_after_gaps(centres: FloatArray, sigma: FloatArray) -> BoolArray:
    """Wrong poses (N,) that come first or second after a lost stretch.

    The first one bends the second by half of its height and the third not at all; the second one bends itself
    by all of it and the third by half, the other way. Where that does not tell them apart both are refused.
    The third one bends itself twice as much as the second: it has both neighbours to be judged by.
    """
    offset, noise = _second_differences(centres, sigma)
    size = np.linalg.norm(offset, axis=1)
    out = np.zeros(len(centres), dtype=bool)
    posed: BoolArray = np.asarray(np.isfinite(centres).all(axis=1), dtype=bool)
    for first in (1 + np.flatnonzero(posed[1:] & ~posed[:-1])).tolist():
        second, third = first + 1, first + 2
        nearby = size[third + 1 : third + 1 + _SCALE_WINDOW]
        if not np.isfinite(size[second : third + 1]).all() or np.isfinite(nearby).sum() < _SCALE_WINDOW // 2:
            continue
        if size[second] > max(_GAP_MIN_SIGMAS * noise[second], _GAP_MIN_SCALE_RATIO * np.nanmedian(nearby)):
            response = -offset[third] @ offset[second] / size[second] ** 2
            out[first] |= response < _FIRST_MAX_RESPONSE
            out[second] |= _SECOND_MIN_RESPONSE < response <= _SECOND_MAX_RESPONSE
    return out


def isolated_poses(localised: BoolArray, inliers: IntArray, min_inliers: int) -> BoolArray:
    """Frames of which nothing but their own few inliers speaks: no neighbouring frame confirms them.

    Args:
        localised: (N,) frames with a pose.
        inliers: (N,) of each pose.
        enough: Inliers with which a pose stands by itself.

    Returns:
        (N,) True in runs of one or two poses amid at least three lost frames on either side.
    """
    out = np.zeros(len(localised), dtype=bool)
    for start, stop in runs(localised):
        surroundings = np.concatenate(
            [
                localised[max(0, start - _MIN_ISOLATING_GAP) : start],
                localised[stop : stop + _MIN_ISOLATING_GAP],
            ]
        )
        if stop - start <= _MAX_ISOLATED_RUN and not surroundings.any():
            out[start:stop] = inliers[start:stop] < min_inliers
    return out
