"""Where the room and the videos stand in the picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from math import sqrt

WIDTH, HEIGHT = 1280, 720
ROOM_WIDTH = 660
_BAR = 22
"""Height of the line of text under a video."""
_GAP = 4
_FREELY = 10
"""Up to so many videos every way to cut them into rows is tried (2^9 of them)."""


@dataclass(frozen=True, slots=True)
class Box:
    """A rectangle in the picture: left, top, width, height."""

    x: int
    y: int
    width: int
    height: int


def place_videos(aspects: Sequence[float]) -> list[tuple[Box, Box]]:
    """A box for each video and one for the line of text under it, in rows that fill the space best.

    Args:
        aspects: Width over height of each video; the first gets a row of its own where that fits.
    """
    layouts = [_rows(aspects, ends) for ends in _partitions(len(aspects))]
    # Lengths, not areas, are summed: one large picture is not worth many that are too small to read.
    return max(layouts, key=lambda boxes: sum(sqrt(box.width * box.height) for box, _ in boxes), default=[])


def _partitions(count: int) -> list[tuple[int, ...]]:
    """Ends of the rows, for every way to cut so many videos into rows; of very many only even rows."""
    if count > _FREELY:
        return [tuple(sorted({*range(row, count, row), count})) for row in range(2, count + 1)]
    inner = range(1, count)
    ways = [(*cuts, count) for size in range(count) for cuts in combinations(inner, size)]
    # No row is shorter than the one above it: the first video is never smaller than another.
    return [ends for ends in ways if _lengths(ends) == sorted(_lengths(ends))]


def _lengths(ends: tuple[int, ...]) -> list[int]:
    return [end - start for start, end in zip((0, *ends[:-1]), ends, strict=True)]


def _rows(aspects: Sequence[float], ends: tuple[int, ...]) -> list[tuple[Box, Box]]:
    """Each row as wide as there is room; all rows narrower where they are too high together."""
    area = WIDTH - ROOM_WIDTH
    starts = (0, *ends[:-1])
    height = [
        (area - _GAP * (end - start + 1)) / sum(aspects[start:end])
        for start, end in zip(starts, ends, strict=True)
    ]
    free = HEIGHT - _GAP * (len(ends) + 1) - _BAR * len(ends)
    shrink = min(1.0, max(free, 1) / sum(height))
    left_over = max(0.0, free - shrink * sum(height)) / (len(ends) + 1)
    top = _GAP + left_over
    out = []
    for start, end, full in zip(starts, ends, height, strict=True):
        high = shrink * full
        width = high * sum(aspects[start:end]) + _GAP * (end - start + 1)
        left = ROOM_WIDTH + _GAP + 0.5 * (area - width)
        for aspect in aspects[start:end]:
            box = Box(round(left), round(top), max(2, int(high * aspect)), max(2, int(high)))
            out.append((box, Box(box.x, box.y + box.height, box.width, _BAR)))
            left += high * aspect + _GAP
        top += high + _BAR + _GAP + left_over
    return out
