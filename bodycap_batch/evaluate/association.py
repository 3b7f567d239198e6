"""Which truth belongs to which estimate: by time, interpolated or nearest."""

from __future__ import annotations

from typing import Literal

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.formats.tum import TimedPoses
from bodycap_batch.model.geometry import poses_at

Association = Literal["interpolate", "nearest"]

_SNAP_NS = 1_000_000
"""Timestamps are written with as few as four decimals: a pose this near needs no neighbour."""


def interpolate_truth(
    truth: TimedPoses, times_ns: IntArray, max_gap_s: float
) -> tuple[FloatArray, BoolArray]:
    """The truth at given times: slerp and linear between its two neighbours.

    Args:
        truth: Poses in time order.
        times_ns: (N,) when.
        max_gap_s: Where the neighbours are further apart than this, there is no truth.

    Returns:
        (N,4,4) poses (identity where there is none) and (N,) which there are.
    """
    return poses_at(
        truth.times_ns,
        truth.world_from_cam,
        times_ns,
        max_gap_ns=round(max_gap_s * 1e9),
        snap_ns=_SNAP_NS,
    )


def nearest_truth(truth: TimedPoses, times_ns: IntArray, max_diff_s: float) -> tuple[FloatArray, BoolArray]:
    """The truth nearest to given times, as benchmark tools associate.

    Args:
        truth: Poses in time order.
        times_ns: (N,) when.
        max_diff_s: Largest time difference of a pair.

    Returns:
        (N,4,4) poses and (N,) which are near enough.
    """
    if len(truth.times_ns) == 0:
        return np.tile(np.eye(4), (len(times_ns), 1, 1)), np.zeros(len(times_ns), dtype=bool)
    after = np.minimum(np.searchsorted(truth.times_ns, times_ns), len(truth.times_ns) - 1)
    before = np.maximum(after - 1, 0)
    closer = np.abs(times_ns - truth.times_ns[before]) <= np.abs(truth.times_ns[after] - times_ns)
    index = np.where(closer, before, after)
    found = np.abs(truth.times_ns[index] - times_ns) <= round(max_diff_s * 1e9)
    return truth.world_from_cam[index], found
