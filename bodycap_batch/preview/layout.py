"""The positions of the room and the videos in the film's image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from math import sqrt

WIDTH, HEIGHT = 1280, 720
"""Size of the film, pixels: 720p, which every player supports."""
ROOM_WIDTH = 660
"""Width of the room's view at the left of the image, pixels: about half of it. Evidence: none."""
_LABEL_HEIGHT = 22
"""Height of the line of text below a video, pixels."""
_MARGIN = 4
"""Space between two videos, pixels."""
_MAX_SEARCHED = 10
"""Number of videos up to which all partitions into rows are tried (2^9 for ten videos)."""


@dataclass(frozen=True, slots=True)
class Box:
    """A rectangle in the image, pixels: left, top, width, height."""

    x: int
    y: int
    width: int
    height: int


def lay_out_videos(aspects: Sequence[float]) -> list[tuple[Box, Box]]:
    """Arrange videos in rows next to the room so that they are as large as possible.

    Args:
        aspects: Width over height of each video. The first video is never smaller than another.

    Returns:
        One box for each video and one for the line of text below it.
    """
    layouts = [_place_rows(aspects, ends) for ends in _partitions(len(aspects))]
    # Lengths are summed, not areas: one large video does not compensate for many that are too small to read.
    return max(layouts, key=lambda boxes: sum(sqrt(box.width * box.height) for box, _ in boxes), default=[])


def _partitions(count: int) -> list[tuple[int, ...]]:
    """Return the ends of the rows of each partition of the videos; for many videos, only even partitions."""
    if count > _MAX_SEARCHED:
        return [tuple(sorted({*range(row, count, row), count})) for row in range(2, count + 1)]
    inner = range(1, count)
    partitions = [(*cuts, count) for size in range(count) for cuts in combinations(inner, size)]
    # No row has fewer videos than the row above it, so the first video is never smaller than another.
    return [ends for ends in partitions if _row_lengths(ends) == sorted(_row_lengths(ends))]


def _row_lengths(ends: tuple[int, ...]) -> list[int]:
    return [end - start for start, end in zip((0, *ends[:-1]), ends, strict=True)]


def _place_rows(aspects: Sequence[float], ends: tuple[int, ...]) -> list[tuple[Box, Box]]:
    """Place rows that fill the width; if their total height is too large, shrink all of them."""
    area_width = WIDTH - ROOM_WIDTH
    starts = (0, *ends[:-1])
    full_heights = [
        (area_width - _MARGIN * (end - start + 1)) / sum(aspects[start:end])
        for start, end in zip(starts, ends, strict=True)
    ]
    free = HEIGHT - _MARGIN * (len(ends) + 1) - _LABEL_HEIGHT * len(ends)
    shrink = min(1.0, max(free, 1) / sum(full_heights))
    left_over = max(0.0, free - shrink * sum(full_heights)) / (len(ends) + 1)
    top = _MARGIN + left_over
    boxes = []
    for start, end, full_height in zip(starts, ends, full_heights, strict=True):
        height = shrink * full_height
        width = height * sum(aspects[start:end]) + _MARGIN * (end - start + 1)
        left = ROOM_WIDTH + _MARGIN + 0.5 * (area_width - width)
        for aspect in aspects[start:end]:
            box = Box(round(left), round(top), max(2, int(height * aspect)), max(2, int(height)))
            boxes.append((box, Box(box.x, box.y + box.height, box.width, _LABEL_HEIGHT)))
            left += height * aspect + _MARGIN
        top += height + _LABEL_HEIGHT + _MARGIN + left_over
    return boxes
