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
"""Ratio to the distance of two old ticks. A new tick nearer than this to an old one coincides with it.
Derivation: above the rounding of tick times."""

_LAST_TICK_TOLERANCE = 1e-6
"""New ticks. The last old tick is included if it misses the new timeline by less than this. Derivation: above
the rounding of tick times."""

_TWO_PASS_CUTOFF_RATIO = float((2**0.5 - 1) ** 0.25)
"""Ratio of the cut-off frequency after two passes of the filter to that of one pass. Source: D. A. Winter,
Biomechanics and Motor Control of Human Movement, 4th ed., section 3.4.4."""

_MIN_TICKS = 4
"""A shorter motion is not smoothed. Evidence: none."""


def resample(motion: Motion, fps: float) -> Motion:
    """Return the motion at another rate, from its first to its last tick.

    Rotations are interpolated by slerp, positions linearly. A tick between two old ticks counts as observed
    if both old ticks were observed.
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
    """Return the motion with root path and rotations low-pass filtered, without delay.

    The motion is returned unchanged if the cut-off frequency is not below half the frame rate.

    Args:
        motion: The motion.
        cutoff_hz: Cut-off frequency of the filter.

    Source: D. A. Winter, Biomechanics and Motor Control of Human Movement, 4th ed., section 3.4.4: a
        second-order Butterworth low-pass, forwards and backwards, with its cut-off corrected for the two
        passes. It is applied to positions and to the components of quaternions with continuous signs.
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
    """Low-pass filter values (T,...) along time."""
    from scipy.signal import butter, sosfiltfilt

    sections = butter(2, cutoff_hz / _TWO_PASS_CUTOFF_RATIO, fs=fps, output="sos")
    padding = min(
        len(values) - 1, round(3.0 * fps / cutoff_hz)
    )  # three periods: the filter's start has decayed
    return np.asarray(sosfiltfilt(sections, values, axis=0, padlen=padding))
