"""Interpolate true poses at the times of estimated poses."""

from __future__ import annotations

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.formats.tum import TimedPoses
from bodycap_batch.model.geometry import poses_at

_SNAP_NS = 1_000_000
"""Maximum time difference (nanoseconds) at which a true pose is used without interpolation.

Derivation: timestamps in some files have only four decimals."""
_MAX_GAP_NS = 100_000_000
"""Maximum time (nanoseconds) between two true poses for an interpolation. Origin: three frames of a usual
video. The truth of `tum_fr1_xyz` has a gap of 0.11 s, which is left out."""


def interpolate_truth(truth: TimedPoses, times_ns: IntArray) -> tuple[FloatArray, BoolArray]:
    """Interpolate true poses at given times: rotations by slerp, positions linearly.

    Args:
        truth: True poses in time order.
        times_ns: (N,) times at which the truth is interpolated, nanoseconds.

    Returns:
        (N,4,4) true poses, identity matrices at times without truth; (N,) mask, True at times with truth.
    """
    return poses_at(truth.times_ns, truth.world_from_cam, times_ns, max_gap_ns=_MAX_GAP_NS, snap_ns=_SNAP_NS)
