"""Draw the clocks of a capture: the correlation of each pair, and the offsets of the windows along time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bodycap_batch.report.figures.svg import element, number, path_through, svg_image, text

if TYPE_CHECKING:
    from bodycap_batch.clocks import ClockEstimates
    from bodycap_batch.clocks.pair_offsets import PairOffset
    from bodycap_batch.core.arrays import FloatArray

_WIDTH, _ROW, _TOP = 960.0, 150.0, 46.0
"""Width of the drawing, height of the row of a pair, and height of the heading, SVG units."""
_PANEL_HEIGHT = 84.0
"""Height of a panel, SVG units."""
_CURVE = (16.0, 400.0)
"""Left edge and width of the panel with the correlation, SVG units."""
_CHUNKS = (476.0, 468.0)
"""Left edge and width of the panel with the offsets of the windows, SVG units."""
_LEAST_RANGE_S = 0.004
"""Least range of the offsets in a panel, seconds. Origin: twice the usual way of sound."""
_AGREES, _DISAGREES, _LINE, _FRAME = "#0b6e4f", "#b3261e", "#5b6770", "#c9ced2"
"""Colours of windows on and off the line, of curves, and of frames."""


def draw_clocks(estimates: ClockEstimates) -> str:
    """Return an SVG drawing with a row for each pair of cameras.

    Args:
        estimates: The clocks, with the pairs.
    """
    height = _TOP + _ROW * max(1, len(estimates.pairs))
    parts = [
        element("rect", x=0, y=0, width=_WIDTH, height=height, fill="#ffffff"),
        text(_CURVE[0], 24.0, "Correlation around the offset (ms)", font_size=14, font_weight="bold"),
        text(_CHUNKS[0], 24.0, "Offset of each window along time", font_size=14, font_weight="bold"),
    ]
    if not estimates.pairs:
        parts.append(text(_CURVE[0], _TOP + 20.0, "No two cameras have sound.", font_size=13))
    for row, pair in enumerate(estimates.pairs):
        parts.append(_pair_row(pair, _TOP + row * _ROW))
    return svg_image(
        _WIDTH, height, "".join(parts), "Clocks of the cameras from their sound", font_family="sans-serif"
    )


def _pair_row(pair: PairOffset, top: float) -> str:
    """Return the row of one pair: its name and result, the curve and the windows."""
    if pair.accepted:
        result = f"{pair.offset_s:+.4f} s"
        if pair.drift_measured:
            result += f", {pair.drift_ppm:+.1f} ± {pair.drift_sigma_ppm:.1f} ppm"
    else:
        result = pair.reason
    name = text(_CURVE[0], top + 14.0, f"{pair.first} and {pair.second}: {result}", font_size=12)
    return name + _curve_panel(pair, top + 24.0) + _chunk_panel(pair, top + 24.0)


def _frame(left: float, top: float, width: float) -> str:
    return element(
        "rect", x=left, y=top, width=width, height=_PANEL_HEIGHT, fill="none", stroke=_FRAME, stroke_width=1
    )


def _curve_panel(pair: PairOffset, top: float) -> str:
    left, width = _CURVE
    out = _frame(left, top, width)
    if pair.curve is None or pair.curve_lags_s is None or not len(pair.curve):
        return out
    # Of neighbouring values, the largest is drawn, so that no peak is lost.
    step = max(1, len(pair.curve) // 480)
    count = len(pair.curve) // step
    values = pair.curve[: count * step].reshape(count, step).max(axis=1)
    x = left + width * (np.arange(count) + 0.5) / count
    y = top + _PANEL_HEIGHT * (1.0 - 0.95 * values / max(float(values.max()), 1e-12))
    reach_ms = 500.0 * float(np.ptp(pair.curve_lags_s))
    line = element(
        "path", d=path_through(zip(x.tolist(), y.tolist(), strict=True)), fill="none", stroke=_LINE
    )
    labels = "".join(
        text(at, top + _PANEL_HEIGHT + 14.0, label, font_size=11, text_anchor=anchor)
        for at, label, anchor in (
            (left, f"{-reach_ms:.0f}", "start"),
            (left + width / 2, "0", "middle"),
            (left + width, f"+{reach_ms:.0f}", "end"),
        )
    )
    return out + line + labels


def _chunk_panel(pair: PairOffset, top: float) -> str:
    left, width = _CHUNKS
    out = _frame(left, top, width)
    if not pair.chunks:
        return out
    times = np.array([chunk.time_s for chunk in pair.chunks])
    offsets = np.array([chunk.offset_s for chunk in pair.chunks])
    shown = offsets[[chunk.agrees for chunk in pair.chunks]] if pair.accepted else offsets
    middle = 0.5 * float(shown.max() + shown.min())
    reach = 0.6 * max(float(np.ptp(shown)), _LEAST_RANGE_S)
    begin, span = float(times.min()), max(float(np.ptp(times)), 1e-6)

    def place(time: FloatArray, offset: FloatArray) -> tuple[FloatArray, FloatArray]:
        x = left + 8.0 + (width - 16.0) * (time - begin) / span
        return x, top + _PANEL_HEIGHT * np.clip(0.5 - 0.5 * (offset - middle) / reach, 0.02, 0.98)

    x, y = place(times, offsets)
    for chunk, at_x, at_y in zip(pair.chunks, x.tolist(), y.tolist(), strict=True):
        colour = _AGREES if chunk.agrees else _DISAGREES
        out += element("circle", cx=at_x, cy=at_y, r=3, fill=colour)
    if pair.accepted:
        ends = np.array([begin, begin + span])
        x, y = place(ends, pair.offset_s + 1e-6 * pair.drift_ppm * (ends - pair.pivot_s))
        drawn = path_through(zip(x.tolist(), y.tolist(), strict=True))
        out += element("path", d=drawn, fill="none", stroke=_LINE, stroke_dasharray="4 3")
    low, high = 1e3 * (middle - reach), 1e3 * (middle + reach)
    return (
        out
        + text(left, top + _PANEL_HEIGHT + 14.0, f"{number(begin)} s", font_size=11)
        + text(
            left + width,
            top + _PANEL_HEIGHT + 14.0,
            f"{number(begin + span)} s",
            font_size=11,
            text_anchor="end",
        )
        + text(
            left + width / 2,
            top + _PANEL_HEIGHT + 14.0,
            f"{low:.1f} to {high:.1f} ms",
            font_size=11,
            text_anchor="middle",
        )
    )
