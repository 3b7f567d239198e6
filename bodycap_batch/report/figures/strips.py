"""One camera over time: status, inliers, error, blur and speed, on the time axis all cameras share."""

from __future__ import annotations

import html
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.geometry import rotation_angle_rad
from bodycap_batch.model.scene import FrameStatus, Trajectory
from bodycap_batch.report.figures.svg import bins, element, number, picture, polyline, text
from bodycap_batch.report.inputs import ReportInputs
from bodycap_batch.report.losses import Loss
from bodycap_batch.report.placing import common_times_s

WIDTH, LEFT, RIGHT = 960.0, 92.0, 12.0
_STATUS_HEIGHT, _ROW_HEIGHT, _GAP = 18.0, 44.0, 10.0
COLUMNS = 480
"""Of each curve: two of its points are two pixels apart on a wide screen."""
_LEAST_COLUMNS = 12
_STATUS_CLASS = {FrameStatus.KEYFRAME: "key", FrameStatus.REGISTERED: "reg"}


@dataclass(frozen=True, slots=True)
class _Row:
    """One curve: a name with its unit, a value per frame, and whether it starts at zero."""

    name: str
    values: FloatArray


def strip(
    inputs: ReportInputs,
    camera: str,
    span_s: tuple[float, float],
    losses: list[Loss],
    bridged_s: float,
    detail: float = 1.0,
) -> str:
    """Draw one camera.

    Args:
        inputs: The results.
        camera: Whose.
        span_s: First and last common time of the axis.
        losses: The camera's lost stretches.
        bridged_s: Holes between two measurements up to this long are bridged by the body; 0: none are.
        detail: Share of the columns that are drawn.
    """
    columns = columns_at(detail)
    selection, path = inputs.selection(camera), inputs.path(camera)
    rows = [] if path is None else _rows_of(path)
    times = np.zeros(0) if path is None else common_times_s(inputs, camera, path.times_ns)
    if selection is not None:
        usual = float(np.median(selection.sharpness)) if len(selection.sharpness) else 0.0
        rows.insert(2 if rows else 0, _Row("sharpness", selection.sharpness / max(usual, 1e-12)))
        if path is None:
            times = np.linspace(*span_s, len(selection.sharpness)) if len(selection.sharpness) else times
    if len(times) == 0:
        return ""
    parts, top = [], 4.0
    if path is not None:
        parts.append(
            _status(path, times, span_s, [_lost_run(loss, times, bridged_s) for loss in losses], columns)
        )
        top += _STATUS_HEIGHT + _GAP
    for row in rows:
        parts.append(_curve(row, times, span_s, top, columns))
        top += _ROW_HEIGHT + _GAP
    parts.append(_axis(span_s, top))
    parts.append(element("line", class_="now", x1=LEFT, x2=LEFT, y1=2.0, y2=top))
    return picture(
        WIDTH,
        top + 18.0,
        "".join(parts),
        f"{camera} over time: {_summary(path)}",
        class_="strip",
        data_left=LEFT,
        data_width=WIDTH - LEFT - RIGHT,
        data_start=f"{span_s[0]:.6f}",
        data_end=f"{span_s[1]:.6f}",
    )


def columns_at(detail: float) -> int:
    """How many points of each curve are drawn at a share of the detail."""
    return max(_LEAST_COLUMNS, int(COLUMNS * detail))


def at(time_s: float | FloatArray, span_s: tuple[float, float]) -> FloatArray:
    """Horizontal place of a time."""
    share = (np.asarray(time_s) - span_s[0]) / max(span_s[1] - span_s[0], 1e-9)
    return np.asarray(LEFT + share * (WIDTH - LEFT - RIGHT))


def _summary(path: Trajectory | None) -> str:
    if path is None:
        return "keyframes and sharpness"
    kept = path.localised
    return f"{int(kept.sum())} of {len(kept)} frames registered"


def _rows_of(path: Trajectory) -> list[_Row]:
    kept = path.localised
    turn = np.full(len(kept), np.nan)
    seconds = np.diff(path.times_ns) * 1e-9
    both = np.flatnonzero(kept[:-1] & kept[1:])
    rotation = path.gauge_from_cam[:, :3, :3]
    angle = rotation_angle_rad(np.swapaxes(rotation[both], -1, -2) @ rotation[both + 1]) if len(both) else 0.0
    turn[both + 1] = np.degrees(angle) / np.maximum(seconds[both], 1e-6)
    speed = np.full(len(kept), np.nan)
    moved = np.linalg.norm(np.diff(path.gauge_from_cam[:, :3, 3], axis=0), axis=1)
    speed[both + 1] = moved[both] / np.maximum(seconds[both], 1e-6)
    unit = "m/s" if path.gauge == "world" else "units/s"
    return [
        _Row("inliers", np.where(kept, path.inliers.astype(np.float64), np.nan)),
        _Row("error, px", path.error_px),
        _Row(f"speed, {unit}", speed),
        _Row("turn, °/s", turn),
    ]


def _status(
    path: Trajectory, times: FloatArray, span_s: tuple[float, float], lost: list[_Run], columns: int
) -> str:
    """Runs of equal status as bars; a lost one says why, and whether the body bridges it."""
    step = _step_s(times)
    apart_s = (span_s[1] - span_s[0]) / (2 * columns)
    localised = path.localised
    parts = [text(LEFT - 8.0, 17.0, "status", class_="label", text_anchor="end")]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], localised.astype(int), [0]])))
    runs = [
        _Run("reg", float(times[first]), float(times[stop - 1] + step))
        for first, stop in zip(edges[::2], edges[1::2], strict=True)
    ]
    parts += [_bar(run, span_s, "registered") for run in _seen_apart(runs, apart_s)]
    keys = np.array([each is FrameStatus.KEYFRAME for each in path.status], dtype=bool)
    if keys.any():
        grain = (WIDTH - LEFT - RIGHT) / (2 * columns)
        places = np.unique((at(times[keys], span_s) / grain).round()) * grain
        lines = "".join(f"M{number(x)} 4V{number(4.0 + _STATUS_HEIGHT / 3)}" for x in places)
        parts.append(element("path", class_="key", d=lines))
    for run in _seen_apart(lost, apart_s):
        what = f"{run.frames} frames lost: {', '.join(run.reasons)}"
        parts.append(_bar(run, span_s, f"{what}, bridged by the body" if run.kind == "bridged" else what))
    return "".join(parts)


@dataclass(frozen=True, slots=True)
class _Run:
    """A stretch of one kind, or several that a screen cannot tell apart."""

    kind: str
    start_s: float
    end_s: float
    frames: int = 0
    reasons: tuple[str, ...] = ()


def _step_s(times: FloatArray) -> float:
    return float(np.median(np.diff(times))) if len(times) > 1 else 0.03


def _lost_run(loss: Loss, times: FloatArray, bridged_s: float) -> _Run:
    # Smoothness carries over a gap between two measurements, not past the last one.
    inside = loss.first > 0 and loss.last < len(times) - 1
    hole = float(times[loss.last + 1] - times[loss.first - 1]) if inside else np.inf
    kind = "bridged" if hole <= bridged_s else "lost"
    return _Run(kind, loss.start_s, loss.end_s + _step_s(times), loss.frames, (loss.reason.value,))


def _seen_apart(runs: list[_Run], apart_s: float) -> list[_Run]:
    """Neighbours of one kind that nobody could tell apart as one: hours of frames stay a page."""
    out: list[_Run] = []
    for run in runs:
        last = out[-1] if out else None
        if last is not None and last.kind == run.kind and run.start_s - last.end_s < apart_s:
            reasons = tuple(dict.fromkeys((*last.reasons, *run.reasons)))
            out[-1] = _Run(run.kind, last.start_s, run.end_s, last.frames + run.frames, reasons)
        else:
            out.append(run)
    return out


def _bar(run: _Run, span_s: tuple[float, float], says: str) -> str:
    left, right = float(at(run.start_s, span_s)), float(at(run.end_s, span_s))
    width = max(right - left, 0.8)
    return element(
        "rect",
        element("title", html.escape(says)),
        class_=run.kind,
        x=left,
        y=4.0,
        width=width,
        height=_STATUS_HEIGHT,
    )


def _curve(row: _Row, times: FloatArray, span_s: tuple[float, float], top: float, most: int) -> str:
    """Median line over the range of each column; long takes are binned, short ones drawn frame by frame."""
    columns = bins(row.values, min(most, len(row.values)))
    middles = np.interp(
        np.linspace(0, len(times) - 1, len(columns)) if len(columns) > 1 else [0.0],
        np.arange(len(times)),
        times,
    )
    x = at(middles, span_s)
    finite = columns[np.isfinite(columns[:, 1])]
    high = float(np.percentile(finite[:, 2], 99)) * 1.1 if len(finite) else 1.0
    high = high if high > 0 else 1.0
    y = top + _ROW_HEIGHT - np.clip(columns / high, 0.0, 1.0) * _ROW_HEIGHT
    bottom = top + _ROW_HEIGHT
    parts = [
        element("rect", class_="plate", x=LEFT, y=top, width=WIDTH - LEFT - RIGHT, height=_ROW_HEIGHT),
        text(LEFT - 8.0, top + 16.0, row.name, class_="label", text_anchor="end"),
        text(LEFT - 8.0, top + 32.0, f"to {_short(high)}", class_="tick", text_anchor="end"),
        element("path", class_="range", d=_band(x, y)),
        element("path", class_="curve", d=polyline(zip(x, y[:, 1], strict=True))),
        element("line", class_="base", x1=LEFT, x2=WIDTH - RIGHT, y1=bottom, y2=bottom),
    ]
    return "".join(parts)


def _band(x: FloatArray, y: FloatArray) -> str:
    """Vertical strokes from least to largest; nothing where both are the same."""
    tall = np.isfinite(y[:, 0]) & (np.abs(y[:, 0] - y[:, 2]) > 0.6)
    return "".join(f"M{number(x[i])} {number(y[i, 0])}V{number(y[i, 2])}" for i in np.flatnonzero(tall))


def _axis(span_s: tuple[float, float], top: float) -> str:
    length = max(span_s[1] - span_s[0], 1e-6)
    step = next(
        (each for each in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 60, 120, 300, 600, 1800) if length / each <= 12),
        3600,
    )
    marks = np.arange(np.ceil(span_s[0] / step), np.floor(span_s[1] / step + 1e-9) + 1) * step
    return "".join(
        text(float(at(mark, span_s)), top + 12.0, f"{mark:g} s", class_="tick", text_anchor="middle")
        for mark in marks
    )


def _short(value: float) -> str:
    return f"{value:.0f}" if value >= 20 else f"{value:.1f}" if value >= 2 else f"{value:.2f}"
