"""Draw the number of landmarks that each pair of cameras shares, as a matrix."""

from __future__ import annotations

import html

from bodycap_batch.core.percent import format_percent
from bodycap_batch.report.advice import count_shared_points
from bodycap_batch.report.figures.svg import element, svg_image, text
from bodycap_batch.report.report_inputs import ReportInputs

_CELL, _LEFT, _TOP = 74.0, 130.0, 26.0
"""Width of a cell, width of the left margin, and height of the top margin, SVG units.

The margins contain the names of the cameras.
"""
_ASPECT = 0.6
"""Ratio of a cell's height to its width."""
_MAX_CAMERAS = 24
"""Maximum number of cameras in the drawing.

With more cameras the drawing would be unreadable. Its size grows with the square of the number of cameras.
"""
_FULL_SHADE_SHARE, _STRONG_TEXT_SHARE = 0.5, 0.3
"""Minimum fraction of common points for a cell with the darkest shade, and for a cell with light text."""


def draw_shared_landmarks(inputs: ReportInputs) -> str:
    """Draw a matrix with one row and one column for each camera.

    Each cell belongs to two cameras: the camera of the row and the camera of the column. The shade of the
    cell shows the fraction of the row camera's points that the column camera also sees.

    Returns:
        The drawing as SVG; "" if there are fewer than two cameras or no maps.
    """
    names = inputs.cameras[:_MAX_CAMERAS]
    if len(names) < 2 or not inputs.maps:
        return ""
    counts = count_shared_points(inputs.maps, names)
    parts = []
    for column, name in enumerate(names):
        x = _LEFT + (column + 0.5) * _CELL
        parts.append(text(x, 16.0, _short_name(name), class_="label", text_anchor="middle"))
    for row, name in enumerate(names):
        y = _TOP + row * _CELL * _ASPECT
        parts.append(text(_LEFT - 8.0, y + 0.36 * _CELL, name, class_="label", text_anchor="end"))
        own = int(counts[row, row])
        for column, other in enumerate(names):
            common, x = int(counts[row, column]), _LEFT + column * _CELL
            parts.append(_draw_cell(x, y, name, other, own, common))
    size = len(names)
    omission = (
        f" (the first {_MAX_CAMERAS} of {len(inputs.cameras)})" if len(inputs.cameras) > _MAX_CAMERAS else ""
    )
    return svg_image(
        _LEFT + size * _CELL + 8.0,
        _TOP + size * _ASPECT * _CELL + 6.0,
        "".join(parts),
        f"Landmarks shared between cameras{omission}",
        class_="shared",
    )


def _draw_cell(x: float, y: float, name: str, other: str, own: int, common: int) -> str:
    """Draw how many of the `own` points of a camera another camera, or the camera itself, sees."""
    share, style, kind = common / max(own, 1), None, "own"
    description, strong = f"{name} sees {own:,} points", ""
    numbers = [f"{common:,}"]
    if name != other:
        description = (
            f"{name} and {other} both see {common:,} points, which are {format_percent(share)} of the points "
            f"of {name}"
        )
        kind, style = "cell", f"fill-opacity:{0.06 + 0.9 * min(share / _FULL_SHADE_SHARE, 1.0):.3f}"
        strong = " strong" if share > _STRONG_TEXT_SHARE else ""
        numbers.append(format_percent(share))
    place = {"x": x + 1.0, "y": y + 1.0, "width": _CELL - 2.0, "height": _ASPECT * _CELL - 2.0}
    rect = element("rect", element("title", html.escape(description)), class_=kind, style=style, **place)
    classes = (f"cellnumber{strong}", f"cellnumber{strong} small")
    return rect + "".join(
        text(
            x + 0.5 * _CELL, y + 0.3 * _CELL + 13.0 * line, words, class_=classes[line], text_anchor="middle"
        )
        for line, words in enumerate(numbers)
    )


def _short_name(name: str) -> str:
    return name if len(name) <= 11 else f"{name[:10]}…"
