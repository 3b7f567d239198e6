"""Draw the body's motion over time: angles of joints, contacts of the feet, clearance of the floor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, runs
from bodycap_batch.model.joint_angles import FootCurve, angle_curves, foot_curves
from bodycap_batch.model.skeleton import Motion
from bodycap_batch.report.figures.svg import element, path_through, text
from bodycap_batch.report.figures.time_axis import (
    LEFT,
    RIGHT,
    WIDTH,
    Span,
    column_count,
    draw_bar,
    draw_plate,
    draw_strip,
    x_from_time,
)

_CURVE_HEIGHT, _BAR_HEIGHT, _MARGIN = 46.0, 13.0, 12.0
"""Height of a curve, of a bar and of the space between them, SVG units."""
_LEAST_RANGE_DEG = 20.0
"""Least range of the axis of an angle, degrees. A smaller range would show noise as motion."""
_CLEARANCE_RANGE_CM = (-5.0, 20.0)
"""Range of the axis of the floor clearance, centimetres. Derivation: toes rise by 5 to 15 cm in a walk."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Take:
    """A motion to draw.

    Attributes:
        name: Name of the motion in the legend.
        motion: The motion.
        start_s: Time of the first tick on the drawn axis, seconds.
    """

    name: str
    motion: Motion
    start_s: float

    def times_s(self) -> FloatArray:
        """Return the time (T,) of each tick on the drawn axis, seconds."""
        return np.asarray(self.start_s + np.arange(len(self.motion.root_in_world_m)) / self.motion.fps)

    def spans_of(self, mask: BoolArray) -> list[tuple[int, int, Span]]:
        """Return the first tick, the end and the times (seconds) of each run of ticks in a mask (T,)."""
        times = self.times_s().tolist()
        return [(start, end, (times[start], times[min(end, len(times) - 1)])) for start, end in runs(mask)]


@dataclass(frozen=True, slots=True)
class _Row:
    """One curve of one take: name, values, mask, range of the axis, unit."""

    name: str
    values: FloatArray
    measured: BoolArray
    low: float
    high: float
    unit: str


def draw_motion_curves(takes: Sequence[Take], span_s: Span, detail: float = 1.0) -> str:
    """Draw one take, or several takes over each other.

    Spans in which the cameras did not measure the joints of a curve are shaded, and the curve is dashed
    there; only the first take is shaded.

    Args:
        takes: The takes, one or two.
        span_s: First and last time of the axis, seconds.
        detail: Fraction of the points of each curve that are drawn, 0 to 1.

    Returns:
        The drawing as SVG; "" without a curve.
    """
    rows = [{row.name: row for row in _rows(take.motion)} for take in takes]
    if not rows or not rows[0]:
        return ""
    parts: list[str] = []
    top = 4.0
    for name in rows[0]:
        found = [(take, each[name]) for take, each in zip(takes, rows, strict=True) if name in each]
        parts.append(_draw_row(found, span_s, top, column_count(detail)))
        top += _CURVE_HEIGHT + _MARGIN
    for number, take in enumerate(takes):
        for foot in foot_curves(take.motion):
            label = f"{foot.name.split()[0]} stands" + (f", {take.name}" if len(takes) > 1 else "")
            parts.append(_draw_contacts(label, foot, take, span_s, top, number))
            top += _BAR_HEIGHT + 5.0
    title = "Joint angles, foot contacts and floor clearance over time"
    return draw_strip(parts, span_s, top, title, "strip motion")


def _rows(motion: Motion) -> list[_Row]:
    """Return the curves of a motion: the angles, then the clearance of each foot."""
    out = []
    for curve in angle_curves(motion):
        low, high = min(0.0, float(curve.degrees.min())), float(curve.degrees.max())
        high = max(high, low + _LEAST_RANGE_DEG)
        out.append(_Row(curve.name, curve.degrees, curve.measured, low, np.ceil(high / 10) * 10, "°"))
    for foot in foot_curves(motion):
        low, high = _CLEARANCE_RANGE_CM
        values = np.clip(100.0 * foot.clearance_m, low, high)
        out.append(_Row(f"{foot.name.split()[0]} sole", values, foot.measured, low, high, " cm"))
    return out


def _draw_row(found: Sequence[tuple[Take, _Row]], span_s: Span, top: float, columns: int) -> str:
    """Draw the curves of one quantity, with a common axis."""
    low, high = min(row.low for _, row in found), max(row.high for _, row in found)
    first_take, first = found[0]
    parts = [
        draw_plate(top, _CURVE_HEIGHT),
        text(LEFT - 8, top + _CURVE_HEIGHT / 2 + 4, first.name, text_anchor="end", class_="small"),
        text(LEFT + 4, top + 11, f"{high:.0f}{first.unit}", class_="tick"),
        text(LEFT + 4, top + _CURVE_HEIGHT - 3, f"{low:.0f}{first.unit}", class_="tick"),
    ]

    def y_of(values: float | FloatArray) -> FloatArray:
        return np.asarray(top + _CURVE_HEIGHT - (values - low) / (high - low) * _CURVE_HEIGHT)

    if low < 0.0 < high:
        zero = float(y_of(0.0))
        parts.append(element("line", class_="base", x1=LEFT, x2=WIDTH - RIGHT, y1=zero, y2=zero))
    parts += [
        draw_bar("unmeasured", times_s, span_s, top, _CURVE_HEIGHT)
        for _, _, times_s in first_take.spans_of(~first.measured)
    ]
    for number, (take, row) in enumerate(found):
        count = len(row.values)
        kept = np.unique(np.linspace(0, count - 1, min(columns, count)).round().astype(int))
        x, y, measured = x_from_time(take.times_s()[kept], span_s), y_of(row.values)[kept], row.measured[kept]
        inside = (x >= LEFT - 0.5) & (x <= WIDTH - RIGHT + 0.5)
        # a dashed piece reaches to the next point, so that the pieces join
        for mask, name in ((measured, ""), (~measured | np.append(~measured[1:], False), " guessed")):
            data = path_through(np.where((mask & inside)[:, None], np.stack([x, y], axis=1), np.nan))
            if data:
                parts.append(element("path", class_=f"curve take{number}{name}", d=data))
    return "".join(parts)


def _draw_contacts(label: str, foot: FootCurve, take: Take, span_s: Span, top: float, number: int) -> str:
    """Draw when a foot stands. Contacts that were not measured are drawn as assumed."""
    parts = [
        draw_plate(top, _BAR_HEIGHT),
        text(LEFT - 8, top + 10, label, text_anchor="end", class_="small"),
    ]
    for start, end, times_s in take.spans_of(foot.stands):
        kind = f"contact take{number}" + ("" if foot.measured[start:end].mean() > 0.5 else " assumed")
        shown_s = max(times_s[0], span_s[0]), min(times_s[1], span_s[1])
        if shown_s[1] > shown_s[0]:
            parts.append(draw_bar(kind, shown_s, span_s, top, _BAR_HEIGHT))
    return "".join(parts)
