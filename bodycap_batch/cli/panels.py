"""Drawings of curves for the commands: panels below one another, with axes of their own, as SVG."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.report.figures.svg import element, path_through, svg_image, text

WIDTH, ROW, TOP = 960.0, 150.0, 46.0
"""Width of a drawing, height of a row of panels, and height of the heading, SVG units."""
_FRAME = "#c9ced2"
"""Colour of the frame of a panel."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """A rectangle with a horizontal and a vertical axis.

    Attributes:
        left: Left edge, SVG units.
        top: Top edge, SVG units.
        width: Width, SVG units.
        height: Height, SVG units.
        x_range: Values at the left and at the right edge.
        y_range: Values at the bottom and at the top edge.
    """

    left: float
    top: float
    width: float
    height: float
    x_range: tuple[float, float]
    y_range: tuple[float, float]

    def across(self, x: FloatArray | float) -> FloatArray:
        """Return the horizontal positions of values, SVG units."""
        return np.asarray(self.left + self.width * (x - self.x_range[0]) / np.ptp(self.x_range))

    def down(self, y: FloatArray | float) -> FloatArray:
        """Return the vertical positions of values, SVG units. Values beyond the axis are at its ends."""
        share = np.clip((y - self.y_range[0]) / np.ptp(self.y_range), 0.0, 1.0)
        return np.asarray(self.top + self.height * (1.0 - share))

    def frame(self) -> str:
        """Return the frame of the panel."""
        size = {"x": self.left, "y": self.top, "width": self.width, "height": self.height}
        return element("rect", **size, fill="none", stroke=_FRAME, stroke_width=1)

    def line(self, x: FloatArray, y: FloatArray, colour: str, **attributes: object) -> str:
        """Return a line through points."""
        points = zip(self.across(x).tolist(), self.down(y).tolist(), strict=True)
        return element("path", d=path_through(points), fill="none", stroke=colour, **attributes)

    def labels(self, start: str, middle: str, end: str) -> str:
        """Return the labels below the left edge, the middle and the right edge."""
        below = self.top + self.height + 14.0
        places = ((0.0, start, "start"), (0.5, middle, "middle"), (1.0, end, "end"))
        return "".join(
            text(self.left + share * self.width, below, words, font_size=11, text_anchor=anchor)
            for share, words, anchor in places
            if words
        )


def drawing(headings: Sequence[tuple[float, str]], rows: Sequence[str], nothing: str, title: str) -> str:
    """Return a drawing of rows of panels as a complete SVG image.

    Args:
        headings: Left edge and words of each heading.
        rows: Content of the rows. The first one starts at `TOP`, each other one `ROW` below the one before.
        nothing: Words that are shown if there is no row.
        title: Title for screen readers.
    """
    height = TOP + ROW * max(1, len(rows))
    parts = [element("rect", x=0, y=0, width=WIDTH, height=height, fill="#ffffff")]
    parts += [text(left, 24.0, words, font_size=14, font_weight="bold") for left, words in headings]
    parts += rows or [text(headings[0][0], TOP + 20.0, nothing, font_size=13)]
    return svg_image(WIDTH, height, "".join(parts), title, font_family="sans-serif")
