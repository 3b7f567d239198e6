"""Draw one camera over time: status, inliers, error, sharpness, speed and rotation.

All cameras have the same time axis.
"""

from __future__ import annotations

import html
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray, runs
from bodycap_batch.model.geometry import rotation_angle_rad
from bodycap_batch.model.scene import FrameStatus, Trajectory
from bodycap_batch.report.drawn_scene import common_times_s
from bodycap_batch.report.figures.svg import bin_statistics, element, number, path_through, svg_image, text
from bodycap_batch.report.frame_losses import FrameLoss
from bodycap_batch.report.report_inputs import ReportInputs

WIDTH, LEFT, RIGHT = 960.0, 92.0, 12.0
"""Width of the drawing, and its left and right margins, SVG units."""
_STATUS_HEIGHT, _CURVE_HEIGHT, _MARGIN = 18.0, 44.0, 10.0
"""Height of the status bar, of a curve, and of the space between them, SVG units."""
MAX_COLUMNS = 480
"""Maximum number of points on a curve. Neighbouring points are two pixels apart on a wide screen."""
_MIN_COLUMNS = 12
"""Minimum number of points on a curve, however small the detail of the page is. Evidence: none."""
_MIN_BAR_WIDTH = 0.8
"""Minimum width of a bar, SVG units. A single lost frame must remain visible."""
_MIN_RANGE_HEIGHT = 0.6
"""Height (SVG units) that a range of values must exceed to be drawn.

A smaller range would be hidden behind its curve.
"""
_TICK_INTERVALS_S = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 60, 120, 300, 600, 1800)
"""Possible intervals between the labels of the time axis, seconds."""
_MAX_TICKS = 12
"""Maximum number of intervals between the labels of the time axis. More labels would overlap."""
_DEFAULT_INTERVAL_S = 0.03
"""Assumed frame interval (seconds) of a video with a single frame, as for about 30 fps."""


@dataclass(frozen=True, slots=True)
class _Curve:
    """One curve of the drawing.

    Attributes:
        name: Name of the quantity, with its unit.
        values: (N,) value of each frame; NaN if unknown.
    """

    name: str
    values: FloatArray


@dataclass(frozen=True, slots=True)
class _StatusBar:
    """A bar that represents an interval of frames, or several intervals that a screen cannot separate.

    Attributes:
        kind: Kind of the interval: "reg" (registered), "bridged", "other" (in another map),
            "turn" (the rotation alone) or "lost".
        start_s: Common time of the bar's start, seconds.
        end_s: Common time of the bar's end, seconds.
        frames: Number of lost frames.
        reasons: Reasons for the loss, as values of `FrameStatus`.
    """

    kind: str
    start_s: float
    end_s: float
    frames: int = 0
    reasons: tuple[str, ...] = ()


def draw_camera_timeline(
    inputs: ReportInputs,
    camera: str,
    span_s: tuple[float, float],
    losses: list[FrameLoss],
    bridged_s: float,
    detail: float = 1.0,
) -> str:
    """Draw the timeline of one camera.

    Args:
        inputs: The results of the job.
        camera: Camera name.
        span_s: First and last common time of the time axis, seconds.
        losses: The lost intervals of the camera.
        bridged_s: Maximum time (seconds) between two measurements that the body's motion bridges; 0 if the
            motion bridges no gap of this camera.
        detail: Fraction of the points on each curve that are drawn, 0 to 1.

    Returns:
        The drawing as SVG; "" if the camera has neither a trajectory nor a keyframe selection.
    """
    columns = column_count(detail)
    selection, path = inputs.selection(camera), inputs.path(camera)
    curves = [] if path is None else _make_curves(path)
    times = np.zeros(0) if path is None else common_times_s(inputs, camera, path.times_ns)
    if selection is not None:
        usual = float(np.median(selection.sharpness)) if len(selection.sharpness) else 0.0
        curves.insert(2 if curves else 0, _Curve("sharpness", selection.sharpness / max(usual, 1e-12)))
        if path is None:
            times = _times_without_path(inputs, camera, span_s, len(selection.sharpness))
    if len(times) == 0:
        return ""
    parts, top = [], 4.0
    if path is not None:
        lost_bars = [_lost_bar(loss, times, bridged_s) for loss in losses]
        parts.append(_draw_status(path, times, span_s, lost_bars, columns))
        parts.append(_draw_slip(inputs, camera, span_s))
        top += _STATUS_HEIGHT + _MARGIN
    for curve in curves:
        parts.append(_draw_curve(curve, times, span_s, top, columns))
        top += _CURVE_HEIGHT + _MARGIN
    return draw_strip(parts, span_s, top, f"{camera} over time: {_summary(path)}")


def draw_strip(
    parts: list[str], span_s: tuple[float, float], top: float, title: str, kind: str = "strip"
) -> str:
    """Return an image of rows above a time axis at the height `top`, with a mark of the shown time."""
    parts.append(_draw_axis(span_s, top))
    parts.append(element("line", class_="now", x1=LEFT, x2=LEFT, y1=2.0, y2=top))
    return svg_image(
        WIDTH,
        top + 18.0,
        "".join(parts),
        title,
        class_=kind,
        data_left=LEFT,
        data_width=WIDTH - LEFT - RIGHT,
        data_start=f"{span_s[0]:.6f}",
        data_end=f"{span_s[1]:.6f}",
    )


def draw_coverage(
    path: Trajectory,
    times_s: FloatArray,
    span_s: tuple[float, float],
    losses: list[FrameLoss],
    bridged_s: float,
) -> str:
    """Draw the intervals in which a camera has poses, as one bar that can be stretched to any width.

    Args:
        path: The trajectory of the camera.
        times_s: (N,) common times of its frames, seconds.
        span_s: First and last common time of the axis, seconds.
        losses: The lost intervals of the camera.
        bridged_s: As in `draw_camera_timeline`.

    Returns:
        The drawing as SVG.
    """
    bars = _draw_bars(path, times_s, span_s, [_lost_bar(loss, times_s, bridged_s) for loss in losses])
    width = WIDTH - LEFT - RIGHT
    return svg_image(
        width,
        _STATUS_HEIGHT,
        element("rect", class_="plate", x=0, y=0, width=width, height=_STATUS_HEIGHT)
        + element("g", bars, transform=f"translate({number(-LEFT)} -4)")
        + element("line", class_="now", x1=0.0, x2=0.0, y1=0.0, y2=_STATUS_HEIGHT),
        f"{path.camera} over time: {_summary(path)}",
        class_="strip",
        preserveAspectRatio="none",
        data_left=0.0,
        data_width=width,
        data_start=f"{span_s[0]:.6f}",
        data_end=f"{span_s[1]:.6f}",
    )


def _times_without_path(
    inputs: ReportInputs, camera: str, span_s: tuple[float, float], count: int
) -> FloatArray:
    """Return the common times (seconds) of the frames of a camera that has no trajectory.

    The times are those of the camera's video. If the video cannot be opened, the frames are spread evenly
    over the time axis.

    Args:
        inputs: The results of the job.
        camera: Camera name.
        span_s: First and last common time of the time axis, seconds.
        count: Number of frames of the camera.
    """
    if inputs.capture is not None:
        times_ns = inputs.capture.camera(camera).times_ns
        if len(times_ns) == count:
            return common_times_s(inputs, camera, times_ns)
    return np.linspace(*span_s, count)


def column_count(detail: float) -> int:
    """Return the number of points on a curve for a fraction of the full detail, 0 to 1."""
    return max(_MIN_COLUMNS, int(MAX_COLUMNS * detail))


def x_from_time(time_s: float | FloatArray, span_s: tuple[float, float]) -> FloatArray:
    """Return the horizontal positions (SVG units) of common times (seconds).

    Args:
        time_s: One or more common times, seconds.
        span_s: First and last common time of the time axis, seconds.
    """
    share = (np.asarray(time_s) - span_s[0]) / max(span_s[1] - span_s[0], 1e-9)
    return np.asarray(LEFT + share * (WIDTH - LEFT - RIGHT))


def _summary(path: Trajectory | None) -> str:
    if path is None:
        return "keyframes and sharpness"
    registered = path.registered
    return f"{int(registered.sum())} of {len(registered)} frames registered"


def _make_curves(path: Trajectory) -> list[_Curve]:
    localised = path.localised
    turn = np.full(len(localised), np.nan)
    seconds = np.diff(path.times_ns) * 1e-9
    both = np.flatnonzero(localised[:-1] & localised[1:])
    rotation = path.gauge_from_cam[:, :3, :3]
    angle = rotation_angle_rad(np.swapaxes(rotation[both], -1, -2) @ rotation[both + 1]) if len(both) else 0.0
    turn[both + 1] = np.degrees(angle) / np.maximum(seconds[both], 1e-6)
    speed = np.full(len(localised), np.nan)
    distance = np.linalg.norm(np.diff(path.gauge_from_cam[:, :3, 3], axis=0), axis=1)
    speed[both + 1] = distance[both] / np.maximum(seconds[both], 1e-6)
    unit = "m/s" if path.gauge == "world" else "units/s"
    return [
        _Curve("inliers", np.where(localised, path.inliers.astype(np.float64), np.nan)),
        _Curve("error, px", path.error_px),
        _Curve(f"speed, {unit}", speed),
        _Curve("turn, °/s", turn),
    ]


def _draw_status(
    path: Trajectory,
    times: FloatArray,
    span_s: tuple[float, float],
    lost_bars: list[_StatusBar],
    columns: int,
) -> str:
    """Draw bars for registered and lost intervals, and a line for each keyframe."""
    parts = [text(LEFT - 8.0, 17.0, "status", class_="label", text_anchor="end")]
    is_keyframe = np.array([status is FrameStatus.KEYFRAME for status in path.status], dtype=bool)
    if is_keyframe.any():
        resolution = (WIDTH - LEFT - RIGHT) / (2 * columns)
        positions = np.unique((x_from_time(times[is_keyframe], span_s) / resolution).round()) * resolution
        lines = "".join(f"M{number(x)} 4V{number(4.0 + _STATUS_HEIGHT / 3)}" for x in positions)
        parts.append(element("path", class_="key", d=lines))
    return _draw_bars(path, times, span_s, lost_bars, columns) + "".join(parts)


def _draw_slip(inputs: ReportInputs, camera: str, span_s: tuple[float, float]) -> str:
    """Draw a line at the time at which the mount of a camera slips; "" if it does not slip."""
    mounts = () if inputs.merge is None else inputs.merge.mounts
    slip = next((mount.slip for mount in mounts if mount.camera == camera), None)
    if slip is None:
        return ""
    x = float(x_from_time(1e-9 * slip.time_ns, span_s))
    title = element("title", "the mount slips")
    return element("path", title, class_="slip", d=f"M{number(x)} 0V{number(8.0 + _STATUS_HEIGHT)}")


def _draw_bars(
    path: Trajectory,
    times: FloatArray,
    span_s: tuple[float, float],
    lost_bars: list[_StatusBar],
    columns: int = MAX_COLUMNS,
) -> str:
    """Draw bars for registered and lost intervals.

    The title of a lost bar gives the reasons for the loss. It also says if the body's motion bridges the gap.
    """
    interval = _frame_interval_s(times)
    resolution_s = (span_s[1] - span_s[0]) / (2 * columns)
    registered = [
        _StatusBar("reg", float(times[first]), float(times[stop - 1] + interval))
        for first, stop in runs(path.localised)
    ]
    parts = [_draw_bar(bar, span_s, "registered") for bar in _merge_close_bars(registered, resolution_s)]
    for bar in _merge_close_bars(lost_bars, resolution_s):
        title = f"{bar.frames} frames lost: {', '.join(bar.reasons)}"
        if bar.kind == "turn":
            title = f"{bar.frames} frames with the rotation alone"
        if bar.kind == "bridged":
            title += ", bridged by the body"
        parts.append(_draw_bar(bar, span_s, title))
    return "".join(parts)


def _frame_interval_s(times: FloatArray) -> float:
    return float(np.median(np.diff(times))) if len(times) > 1 else _DEFAULT_INTERVAL_S


_KINDS = {FrameStatus.OTHER_MAP: "other", FrameStatus.ROTATION_ONLY: "turn"}
"""Kind of the bar of frames that are lost in the map but not without any result."""


def _lost_bar(loss: FrameLoss, times: FloatArray, bridged_s: float) -> _StatusBar:
    # The smoothness of the motion bridges a gap between two measurements. The time before the first
    # measurement and the time after the last measurement are not bridged.
    is_between = loss.first > 0 and loss.last < len(times) - 1
    gap_s = float(times[loss.last + 1] - times[loss.first - 1]) if is_between else np.inf
    kind = "bridged" if gap_s <= bridged_s else "lost"
    kind = _KINDS.get(loss.reason, kind)
    end_s = loss.end_s + _frame_interval_s(times)
    return _StatusBar(kind, loss.start_s, end_s, loss.frame_count, (loss.reason.value,))


def _merge_close_bars(bars: list[_StatusBar], resolution_s: float) -> list[_StatusBar]:
    """Merge neighbouring bars of the same kind that a screen cannot separate.

    This limits the size of the drawing for a long video.

    Args:
        bars: The bars in the order of time.
        resolution_s: Smallest distance of two bars that a screen can separate, seconds.
    """
    merged: list[_StatusBar] = []
    for bar in bars:
        last = merged[-1] if merged else None
        if last is not None and last.kind == bar.kind and bar.start_s - last.end_s < resolution_s:
            reasons = tuple(dict.fromkeys((*last.reasons, *bar.reasons)))
            merged[-1] = _StatusBar(bar.kind, last.start_s, bar.end_s, last.frames + bar.frames, reasons)
        else:
            merged.append(bar)
    return merged


def _draw_bar(bar: _StatusBar, span_s: tuple[float, float], title: str) -> str:
    left, right = float(x_from_time(bar.start_s, span_s)), float(x_from_time(bar.end_s, span_s))
    return element(
        "rect",
        element("title", html.escape(title)),
        class_=bar.kind,
        x=left,
        y=4.0,
        width=max(right - left, _MIN_BAR_WIDTH),
        height=_STATUS_HEIGHT,
    )


def _draw_curve(
    curve: _Curve, times: FloatArray, span_s: tuple[float, float], top: float, max_columns: int
) -> str:
    """Draw a curve as a line through the median of each column, over the range of the column's values.

    A column represents several successive frames, or a single frame in a short video.
    """
    columns = bin_statistics(curve.values, min(max_columns, len(curve.values)))
    column_times = np.interp(
        np.linspace(0, len(times) - 1, len(columns)) if len(columns) > 1 else [0.0],
        np.arange(len(times)),
        times,
    )
    x = x_from_time(column_times, span_s)
    finite = columns[np.isfinite(columns[:, 1])]
    high = float(np.percentile(finite[:, 2], 99)) * 1.1 if len(finite) else 1.0
    high = high if high > 0 else 1.0
    y = top + _CURVE_HEIGHT - np.clip(columns / high, 0.0, 1.0) * _CURVE_HEIGHT
    bottom = top + _CURVE_HEIGHT
    parts = [
        element("rect", class_="plate", x=LEFT, y=top, width=WIDTH - LEFT - RIGHT, height=_CURVE_HEIGHT),
        text(LEFT - 8.0, top + 16.0, curve.name, class_="label", text_anchor="end"),
        text(LEFT - 8.0, top + 32.0, f"to {_short_number(high)}", class_="tick", text_anchor="end"),
        element("path", class_="range", d=_range_path(x, y)),
        element("path", class_="curve", d=path_through(zip(x, y[:, 1], strict=True))),
        element("line", class_="base", x1=LEFT, x2=WIDTH - RIGHT, y1=bottom, y2=bottom),
    ]
    return "".join(parts)


def _range_path(x: FloatArray, y: FloatArray) -> str:
    """Return a vertical line from the smallest to the largest value of each column, as SVG path data.

    Columns whose smallest and largest values hardly differ are omitted.
    """
    visible = np.isfinite(y[:, 0]) & (np.abs(y[:, 0] - y[:, 2]) > _MIN_RANGE_HEIGHT)
    return "".join(f"M{number(x[i])} {number(y[i, 0])}V{number(y[i, 2])}" for i in np.flatnonzero(visible))


def _draw_axis(span_s: tuple[float, float], top: float) -> str:
    """Draw the labels of a time axis.

    Args:
        span_s: First and last time of the axis, seconds.
        top: Upper end of the labels, SVG units.
    """
    length = max(span_s[1] - span_s[0], 1e-6)
    interval = next((each for each in _TICK_INTERVALS_S if length / each <= _MAX_TICKS), 3600)
    first, last = np.ceil(span_s[0] / interval), np.floor(span_s[1] / interval + 1e-9)
    return "".join(
        text(float(x_from_time(time, span_s)), top + 12.0, f"{time:g} s", class_="tick", text_anchor="middle")
        for time in np.arange(first, last + 1) * interval
    )


def _short_number(value: float) -> str:
    return f"{value:.0f}" if value >= 20 else f"{value:.1f}" if value >= 2 else f"{value:.2f}"
