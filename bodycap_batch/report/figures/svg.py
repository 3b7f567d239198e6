"""Write SVG elements as text, escaped and with short numbers."""

from __future__ import annotations

import html
from collections.abc import Iterable

import numpy as np

from bodycap_batch.core.arrays import FloatArray


def number(value: float) -> str:
    """Return a coordinate as text with one decimal. More decimals would make no visible difference."""
    return f"{value:.1f}".removesuffix(".0")


def element(tag: str, content: str = "", /, **attributes: object) -> str:
    """Return an SVG element as text.

    In the names of attributes, a trailing underscore is removed and other underscores become hyphens. An
    attribute with the value None is omitted.

    Args:
        tag: Name of the element.
        content: Content of the element as SVG text, already escaped.
        **attributes: Value of each attribute, by attribute name.
    """
    pairs = [
        f' {name.rstrip("_").replace("_", "-")}="{html.escape(_attribute_text(value), quote=True)}"'
        for name, value in attributes.items()
        if value is not None
    ]
    return f"<{tag}{''.join(pairs)}>{content}</{tag}>" if content else f"<{tag}{''.join(pairs)}/>"


def text(x: float, y: float, words: str, **attributes: object) -> str:
    """Return an SVG element with one line of text at a position in SVG units."""
    return element("text", html.escape(words), x=x, y=y, **attributes)


def svg_image(width: float, height: float, content: str, title: str, **attributes: object) -> str:
    """Return a complete SVG drawing with a title for screen readers."""
    named = element("title", html.escape(title)) + content
    return element(
        "svg",
        named,
        viewBox=f"0 0 {number(width)} {number(height)}",
        role="img",
        aria_label=title,
        xmlns="http://www.w3.org/2000/svg",
        **attributes,
    )


def path_through(points: Iterable[Iterable[float]]) -> str:
    """Return SVG path data of a line through points. A point that is not finite interrupts the line."""
    out, pen_up = [], True
    for x, y in points:
        if not (np.isfinite(x) and np.isfinite(y)):
            pen_up = True
            continue
        out.append(f"{'M' if pen_up else 'L'}{number(x)} {number(y)}")
        pen_up = False
    return "".join(out)


def bin_statistics(values: FloatArray, count: int) -> FloatArray:
    """Split values into parts of equal length and summarise each part.

    Args:
        values: (N,) values.
        count: Number of parts.

    Returns:
        (count,3) minimum, median and maximum of the finite values of each part; NaN for a part
            without finite values.
    """
    edges = np.linspace(0, len(values), count + 1).round().astype(int)
    statistics = np.full((count, 3), np.nan)
    for index in range(count):
        part = values[edges[index] : max(edges[index + 1], edges[index] + 1)]
        part = np.sort(part[np.isfinite(part)])
        if len(part):
            # The median of sorted values. `np.median` takes ten times as long for short parts.
            middle = 0.5 * (part[(len(part) - 1) // 2] + part[len(part) // 2])
            statistics[index] = part[0], middle, part[-1]
    return statistics


def _attribute_text(value: object) -> str:
    return number(float(value)) if isinstance(value, float | np.floating) else str(value)
