"""Draw the clocks of a capture: the correlation of each pair, and the offsets of the windows along time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bodycap_batch.cli.panels import ROW, TOP, Panel, drawing
from bodycap_batch.report.figures.svg import element, number, text

if TYPE_CHECKING:
    from bodycap_batch.clocks import ClockEstimates
    from bodycap_batch.clocks.pair_offsets import PairOffset

_PANEL_HEIGHT = 84.0
"""Height of a panel, SVG units."""
_CURVE, _CHUNKS = (16.0, 400.0), (476.0, 468.0)
"""Left edge and width of the panels with the correlation and with the offsets of the windows, SVG units."""
_LEAST_RANGE_S = 0.004
"""Least range of the offsets in a panel, seconds. Origin: twice the usual way of sound."""
_AGREES, _DISAGREES, _LINE = "#0b6e4f", "#b3261e", "#5b6770"
"""Colours of windows on and off the line, and of curves."""


def draw_clocks(estimates: ClockEstimates) -> str:
    """Return an SVG drawing with a row for each pair of cameras.

    Args:
        estimates: The clocks, with the pairs.
    """
    headings = (
        (_CURVE[0], "Correlation around the offset (ms)"),
        (_CHUNKS[0], "Offset of each window along time"),
    )
    rows = [_pair_row(pair, TOP + row * ROW) for row, pair in enumerate(estimates.pairs)]
    return drawing(headings, rows, "No two cameras have sound.", "Clocks of the cameras from their sound")


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


def _panel(
    place: tuple[float, float], top: float, x_range: tuple[float, float], y_range: tuple[float, float]
) -> Panel:
    left, width = place
    return Panel(left=left, top=top, width=width, height=_PANEL_HEIGHT, x_range=x_range, y_range=y_range)


def _curve_panel(pair: PairOffset, top: float) -> str:
    if pair.curve is None or pair.curve_lags_s is None or not len(pair.curve):
        return _panel(_CURVE, top, (0.0, 1.0), (0.0, 1.0)).frame()
    # Of neighbouring values, the largest is drawn, so that no peak is lost.
    step = max(1, len(pair.curve) // 480)
    count = len(pair.curve) // step
    values = pair.curve[: count * step].reshape(count, step).max(axis=1)
    panel = _panel(_CURVE, top, (-0.5, count - 0.5), (0.0, max(float(values.max()), 1e-12) / 0.95))
    reach_ms = 500.0 * float(np.ptp(pair.curve_lags_s))
    line = panel.line(np.arange(float(count)), values, _LINE)
    return panel.frame() + line + panel.labels(f"{-reach_ms:.0f}", "0", f"+{reach_ms:.0f}")


def _chunk_panel(pair: PairOffset, top: float) -> str:
    if not pair.chunks:
        return _panel(_CHUNKS, top, (0.0, 1.0), (0.0, 1.0)).frame()
    times = np.array([chunk.time_s for chunk in pair.chunks])
    offsets = np.array([chunk.offset_s for chunk in pair.chunks])
    shown = offsets[[chunk.agrees for chunk in pair.chunks]] if pair.accepted else offsets
    middle = 0.5 * float(shown.max() + shown.min())
    reach = 0.6 * max(float(np.ptp(shown)), _LEAST_RANGE_S)
    begin, span = float(times.min()), max(float(np.ptp(times)), 1e-6)
    beside = 0.02 * span
    panel = _panel(_CHUNKS, top, (begin - beside, begin + span + beside), (middle - reach, middle + reach))
    out = panel.frame()
    for chunk, x, y in zip(pair.chunks, panel.across(times), panel.down(offsets), strict=True):
        out += element("circle", cx=x, cy=y, r=3, fill=_AGREES if chunk.agrees else _DISAGREES)
    if pair.accepted:
        ends = np.array([begin, begin + span])
        offset_s = pair.offset_s + 1e-6 * pair.drift_ppm * (ends - pair.pivot_s)
        out += panel.line(ends, offset_s, _LINE, stroke_dasharray="4 3")
    low, high = 1e3 * (middle - reach), 1e3 * (middle + reach)
    return out + panel.labels(
        f"{number(begin)} s", f"{low:.1f} to {high:.1f} ms", f"{number(begin + span)} s"
    )
