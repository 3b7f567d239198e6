"""SVG elements as text: escaped, with short numbers."""

from __future__ import annotations

import html
from collections.abc import Iterable

import numpy as np

from bodycap_batch.core.arrays import FloatArray


def number(value: float) -> str:
    """Return a coordinate with one decimal, which is as exact as a screen."""
    return f"{value:.1f}".removesuffix(".0")


def element(tag: str, content: str = "", /, **attributes: object) -> str:
    """Return an element.

    Underscores in attribute names become hyphens, and a trailing underscore is removed. An attribute with the
    value None is omitted.
    """
    pairs = [
        f' {name.rstrip("_").replace("_", "-")}="{html.escape(_attribute_text(value), quote=True)}"'
        for name, value in attributes.items()
        if value is not None
    ]
    return f"<{tag}{''.join(pairs)}>{content}</{tag}>" if content else f"<{tag}{''.join(pairs)}/>"


def text(x: float, y: float, words: str, **attributes: object) -> str:
    """Return a line of text."""
    return element("text", html.escape(words), x=x, y=y, **attributes)


def svg_image(width: float, height: float, content: str, title: str, **attributes: object) -> str:
    """Return a complete drawing with a title for screen readers."""
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


def path_through(points: Iterable[tuple[float, float]]) -> str:
    """Return path data of a line through points; the line is interrupted at a point that is not finite."""
    out, pen_up = [], True
    for x, y in points:
        if not (np.isfinite(x) and np.isfinite(y)):
            pen_up = True
            continue
        out.append(f"{'M' if pen_up else 'L'}{number(x)} {number(y)}")
        pen_up = False
    return "".join(out)


def bin_statistics(values: FloatArray, count: int) -> FloatArray:
    """Return minimum, median and maximum (count,3) of equal parts of values (N,), NaN for empty parts."""
    edges = np.linspace(0, len(values), count + 1).round().astype(int)
    statistics = np.full((count, 3), np.nan)
    for index in range(count):
        part = values[edges[index] : max(edges[index + 1], edges[index] + 1)]
        part = part[np.isfinite(part)]
        if len(part):
            statistics[index] = part.min(), np.median(part), part.max()
    return statistics


def _attribute_text(value: object) -> str:
    return number(float(value)) if isinstance(value, float | np.floating) else str(value)
