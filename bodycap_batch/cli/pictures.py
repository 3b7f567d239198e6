"""Drawings for the commands, as SVG: the clocks of a capture, and the telemetry of a camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.printable import printable
from bodycap_batch.report.figures.svg import bin_statistics, element, number, path_through, svg_image, text
from bodycap_batch.telemetry.streams import ACCELEROMETER, EXPOSURE, GRAVITY, GYROSCOPE

if TYPE_CHECKING:
    from bodycap_batch.clocks import ClockEstimates
    from bodycap_batch.clocks.pair_offsets import PairOffset
    from bodycap_batch.telemetry import CameraTelemetry, Stream


_WIDTH, _ROW, _TOP = 960.0, 150.0, 46.0
"""Width of a drawing, height of a row of panels, and height of the heading, SVG units."""
_FRAME = "#c9ced2"
"""Colour of the frame of a panel."""


@dataclass(frozen=True, slots=True)
class _Panel:
    """A rectangle with a horizontal and a vertical axis.

    Attributes:
        place: Left edge, width and height, SVG units.
        top: Top edge, SVG units.
        x_range: Values at the left and at the right edge.
        y_range: Values at the bottom and at the top edge.
    """

    place: tuple[float, float, float]
    top: float
    x_range: tuple[float, float] = (0.0, 1.0)
    y_range: tuple[float, float] = (0.0, 1.0)

    def across(self, x: FloatArray | float) -> FloatArray:
        """Return the horizontal positions of values, SVG units."""
        left, width, _ = self.place
        return np.asarray(left + width * (x - self.x_range[0]) / np.ptp(self.x_range))

    def down(self, y: FloatArray | float) -> FloatArray:
        """Return the vertical positions of values, SVG units. Values beyond the axis are at its ends."""
        share = np.clip((y - self.y_range[0]) / np.ptp(self.y_range), 0.0, 1.0)
        return np.asarray(self.top + self.place[2] * (1.0 - share))

    def frame(self) -> str:
        """Return the frame of the panel."""
        left, width, height = self.place
        size = {"x": left, "y": self.top, "width": width, "height": height}
        return element("rect", **size, fill="none", stroke=_FRAME, stroke_width=1)

    def line(self, x: FloatArray, y: FloatArray, colour: str, **attributes: object) -> str:
        """Return a line through points."""
        points = zip(self.across(x).tolist(), self.down(y).tolist(), strict=True)
        return element("path", d=path_through(points), fill="none", stroke=colour, **attributes)

    def labels(self, start: str, middle: str, end: str) -> str:
        """Return the labels below the left edge, the middle and the right edge."""
        left, width, height = self.place
        places = ((0.0, start, "start"), (0.5, middle, "middle"), (1.0, end, "end"))
        return "".join(
            text(left + share * width, self.top + height + 14.0, words, font_size=11, text_anchor=anchor)
            for share, words, anchor in places
            if words
        )


def _drawing(headings: Sequence[tuple[float, str]], rows: Sequence[str], nothing: str, title: str) -> str:
    """Return a drawing of rows of panels as a complete SVG image.

    Args:
        headings: Left edge and words of each heading.
        rows: Content of the rows. The first one starts at `_TOP`, each other one `_ROW` below the one before.
        nothing: Words that are shown if there is no row.
        title: Title for screen readers.
    """
    height = _TOP + _ROW * max(1, len(rows))
    parts = [element("rect", x=0, y=0, width=_WIDTH, height=height, fill="#ffffff")]
    parts += [text(left, 24.0, words, font_size=14, font_weight="bold") for left, words in headings]
    parts += rows or [text(headings[0][0], _TOP + 20.0, nothing, font_size=13)]
    return svg_image(_WIDTH, height, "".join(parts), title, font_family="sans-serif")


_CURVE, _CHUNKS = (16.0, 400.0, 84.0), (476.0, 468.0, 84.0)
"""Places of the panels with the correlation and with the offsets of the windows, as in `_Panel`."""
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
    rows = [_pair_row(pair, _TOP + row * _ROW) for row, pair in enumerate(estimates.pairs)]
    return _drawing(headings, rows, "No two cameras have sound.", "Clocks of the cameras from their sound")


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


def _curve_panel(pair: PairOffset, top: float) -> str:
    if pair.curve is None or pair.curve_lags_s is None or not len(pair.curve):
        return _Panel(_CURVE, top).frame()
    # Of neighbouring values, the largest is drawn, so that no peak is lost.
    step = max(1, len(pair.curve) // 480)
    count = len(pair.curve) // step
    values = pair.curve[: count * step].reshape(count, step).max(axis=1)
    panel = _Panel(_CURVE, top, (-0.5, count - 0.5), (0.0, max(float(values.max()), 1e-12) / 0.95))
    reach_ms = 500.0 * float(np.ptp(pair.curve_lags_s))
    line = panel.line(np.arange(float(count)), values, _LINE)
    return panel.frame() + line + panel.labels(f"{-reach_ms:.0f}", "0", f"+{reach_ms:.0f}")


def _chunk_panel(pair: PairOffset, top: float) -> str:
    if not pair.chunks:
        return _Panel(_CHUNKS, top).frame()
    times = np.array([chunk.time_s for chunk in pair.chunks])
    offsets = np.array([chunk.offset_s for chunk in pair.chunks])
    shown = offsets[[chunk.agrees for chunk in pair.chunks]] if pair.accepted else offsets
    middle = 0.5 * float(shown.max() + shown.min())
    reach = 0.6 * max(float(np.ptp(shown)), _LEAST_RANGE_S)
    begin, span = float(times.min()), max(float(np.ptp(times)), 1e-6)
    beside = 0.02 * span
    panel = _Panel(_CHUNKS, top, (begin - beside, begin + span + beside), (middle - reach, middle + reach))
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


_STREAM = (70.0, 870.0, 100.0)
"""Place of the panel of a stream, as in `_Panel`."""
_BINS = round(_STREAM[1])
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
    rows = [_row(stream, _TOP + row * _ROW, span_s) for row, stream in enumerate(streams)]
    return _drawing(((_STREAM[0], title),), rows, "The video has no telemetry.", title)


def _row(stream: Stream, top: float, span_s: tuple[float, float]) -> str:
    """Return the row of a stream: its title, its axes, its gaps and a line for each value."""
    low, high = float(stream.values.min()), float(stream.values.max())
    # The lines keep a distance of a twenty-fifth from the frame. A constant stream is drawn as well.
    reach = max(high - low, 1e-3 * max(abs(low), abs(high)), 1e-9) / 0.92
    y_range = low - 0.04 * reach, low + 0.96 * reach
    (left, _, height), panel = _STREAM, _Panel(_STREAM, top + 16.0, span_s, y_range)
    title = f"{_DRAWN[stream.key]}, {stream.rate_hz:.2f} per second"
    out = text(left, top + 10.0, title, font_size=12)
    for gap_s in stream.gaps_s:
        start, stop = panel.across(np.array(gap_s)).tolist()
        out += element("rect", x=start, y=panel.top, width=max(1.0, stop - start), height=height, fill=_GAP)
    out += panel.frame()
    for column, colour in zip(range(min(3, stream.values.shape[1])), _COLOURS, strict=False):
        out += panel.line(*_extremes(stream.times_s, stream.values[:, column]), colour, stroke_width=0.8)
    for y, value in ((panel.top + 10.0, high), (panel.top + height, low)):
        out += text(left - 4.0, y, f"{value:.3g}", font_size=11, text_anchor="end")
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
