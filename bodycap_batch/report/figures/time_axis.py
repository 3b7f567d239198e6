"""The time axis that the drawings of cameras and of the motion have in common, and what is drawn along it."""

from __future__ import annotations

import html

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.report.figures.svg import element, svg_image, text

WIDTH, LEFT, RIGHT = 960.0, 92.0, 12.0
"""Width of a drawing, and its left and right margins, SVG units."""
PLOT_WIDTH = WIDTH - LEFT - RIGHT
MAX_COLUMNS = 480
"""Maximum number of points on a curve. Neighbouring points are two pixels apart on a wide screen."""
_MIN_COLUMNS = 12
"""Minimum number of points on a curve, however small the detail of the page is. Evidence: none."""
_MIN_BAR_WIDTH = 0.8
"""Minimum width of a bar, SVG units. A single lost frame must remain visible."""
_TICK_INTERVALS_S = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 60, 120, 300, 600, 1800)
"""Possible intervals between the labels of the time axis, seconds."""
_MAX_TICKS = 12
"""Maximum number of intervals between the labels of the time axis. More labels would overlap."""

Span = tuple[float, float]
"""First and last common time of a time axis, seconds."""


def column_count(detail: float) -> int:
    """Return the number of points on a curve for a fraction of the full detail, 0 to 1."""
    return max(_MIN_COLUMNS, int(MAX_COLUMNS * detail))


def x_from_time(time_s: float | FloatArray, span_s: Span) -> FloatArray:
    """Return the horizontal positions (SVG units) of common times (seconds)."""
    share = (np.asarray(time_s) - span_s[0]) / max(span_s[1] - span_s[0], 1e-9)
    return np.asarray(LEFT + share * PLOT_WIDTH)


def draw_plate(top: float, height: float) -> str:
    """Draw the background of a row."""
    return element("rect", class_="plate", x=LEFT, y=top, width=PLOT_WIDTH, height=height)


def draw_bar(kind: str, times_s: Span, span_s: Span, top: float, height: float, title: str = "") -> str:
    """Draw an interval of time as a bar of the class `kind`."""
    left, right = x_from_time(np.array(times_s), span_s).tolist()
    content = element("title", html.escape(title)) if title else ""
    width = max(right - left, _MIN_BAR_WIDTH)
    return element("rect", content, class_=kind, x=left, y=top, width=width, height=height)


def draw_strip(parts: list[str], span_s: Span, top: float, title: str, kind: str = "strip") -> str:
    """Return an image of rows above a time axis at the height `top`, with a mark of the shown time."""
    content = "".join((*parts, _draw_labels(span_s, top), draw_now(LEFT, 2.0, top)))
    return svg_image(WIDTH, top + 18.0, content, title, class_=kind, **axis_data(LEFT, span_s))


def draw_now(x: float, top: float, bottom: float) -> str:
    """Draw the mark of the shown time, which a script of the page moves."""
    return element("line", class_="now", x1=x, x2=x, y1=top, y2=bottom)


def axis_data(left: float, span_s: Span) -> dict[str, object]:
    """Return the attributes that tell the scripts of the page where the time axis of a drawing is."""
    start, end = (f"{time:.6f}" for time in span_s)
    return {"data_left": left, "data_width": PLOT_WIDTH, "data_start": start, "data_end": end}


def _draw_labels(span_s: Span, top: float) -> str:
    length = max(span_s[1] - span_s[0], 1e-6)
    interval = next((each for each in _TICK_INTERVALS_S if length / each <= _MAX_TICKS), 3600)
    first, last = np.ceil(span_s[0] / interval), np.floor(span_s[1] / interval + 1e-9)
    return "".join(
        text(float(x_from_time(time, span_s)), top + 12.0, f"{time:g} s", class_="tick", text_anchor="middle")
        for time in np.arange(first, last + 1) * interval
    )
