"""Do the cameras share one clock? Limbs that move about the trunk too early or too late."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.cameras.track import MAX_SAMPLE_GAP_NS, CameraTrack, pick_evenly
from bodycap_batch.model.geometry import invert

_SEARCH_STEP_S = 0.05
_MAX_SHIFT_S = 3.0
_MIN_OVERLAP_RATIO = 3.0
"""Shifts are looked for up to a third of the time that both cameras share."""
_MAX_SAMPLES = 200
_MIN_SAMPLES = 30
_MIN_SHIFT_S = 0.25
_MAX_SCATTER_RATIO = 0.7
"""A clock is doubted where a shift of so much leaves at most that share of the scatter. Over 26 pairs of 12
captures (walks, arms thrown about, kitchen work, turning on the spot, bending and lifting) none is with
right clocks (shifts up to 0.25 s gained most, 0.71 of the scatter at the best), 22 with clocks half a second
off and 23 with a second. Nine of ten shifts are told within 0.2 s; one in a clip of 5 s was 0.4 s off, one
2.3. With the cameras' turns weighed beside their places there was no false alarm either, 19 and 21 were
found, all within 0.3 s, but that clip's lag and one of half a second went unseen."""


def suspicious_clocks(tracks: Sequence[CameraTrack]) -> dict[str, dict[str, float]]:
    """Cameras that sit more steadily on the body when their clock is shifted.

    Where a limb's camera is in the axes of the trunk's scatters by what the limb does; with a wrong clock by
    where the whole body went in the meantime as well. Straight walks tell nothing: they move it to one side,
    and there a swinging arm may happen to follow the trunk's turns; but then it lies farther off, as it
    hardly does with the right clock.

    Args:
        tracks: Paths in one map, the trunk's first.

    Returns:
        By camera ``shift_s``, to be added to its times, and ``scatter_left``, the share that is left then.
    """
    out = {}
    for limb in tracks[1:]:
        found = best_time_shift(tracks[0], limb)
        if found is None or abs(found[0]) < _MIN_SHIFT_S or found[1] > _MAX_SCATTER_RATIO:
            continue
        if _median_distance(tracks[0], limb, found[0]) < _median_distance(tracks[0], limb, 0.0):
            out[limb.camera] = {"shift_s": round(found[0], 2), "scatter_left": round(found[1], 3)}
    return out


def best_time_shift(trunk: CameraTrack, limb: CameraTrack) -> tuple[float, float] | None:
    """Seconds that bring a limb's path nearest to the trunk's, and the share of the scatter that leaves.

    None where the two were measured together for too short a time.
    """
    start, end = (pick(trunk.times_ns[at], limb.times_ns[at]) for pick, at in ((max, 0), (min, -1)))
    reach_s = min(_MAX_SHIFT_S, 1e-9 * float(end - start) / _MIN_OVERLAP_RATIO)
    if reach_s < _MIN_SHIFT_S:
        return None
    shifts_s = _SEARCH_STEP_S * np.arange(-int(reach_s / _SEARCH_STEP_S), int(reach_s / _SEARCH_STEP_S) + 1)
    margin_ns = round(1e9 * reach_s)
    inside = np.flatnonzero((limb.times_ns >= start + margin_ns) & (limb.times_ns <= end - margin_ns))
    if len(inside) < _MIN_SAMPLES:
        return None
    limb = limb.keep(np.isin(np.arange(len(limb.times_ns)), pick_evenly(inside, _MAX_SAMPLES)))
    scatter = np.array([_position_scatter(trunk, limb, float(shift_s)) for shift_s in shifts_s])
    best, now = int(np.argmin(scatter)), scatter[len(scatter) // 2]
    if not (np.isfinite(now) and now > 0.0):
        return None
    return float(shifts_s[best]), float(scatter[best] / now)


def _position_scatter(trunk: CameraTrack, limb: CameraTrack, shift_s: float) -> float:
    """Root mean square distance of a limb's camera from its usual place in the trunk camera's axes."""
    seen = _positions_in_trunk(trunk, limb, shift_s)
    if len(seen) < _MIN_SAMPLES:
        return np.inf
    return float(np.sqrt(((seen - np.median(seen, axis=0)) ** 2).sum(axis=1).mean()))


def _median_distance(trunk: CameraTrack, limb: CameraTrack, shift_s: float) -> float:
    """Median distance of a limb's camera from the trunk's.

    The right clock brought 47 of 49 nearer (by 8 to 62 %) for which it was found, in six captures, and took
    two 1 and 3 % farther. A right clock that was doubted: 6 % farther.
    """
    return float(np.median(np.linalg.norm(_positions_in_trunk(trunk, limb, shift_s), axis=1)))


def _positions_in_trunk(trunk: CameraTrack, limb: CameraTrack, shift_s: float) -> FloatArray:
    """(N,3) where a limb's camera is in the trunk camera's axes, its times shifted."""
    poses, known = trunk.poses_at(limb.times_ns + round(1e9 * shift_s), max_gap_ns=MAX_SAMPLE_GAP_NS)
    return np.asarray((invert(poses[known]) @ limb.map_from_cam[known])[:, :3, 3])
