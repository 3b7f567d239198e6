"""Find what moves by itself: the hands of the wearer, what they carry, other people, doors.

The room covers most of the picture for most of the time. The motion of the camera between two frames is the
one with the support of most cells of the picture. A track that does not follow it moves by itself.
"""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import BoolArray, IntArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.optical_flow import Pixels, pixel_scale, unit_directions
from bodycap_batch.model.point_tracks import PointTracks
from bodycap_batch.tracks.relative_motion import Motion, RayMatches, measure_rotation, residuals

_SPANS_S = (0.2, 0.4)
"""Times, seconds, over which the motion of points is compared with that of the camera. Evidence:
docs/decisions/tracks.md."""
_EVERY_S = 0.1
"""Time, seconds, between two starts of such a comparison. Evidence: none."""
_ERROR_PX = 0.6
"""Standard deviation of a track over such a time, px of an image with a long side of 640 px. Origin: the
limit of the check of tracks, forward and back."""
_MIN_SUPPORT = 0.6
"""Share of the cells with a track that must support the motion of the camera. With less, for example with a
shadow that moves over a table, it is not known what is the room. Evidence: docs/decisions/tracks.md."""
_OFF_ERRORS = 4.0
"""Distance, in standard deviations, of a track from the motion of the camera with which it does not follow
it. Evidence: docs/decisions/tracks.md."""
_MIN_OFF = 2
"""Minimum number of times that a moving track is off the motion of the camera. Evidence: none."""
_MIN_OFF_SHARE = 0.25
"""The same as a share of all times: what is carried stands still before and after. Evidence:
docs/decisions/tracks.md."""
_MIN_AHEAD = 0.1
"""Minimum cosine of the angle between a line of sight and the optical axis."""
_SUPPORT_CELLS = (12, 9)
"""Number of columns and rows of the grid in which support is counted."""
_CELL_PX = 16.0
"""Side of a cell of the result, px of an image with a long side of 640 px: that of regions fixed to the
camera."""
_NEIGHBOURS = 3
"""Side, in cells, of the square in which moving and other tracks are counted: tracks are about two cells
apart. Evidence: none."""
_MIN_TRACKS = 2
"""Minimum number of moving tracks in this square. A single one may be a reflection. Evidence: none."""


def find_moving_tracks(tracks: PointTracks, lens: Camera, times_ns: IntArray) -> BoolArray:
    """Find the tracks that do not follow the motion of the camera for a part of their time.

    Args:
        tracks: Tracks of the camera.
        lens: Intrinsics of the camera.
        times_ns: (N,) times of the frames, nanoseconds.

    Returns:
        (T,) True for each track that moves by itself, by its number.
    """
    count = 1 + int(tracks.track.max(initial=-1))
    off, compared = np.zeros((2, count), dtype=np.int64)
    for one, other in _pairs(times_ns):
        numbers, start, end = tracks.between(one, other)
        matches, seen = ray_matches(start, end, lens)
        is_off = _off_camera_motion(matches)
        if is_off is not None:
            off[numbers[seen][is_off]] += 1
            compared[numbers[seen]] += 1
    return np.asarray((off >= _MIN_OFF) & (off > _MIN_OFF_SHARE * compared))


def camera_motion(matches: RayMatches) -> Motion | None:
    """Return the motion of the camera; None if matches of less than `_MIN_SUPPORT` of the cells follow it."""
    motion = measure_rotation(matches)
    is_known = motion is not None and motion.support >= _MIN_SUPPORT * len(np.unique(matches.cells))
    return motion if is_known else None


def _off_camera_motion(matches: RayMatches) -> BoolArray | None:
    """Return which matches (M,) do not follow the motion of the camera; None if that motion is not known."""
    motion = camera_motion(matches)
    if motion is None:
        return None
    residual, in_front = residuals(matches, motion)
    return np.asarray((np.abs(residual) > _OFF_ERRORS) | ~in_front)


def find_moving_regions(tracks: PointTracks, moving: BoolArray) -> BoolArray:
    """Return the regions of each picture in which most tracks move by themselves.

    Args:
        tracks: Tracks of the camera.
        moving: (T,) True for each track that moves by itself.

    Returns:
        (N,R,C) mask of cells that divide the picture evenly.
    """
    import cv2

    cell_px = _CELL_PX * pixel_scale(tracks.width_px, tracks.height_px)
    rows, columns = max(1, round(tracks.height_px / cell_px)), max(1, round(tracks.width_px / cell_px))
    frame = np.repeat(np.arange(tracks.frame_count), np.diff(tracks.first))
    size = np.array([tracks.width_px, tracks.height_px])
    cell = np.clip((tracks.px / size * (columns, rows)).astype(np.int64), 0, (columns - 1, rows - 1))
    votes = np.zeros((2, tracks.frame_count, rows, columns), dtype=np.float32)
    np.add.at(votes, (moving[tracks.track].astype(np.int64), frame, cell[:, 1], cell[:, 0]), 1.0)
    square = (_NEIGHBOURS, _NEIGHBOURS)
    out = np.zeros((tracks.frame_count, rows, columns), dtype=bool)
    for number, (others, own) in enumerate(zip(*votes, strict=True)):
        near, near_others = (
            cv2.boxFilter(each, -1, square, normalize=False, borderType=cv2.BORDER_CONSTANT)
            for each in (own, others)
        )
        out[number] = (near >= _MIN_TRACKS) & (near > near_others)
    return out


def _pairs(times_ns: IntArray) -> list[tuple[int, int]]:
    """Return the pairs of frames that are compared."""
    starts = np.unique(np.searchsorted(times_ns, np.arange(times_ns[0], times_ns[-1], int(_EVERY_S * 1e9))))
    out = []
    for span in _SPANS_S:
        ends = np.searchsorted(times_ns, times_ns[starts] + int(span * 1e9))
        inside = ends < len(times_ns)
        out += list(zip(starts[inside].tolist(), ends[inside].tolist(), strict=True))
    return out


def ray_matches(start: Pixels, end: Pixels, lens: Camera) -> tuple[RayMatches, BoolArray]:
    """Return the lines of sight of points (K,2) in two frames, and which points have them (K,)."""
    first, second = (unit_directions(lens.unproject(px.astype(np.float64))) for px in (start, end))
    seen = np.isfinite(first).all(axis=1) & np.isfinite(second).all(axis=1)
    seen &= (first[:, 2] > _MIN_AHEAD) & (second[:, 2] > _MIN_AHEAD)
    columns, rows = _SUPPORT_CELLS
    place = (start[seen] / (lens.width_px, lens.height_px) * (columns, rows)).astype(np.int64)
    noise_rad = _ERROR_PX * pixel_scale(lens.width_px, lens.height_px) / lens.focal_px
    matches = RayMatches(
        first=first[seen],
        second=second[seen],
        cells=place[:, 1] * columns + place[:, 0],
        noise_rad=np.full(int(seen.sum()), noise_rad),
    )
    return matches, np.asarray(seen)
