"""SVG by hand: a few elements, escaped, with short numbers."""

from __future__ import annotations

import html
from collections.abc import Iterable

import numpy as np

from bodycap_batch.core.arrays import FloatArray


def number(value: float) -> str:
    """A coordinate with no more digits than a screen shows."""
    return f"{value:.1f}".removesuffix(".0")


def element(tag: str, content: str = "", /, **attributes: object) -> str:
    """An element; underscores in attribute names become hyphens, None leaves one out."""
    pairs = [
        f' {name.rstrip("_").replace("_", "-")}="{html.escape(_text(value), quote=True)}"'
        for name, value in attributes.items()
        if value is not None
    ]
    return f"<{tag}{''.join(pairs)}>{content}</{tag}>" if content else f"<{tag}{''.join(pairs)}/>"


def text(x: float, y: float, words: str, **attributes: object) -> str:
    """A line of text."""
    return element("text", html.escape(words), x=x, y=y, **attributes)


def picture(width: float, height: float, content: str, title: str, **attributes: object) -> str:
    """A whole drawing with a name for those who cannot see it."""
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


def polyline(points: Iterable[tuple[float, float]]) -> str:
    """Path data through points; a point that is not finite breaks the line."""
    out, pen_up = [], True
    for x, y in points:
        if not (np.isfinite(x) and np.isfinite(y)):
            pen_up = True
            continue
        out.append(f"{'M' if pen_up else 'L'}{number(x)} {number(y)}")
        pen_up = False
    return "".join(out)


def bins(values: FloatArray, count: int) -> FloatArray:
    """(count, 3) least, median and largest value of `count` equal parts; NaN where a part has none."""
    edges = np.linspace(0, len(values), count + 1).round().astype(int)
    out = np.full((count, 3), np.nan)
    for index in range(count):
        part = values[edges[index] : max(edges[index + 1], edges[index] + 1)]
        part = part[np.isfinite(part)]
        if len(part):
            out[index] = part.min(), np.median(part), part.max()
    return out


def _text(value: object) -> str:
    return number(float(value)) if isinstance(value, float | np.floating) else str(value)
