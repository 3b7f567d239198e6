"""Draw the body's motion over time: angles of joints, contacts of the feet, clearance of the floor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, runs
from bodycap_batch.model.joint_angles import FootCurve, angle_curves, foot_curves
from bodycap_batch.model.skeleton import Motion
from bodycap_batch.report.figures.camera_timeline import (
    LEFT,
    RIGHT,
    WIDTH,
    column_count,
    draw_strip,
)
from bodycap_batch.report.figures.svg import element, path_through, text

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


@dataclass(frozen=True, slots=True)
class _Row:
    """One curve of one take: name, values, mask, range of the axis, zero line."""

    name: str
    values: FloatArray
    measured: BoolArray
    low: float
    high: float
    unit: str


def draw_motion_curves(takes: Sequence[Take], span_s: tuple[float, float], detail: float = 1.0) -> str:
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
            parts.append(_draw_bar(label, foot, take, span_s, top, number))
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


def _draw_row(
    found: Sequence[tuple[Take, _Row]], span_s: tuple[float, float], top: float, columns: int
) -> str:
    """Draw the curves of one quantity, with a common axis."""
    low, high = min(row.low for _, row in found), max(row.high for _, row in found)
    parts = [
        element("rect", class_="plate", x=LEFT, y=top, width=WIDTH - LEFT - RIGHT, height=_CURVE_HEIGHT),
        text(LEFT - 8, top + _CURVE_HEIGHT / 2 + 4, found[0][1].name, text_anchor="end", class_="small"),
        text(LEFT + 4, top + 11, f"{high:.0f}{found[0][1].unit}", class_="tick"),
        text(LEFT + 4, top + _CURVE_HEIGHT - 3, f"{low:.0f}{found[0][1].unit}", class_="tick"),
    ]

    def y_of(values: FloatArray) -> FloatArray:
        return np.asarray(top + _CURVE_HEIGHT - (values - low) / (high - low) * _CURVE_HEIGHT)

    if low < 0.0 < high:
        zero = float(y_of(np.zeros(1))[0])
        parts.append(element("line", class_="base", x1=LEFT, x2=WIDTH - RIGHT, y1=zero, y2=zero))
    first_take, first_row = found[0]
    for start, end in _unmeasured(first_row.measured):
        x1, x2 = (_x(float(t), span_s) for t in _edges(first_take, start, end))
        parts.append(
            element("rect", class_="unmeasured", x=x1, y=top, width=max(x2 - x1, 0.8), height=_CURVE_HEIGHT)
        )
    for number, (take, row) in enumerate(found):
        kept = np.unique(
            np.linspace(0, len(row.values) - 1, min(columns, len(row.values))).round().astype(int)
        )
        x = np.array([_x(float(time), span_s) for time in take.times_s()[kept]])
        y, measured = y_of(row.values)[kept], row.measured[kept]
        inside = (x >= LEFT - 0.5) & (x <= WIDTH - RIGHT + 0.5)
        for mask, name in ((measured, ""), (~measured, " guessed")):
            # a dashed or solid piece reaches to the next point, so that the pieces join
            wide = mask | np.append(mask[1:], False) if name else mask
            points = np.where((wide & inside)[:, None], np.stack([x, y], axis=1), np.nan)
            data = path_through((float(a), float(b)) for a, b in points)
            if data:
                parts.append(element("path", class_=f"curve take{number}{name}", d=data))
    return "".join(parts)


def _draw_bar(
    label: str, foot: FootCurve, take: Take, span_s: tuple[float, float], top: float, number: int
) -> str:
    """Draw when a foot stands. Contacts that were not measured are drawn as assumed."""
    stands, measured = foot.stands, foot.measured
    parts = [
        element("rect", class_="plate", x=LEFT, y=top, width=WIDTH - LEFT - RIGHT, height=_BAR_HEIGHT),
        text(LEFT - 8, top + 10, label, text_anchor="end", class_="small"),
    ]
    for start, end in runs(stands):
        x1, x2 = (_x(float(t), span_s) for t in _edges(take, start, end))
        kind = f"contact take{number}" + ("" if measured[start:end].mean() > 0.5 else " assumed")
        x1, x2 = max(x1, LEFT), min(x2, WIDTH - RIGHT)
        if x2 > x1:
            parts.append(element("rect", class_=kind, x=x1, y=top, width=x2 - x1, height=_BAR_HEIGHT))
    return "".join(parts)


def _unmeasured(measured: BoolArray) -> list[tuple[int, int]]:
    return [(int(start), int(end)) for start, end in runs(~measured)]


def _edges(take: Take, start: int, end: int) -> tuple[float, float]:
    """Return the times of the first tick `start` and of the end of the last tick before `end`, seconds."""
    times = take.times_s()
    return float(times[start]), float(times[min(end, len(times) - 1)])


def _x(time_s: float, span_s: tuple[float, float]) -> float:
    width = WIDTH - LEFT - RIGHT
    return LEFT + (time_s - span_s[0]) / max(span_s[1] - span_s[0], 1e-9) * width
