"""Find what is fixed to the camera: the own hand on a wrist camera, the rim of a lens or a helmet, a text."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import BoolArray, IntArray
from bodycap_batch.core.percent import format_percent
from bodycap_batch.model.optical_flow import Pixels, pixel_scale
from bodycap_batch.model.point_tracks import PointTracks

_WINDOW_S = 1.0 / 3.0
"""Time, seconds, over which the motion of points is compared. Evidence: docs/decisions/tracks.md."""
_CELL_PX = 16.0
"""Side of a cell, px of an image with a long side of 640 px. Evidence: docs/decisions/tracks.md."""
_MOVING_PERCENTILE = 75.0
"""Percentile of the displacements that stands for the room: a quarter of the tracks at least is in the room.
Evidence: docs/decisions/tracks.md."""
_MIN_SHIFT_PX = 6.0
"""Minimum displacement of the room, px of an image with a long side of 640 px. Origin: ten times the error of
a track over this time, so that a fixed point and a point of the room differ."""
_FIXED_SHARE = 0.2
"""Maximum displacement of a fixed point, as a share of that of the room. Evidence:
docs/decisions/tracks.md."""
_MIN_COHERENCE = 0.7
"""Minimum length of the mean displacement of the moving points, divided by their mean length. It is near 1 if
the camera turns, and small if it moves forward or if things move by themselves."""
_MIN_SPREAD = 0.6
"""Minimum spread of the moving points in the picture, as a share of that of all points. Things that move in
front of a still camera cover a part of the picture. Evidence: docs/decisions/tracks.md."""
_DIRECTIONS = 4
"""Number of sectors of the direction of turn."""
_MIN_DIRECTIONS = 2
"""Minimum number of sectors in which a cell is fixed. In one direction, an edge stands still, too."""
_MIN_VOTES = 3
"""Minimum number of tracks of a cell in one sector."""
_MIN_CELLS = 3
"""Minimum number of connected cells. A single cell is a reflection, or a far thing in the direction of
travel."""
_MAX_MASKED = 0.75
"""Maximum share of the picture that may be fixed to the camera. If it is more, the camera stood still."""


def fixed_notes(camera: str, regions: BoolArray) -> list[str]:
    """Return a note for the user about the parts of a camera's picture that are left out."""
    if not regions.any():
        return []
    return [
        f"{camera}: {format_percent(float(regions.mean()))} of the picture is fixed to the camera (for "
        "example the own hand, or the rim of a lens) and is left out"
    ]


def find_fixed_regions(tracks: PointTracks, times_ns: IntArray) -> BoolArray:
    """Find the parts of the picture that are fixed to the camera.

    Such a part stays where it is in the picture while the camera turns in several directions. Each track that
    moves much less than the room, while the room moves evenly across the picture, is a vote for its cell.

    Args:
        tracks: Tracks of the camera.
        times_ns: (N,) times of the frames, nanoseconds.

    Returns:
        (R,C) mask of cells, True where the picture is fixed to the camera. The cells divide the picture
        evenly. It is all False if the camera does not turn.
    """
    import cv2

    cell_px = _CELL_PX * pixel_scale(tracks.width_px, tracks.height_px)
    rows, columns = round(tracks.height_px / cell_px), round(tracks.width_px / cell_px)
    shape = (max(1, rows), max(1, columns))
    votes, total = (np.zeros((_DIRECTIONS, *shape)) for _ in range(2))
    size = np.array([tracks.width_px, tracks.height_px])
    for one, other in _pairs(times_ns):
        _, start, end = tracks.between(one, other)
        turn = _turn(start, end, tracks)
        if turn is None:
            continue
        sector, is_fixed = turn
        cell = np.clip(
            (start / size * (shape[1], shape[0])).astype(np.int64), 0, (shape[1] - 1, shape[0] - 1)
        )
        np.add.at(total[sector], (cell[:, 1], cell[:, 0]), 1.0)
        np.add.at(votes[sector], (cell[:, 1], cell[:, 0]), is_fixed.astype(np.float64))
    in_sector = (total >= _MIN_VOTES) & (votes > 0.5 * total)
    fixed = (in_sector.sum(axis=0) >= _MIN_DIRECTIONS) & (votes.sum(axis=0) > 0.5 * total.sum(axis=0))
    # The points are about two cells apart, and those on a fixed thing stay where they are.
    between = np.ones((5, 5), np.uint8)
    closed = cv2.morphologyEx(np.pad(fixed.astype(np.uint8), 3), cv2.MORPH_CLOSE, between)[3:-3, 3:-3]
    count, label, statistics, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    large = [number for number in range(1, count) if statistics[number, cv2.CC_STAT_AREA] >= _MIN_CELLS]
    # Tracks leave the border of a fixed thing: its outline is between two cells.
    grown = cv2.dilate(np.isin(label, large).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return np.asarray(grown if grown.mean() <= _MAX_MASKED else np.zeros(shape, dtype=bool))


def _pairs(times_ns: IntArray) -> list[tuple[int, int]]:
    """Return pairs of frames that are `_WINDOW_S` apart; successive pairs overlap by three quarters."""
    ends = np.searchsorted(times_ns, times_ns + int(_WINDOW_S * 1e9))
    pairs = [(one, int(other)) for one, other in enumerate(ends) if one < other < len(times_ns)]
    step = 1 if not pairs else max(1, (pairs[0][1] - pairs[0][0]) // 4)
    return pairs[::step]


def _turn(start: Pixels, end: Pixels, tracks: PointTracks) -> tuple[int, BoolArray] | None:
    """Return the sector of the direction of turn and the fixed points (N,); None if the camera did not turn.

    Args:
        start: (N,2) positions in the first frame, px.
        end: (N,2) positions in the second frame, px.
        tracks: Tracks of the camera.
    """
    if len(start) < _DIRECTIONS * _MIN_VOTES:
        return None
    shift = end - start
    length = np.linalg.norm(shift, axis=1)
    room_px = float(np.percentile(length, _MOVING_PERCENTILE))
    if room_px < _MIN_SHIFT_PX * pixel_scale(tracks.width_px, tracks.height_px):
        return None
    moving = length > 0.5 * room_px
    mean = shift[moving].mean(axis=0)
    spread = start[moving].std(axis=0) / np.maximum(start.std(axis=0), 1e-9)
    if np.linalg.norm(mean) < _MIN_COHERENCE * length[moving].mean() or spread.min() < _MIN_SPREAD:
        return None
    angle = np.arctan2(mean[1], mean[0]) % np.pi
    return int(angle / np.pi * _DIRECTIONS) % _DIRECTIONS, np.asarray(length < _FIXED_SHARE * room_px)
