"""Draw the telemetry of a camera: the streams along time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bodycap_batch.core.printable import printable
from bodycap_batch.report.figures.svg import bin_statistics, element, number, path_through, svg_image, text
from bodycap_batch.telemetry.streams import ACCELEROMETER, EXPOSURE, GRAVITY, GYROSCOPE

if TYPE_CHECKING:
    from bodycap_batch.core.arrays import FloatArray
    from bodycap_batch.telemetry import CameraTelemetry, Stream

_WIDTH, _ROW, _TOP = 960.0, 150.0, 46.0
"""Width of the drawing, height of the row of a stream, and height of the heading, SVG units."""
_PANEL = (70.0, 870.0, 100.0)
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
_FRAME, _GAP = "#c9ced2", "#f3d9d7"
"""Colours of frames and of gaps."""


def draw_telemetry(found: CameraTelemetry) -> str:
    """Return an SVG drawing with a row for each stream.

    Args:
        found: The telemetry.
    """
    streams = [found.streams[key] for key in _DRAWN if key in found.streams]
    height = _TOP + _ROW * max(1, len(streams))
    title = printable(f"Telemetry{f' of {found.model}' if found.model else ''}")
    parts = [
        element("rect", x=0, y=0, width=_WIDTH, height=height, fill="#ffffff"),
        text(_PANEL[0], 24.0, title, font_size=14, font_weight="bold"),
    ]
    if not streams:
        parts.append(text(_PANEL[0], _TOP + 20.0, "The video has no telemetry.", font_size=13))
    else:
        begin = min(float(stream.times_s[0]) for stream in streams)
        end = max(float(stream.times_s[-1]) for stream in streams)
        for row, stream in enumerate(streams):
            parts.append(_row(stream, _TOP + row * _ROW, (begin, max(end, begin + 1e-6))))
    return svg_image(_WIDTH, height, "".join(parts), title, font_family="sans-serif")


def _row(stream: Stream, top: float, span_s: tuple[float, float]) -> str:
    """Return the row of a stream: its title, its axes, its gaps and a line for each value."""
    left, width, height = _PANEL
    begin, end = span_s
    low, high = float(stream.values.min()), float(stream.values.max())
    reach = max(high - low, 1e-3 * max(abs(low), abs(high)), 1e-9)
    title = f"{_DRAWN[stream.key]}, {stream.rate_hz:.2f} per second"
    out = text(left, top + 10.0, title, font_size=12)
    panel = top + 16.0
    for start_s, end_s in stream.gaps_s:
        x = left + width * (start_s - begin) / (end - begin)
        shown = max(1.0, width * (end_s - start_s) / (end - begin))
        out += element("rect", x=x, y=panel, width=shown, height=height, fill=_GAP)
    out += element(
        "rect", x=left, y=panel, width=width, height=height, fill="none", stroke=_FRAME, stroke_width=1
    )
    for column, colour in zip(range(min(3, stream.values.shape[1])), _COLOURS, strict=False):
        along, values = _extremes(stream.times_s, stream.values[:, column], span_s)
        across, down = left + width * along, panel + height * (0.96 - 0.92 * (values - low) / reach)
        line = path_through(zip(across.tolist(), down.tolist(), strict=True))
        out += element("path", d=line, fill="none", stroke=colour, stroke_width=0.8)
    labels = (
        (left - 4.0, panel + 10.0, f"{high:.3g}", "end"),
        (left - 4.0, panel + height, f"{low:.3g}", "end"),
        (left, panel + height + 14.0, f"{number(begin)} s", "start"),
        (left + width, panel + height + 14.0, f"{number(end)} s", "end"),
    )
    return out + "".join(text(x, y, label, font_size=11, text_anchor=end_) for x, y, label, end_ in labels)


def _extremes(
    times_s: FloatArray, values: FloatArray, span_s: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    """Return the points of a line through the least and the largest value of each part of the time axis.

    Args:
        times_s: (N,) times, seconds.
        values: (N,) values.
        span_s: First and last time of the axis, seconds.

    Returns:
        The positions along the axis, from 0 to 1, and the values.
    """
    x = (times_s - span_s[0]) / (span_s[1] - span_s[0])
    if len(values) <= 2 * _BINS:
        return np.asarray(x), values
    statistics = bin_statistics(values, _BINS)
    edges = np.linspace(0, len(values) - 1, _BINS).round().astype(int)
    return np.repeat(x[edges], 2), statistics[:, [0, 2]].ravel()
