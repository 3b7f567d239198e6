"""Associate ground truth with estimates by time: interpolated, or the nearest pose."""

from __future__ import annotations

from typing import Literal

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.formats.tum import TimedPoses
from bodycap_batch.model.geometry import poses_at

Association = Literal["interpolate", "nearest"]

_SNAP_NS = 1_000_000
"""Nanoseconds. A true pose this near in time is used even without a second neighbour. Derivation: some files
have timestamps of only four decimals."""


def interpolate_truth(
    truth: TimedPoses, times_ns: IntArray, max_gap_s: float
) -> tuple[FloatArray, BoolArray]:
    """Interpolate the true poses at given times: rotations by slerp, positions linearly.

    Args:
        truth: True poses in the order of time.
        times_ns: (N,) times to interpolate at.
        max_gap_s: Largest time between two true poses; in a longer gap there is no truth.

    Returns:
        (N,4,4) true poses, the identity without truth, and a mask (N,) of the times with truth.
    """
    return poses_at(
        truth.times_ns,
        truth.world_from_cam,
        times_ns,
        max_gap_ns=round(max_gap_s * 1e9),
        snap_ns=_SNAP_NS,
    )


def nearest_truth(truth: TimedPoses, times_ns: IntArray, max_diff_s: float) -> tuple[FloatArray, BoolArray]:
    """Return the true poses that are nearest to given times, as the TUM benchmark tools do.

    Args:
        truth: True poses in the order of time.
        times_ns: (N,) times of the estimates.
        max_diff_s: Largest time difference between an estimate and its truth.

    Returns:
        (N,4,4) nearest true poses, and a mask (N,) of those that are near enough.
    """
    if len(truth.times_ns) == 0:
        return np.tile(np.eye(4), (len(times_ns), 1, 1)), np.zeros(len(times_ns), dtype=bool)
    after = np.minimum(np.searchsorted(truth.times_ns, times_ns), len(truth.times_ns) - 1)
    before = np.maximum(after - 1, 0)
    closer = np.abs(times_ns - truth.times_ns[before]) <= np.abs(truth.times_ns[after] - times_ns)
    index = np.where(closer, before, after)
    found = np.abs(truth.times_ns[index] - times_ns) <= round(max_diff_s * 1e9)
    return truth.world_from_cam[index], found
