"""Make the tables of a job's metrics. Each cell names the path of its value in ``metrics.json``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
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


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a table whose rows are the entries of a group in ``metrics.json``.

    Attributes:
        head: Heading.
        key: Path of the value in an entry.
        form: Format string, function or texts by value, which give the displayed text.
        factor: Factor that converts the value to the displayed unit.
        bar: True for a bar behind the text, relative to the largest value of the column.
    """

    head: str
    key: str
    form: str | Callable[[float], str] | Mapping[str, str] = "{:,}"
    factor: float = 1.0
    bar: bool = False


def _group_table(
    metrics: Mapping[str, Any],
    groups: Sequence[str],
    columns: Sequence[Column],
    name: Callable[[str], str] = str,
    *,
    total: str = "",
    **words: str,
) -> Table:
    """Return a table with a row for each entry of some groups.

    Args:
        metrics: The content of ``metrics.json``.
        groups: Path of each group: a mapping by name, or a list of entries with names.
        columns: The first column holds the names, and its key is not used; the others hold values.
        name: Returns the displayed name of an entry.
        total: Name of a last row with the values of all entries together; "" for no such row.
        words: Caption and note of the table.
    """
    rows = []
    for group in groups:
        entries = metric_at(metrics, group) or {}
        is_list = isinstance(entries, list)
        for key in range(len(entries)) if is_list else entries:
            path = f"{group}.{metric_path(key)}"
            label = metric_at(metrics, f"{path}.name") or f"map {key}" if is_list else key
            rows.append((Cell(text=name(str(label))), *_value_cells(metrics, path, columns[1:])))
    if total:
        rows.append((Cell(text=total), *_value_cells(metrics, "total", columns[1:])))
    for number, column in enumerate(columns):
        if column.bar and rows:
            largest = max(row[number].value or 0.0 for row in rows) or 1.0
            rows = [_with_bar(row, number, (row[number].value or 0.0) / largest) for row in rows]
    return Table(heads=tuple(column.head for column in columns), rows=tuple(rows), **words)


def _with_bar(row: Sequence[Cell], number: int, share: float) -> tuple[Cell, ...]:
    """Return a row with a bar behind the text of one cell."""
    return (*row[:number], replace(row[number], share=share), *row[number + 1 :])


def _value_cells(metrics: Mapping[str, Any], path: str, columns: Sequence[Column]) -> list[Cell]:
    """Return the cells of the entry at a path."""
    cells = []
    for column in columns:
        place = f"{path}.{column.key}"
        if isinstance(column.form, Mapping):
            value = str(metric_at(metrics, place))
            cells.append(Cell(text=column.form.get(value, value)))
        else:
            cells.append(metric_cell(metrics, place, column.form, column.factor))
    return cells


def _percent(value: float) -> str:
    return format_percent(value, 1)


def _sigma_percent(value: float) -> str:
    return f"± {_percent(value)}"


_CLOCK_SOURCES = {
    "sound": "sound",
    "sensors": "inertial sensors",
    "motion": "motion",
    "stated": "stated in the job or the calibration",
    "common": "common clock",
    "none": "unknown",
}
"""Text for the user, by the source of a clock."""


def make_tables(inputs: ReportInputs) -> dict[str, Table]:
    """Return the tables of the page, by table name. Tables without rows are omitted."""
    metrics = inputs.metrics
    if metrics is None:
        return {}
    clocks = _group_table(
        metrics,
        ["clocks"],
        [
            Column("Camera", ""),
            Column("Offset", "offset_s", "{:+.4f} s"),
            Column("Sigma", "sigma_s", "{:.1f} ms", 1000.0),
            Column("Drift", "drift_ppm", "{:+.1f} ppm"),
            Column("Sigma of the drift", "drift_sigma_ppm", "{:.1f} ppm"),
            Column("Source", "source", _CLOCK_SOURCES),
        ],
        caption="Clocks of the cameras",
        note="Common time = camera time · (1 + drift) + offset. The offset is relative to the reference "
        "camera, whose offset is 0.",
    )
    tables = {
        "frames": _group_table(
            metrics,
            ["cameras"],
            [
                Column("Camera", ""),
                Column("Frames", "frames"),
                Column("Registered", "frames_registered"),
                Column("Share", "coverage", _percent),
                Column("Keyframes", "keyframes"),
                Column("Median inliers", "registration.median_inliers", "{:.0f}"),
            ],
            total="all cameras",
            caption="Table 1. Frames registered",
        ),
        "clocks": clocks if len(clocks.rows) > 1 else replace(clocks, rows=()),
        "shutters": _shutters_table(metrics),
        "sensors": _sensors_table(metrics),
        "map": _group_table(
            metrics,
            ["cameras", "models"],
            [
                Column("Seen by", ""),
                Column("Points", "points"),
                Column("Measurements", "measurements"),
                Column("Mean reprojection error", "mean_reprojection_error_px", "{:.2f} px"),
            ],
            total="all",
            caption="Table 2. The map",
            note="Errors in pixels are measured in the reduced frames (long side: `work_px`).",
        ),
    }
    if "merge" in metrics:
        tables |= _body_tables(metrics) | {"sigma": _joint_sigma_table(inputs)}
    return {name: table for name, table in tables.items() if table.rows}


def _body_tables(metrics: Mapping[str, Any]) -> dict[str, Table]:
    """Return the tables about the body, by table name."""
    scale = metrics["merge"].get("scale", {})
    distances = (
        Column("Joint", ""),
        Column("Distance, median", "p50", "{:.2f} mm", 1000.0),
        Column("Distance, 95th percentile", "p95", "{:.2f} mm", 1000.0, bar=True),
    )
    return {
        "residuals": _group_table(
            metrics,
            ["merge.cameras"],
            [
                Column("Camera", ""),
                Column("Poses", "measurements"),
                Column("Excluded", "dropped_as_gross_errors"),
                Column("Down-weighted", "down_weighted"),
                Column("Longest gap", "longest_gap_s", "{:.2f} s"),
                Column("Distance, median", "residual_m.p50", "{:.2f} cm", 100.0),
                Column("Distance, 95th percentile", "residual_m.p95", "{:.2f} cm", 100.0, bar=True),
                Column("Rotation, 95th percentile", "residual_deg.p95", "{:.2f}°"),
            ],
            caption="Difference between each camera's poses and the solved body",
        ),
        "joints": _group_table(
            metrics, ["merge.joint_gap_m"], distances, caption="Distance between bones at each joint"
        ),
        "hinges": _group_table(
            metrics,
            ["merge.hinge_off_plane_m"],
            distances,
            caption="Distance of elbows and knees from their bending plane",
        ),
        "mounts": _group_table(
            metrics,
            ["merge.mounts"],
            [
                Column("Camera", ""),
                Column("Bone", "role", {}),
                Column("Roll", "roll_deg", "{:.0f}°"),
                Column("Rotation from the assumed mount", "from_prior_deg", "{:.1f}°"),
                Column("Distance from the assumed mount", "from_prior_m", "{:.1f} cm", 100.0),
                Column("Rotation uncertainty", "sigma_deg", "± {:.1f}°"),
                Column("Position uncertainty", "sigma_m", "± {:.1f} cm", 100.0),
            ],
            caption="Estimated mounts",
        ),
        "joined": _group_table(
            metrics,
            ["merge.joined_cameras"],
            [
                Column("Camera", ""),
                Column("Rotation uncertainty", "sigma_deg", "± {:.1f}°"),
                Column("Position uncertainty", "sigma_m", "± {:.1f} cm", 100.0),
            ],
            caption="Cameras whose position only the body's movement determines",
            note="The map of these cameras has no place in common with the main map.",
        ),
        "scale": _group_table(
            metrics,
            ["merge.scale.sources"],
            [
                Column("Source", ""),
                Column("Uncertainty", "relative_sigma", _sigma_percent),
                Column("Difference from the used scale", "off", "{:+.1f} %", 100.0),
                Column("", "used", {"True": "used", "False": "not used"}),
            ],
            caption="Sources of the metric scale",
            note=_chi_square_note(scale),
        ),
        "rules": _soft_limits_table(metrics),
        "flexion": _group_table(
            metrics,
            ["merge.flexion_sigma_deg"],
            [
                Column("Joint", ""),
                Column("Measured", "observed.p50", "± {:.0f}°"),
                Column("In gaps", "filled.p50", "± {:.0f}°"),
            ],
            _hinge_text,
            caption="Uncertainty of the bending angle of elbows and knees (one standard deviation, median)",
            note="Most of it is an error that stays the same over the capture: it comes from the mounts, the "
            "metric scale and the bone lengths.",
        ),
    }


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
    groups = [
        f"mapping.rolling_shutter.{number}" for number in range(len(mapping.get("rolling_shutter", ())))
    ]
    groups.append("mapping.readouts_from_matches")
    rows = []
    for name in metrics["cameras"]:
        places = (f"{group}.{metric_path(name)}" for group in groups)
        path = next((place for place in places if metric_at(metrics, place) is not None), None)
        if path is None:
            continue
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
    sensors = metrics.get("telemetry", {})
    reasons = [
        f"{name}: {reason}."
        for name, sensor in sensors.items()
        for reason in (
            sensor["reason"] if sensor["verdict"] != "agrees" else "",
            sensor.get("stabilisation", {}).get("reason", ""),
        )
        if reason
    ]
    return _group_table(
        metrics,
        ["telemetry"],
        [
            Column("Camera", ""),
            Column("Sensor", "verdict", _SENSOR_VERDICTS),
            Column("Delay", "delay_s", "{:+.1f} ms", 1000.0),
            Column("Sigma", "delay_sigma_s", "{:.1f} ms", 1000.0),
            Column("Turned by", "turned_deg", "{:.1f}°"),
            Column("Clock rate", "rate_ppm", "{:+.0f} ppm"),
            Column("Lost frames with a pose", "frames_filled"),
        ],
        caption="Inertial sensors",
        note=" ".join(["Time of a sample = time of the frame + delay.", *reasons]),
    )


def _hinge_text(role: str) -> str:
    side, part = split_side(role)
    return f"{side.lower()} {_HINGE_TEXTS[part]}".strip()


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


def _soft_limits_table(metrics: Mapping[str, Any]) -> Table:
    activity = metrics["merge"].get("activity", {})
    rows = []
    for name, share in activity.get("rules_active", {}).items():
        active = metric_cell(metrics, metric_path("merge", "activity", "rules_active", name), _percent)
        path = metric_path("merge", "activity", "rules_pressed_m", name)
        excess = [metric_cell(metrics, f"{path}.{key}", "{:.1f} cm", 100.0) for key in ("p50", "p95")]
        rows.append((Cell(text=_limit_text(str(name))), replace(active, share=float(share)), *excess))
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
    rows: list[tuple[Cell, ...]] = []
    if inputs.merge is not None and sigma is not None:
        known = np.flatnonzero(np.isfinite(sigma).any(axis=0))
        medians, highs = np.nanpercentile(sigma[:, known], [50, 95], axis=0).tolist()
        for joint, median, high in zip(known.tolist(), medians, highs, strict=True):
            bar = Cell(text=f"{100 * high:.1f} cm", share=high / max(highs) if max(highs) else 0.0)
            rows.append(
                (Cell(text=inputs.merge.skeleton.joints[joint]), Cell(text=f"{100 * median:.1f} cm"), bar)
            )
    return Table(
        caption="Uncertainty of each joint's position (one standard deviation)",
        heads=("Joint", "Median", "95 %"),
        rows=tuple(rows),
    )


def headline_figures(metrics: Mapping[str, Any]) -> Iterable[tuple[str, Cell]]:
    """Yield the name and the cell of each value at the top of the page."""
    yield "frames registered", metric_cell(metrics, "total.frames_registered")
    yield "of all frames", metric_cell(metrics, "total.coverage", _percent)
    yield "map error", metric_cell(metrics, "total.mean_reprojection_error_px", "{:.2f} px")
    yield "points in the map", metric_cell(metrics, "total.points")
    if "merge" in metrics:
        cameras = metrics["merge"].get("cameras", {})
        if cameras:
            worst = max(cameras, key=lambda name: float(cameras[name]["longest_gap_s"]))
            path = metric_path("merge", "cameras", worst, "longest_gap_s")
            yield "longest gap", metric_cell(metrics, path, "{:.2f} s")
        yield "metric scale", metric_cell(metrics, "merge.scale.relative_sigma", _sigma_percent)
