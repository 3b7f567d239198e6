"""Check of the clock offsets: find limb cameras that move too early or too late relative to the trunk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.cameras.track import MAX_SAMPLE_GAP_NS, CameraTrack, pick_evenly
from bodycap_batch.model.geometry import invert

_SEARCH_STEP_S = 0.05
"""Difference (seconds) between successive shifts that are tried. The result is accurate to four times this
difference."""
_MAX_SHIFT_S = 3.0
"""Maximum shift (seconds) that is tried. Evidence: none."""
_MIN_OVERLAP_RATIO = 3.0
"""Minimum ratio of the time that both cameras share to the largest shift that is tried. If the cameras share
only a short time, large shifts are therefore not tried. Unit: 1. Evidence: none."""
_MAX_SAMPLES = 200
"""Maximum number of frames of the limb's camera that are compared. It bounds the time of the search."""
_MIN_SAMPLES = 30
"""Minimum number of frames for a reliable scatter: one second at 30 fps. The scatter is the RMS distance of
the limb's camera from its median position in the axes of the trunk's camera."""
_MIN_SHIFT_S = 0.25
"""Minimum shift (seconds) of a suspicious clock. Even with a correct clock, the best shift may be almost this
large. Evidence: docs/decisions/merging.md."""
_MAX_SCATTER_RATIO = 0.7
"""Maximum ratio of the scatter with the shift to the scatter without a shift, for a suspicious clock.
Evidence: docs/decisions/merging.md."""


@dataclass(frozen=True, slots=True)
class TimeShift:
    """The shift of a camera's clock that gives the smallest scatter.

    Attributes:
        shift_s: Shift (seconds) to be added to the camera's times.
        scatter_ratio: Ratio of the scatter with the shift to the scatter without a shift.
    """

    shift_s: float
    scatter_ratio: float


def suspicious_clocks(tracks: Sequence[CameraTrack]) -> dict[str, dict[str, float]]:
    """Find cameras that move more rigidly with the body if their clock is shifted.

    In the axes of the trunk's camera, the position of a limb's camera varies with the movement of the limb.
    If the clock is wrong by some time, this position also varies with the movement of the whole body during
    this time.

    In a straight walk, the clock's error moves the limb's camera by a constant vector, so the scatter does
    not reveal the error. With a wrong shift, a swinging arm may then accidentally follow the rotations of the
    trunk. A wrong shift increases the distance between the two cameras. The correct shift hardly increases
    this distance. A shift is therefore accepted only if it also decreases this distance.

    Args:
        tracks: Tracks in one map, the track of the trunk's camera first.

    Returns:
        By camera, ``shift_s`` to be added to its times (seconds), and ``scatter_left``, the ratio of the
        scatter with the shift to the scatter without the shift.
    """
    out = {}
    for limb in tracks[1:]:
        found = best_time_shift(tracks[0], limb)
        if found is None or abs(found.shift_s) < _MIN_SHIFT_S or found.scatter_ratio > _MAX_SCATTER_RATIO:
            continue
        if _median_distance(tracks[0], limb, found.shift_s) < _median_distance(tracks[0], limb, 0.0):
            out[limb.camera] = {
                "shift_s": round(found.shift_s, 2),
                "scatter_left": round(found.scatter_ratio, 3),
            }
    return out


def best_time_shift(trunk: CameraTrack, limb: CameraTrack) -> TimeShift | None:
    """Find the time shift of a limb's camera that minimises the scatter of its position in the trunk's axes.

    Returns:
        The shift; None if the time in which both cameras were localised is too short.
    """
    start, end = (pick(trunk.times_ns[at], limb.times_ns[at]) for pick, at in ((max, 0), (min, -1)))
    max_shift_s = min(_MAX_SHIFT_S, 1e-9 * float(end - start) / _MIN_OVERLAP_RATIO)
    if max_shift_s < _MIN_SHIFT_S:
        return None
    steps = int(max_shift_s / _SEARCH_STEP_S)
    shifts_s = _SEARCH_STEP_S * np.arange(-steps, steps + 1)
    margin_ns = round(1e9 * max_shift_s)
    inside = np.flatnonzero((limb.times_ns >= start + margin_ns) & (limb.times_ns <= end - margin_ns))
    if len(inside) < _MIN_SAMPLES:
        return None
    limb = limb.keep(np.isin(np.arange(len(limb.times_ns)), pick_evenly(inside, _MAX_SAMPLES)))
    scatter = np.array([_position_scatter(trunk, limb, float(shift_s)) for shift_s in shifts_s])
    best, unshifted = int(np.argmin(scatter)), scatter[len(scatter) // 2]
    if not (np.isfinite(unshifted) and unshifted > 0.0):
        return None
    return TimeShift(float(shifts_s[best]), float(scatter[best] / unshifted))


def _position_scatter(trunk: CameraTrack, limb: CameraTrack, shift_s: float) -> float:
    """Return the RMS distance (map units) of a limb's camera from its median position in the trunk's axes."""
    positions = _positions_in_trunk(trunk, limb, shift_s)
    if len(positions) < _MIN_SAMPLES:
        return np.inf
    return float(np.sqrt(((positions - np.median(positions, axis=0)) ** 2).sum(axis=1).mean()))


def _median_distance(trunk: CameraTrack, limb: CameraTrack, shift_s: float) -> float:
    """Return the median distance (map units) of a limb's camera from the trunk's camera, for a clock shift.

    Evidence that the correct shift decreases this distance: docs/decisions/merging.md.
    """
    return float(np.median(np.linalg.norm(_positions_in_trunk(trunk, limb, shift_s), axis=1)))


def _positions_in_trunk(trunk: CameraTrack, limb: CameraTrack, shift_s: float) -> FloatArray:
    """Return positions (N,3) of a limb's camera at shifted times in the axes of the trunk's camera."""
    poses, valid = trunk.poses_at(limb.times_ns + round(1e9 * shift_s), max_gap_ns=MAX_SAMPLE_GAP_NS)
    return np.asarray((invert(poses[valid]) @ limb.map_from_cam[valid])[:, :3, 3])
