"""Another frame rate, and smoothing."""

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
"""A new tick this near to an old one, as a share of their distance, is that one."""


def resample(motion: Motion, fps: float) -> Motion:
    """The motion at another rate, from its first tick to its last.

    Rotations by slerp, positions linearly; a tick between two others was observed if both were.
    """
    if fps == motion.fps:
        return motion
    last = len(motion.root_in_world_m) - 1
    ticks = int(np.floor(last / motion.fps * fps + 1e-6)) + 1
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
    """Take out what is faster than the cut-off from the root's path and all rotations, without delay.

    Nothing is done where the rate cannot hold anything faster.

    Source: D. A. Winter, Biomechanics and Motor Control of Human Movement, 4th ed., section 3.4.4: a
        second-order Butterworth low-pass, forwards and backwards, its cut-off corrected for the two passes;
        here on positions and on the components of sign-continuous quaternions.
    """
    if 2.0 * cutoff_hz / _TWO_PASS_CUTOFF_RATIO >= motion.fps or len(motion.root_in_world_m) < _MIN_TICKS:
        return motion
    quats = _low_pass(continuous_quat_xyzw(motion.local_rotation), cutoff_hz, motion.fps)
    return replace(
        motion,
        root_in_world_m=_low_pass(motion.root_in_world_m, cutoff_hz, motion.fps),
        local_rotation=rotation_from_quat_xyzw(quats),
    )


_TWO_PASS_CUTOFF_RATIO = float((2**0.5 - 1) ** 0.25)
_MIN_TICKS = 4


def _low_pass(values: FloatArray, cutoff_hz: float, fps: float) -> FloatArray:
    """Filter along time (T,...)."""
    from scipy.signal import butter, sosfiltfilt

    sections = butter(2, cutoff_hz / _TWO_PASS_CUTOFF_RATIO, fs=fps, output="sos")
    reach = min(len(values) - 1, round(3.0 * fps / cutoff_hz))
    return np.asarray(sosfiltfilt(sections, values, axis=0, padlen=reach))
