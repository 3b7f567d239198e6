"""How many landmarks each pair of cameras shares."""

from __future__ import annotations

import html

from bodycap_batch.core.percent import format_percent
from bodycap_batch.report.advice import shared_points
from bodycap_batch.report.figures.svg import element, picture, text
from bodycap_batch.report.inputs import ReportInputs

_CELL, _LEFT, _TOP = 74.0, 130.0, 26.0
_MOST = 24
"""More cameras than this make a square that nobody reads, and one that grows with their square."""


def shared(inputs: ReportInputs) -> str:
    """Cameras against cameras; the shade is the share of the row camera's own points."""
    names = inputs.cameras[:_MOST]
    if len(names) < 2 or not inputs.maps:
        return ""
    counts = shared_points(inputs.maps, names)
    parts = []
    for column, name in enumerate(names):
        x = _LEFT + (column + 0.5) * _CELL
        parts.append(text(x, 16.0, _brief(name), class_="label", text_anchor="middle"))
    for row, name in enumerate(names):
        y = _TOP + row * _CELL * 0.6
        parts.append(text(_LEFT - 8.0, y + 0.36 * _CELL, name, class_="label", text_anchor="end"))
        for column, other in enumerate(names):
            own = max(int(counts[row, row]), 1)
            share = counts[row, column] / own
            says = (
                f"{name} sees {counts[row, row]:,} points"
                if row == column
                else f"{name} and {other} share {counts[row, column]:,} points, "
                f"{format_percent(share)} of {name}'s"
            )
            x = _LEFT + column * _CELL
            parts.append(
                element(
                    "rect",
                    element("title", html.escape(says)),
                    class_="own" if row == column else "cell",
                    style=None if row == column else f"fill-opacity:{0.06 + 0.9 * min(share / 0.5, 1.0):.3f}",
                    x=x + 1.0,
                    y=y + 1.0,
                    width=_CELL - 2.0,
                    height=0.6 * _CELL - 2.0,
                )
            )
            words = f"{counts[row, column]:,}"
            middle = x + 0.5 * _CELL
            tone = "cellnumber strong" if row != column and share > 0.3 else "cellnumber"
            parts.append(text(middle, y + 0.3 * _CELL, words, class_=tone, text_anchor="middle"))
            if row != column:
                parts.append(
                    text(
                        middle,
                        y + 0.3 * _CELL + 13.0,
                        f"{format_percent(share)}",
                        class_=f"{tone} small",
                        text_anchor="middle",
                    )
                )
    size = len(names)
    first = f" (the first {_MOST} of {len(inputs.cameras)})" if len(inputs.cameras) > _MOST else ""
    title = f"Landmarks shared between cameras{first}"
    return picture(
        _LEFT + size * _CELL + 8.0, _TOP + size * 0.6 * _CELL + 6.0, "".join(parts), title, class_="shared"
    )


def _brief(name: str) -> str:
    return name if len(name) <= 11 else f"{name[:10]}…"
