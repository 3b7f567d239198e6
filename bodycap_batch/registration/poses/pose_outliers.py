"""Find poses that deviate from the poses around them, and isolated poses."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, runs
from bodycap_batch.core.mechanisms import Mechanism, is_on, record_act

_MIN_SIGMAS = 8.0
"""Minimum deviation of an outlier, in standard deviations of the camera centres. Evidence: none."""
_MIN_SCALE_RATIO = 10.0
"""Minimum deviation of an outlier, as a multiple of the typical second difference around it. This ratio does
not depend on the map's scale or on the speed. Evidence: none."""
_MIN_NEIGHBOUR_RESPONSE = 0.5
"""Minimum response of the two neighbours of an outlier. The response is the fraction of the outlier's second
difference that the neighbours' second differences cancel. It is 1 at a single outlier and 0 at a jerk of the
camera. Origin: the middle of 0 and 1."""
_SLOW_SPAN_NS, _MIN_NEIGHBOUR_RESPONSE_SLOW = 90_000_000, 0.8
"""If the time between the two neighbours exceeds _SLOW_SPAN_NS (nanoseconds), the minimum response is
_MIN_NEIGHBOUR_RESPONSE_SLOW. Otherwise the minimum response is _MIN_NEIGHBOUR_RESPONSE. During a longer time,
a fast gesture may also bend the path at a single frame. The response of a gesture is smaller than the
response of an outlier. Evidence: docs/decisions/registration.md."""
_GAP_MIN_SIGMAS = 4.0
"""Minimum deviation of an outlier next to a lost interval, in standard deviations. Evidence:
docs/decisions/registration.md."""
_GAP_MIN_SCALE_RATIO = 5.0
"""Minimum deviation of an outlier next to a lost interval, as a multiple of the typical second difference.
Evidence: docs/decisions/registration.md."""
_RUN_LENGTHS = (2, 3)
"""Numbers of successive poses that are tested together as a run of outliers. A longer run may be real
motion."""
_MAX_RUN_SPAN_NS = 140_000_000
"""Maximum time from the frame before a run to the frame after the run. Unit: nanoseconds. Origin: a run of
three poses at 30 Hz. In a longer time, a body can really move away and return."""
_MIN_KINK_RATIO = 2.0
"""Minimum deviation of a run, as a multiple of the deviation that a sudden stop of the body explains.
Evidence: none."""
_MAX_EXTRAPOLATION_RATIO = 0.5
"""Maximum extrapolation error at the pose after the run, as a fraction of the run's deviation. If the error
is larger, the path does not return to its earlier course after the run. The run is then treated as motion and
not as an outlier. Evidence: none."""
_SECOND_MIN_RESPONSE, _FIRST_MAX_RESPONSE, _SECOND_MAX_RESPONSE = 0.25, 0.45, 1.0
"""Thresholds of the response after a lost interval. The response is the fraction of the second pose's second
difference that the third pose's second difference cancels. The first pose may be wrong if the response is
below _FIRST_MAX_RESPONSE. The second pose may be wrong if the response is between _SECOND_MIN_RESPONSE and
_SECOND_MAX_RESPONSE. Origin: the response is 0 if the first pose is wrong, 0.5 if the second pose is wrong,
and 2 if the third pose is wrong. Evidence for the thresholds between these values: none."""
_MIN_SIDE_RESPONSE = 0.125
"""Minimum fraction of a single outlier's second difference that each neighbour cancels. It is 0.5 at a single
outlier. At a step of the path, it is 1 on one side and 0 on the other. Origin: a quarter of 0.5."""
_STEP_MIN_RESPONSE, _STEP_MAX_RESPONSE = 0.75, 1.5
"""Response (as after a lost interval) at which all poses between the lost interval and a step are
wrong. Origin: it is 0.5 if the second pose is wrong, 1 at a step, 2 if the third pose is wrong."""
_STEP_LENGTHS = (2, 3)
"""Numbers of poses between a lost interval and a step, as for runs. Evidence:
docs/decisions/registration.md."""
_SCALE_WINDOW = 12
"""Number of frames on either side that determine the typical second difference. Evidence: none."""
ISOLATED_INLIER_FACTOR = 4
"""Minimum number of inliers of an isolated pose that is kept, as a multiple of the minimum number for other
poses. Evidence: none."""
_MAX_ISOLATED_RUN = 2
"""Maximum number of successive poses that are treated as isolated. Evidence: none."""
_MIN_ISOLATING_GAP = 3
"""Minimum number of lost frames on either side of isolated poses. Evidence: none."""


def find_outlier_poses(centres: FloatArray, sigma: FloatArray, times_ns: IntArray) -> BoolArray:
    """Find up to three successive frames whose camera centre is far from the path of the other frames.

    The test uses second differences. The second difference of a frame is the offset of its centre from the
    midpoint of the centres before and after it. A single outlier changes its own second difference by its
    full deviation. It changes the second differences of both neighbours by half of this deviation, with the
    opposite sign. A body that stops suddenly changes mainly one second difference.

    Next to a lost interval only one side can be tested. The limits are lower there, because more poses are
    wrong. A deviation of several frames that lasts longer than `_MAX_RUN_SPAN_NS` is treated as motion.

    Args:
        centres: (N,3) camera centres in the map's gauge; NaN for frames without a pose.
        sigma: (N,) standard deviation of each centre relative to its neighbours, in the unit of the centres;
            NaN for frames without a pose.
        times_ns: (N,) times of the frames in nanoseconds, increasing.

    Returns:
        Mask (N,) of the frames whose pose is an outlier. The mask does not depend on the scale of the map.
    """
    if not is_on(Mechanism.POSE_OUTLIERS):
        return np.zeros(len(centres), dtype=bool)
    size = np.linalg.norm(_second_differences(centres, sigma)[0], axis=1)
    in_run = np.zeros(len(centres), dtype=bool)
    for length in _RUN_LENGTHS:
        in_run |= _outlier_runs(centres, sigma, times_ns, size, length)
    # Runs are removed first, because a correct pose next to a run would look like an outlier.
    centres = np.where(in_run[:, None], np.nan, centres)
    backwards = _outliers_after_gaps(centres[::-1], sigma[::-1])[::-1]
    ends = _outliers_after_gaps(centres, sigma) | backwards
    found = np.asarray(in_run | _single_outliers(centres, sigma, times_ns) | ends)
    record_act(Mechanism.POSE_OUTLIERS, int(found.sum()))
    return found


def _single_outliers(centres: FloatArray, sigma: FloatArray, times_ns: IntArray) -> BoolArray:
    """Return a mask (N,) of single outliers: frames that deviate from both neighbours."""
    offset, noise = _second_differences(centres, sigma)
    size = np.linalg.norm(offset, axis=1)
    out = np.zeros(len(centres), dtype=bool)
    # Both neighbours need a second difference. Otherwise the wrong one of the three frames could be selected.
    frames = 1 + _run_starts(np.isfinite(size), 3)
    highest = np.maximum(size[frames - 1], size[frames + 1])
    frames = frames[(size[frames] > _MIN_SIGMAS * noise[frames]) & (size[frames] >= highest)]
    sides = -np.stack([np.sum(offset[frames + side] * offset[frames], axis=1) for side in (-1, 1)])
    response = np.where((sides >= _MIN_SIDE_RESPONSE * size[frames] ** 2).all(axis=0), sides.sum(axis=0), 0.0)
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
    """Return a mask (N,) of the frames in runs of outliers of a given length.

    A run is tested against the straight line from the pose before it to the pose after it.

    Args:
        centres: (N,3) camera centres.
        sigma: (N,) standard deviation of each centre.
        times_ns: (N,) times of the frames in nanoseconds.
        size: (N,) length of each frame's second difference.
        length: Number of poses in a run.
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
        # The expected deviation from the line: every frame of the run is assumed to have the typical second
        # difference.
        local = _local_scale(size, before[row], behind[row] + 1, _SCALE_WINDOW) * 0.25 * steps**2
        out[run[row]] |= smallest[row] > _MIN_SCALE_RATIO * local
    return out


def _local_scale(size: FloatArray, start: int, stop: int, window: int) -> float:
    """Return the typical length of a second difference: the median over `window` frames on either side.

    The frames [start, stop) are not used. The result is infinite if too few second differences are
    known.
    """
    nearby = np.concatenate([size[max(0, start - window) : start], size[stop : stop + window]])
    return float(np.nanmedian(nearby)) if np.isfinite(nearby).sum() >= _SCALE_WINDOW // 2 else np.inf


def _run_starts(known: BoolArray, length: int) -> IntArray:
    """Return the first frames of all runs of `length` successive known frames; runs may overlap."""
    if len(known) < length:
        return np.zeros(0, dtype=np.int64)
    rows = np.lib.stride_tricks.sliding_window_view(known, length)
    return np.flatnonzero(rows.all(axis=1))


def _second_differences(centres: FloatArray, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the offsets (N,3) from the midpoint of both neighbours, and their standard deviations (N,)."""
    offset, noise = np.full((len(centres), 3), np.nan), np.full(len(centres), np.nan)
    if len(centres) >= 3:
        offset[1:-1] = centres[1:-1] - 0.5 * (centres[:-2] + centres[2:])
        noise[1:-1] = np.sqrt(sigma[1:-1] ** 2 + 0.25 * (sigma[:-2] ** 2 + sigma[2:] ** 2))
    return offset, noise


def _outliers_after_gaps(centres: FloatArray, sigma: FloatArray) -> BoolArray:
    """Return a mask (N,) of the wrong poses among the first two poses after each lost interval.

    If the first pose is wrong, the second difference of the second pose changes by half of the first pose's
    deviation. The second difference of the third pose does not change.

    If the second pose is wrong, its own second difference changes by its full deviation. The second
    difference of the third pose changes by half of this deviation, with the opposite sign. If the response
    does not distinguish a wrong first pose from a wrong second pose, both poses are rejected.

    If the first two or three poses are wrong and agree with each other, the path makes a step after them: its
    second differences before and after the step cancel each other. The few poses are rejected.

    If the third pose is wrong, its own second difference changes twice as much as the second difference of
    the second pose. The third pose is not tested here, because it has both neighbours: `_single_outliers`
    tests it.
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
        for last in (first + length - 1 for length in _STEP_LENGTHS):
            if _is_step(offset, noise, last):
                out[first : last + 1] = True
    return out


def _is_step(offset: FloatArray, noise: FloatArray, last: int) -> bool:
    """Return whether the path makes a step from a pose to the next one: both sides of it are smooth.

    Args:
        offset: (N,3) second differences.
        noise: (N,) their standard deviations.
        last: Frame before the step.
    """
    nearby = np.linalg.norm(offset[last + 2 : last + 2 + _SCALE_WINDOW], axis=1)
    if not np.isfinite(offset[last : last + 2]).all() or np.isfinite(nearby).sum() < _SCALE_WINDOW // 2:
        return False
    size = float(np.linalg.norm(offset[last]))
    response = -float(offset[last + 1] @ offset[last]) / size**2
    is_large = size > max(_GAP_MIN_SIGMAS * noise[last], _GAP_MIN_SCALE_RATIO * np.nanmedian(nearby))
    return bool(is_large and _STEP_MIN_RESPONSE < response <= _STEP_MAX_RESPONSE)


def isolated_poses(localised: BoolArray, inliers: IntArray, min_inliers: int) -> BoolArray:
    """Return the frames whose pose has few inliers and no support from neighbouring frames.

    Args:
        localised: (N,) True for frames with a pose.
        inliers: (N,) number of inliers of each pose.
        min_inliers: Minimum number of inliers of an isolated pose that is kept.

    Returns:
        Mask (N,) of runs of one or two poses with too few inliers and at least three lost frames on either
        side.
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
