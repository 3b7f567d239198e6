"""Draw the telemetry of a camera: the streams along time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bodycap_batch.cli.panels import ROW, TOP, Panel, drawing
from bodycap_batch.core.printable import printable
from bodycap_batch.report.figures.svg import bin_statistics, element, number, text
from bodycap_batch.telemetry.streams import ACCELEROMETER, EXPOSURE, GRAVITY, GYROSCOPE

if TYPE_CHECKING:
    from bodycap_batch.core.arrays import FloatArray
    from bodycap_batch.telemetry import CameraTelemetry, Stream

_PANEL = {"left": 70.0, "width": 870.0, "height": 100.0}
"""Left edge, width and height of a panel, SVG units."""
_BINS = 870
"""Number of parts of the time axis: one for each SVG unit."""
_DRAWN = {
    GYROSCOPE: "Angular rate (rad/s): x right, y down, z forward",
    ACCELEROMETER: "Specific force (m/s²): x right, y down, z forward",
    GRAVITY: "Upwards: x right, y down, z forward",
    EXPOSURE: "Exposure time (s)",
    "ISOE": "ISO",
    "ISOG": "Gain of the sensor",
}
"""Titles of the streams that are drawn, by key."""
_COLOURS = ("#b3261e", "#0b6e4f", "#1d4f91")
"""Colours of the axes x, y, z."""
_GAP = "#f3d9d7"
"""Colour of gaps."""


def draw_telemetry(found: CameraTelemetry) -> str:
    """Return an SVG drawing with a row for each stream.

    Args:
        found: The telemetry.
    """
    streams = [found.streams[key] for key in _DRAWN if key in found.streams]
    title = printable(f"Telemetry{f' of {found.model}' if found.model else ''}")
    begin = min((float(stream.times_s[0]) for stream in streams), default=0.0)
    end = max((float(stream.times_s[-1]) for stream in streams), default=0.0)
    span_s = begin, max(end, begin + 1e-6)
    rows = [_row(stream, TOP + row * ROW, span_s) for row, stream in enumerate(streams)]
    return drawing(((_PANEL["left"], title),), rows, "The video has no telemetry.", title)


def _row(stream: Stream, top: float, span_s: tuple[float, float]) -> str:
    """Return the row of a stream: its title, its axes, its gaps and a line for each value."""
    low, high = float(stream.values.min()), float(stream.values.max())
    # The lines keep a distance of a twenty-fifth from the frame. A constant stream is drawn as well.
    reach = max(high - low, 1e-3 * max(abs(low), abs(high)), 1e-9) / 0.92
    y_range = low - 0.04 * reach, low + 0.96 * reach
    panel = Panel(top=top + 16.0, x_range=span_s, y_range=y_range, **_PANEL)
    title = f"{_DRAWN[stream.key]}, {stream.rate_hz:.2f} per second"
    out = text(panel.left, top + 10.0, title, font_size=12)
    for gap_s in stream.gaps_s:
        start, stop = panel.across(np.array(gap_s)).tolist()
        width = max(1.0, stop - start)
        out += element("rect", x=start, y=panel.top, width=width, height=panel.height, fill=_GAP)
    out += panel.frame()
    for column, colour in zip(range(min(3, stream.values.shape[1])), _COLOURS, strict=False):
        out += panel.line(*_extremes(stream.times_s, stream.values[:, column]), colour, stroke_width=0.8)
    for y, value in ((panel.top + 10.0, high), (panel.top + panel.height, low)):
        out += text(panel.left - 4.0, y, f"{value:.3g}", font_size=11, text_anchor="end")
    return out + panel.labels(f"{number(span_s[0])} s", "", f"{number(span_s[1])} s")


def _extremes(times_s: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return times and values (M,) of a line through the least and the largest value of each part.

    Args:
        times_s: (N,) times, seconds.
        values: (N,) values.
    """
    if len(values) <= 2 * _BINS:
        return times_s, values
    edges = np.linspace(0, len(values) - 1, _BINS).round().astype(int)
    return np.repeat(times_s[edges], 2), bin_statistics(values, _BINS)[:, [0, 2]].ravel()
