"""Make the tables of a job's metrics. Each cell names the path of its value in ``metrics.json``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bodycap_batch.core.percent import format_percent
from bodycap_batch.model.skeleton_presets import split_side
from bodycap_batch.report.metric_paths import metric_at, metric_path
from bodycap_batch.report.report_inputs import ReportInputs
from bodycap_batch.report.viewer_data import known_joint_sigma_m

_LIMIT_TEXTS = {
    "elbow not overstretched": "elbow must not bend backward",
    "knee not overstretched": "knee must not bend backward",
    "palm within reach": "palm must stay within reach of the shoulder",
    "palm below the shoulder": "palm must stay below the shoulder",
    "palm on its side": "palm must stay on its own side of the body",
}
"""Text for the user, by the name of a soft limit without its side."""
_HINGE_TEXTS = {"ForeArm": "elbow", "Leg": "knee"}
"""Text for the user, by the part of the body below a hinge."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """One cell of a table.

    Attributes:
        text: The displayed text.
        metric: Path (see `metric_path`) of the value in ``metrics.json``; "" if the cell shows no value of
            this file.
        value: The value without rounding; None if the cell shows no number.
        share: Relative length of a bar behind the text, 0 to 1; None for no bar.
    """

    text: str
    metric: str = ""
    value: float | None = None
    share: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """A table with a caption. The first cell of each row is the row's heading."""

    caption: str
    heads: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""


def make_tables(inputs: ReportInputs) -> dict[str, Table]:
    """Return the tables of the page, by table name. Tables without rows are omitted."""
    metrics = inputs.metrics
    if metrics is None:
        return {}
    tables = {
        "frames": _frames_table(metrics),
        "clocks": _clocks_table(metrics),
        "shutters": _shutters_table(metrics),
        "sensors": _sensors_table(metrics),
        "map": _map_table(metrics),
    }
    if "merge" in metrics:
        merge = metrics["merge"]
        tables |= {
            "residuals": _residuals_table(merge),
            "joints": _joint_distance_table(merge, "joint_gap_m", "Distance between bones at each joint"),
            "hinges": _joint_distance_table(
                merge, "hinge_off_plane_m", "Distance of elbows and knees from their bending plane"
            ),
            "mounts": _mounts_table(merge),
            "joined": _joined_cameras_table(merge),
            "scale": _scale_table(merge),
            "limbs": _limb_scales_table(merge),
            "rules": _soft_limits_table(merge),
            "sigma": _joint_sigma_table(inputs),
            "flexion": _flexion_table(merge),
        }
    return {name: table for name, table in tables.items() if table.rows}


def metric_cell(
    metrics: Mapping[str, Any],
    dotted: str,
    form: str | Callable[[float], str] = "{:,}",
    factor: float = 1.0,
) -> Cell:
    """Return a value of ``metrics.json`` as a cell. An unknown value is shown as a dash.

    Args:
        metrics: The content of ``metrics.json``.
        dotted: Dotted path of the value, as `metric_path` returns it.
        form: Format string for the value, or function that converts the value to text.
        factor: Factor that converts the value to the displayed unit.
    """
    value = metric_at(metrics, dotted)
    if value is None:
        return Cell(text="–", metric=dotted)
    shown = value if factor == 1.0 else factor * value
    text = form.format(shown) if isinstance(form, str) else form(shown)
    return Cell(text=text, metric=dotted, value=value)


def _percent(value: float) -> str:
    return format_percent(value, 1)


def _sigma_percent(value: float) -> str:
    return f"± {_percent(value)}"


def _frames_table(metrics: Mapping[str, Any]) -> Table:
    rows = []
    paths = {name: metric_path("cameras", name) for name in metrics["cameras"]}
    for name, path in (*paths.items(), ("all cameras", "total")):
        rows.append(
            (
                Cell(text=name),
                metric_cell(metrics, f"{path}.frames"),
                metric_cell(metrics, f"{path}.frames_registered"),
                metric_cell(metrics, f"{path}.coverage", _percent),
                metric_cell(metrics, f"{path}.keyframes"),
                metric_cell(metrics, f"{path}.registration.median_inliers", "{:.0f}")
                if path != "total"
                else Cell(text=""),
            )
        )
    heads = ("Camera", "Frames", "Registered", "Share", "Keyframes", "Median inliers")
    return Table(caption="Table 1. Frames registered", heads=heads, rows=tuple(rows))


_CLOCK_SOURCES = {
    "sound": "sound",
    "sensors": "inertial sensors",
    "motion": "motion",
    "stated": "stated in the job or the calibration",
    "common": "common clock",
    "none": "unknown",
}
"""Text for the user, by the source of a clock."""


def _clocks_table(metrics: Mapping[str, Any]) -> Table:
    rows = []
    for name, clock in metrics.get("clocks", {}).items():
        path = metric_path("clocks", name)
        rows.append(
            (
                Cell(text=name),
                metric_cell(metrics, f"{path}.offset_s", "{:+.4f} s"),
                metric_cell(metrics, f"{path}.sigma_s", "{:.1f} ms", 1000.0),
                metric_cell(metrics, f"{path}.drift_ppm", "{:+.1f} ppm"),
                metric_cell(metrics, f"{path}.drift_sigma_ppm", "{:.1f} ppm"),
                Cell(text=_CLOCK_SOURCES.get(clock["source"], str(clock["source"]))),
            )
        )
    return Table(
        caption="Clocks of the cameras",
        heads=("Camera", "Offset", "Sigma", "Drift", "Sigma of the drift", "Source"),
        rows=tuple(rows) if len(rows) > 1 else (),
        note="Common time = camera time · (1 + drift) + offset. The offset is relative to the reference "
        "camera, whose offset is 0.",
    )


_READOUT_SOURCES = {
    "stated": "stated in the job or the calibration",
    "estimated": "estimated from the video",
    "of the map": "estimated from the video",
    "none found": "no rolling shutter found",
}
"""Text for the user, by the source of a readout time. Any other source is the reason why none is known."""


def _shutters_table(metrics: Mapping[str, Any]) -> Table:
    """Return the readout time of each camera that is not stated to have a global shutter."""
    mapping = metrics.get("mapping", {})
    paths: dict[str, tuple[str, ...]] = {}
    for number, readouts in enumerate(mapping.get("rolling_shutter", ())):
        for name in readouts:
            paths.setdefault(name, ("mapping", "rolling_shutter", str(number), name))
    for name in mapping.get("readouts_from_matches", {}):
        paths.setdefault(name, ("mapping", "readouts_from_matches", name))
    rows = []
    for name in metrics["cameras"]:
        if name not in paths:
            continue
        path = metric_path(*paths[name])
        source = str(metric_at(metrics, f"{path}.source"))
        if source == "stated" and not metric_at(metrics, f"{path}.seconds"):
            continue
        found = [metric_cell(metrics, f"{path}.{key}", "{:.2f} ms", 1000.0) for key in ("seconds", "sigma_s")]
        if source not in _READOUT_SOURCES:
            found = [Cell(text="–"), Cell(text="–")]
        elif source == "stated":
            found[1] = Cell(text="–")
        rows.append((Cell(text=name), *found, Cell(text=_READOUT_SOURCES.get(source, source))))
    return Table(
        caption="Rolling shutters of the cameras",
        heads=("Camera", "Readout time", "Sigma", "Source"),
        rows=tuple(rows),
        note="The readout time is the time from the exposure of the first row of the sensor to the exposure "
        "of the last row. Poses and map are corrected for it. If you know it, state `rolling_shutter_s`.",
    )


_SENSOR_VERDICTS = {
    "agrees": "agrees with the pictures",
    "stabilised": "not used: the camera stabilised the video",
    "unknown": "not used",
}
"""Text for the user, by the verdict of the comparison of a gyroscope with the pictures."""


def _sensors_table(metrics: Mapping[str, Any]) -> Table:
    rows, reasons = [], []
    for name, sensor in metrics.get("telemetry", {}).items():
        path = metric_path("telemetry", name)
        if sensor["verdict"] != "agrees":
            reasons.append(f"{name}: {sensor['reason']}.")
        if "stabilisation" in sensor:
            reasons.append(f"{name}: {sensor['stabilisation']['reason']}.")
        rows.append(
            (
                Cell(text=name),
                Cell(text=_SENSOR_VERDICTS.get(sensor["verdict"], str(sensor["verdict"]))),
                metric_cell(metrics, f"{path}.delay_s", "{:+.1f} ms", 1000.0),
                metric_cell(metrics, f"{path}.delay_sigma_s", "{:.1f} ms", 1000.0),
                metric_cell(metrics, f"{path}.turned_deg", "{:.1f}°"),
                metric_cell(metrics, f"{path}.rate_ppm", "{:+.0f} ppm"),
                metric_cell(metrics, f"{path}.frames_filled"),
            )
        )
    return Table(
        caption="Inertial sensors",
        heads=("Camera", "Sensor", "Delay", "Sigma", "Turned by", "Clock rate", "Lost frames with a pose"),
        rows=tuple(rows),
        note=" ".join(["Time of a sample = time of the frame + delay.", *reasons]),
    )


def _map_table(metrics: Mapping[str, Any]) -> Table:
    paths = [(name, metric_path("cameras", name)) for name in metrics["cameras"]]
    paths += [(f"map {index}", metric_path("models", index)) for index in range(len(metrics["models"]))]
    rows = []
    for head, path in (*paths, ("all", "total")):
        rows.append(
            (
                Cell(text=head),
                metric_cell(metrics, f"{path}.points"),
                metric_cell(metrics, f"{path}.measurements"),
                metric_cell(metrics, f"{path}.mean_reprojection_error_px", "{:.2f} px"),
            )
        )
    return Table(
        caption="Table 2. The map",
        heads=("Seen by", "Points", "Measurements", "Mean reprojection error"),
        rows=tuple(rows),
        note="Errors in pixels are measured in the reduced frames (long side: `work_px`).",
    )


def _residuals_table(merge: Mapping[str, Any]) -> Table:
    metrics = {"merge": merge}
    cameras = merge.get("cameras", {})
    largest = max((camera["residual_m"]["p95"] for camera in cameras.values()), default=0.0)
    rows = []
    for name, camera in cameras.items():
        path = metric_path("merge", "cameras", name)
        p95 = metric_cell(metrics, f"{path}.residual_m.p95", "{:.2f} cm", 100.0)
        rows.append(
            (
                Cell(text=name),
                metric_cell(metrics, f"{path}.measurements"),
                metric_cell(metrics, f"{path}.dropped_as_gross_errors"),
                metric_cell(metrics, f"{path}.down_weighted"),
                metric_cell(metrics, f"{path}.longest_gap_s", "{:.2f} s"),
                metric_cell(metrics, f"{path}.residual_m.p50", "{:.2f} cm", 100.0),
                replace(p95, share=camera["residual_m"]["p95"] / largest if largest else 0.0),
                metric_cell(metrics, f"{path}.residual_deg.p95", "{:.2f}°"),
            )
        )
    heads = (
        "Camera",
        "Poses",
        "Excluded",
        "Down-weighted",
        "Longest gap",
        "Distance, median",
        "Distance, 95th percentile",
        "Rotation, 95th percentile",
    )
    return Table(
        caption="Difference between each camera's poses and the solved body", heads=heads, rows=tuple(rows)
    )


def _joint_distance_table(merge: Mapping[str, Any], key: str, caption: str) -> Table:
    """Return a table with the median and the 95th percentile of a distance at each joint.

    A bar shows the 95th percentile relative to the largest 95th percentile in the table.

    Args:
        merge: The entry ``merge`` of ``metrics.json``.
        key: Name of the distance in this entry.
        caption: Caption of the table.
    """
    metrics, distances = {"merge": merge}, merge.get(key, {})
    largest = max((distance["p95"] for distance in distances.values()), default=0.0)
    rows = []
    for role in distances:
        path = metric_path("merge", key, role)
        p95 = metric_cell(metrics, f"{path}.p95", "{:.2f} mm", 1000.0)
        share = distances[role]["p95"] / largest if largest else 0.0
        rows.append(
            (
                Cell(text=role),
                metric_cell(metrics, f"{path}.p50", "{:.2f} mm", 1000.0),
                replace(p95, share=share),
            )
        )
    return Table(
        caption=caption, heads=("Joint", "Distance, median", "Distance, 95th percentile"), rows=tuple(rows)
    )


def _mounts_table(merge: Mapping[str, Any]) -> Table:
    metrics = {"merge": merge}
    rows = []
    for name, mount in merge.get("mounts", {}).items():
        path = metric_path("merge", "mounts", name)
        rows.append(
            (
                Cell(text=name),
                Cell(text=str(mount["role"])),
                metric_cell(metrics, f"{path}.roll_deg", "{:.0f}°"),
                metric_cell(metrics, f"{path}.from_prior_deg", "{:.1f}°"),
                metric_cell(metrics, f"{path}.from_prior_m", "{:.1f} cm", 100.0),
                metric_cell(metrics, f"{path}.sigma_deg", "± {:.1f}°"),
                metric_cell(metrics, f"{path}.sigma_m", "± {:.1f} cm", 100.0),
            )
        )
    heads = (
        "Camera",
        "Bone",
        "Roll",
        "Rotation from the assumed mount",
        "Distance from the assumed mount",
        "Rotation uncertainty",
        "Position uncertainty",
    )
    return Table(caption="Estimated mounts", heads=heads, rows=tuple(rows))


def _joined_cameras_table(merge: Mapping[str, Any]) -> Table:
    metrics = {"merge": merge}
    rows = tuple(
        (
            Cell(text=name),
            metric_cell(metrics, metric_path("merge", "joined_cameras", name, "sigma_deg"), "± {:.1f}°"),
            metric_cell(
                metrics, metric_path("merge", "joined_cameras", name, "sigma_m"), "± {:.1f} cm", 100.0
            ),
        )
        for name in merge.get("joined_cameras", {})
    )
    return Table(
        caption="Cameras whose position only the body's movement determines",
        heads=("Camera", "Rotation uncertainty", "Position uncertainty"),
        rows=rows,
        note="The map of these cameras has no place in common with the main map.",
    )


def _scale_table(merge: Mapping[str, Any]) -> Table:
    scale = merge.get("scale", {})
    rows = tuple(
        (
            *_scale_source_cells(merge, f"merge.scale.sources.{index}"),
            Cell(text="used" if source["used"] else "not used"),
        )
        for index, source in enumerate(scale.get("sources", ()))
    )
    return Table(
        caption="Sources of the metric scale",
        heads=("Source", "Uncertainty", "Difference from the used scale", ""),
        rows=rows,
        note=_chi_square_note(scale),
    )


def _limb_scales_table(merge: Mapping[str, Any]) -> Table:
    limbs = merge.get("scale", {}).get("limbs", {})
    rows = tuple(
        _scale_source_cells(merge, f"merge.scale.limbs.alone.{index}")
        for index in range(len(limbs.get("alone", ())))
    )
    return Table(
        caption="Metric scale, estimated from each limb alone",
        heads=("Limb", "Uncertainty", "Difference from the used scale"),
        rows=rows,
        note=_chi_square_note(limbs),
    )


def _scale_source_cells(merge: Mapping[str, Any], path: str) -> tuple[Cell, ...]:
    metrics = {"merge": merge}
    return (
        Cell(text=str(metric_at(metrics, f"{path}.name"))),
        metric_cell(metrics, f"{path}.relative_sigma", _sigma_percent),
        metric_cell(metrics, f"{path}.off", "{:+.1f} %", 100.0),
    )


def _chi_square_note(agreement: Mapping[str, Any]) -> str:
    """Return a note that compares the disagreement of the estimates (χ²) with the expected disagreement.

    Args:
        agreement: An entry of ``metrics.json`` with ``chi2`` and ``degrees_of_freedom``.

    Returns:
        The note; "" if the degrees of freedom are missing or 0.
    """
    degrees_of_freedom = agreement.get("degrees_of_freedom")
    if not degrees_of_freedom:
        return ""
    return (
        f"The χ² of these estimates is {agreement['chi2']:.1f}; a value of about {degrees_of_freedom} is "
        "expected if all estimates are right."
    )


def _soft_limits_table(merge: Mapping[str, Any]) -> Table:
    metrics, activity = {"merge": merge}, merge.get("activity", {})
    rows = []
    for name, share in activity.get("rules_active", {}).items():
        active = metric_cell(metrics, metric_path("merge", "activity", "rules_active", name), _percent)
        has_excess = name in activity.get("rules_pressed_m", {})
        path = metric_path("merge", "activity", "rules_pressed_m", name)
        excess = [metric_cell(metrics, f"{path}.{key}", "{:.1f} cm", 100.0) for key in ("p50", "p95")]
        rows.append(
            (
                Cell(text=_limit_text(str(name))),
                replace(active, share=float(share)),
                *(excess if has_excess else (Cell(text="–"), Cell(text="–"))),
            )
        )
    return Table(
        caption="Soft limits: share of the time in which each limit was exceeded, and distance by which "
        "the limit was exceeded",
        heads=("Limit", "Share of the time", "Median", "95 %"),
        rows=tuple(rows),
        note="If a limit is exceeded all the time, it contradicts the measurements: check the camera's "
        "mount and the `activity` of the job.",
    )


def _limit_text(name: str) -> str:
    """Return the text that describes a soft limit to the user, from the limit's name in ``metrics.json``."""
    side, _, limit = name.partition(" ")
    return f"{side} {_LIMIT_TEXTS[limit]}" if limit in _LIMIT_TEXTS else name


def _joint_sigma_table(inputs: ReportInputs) -> Table:
    sigma = None if inputs.merge is None else known_joint_sigma_m(inputs.merge)
    if inputs.merge is None or sigma is None:
        return Table(caption="", heads=(), rows=())
    rows = []
    known = np.isfinite(sigma).any(axis=0)
    largest = float(np.nanpercentile(sigma[:, known], 95, axis=0).max()) if known.any() else 0.0
    for joint in np.flatnonzero(known):
        median, p95 = np.nanpercentile(sigma[:, joint], [50, 95])
        share = float(p95) / largest if largest else 0.0
        rows.append(
            (
                Cell(text=inputs.merge.skeleton.joints[joint]),
                Cell(text=f"{100 * median:.1f} cm"),
                Cell(text=f"{100 * p95:.1f} cm", share=share),
            )
        )
    return Table(
        caption="Uncertainty of each joint's position (one standard deviation)",
        heads=("Joint", "Median", "95 %"),
        rows=tuple(rows),
    )


def _flexion_table(merge: Mapping[str, Any]) -> Table:
    """Return how well the angles of elbows and knees are known."""
    metrics, rows = {"merge": merge}, []
    for role in merge.get("flexion_sigma_deg", {}):
        side, part = split_side(role)
        paths = [
            metric_path("merge", "flexion_sigma_deg", role, name, "p50") for name in ("observed", "filled")
        ]
        name = Cell(text=f"{side.lower()} {_HINGE_TEXTS[part]}".strip())
        rows.append((name, *(metric_cell(metrics, path, "± {:.0f}°") for path in paths)))
    return Table(
        caption="Uncertainty of the bending angle of elbows and knees (one standard deviation, median)",
        heads=("Joint", "Measured", "In gaps"),
        rows=tuple(rows),
        note="Most of it is an error that stays the same over the capture: it comes from the mounts, the "
        "metric scale and the bone lengths.",
    )


def headline_figures(metrics: Mapping[str, Any]) -> Iterable[tuple[str, Cell]]:
    """Yield the name and the cell of each value at the top of the page."""
    yield "frames registered", metric_cell(metrics, "total.frames_registered")
    yield "of all frames", metric_cell(metrics, "total.coverage", _percent)
    yield "map error", metric_cell(metrics, "total.mean_reprojection_error_px", "{:.2f} px")
    yield "points in the map", metric_cell(metrics, "total.points")
    if "merge" in metrics:
        worst = max(
            metrics["merge"].get("cameras", {}).items(),
            key=lambda item: item[1]["longest_gap_s"],
            default=None,
        )
        if worst is not None:
            path = metric_path("merge", "cameras", worst[0], "longest_gap_s")
            yield "longest gap", metric_cell(metrics, path, "{:.2f} s")
        yield "metric scale", metric_cell(metrics, "merge.scale.relative_sigma", _sigma_percent)
