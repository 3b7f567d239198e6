"""Remove grossly wrong poses from the path of a camera."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, runs
from bodycap_batch.merging.cameras.track import CameraTrack

OUTLIER_HALF_WINDOW = 6
"""Each frame is compared with this number of frames before it, and with this number of frames after it. The
value is 0.2 s at 30 fps. Over this time, a quadratic function of time follows a swinging hand to a few
centimetres. Evidence: none."""


OUTLIER_LIMIT_M = 0.12
"""Maximum distance (metres) of a pose from the quadratic through the neighbouring frames. A swinging hand
deviates from the quadratic by a fraction of this distance. A pose at a larger distance is wrong. Evidence:
none."""

_JUMP_RATIO = 2.0
"""Ratio of a third difference of the path to the displacement of the frames that cause it. Origin: the third
differences of a step are 1, -2 and 1 times its height. Evidence: docs/decisions/merging.md."""
_DIFFERENCE_FRAMES = 4
"""Number of successive frames that a third difference compares."""
NEXT_FRAME = 1.5
"""Maximum step between successive frames without a lost frame between them, in frame intervals. Derivation:
the middle between one and two intervals."""
_END_FRAMES = 2
"""Number of frames at each end of a run that have too few neighbours on one side for a quadratic."""
_LINE_FRAMES = 3
"""Number of frames that predict the next frame with constant velocity. Evidence:
docs/decisions/merging.md."""
_END_QUANTILE, _END_RATIO = 0.95, 3.0
"""A frame at an end is wrong if its distance from the prediction exceeds this quantile of the distances
inside the run by this ratio. Evidence: docs/decisions/merging.md."""
_MIN_INNER = 10
"""Minimum number of frames inside a run that show how far frames are from their predictions. Evidence: none.
"""


def remove_outliers(track: CameraTrack, scale: float, fps: float) -> CameraTrack:
    """Remove frames whose centre jumps away from the path through the neighbouring frames.

    Args:
        track: The measured path.
        scale: Metres per map unit; a provisional value is accurate enough.
        fps: Nominal frame rate of the camera.
    """
    # Wrong frames at an end bend the quadratics of their neighbours, and wrong frames elsewhere raise the
    # limit for the ends. So the ends are tested twice.
    track = _without_wrong_ends(track, scale, fps)
    track = track.keep(~_wrong_inside(track, scale, fps))
    return _without_wrong_ends(track, scale, fps)


def _wrong_inside(track: CameraTrack, scale: float, fps: float) -> BoolArray:
    """Return a mask (N,) of the wrong frames that have neighbours on both sides."""
    count = len(track.times_ns)
    steps = np.array([step for step in range(-OUTLIER_HALF_WINDOW, OUTLIER_HALF_WINDOW + 1) if step])
    index = np.arange(count)[:, None] + steps
    valid = (index >= 0) & (index < count)
    index = np.clip(index, 0, count - 1)
    time = (track.times_ns[index] - track.times_ns[:, None]) * (1e-9 * fps)
    valid &= np.abs(time) <= OUTLIER_HALF_WINDOW + 0.5
    centre = scale * (track.map_from_cam[index, :3, 3] - track.map_from_cam[:, None, :3, 3])
    predicted = _robust_quadratic(time / OUTLIER_HALF_WINDOW, centre, valid)
    # For a frame with fewer than two neighbours on one side, the quadratic extrapolates, and a change of
    # direction looks like an error.
    inner = ((time < 0) & valid).sum(axis=1).clip(max=2) + ((time > 0) & valid).sum(axis=1).clip(max=2) == 4
    bad = (np.linalg.norm(predicted, axis=1) > OUTLIER_LIMIT_M) & inner & (valid.sum(axis=1) >= 6)
    frame_time = track.times_ns.astype(np.float64) * (1e-9 * fps)
    return _runs_with_jumps(bad, frame_time, scale * track.map_from_cam[:, :3, 3])


def _without_wrong_ends(track: CameraTrack, scale: float, fps: float) -> CameraTrack:
    time = track.times_ns.astype(np.float64) * (1e-9 * fps)
    return track.keep(~_wrong_ends(time, scale * track.map_from_cam[:, :3, 3]))


def _wrong_ends(time: FloatArray, centre_m: FloatArray) -> BoolArray:
    """Return a mask (N,) of the wrong frames among the first two and the last two frames of each run.

    These frames have too few neighbours on one side for a quadratic. The frames on the other side predict
    them: in a straight line, with constant velocity. A frame is wrong if it is much farther from the
    prediction than the frames inside the runs are from theirs, and so are the frames between it and the end.

    Args:
        time: (N,) times of the frames, in frame intervals.
        centre_m: (N,3) camera centres, metres.
    """
    out = np.zeros(len(time), dtype=bool)
    # Across a longer step, one or both frames on each side lack a second neighbour in the window.
    first = np.flatnonzero(np.diff(time, prepend=-np.inf) > OUTLIER_HALF_WINDOW - 0.5)
    for forward in (True, False):
        order = np.arange(len(time)) if forward else np.arange(len(time))[::-1]
        off_m = _distance_from_line(time[order], centre_m[order])[order]
        for start, stop in zip(first, [*first[1:], len(time)], strict=True):
            inner = off_m[start + _LINE_FRAMES + _END_FRAMES : stop - _LINE_FRAMES - _END_FRAMES]
            if len(inner) < _MIN_INNER:
                continue
            limit_m = max(OUTLIER_LIMIT_M, _END_RATIO * float(np.quantile(inner, _END_QUANTILE)))
            end = (
                np.arange(stop - _END_FRAMES, stop)
                if forward
                else np.arange(start, start + _END_FRAMES)[::-1]
            )
            wrong = np.flatnonzero(off_m[end] > limit_m)
            out[end[wrong[0] :] if len(wrong) else []] = True
    return out


def _distance_from_line(time: FloatArray, centre_m: FloatArray) -> FloatArray:
    """Return the distance (N,) of each centre from the straight line through the frames before it, metres."""
    out = np.zeros(len(time))
    index = np.arange(_LINE_FRAMES, len(time))
    before = index[:, None] - np.arange(1, _LINE_FRAMES + 1)
    past, places = time[before] - time[index, None], centre_m[before]
    middle = past.mean(axis=1, keepdims=True)
    spread = (past - middle) / np.maximum(((past - middle) ** 2).sum(axis=1, keepdims=True), 1e-12)
    velocity = np.einsum("nw,nwk->nk", spread, places)
    predicted = places.mean(axis=1) - middle * velocity
    # Across lost frames, a constant velocity predicts nothing: an acceleration looks like an error.
    is_near = np.abs(time[index] - time[index - _LINE_FRAMES]) < _LINE_FRAMES + 0.5
    out[index] = np.where(is_near, np.linalg.norm(predicted - centre_m[index], axis=1), 0.0)
    return out


def _runs_with_jumps(bad: BoolArray, time: FloatArray, centre_m: FloatArray) -> BoolArray:
    """Return a mask (N,) of the runs of bad frames in which the path jumps.

    The path of a very fast arm deviates from any quadratic, but its acceleration hardly changes from one
    frame to the next. A frame that is displaced changes a third difference by three times its displacement,
    and the first frame of a displaced block by twice the displacement. Across lost frames, the third
    derivative is compared in the same unit. A few frames between lost frames have no third difference of
    their own. For them, the path jumps if a second difference is larger than the limit.

    Args:
        bad: (N,) True for a bad frame.
        time: (N,) times of the frames, in frame intervals.
        centre_m: (N,3) camera centres, metres.
    """
    jump = np.zeros(len(bad), dtype=bool)
    divided = centre_m
    for order in (1, 2, 3):
        divided = order * np.diff(divided, axis=0) / (time[order:] - time[:-order])[:, None]
    steep = np.linalg.norm(divided, axis=1) > _JUMP_RATIO * OUTLIER_LIMIT_M
    jump[1:-2] |= steep
    jump[2:-1] |= steep
    block = np.cumsum(np.diff(time, prepend=time[:1]) > NEXT_FRAME)
    few = np.bincount(block, minlength=1)[block] < _DIFFERENCE_FRAMES
    bent = np.linalg.norm(np.diff(centre_m, n=2, axis=0), axis=1) > OUTLIER_LIMIT_M
    jump[1:-1] |= bent & few[1:-1]
    out = np.zeros(len(bad), dtype=bool)
    for start, stop in runs(bad):
        out[start:stop] = jump[max(start - 1, 0) : stop + 1].any()
    return out


def _robust_quadratic(time: FloatArray, centre: FloatArray, valid: BoolArray) -> FloatArray:
    """Fit quadratics with Cauchy weights, and return their values (N,3) at time 0.

    Args:
        time: (N,W) times of the W frames around each frame.
        centre: (N,W,3) camera centres at these times.
        valid: (N,W) True if the centre is used.
    """
    basis = np.stack([np.ones_like(time), time, time**2], axis=-1)
    weight = valid.astype(np.float64)
    for _ in range(8):
        weighted = basis * weight[..., None]
        normal = np.einsum("nwi,nwj->nij", weighted, basis) + 1e-9 * np.eye(3)
        coefficients = np.linalg.solve(normal, np.einsum("nwi,nwk->nik", weighted, centre))
        residual = np.linalg.norm(centre - basis @ coefficients, axis=-1)
        weight = valid / (1.0 + (residual / (0.25 * OUTLIER_LIMIT_M)) ** 2)
    return np.asarray(coefficients[:, 0])
