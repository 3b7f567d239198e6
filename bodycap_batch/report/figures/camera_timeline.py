"""Draw one camera over time: status, inliers, error, sharpness, speed and rotation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray, runs
from bodycap_batch.model.scene import FrameStatus, Trajectory
from bodycap_batch.report.drawn_scene import common_times_s
from bodycap_batch.report.figures.svg import bin_statistics, element, number, path_through, svg_image, text
from bodycap_batch.report.figures.time_axis import (
    LEFT,
    MAX_COLUMNS,
    PLOT_WIDTH,
    RIGHT,
    WIDTH,
    Span,
    axis_data,
    column_count,
    draw_bar,
    draw_now,
    draw_plate,
    draw_strip,
    x_from_time,
)
from bodycap_batch.report.frame_losses import turn_per_frame_deg
from bodycap_batch.report.loss_causes import LostSpan
from bodycap_batch.report.report_inputs import ReportInputs

_TOP, _STATUS_HEIGHT, _CURVE_HEIGHT, _MARGIN = 4.0, 18.0, 44.0, 10.0
"""Top of the drawing, heights of the status bar and of a curve, and space between them, SVG units."""
_MIN_RANGE_HEIGHT = 0.6
"""Height (SVG units) that a range of values must exceed to be drawn.

A smaller range would be hidden behind its curve.
"""
_DEFAULT_INTERVAL_S = 0.03
"""Assumed frame interval (seconds) of a video with a single frame, as for about 30 fps."""


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

    @property
    def title(self) -> str:
        """What the bar means, for the user."""
        if self.kind == "reg":
            return "registered"
        if self.kind == "turn":
            return f"{self.frames} frames with the rotation alone"
        bridged = ", bridged by the body" if self.kind == "bridged" else ""
        return f"{self.frames} frames lost: {', '.join(self.reasons)}{bridged}"


def draw_camera_timeline(
    inputs: ReportInputs,
    camera: str,
    span_s: Span,
    losses: list[LostSpan],
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
        curves.insert(2, ("sharpness", selection.sharpness / max(usual, 1e-12)))
        if path is None:
            times = _times_without_path(inputs, camera, span_s, len(selection.sharpness))
    if len(times) == 0:
        return ""
    parts, top = [], _TOP
    if path is not None:
        parts.append(_draw_bars(path, times, span_s, losses, bridged_s, columns))
        parts.append(text(LEFT - 8.0, 17.0, "status", class_="label", text_anchor="end"))
        parts.append(_draw_keyframes(path, times, span_s, columns))
        parts.append(_draw_slip(inputs, camera, span_s))
        top += _STATUS_HEIGHT + _MARGIN
    for name, values in curves:
        parts.append(_draw_curve(name, values, times, span_s, top, columns))
        top += _CURVE_HEIGHT + _MARGIN
    return draw_strip(parts, span_s, top, f"{camera} over time: {_summary(path)}")


def draw_coverage(
    path: Trajectory, times_s: FloatArray, span_s: Span, losses: list[LostSpan], bridged_s: float
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
    bars = draw_plate(_TOP, _STATUS_HEIGHT) + _draw_bars(path, times_s, span_s, losses, bridged_s)
    return svg_image(
        PLOT_WIDTH,
        _STATUS_HEIGHT,
        element("g", bars, transform=f"translate({number(-LEFT)} {number(-_TOP)})")
        + draw_now(0.0, 0.0, _STATUS_HEIGHT),
        f"{path.camera} over time: {_summary(path)}",
        class_="strip",
        preserveAspectRatio="none",
        **axis_data(0.0, span_s),
    )


def _times_without_path(inputs: ReportInputs, camera: str, span_s: Span, count: int) -> FloatArray:
    """Return the common times (seconds) of the `count` frames of a camera that has no trajectory.

    The times are those of the camera's video. If the video cannot be opened, the frames are spread evenly
    over the time axis.
    """
    if inputs.capture is not None:
        times_ns = inputs.capture.camera(camera).times_ns
        if len(times_ns) == count:
            return common_times_s(inputs, camera, times_ns)
    return np.linspace(*span_s, count)


def _summary(path: Trajectory | None) -> str:
    if path is None:
        return "keyframes and sharpness"
    registered = path.registered
    return f"{int(registered.sum())} of {len(registered)} frames registered"


def _make_curves(path: Trajectory) -> list[tuple[str, FloatArray]]:
    """Return the name of each quantity with its unit, and its value (N,) in each frame; NaN if unknown."""
    seconds = np.maximum(np.diff(path.times_ns) * 1e-9, 1e-6)
    both = path.localised[:-1] & path.localised[1:]
    distance = np.linalg.norm(np.diff(path.gauge_from_cam[:, :3, 3], axis=0), axis=1)
    unit = "m/s" if path.gauge == "world" else "units/s"
    return [
        ("inliers", np.where(path.localised, path.inliers.astype(np.float64), np.nan)),
        ("error, px", path.error_px),
        (f"speed, {unit}", np.append(np.nan, np.where(both, distance, np.nan) / seconds)),
        ("turn, °/s", np.append(np.nan, turn_per_frame_deg(path) / seconds)),
    ]


def _draw_keyframes(path: Trajectory, times: FloatArray, span_s: Span, columns: int) -> str:
    """Draw a line for each keyframe that a screen can separate from the one before it."""
    is_keyframe = np.array([status is FrameStatus.KEYFRAME for status in path.status], dtype=bool)
    if not is_keyframe.any():
        return ""
    resolution = PLOT_WIDTH / (2 * columns)
    positions = np.unique((x_from_time(times[is_keyframe], span_s) / resolution).round()) * resolution
    bottom = number(_TOP + _STATUS_HEIGHT / 3)
    return element(
        "path", class_="key", d="".join(f"M{number(x)} {number(_TOP)}V{bottom}" for x in positions)
    )


def _draw_slip(inputs: ReportInputs, camera: str, span_s: Span) -> str:
    """Draw a line at the time at which the mount of a camera slips; "" if it does not slip."""
    mounts = () if inputs.merge is None else inputs.merge.mounts
    slip = next((mount.slip for mount in mounts if mount.camera == camera), None)
    if slip is None:
        return ""
    x = float(x_from_time(1e-9 * slip.time_ns, span_s))
    title = element("title", "the mount slips")
    return element("path", title, class_="slip", d=f"M{number(x)} 0V{number(2 * _TOP + _STATUS_HEIGHT)}")


def _draw_bars(
    path: Trajectory,
    times: FloatArray,
    span_s: Span,
    losses: list[LostSpan],
    bridged_s: float,
    columns: int = MAX_COLUMNS,
) -> str:
    """Draw bars for registered and lost intervals. The title of a lost bar gives the reasons for the loss."""
    interval = float(np.median(np.diff(times))) if len(times) > 1 else _DEFAULT_INTERVAL_S
    resolution_s = (span_s[1] - span_s[0]) / (2 * columns)
    registered = [
        _StatusBar("reg", float(times[first]), float(times[stop - 1] + interval))
        for first, stop in runs(path.localised)
    ]
    lost = [
        _StatusBar(
            _loss_kind(loss, times, bridged_s),
            loss.from_s,
            loss.to_s + interval,
            loss.frames,
            (loss.reason.value,),
        )
        for loss in losses
    ]
    return "".join(
        draw_bar(bar.kind, (bar.start_s, bar.end_s), span_s, _TOP, _STATUS_HEIGHT, bar.title)
        for bars in (registered, lost)
        for bar in _merge_close_bars(bars, resolution_s)
    )


def _loss_kind(loss: LostSpan, times: FloatArray, bridged_s: float) -> str:
    if loss.reason is FrameStatus.OTHER_MAP:
        return "other"
    if loss.reason is FrameStatus.ROTATION_ONLY:
        return "turn"
    # The smoothness of the motion bridges a gap between two measurements. The time before the first
    # measurement and the time after the last measurement are not bridged.
    is_between = loss.first > 0 and loss.last < len(times) - 1
    return "bridged" if is_between and times[loss.last + 1] - times[loss.first - 1] <= bridged_s else "lost"


def _merge_close_bars(bars: list[_StatusBar], resolution_s: float) -> Iterator[_StatusBar]:
    """Merge neighbouring bars of the same kind that a screen cannot separate.

    This limits the size of the drawing for a long video.

    Args:
        bars: The bars in the order of time.
        resolution_s: Smallest distance of two bars that a screen can separate, seconds.
    """
    last: _StatusBar | None = None
    for bar in bars:
        if last is not None and last.kind == bar.kind and bar.start_s - last.end_s < resolution_s:
            reasons = tuple(dict.fromkeys((*last.reasons, *bar.reasons)))
            last = _StatusBar(bar.kind, last.start_s, bar.end_s, last.frames + bar.frames, reasons)
            continue
        if last is not None:
            yield last
        last = bar
    if last is not None:
        yield last


def _draw_curve(
    name: str, values: FloatArray, times: FloatArray, span_s: Span, top: float, max_columns: int
) -> str:
    """Draw a curve as a line through the median of each column, over the range of the column's values.

    A column represents several successive frames, or a single frame in a short video.
    """
    columns = bin_statistics(values, min(max_columns, len(values)))
    places = np.linspace(0, len(times) - 1, len(columns)) if len(columns) > 1 else [0.0]
    x = x_from_time(np.interp(places, np.arange(len(times)), times), span_s)
    finite = columns[np.isfinite(columns[:, 1])]
    high = float(np.percentile(finite[:, 2], 99)) * 1.1 if len(finite) else 1.0
    high = high if high > 0 else 1.0
    bottom = top + _CURVE_HEIGHT
    y = bottom - np.clip(columns / high, 0.0, 1.0) * _CURVE_HEIGHT
    return "".join(
        (
            draw_plate(top, _CURVE_HEIGHT),
            text(LEFT - 8.0, top + 16.0, name, class_="label", text_anchor="end"),
            text(LEFT - 8.0, top + 32.0, f"to {_short_number(high)}", class_="tick", text_anchor="end"),
            element("path", class_="range", d=_range_path(x, y)),
            element("path", class_="curve", d=path_through(zip(x, y[:, 1], strict=True))),
            element("line", class_="base", x1=LEFT, x2=WIDTH - RIGHT, y1=bottom, y2=bottom),
        )
    )


def _range_path(x: FloatArray, y: FloatArray) -> str:
    """Return a vertical line from the smallest to the largest value of each column, as SVG path data.

    Columns whose smallest and largest values hardly differ are omitted.
    """
    visible = np.isfinite(y[:, 0]) & (np.abs(y[:, 0] - y[:, 2]) > _MIN_RANGE_HEIGHT)
    return "".join(f"M{number(x[i])} {number(y[i, 0])}V{number(y[i, 2])}" for i in np.flatnonzero(visible))


def _short_number(value: float) -> str:
    return f"{value:.0f}" if value >= 20 else f"{value:.1f}" if value >= 2 else f"{value:.2f}"
