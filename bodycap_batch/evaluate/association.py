"""Associate true poses with estimated poses by time: interpolate the truth or take the nearest true pose."""

from __future__ import annotations

from typing import Literal

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.formats.tum import TimedPoses
from bodycap_batch.model.geometry import poses_at

Association = Literal["interpolate", "nearest"]

_SNAP_NS = 1_000_000
"""Maximum time difference (nanoseconds) at which a true pose is used without interpolation.

Derivation: timestamps in some files have only four decimals."""


def interpolate_truth(
    truth: TimedPoses, times_ns: IntArray, max_gap_s: float
) -> tuple[FloatArray, BoolArray]:
    """Interpolate true poses at given times: rotations by slerp, positions linearly.

    Args:
        truth: True poses in time order.
        times_ns: (N,) times at which the truth is interpolated, nanoseconds.
        max_gap_s: Maximum time (seconds) between two true poses for an interpolation.

    Returns:
        (N,4,4) true poses, identity matrices at times without truth; (N,) mask, True at times with truth.
    """
    return poses_at(
        truth.times_ns,
        truth.world_from_cam,
        times_ns,
        max_gap_ns=round(max_gap_s * 1e9),
        snap_ns=_SNAP_NS,
    )


def nearest_truth(truth: TimedPoses, times_ns: IntArray, max_diff_s: float) -> tuple[FloatArray, BoolArray]:
    """Return the true pose that is nearest to each given time, as the TUM benchmark tools do.

    Args:
        truth: True poses in time order.
        times_ns: (N,) times of the estimates, nanoseconds.
        max_diff_s: Maximum time difference (seconds) between an estimate and its true pose.

    Returns:
        (N,4,4) nearest true poses; (N,) mask, True if the time difference is at most `max_diff_s`.
    """
    if len(truth.times_ns) == 0:
        return np.tile(np.eye(4), (len(times_ns), 1, 1)), np.zeros(len(times_ns), dtype=bool)
    after = np.minimum(np.searchsorted(truth.times_ns, times_ns), len(truth.times_ns) - 1)
    before = np.maximum(after - 1, 0)
    closer = np.abs(times_ns - truth.times_ns[before]) <= np.abs(truth.times_ns[after] - times_ns)
    index = np.where(closer, before, after)
    found = np.abs(truth.times_ns[index] - times_ns) <= round(max_diff_s * 1e9)
    return truth.world_from_cam[index], found
