"""Poses that their neighbours speak against, or that nothing confirms."""

from __future__ import annotations

import numpy as np

from bodycap_batch.arrays import BoolArray, FloatArray, IntArray

_SIGMAS = 8.0
_TIMES_USUAL = 10.0
"""A jump stands out of the bends of the path around it, whatever the scale and the speed."""
_ANSWERED = 0.5
"""How much of a frame's bend its two neighbours' bends undo: all of it at a jump, nothing at a jerk."""
_AROUND = 12
_LONE_RUN = 2
_LONE_GAP = 3


def pose_jumps(centres: FloatArray, sigma: FloatArray) -> BoolArray:
    """Frames whose centre leaves the line between its neighbours as nothing around it does.

    The bend of a frame is its offset from the middle of the frames before and after it. A jump bends itself
    by its full height and both neighbours by half of it, the other way; a body that stops dead or starts with
    a jerk bends one frame and its neighbours hardly.

    Args:
        centres: (N,3) camera centres; NaN where there is no pose.
        sigma: (N,) standard deviation of the centre beside its neighbours', same unit; NaN likewise.

    Returns:
        (N,) True where the pose is to be refused. Scaling the map changes nothing.
    """
    count = len(centres)
    offset = np.full((count, 3), np.nan)
    noise = np.full(count, np.nan)
    if count >= 3:
        offset[1:-1] = centres[1:-1] - 0.5 * (centres[:-2] + centres[2:])
        noise[1:-1] = np.sqrt(sigma[1:-1] ** 2 + 0.25 * (sigma[:-2] ** 2 + sigma[2:] ** 2))
    bend = np.linalg.norm(offset, axis=1)
    out = np.zeros(count, dtype=bool)
    for frame in np.flatnonzero(np.isfinite(bend) & (bend > _SIGMAS * noise)).tolist():
        three = bend[max(0, frame - 1) : frame + 2]
        # Without both neighbours' own bends the wrong one of the three could be blamed.
        if not np.isfinite(three).all() or bend[frame] < three.max():
            continue
        answer = -(offset[frame - 1] + offset[frame + 1]) @ offset[frame] / bend[frame] ** 2
        if answer < _ANSWERED:
            continue
        before = bend[max(0, frame - _AROUND) : frame - 1]
        near = np.concatenate([before, bend[frame + 2 : frame + _AROUND + 1]])
        if np.isfinite(near).sum() >= _AROUND // 2:
            out[frame] = bend[frame] > _TIMES_USUAL * np.nanmedian(near)
    return out


def lone_poses(localised: BoolArray, inliers: IntArray, enough: int) -> BoolArray:
    """Frames of which nothing but their own few inliers speaks: no neighbouring frame confirms them.

    Args:
        localised: (N,) frames with a pose.
        inliers: (N,) of each pose.
        enough: Inliers with which a pose stands by itself.

    Returns:
        (N,) True in runs of one or two poses amid at least three lost frames on either side.
    """
    out = np.zeros(len(localised), dtype=bool)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], localised, [False]]).astype(int)))
    for start, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        around = np.concatenate(
            [localised[max(0, start - _LONE_GAP) : start], localised[stop : stop + _LONE_GAP]]
        )
        if stop - start <= _LONE_RUN and not around.any():
            out[start:stop] = inliers[start:stop] < enough
    return out
