"""Compute the positions of the room and the videos in the preview's image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from math import sqrt

WIDTH, HEIGHT = 1280, 720
"""Pixels: width and height of the preview (720p). Every player supports this size."""
ROOM_WIDTH = 660
"""Pixels: width of the room's view at the left of the image. It is about half of the image. Evidence:
none."""
_LABEL_HEIGHT = 22
"""Pixels: height of the line of text below a video."""
_MARGIN = 4
"""Pixels: space between two videos."""
_MAX_SEARCHED = 10
"""Maximum number of videos for which all partitions into rows are tried. Ten videos have 2^9 partitions."""


@dataclass(frozen=True, slots=True)
class Box:
    """A rectangle in the image, in pixels.

    Attributes:
        x: Left column.
        y: Top row.
        width: Width.
        height: Height.
    """

    x: int
    y: int
    width: int
    height: int


def lay_out_videos(aspects: Sequence[float]) -> list[tuple[Box, Box]]:
    """Arrange videos in rows next to the room, so that the videos are as large as possible.

    Args:
        aspects: Ratio of width to height of each video.

    Returns:
        For each video, a box for the video and a box for the line of text below it. No row has fewer
        videos than the row above it.
    """
    layouts = [_place_rows(aspects, ends) for ends in _partitions(len(aspects))]
    # The square roots of the areas are summed. If areas were summed, a large video could compensate for many
    # unreadably small videos.
    return max(layouts, key=lambda boxes: sum(sqrt(box.width * box.height) for box, _ in boxes), default=[])


def _partitions(count: int) -> list[tuple[int, ...]]:
    """Return partitions of the videos into rows.

    A partition lists, for each row, the number of videos up to the end of this row. For example, (2, 5) means
    two videos in the first row and three videos in the second row.

    No row has fewer videos than the row above it: the first videos are then the largest. For many videos,
    only partitions into rows of equal length are returned. Their first row may be shorter.
    """
    if count > _MAX_SEARCHED:
        return [tuple(range(count % row or row, count + 1, row)) for row in range(2, count + 1)]
    inner = range(1, count)
    partitions = [(*cuts, count) for size in range(count) for cuts in combinations(inner, size)]
    return [ends for ends in partitions if _row_lengths(ends) == sorted(_row_lengths(ends))]


def _row_lengths(ends: tuple[int, ...]) -> list[int]:
    return [end - start for start, end in zip((0, *ends[:-1]), ends, strict=True)]


def _place_rows(aspects: Sequence[float], ends: tuple[int, ...]) -> list[tuple[Box, Box]]:
    """Place rows that fill the width. If their total height is too large, all rows are shrunk.

    Args:
        aspects: Ratio of width to height of each video.
        ends: For each row, the number of videos up to the end of this row.

    Returns:
        For each video, a box for the video and a box for the line of text below it.
    """
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
