"""Resample a motion to another frame rate, and smooth it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.geometry import (
    continuous_quat_xyzw,
    interpolate_pose,
    make_transform,
    rotation_from_quat_xyzw,
)
from bodycap_batch.model.skeleton import Motion

_TICK_TOLERANCE = 1e-9
"""A new tick and an old tick are treated as the same time if their distance is at most this tolerance.

Unit: interval of the old ticks. Derivation: the tolerance is larger than the rounding of tick times.
"""

_LAST_TICK_TOLERANCE = 1e-6
"""The last new tick may be later than the last old tick by at most this tolerance.

Unit: interval of the new ticks. Derivation: the tolerance is larger than the rounding of tick times.
"""

_TWO_PASS_CUTOFF_RATIO = float((2**0.5 - 1) ** 0.25)
"""Ratio of the filter's cut-off frequency after two passes to its cut-off frequency after one pass.

Source: D. A. Winter, Biomechanics and Motor Control of Human Movement, 4th ed., section 3.4.4.
"""

_MIN_TICKS = 4
"""Minimum number of ticks of a motion that is smoothed. Evidence: none."""


def resample(motion: Motion, fps: float) -> Motion:
    """Return the motion at another frame rate, from the first to the last tick of the old motion.

    Rotations are interpolated by slerp, and positions linearly. A joint is observed at a new tick between two
    old ticks if the joint was observed at both old ticks.

    Args:
        motion: The old motion.
        fps: The new frame rate, ticks per second.
    """
    if fps == motion.fps:
        return motion
    last = len(motion.root_in_world_m) - 1
    ticks = int(np.floor(last / motion.fps * fps + _LAST_TICK_TOLERANCE)) + 1
    at = np.minimum(np.arange(ticks) * (motion.fps / fps), last)
    before = np.minimum(at.astype(np.int64), max(last - 1, 0))
    after = np.minimum(before + 1, last)
    alpha = at - before
    poses = make_transform(motion.local_rotation, np.zeros(3))
    poses[:, 0, :3, 3] = motion.root_in_world_m
    poses = interpolate_pose(poses[before], poses[after], alpha[:, None])
    first, second = (
        motion.observed[np.where(alpha > s, after, before)] for s in (1.0 - _TICK_TOLERANCE, _TICK_TOLERANCE)
    )
    return replace(
        motion,
        fps=fps,
        root_in_world_m=poses[:, 0, :3, 3],
        local_rotation=poses[..., :3, :3],
        observed=first & second,
    )


def smooth(motion: Motion, cutoff_hz: float) -> Motion:
    """Return the motion with a low-pass filter applied to the root path and the rotations, without delay.

    The motion is returned unchanged if it is too short. It is also returned unchanged if the filter's cut-off
    frequency for one pass is at least half the frame rate.

    Args:
        motion: The motion.
        cutoff_hz: Cut-off frequency after both passes of the filter, Hz.

    Source: D. A. Winter, Biomechanics and Motor Control of Human Movement, 4th ed., section 3.4.4. The filter
        is a second-order Butterworth low-pass, applied forwards and backwards. The cut-off frequency is
        corrected for the two passes. The filter is applied to positions and to the components of quaternions
        with continuous signs.
    """
    if 2.0 * cutoff_hz / _TWO_PASS_CUTOFF_RATIO >= motion.fps or len(motion.root_in_world_m) < _MIN_TICKS:
        return motion
    quats = _low_pass(continuous_quat_xyzw(motion.local_rotation), cutoff_hz, motion.fps)
    return replace(
        motion,
        root_in_world_m=_low_pass(motion.root_in_world_m, cutoff_hz, motion.fps),
        local_rotation=rotation_from_quat_xyzw(quats),
    )


def _low_pass(values: FloatArray, cutoff_hz: float, fps: float) -> FloatArray:
    """Return values (T,...) after low-pass filtering along the time axis."""
    from scipy.signal import butter, sosfiltfilt

    sections = butter(2, cutoff_hz / _TWO_PASS_CUTOFF_RATIO, fs=fps, output="sos")
    padding = min(
        len(values) - 1, round(3.0 * fps / cutoff_hz)
    )  # three periods: long enough for the filter's transient to decay
    return np.asarray(sosfiltfilt(sections, values, axis=0, padlen=padding))
