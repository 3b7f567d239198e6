"""The figures of a job as rows of tables, each cell with the place in ``metrics.json`` it was taken from."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bodycap_batch.core.percent import format_percent
from bodycap_batch.report.inputs import ReportInputs
from bodycap_batch.report.solid import joint_sigma_m


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """One cell.

    Attributes:
        says: What is read.
        metric: Dotted place in ``metrics.json``, "" where the cell is no figure of it.
        value: The unrounded figure.
        share: Length of a bar behind it, 0 to 1; None for none.
    """

    says: str
    metric: str = ""
    value: float | None = None
    share: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """A table with a caption; the first cell of a row is its head."""

    caption: str
    heads: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""


def look_up(metrics: Mapping[str, Any], dotted: str) -> Any:
    """The value at a dotted place, None where there is none. Camera names may hold no dot."""
    value: Any = metrics
    for part in dotted.split("."):
        if isinstance(value, list):
            value = value[int(part)] if int(part) < len(value) else None
        else:
            value = value.get(part) if isinstance(value, Mapping) else None
    return value


def tables_of(inputs: ReportInputs) -> dict[str, Table]:
    """All tables of the page by name; one that has no rows is missing."""
    metrics = inputs.metrics
    if metrics is None:
        return {}
    found = {"frames": _frames(metrics), "map": _map(metrics)}
    if "merge" in metrics:
        merge = metrics["merge"]
        found |= {
            "residuals": _residuals(merge),
            "joints": _gaps(merge, "joint_gap_m", "How far apart bones meet at each joint"),
            "hinges": _gaps(merge, "hinge_off_plane_m", "How far each hinge is bent sideways"),
            "mounts": _mounts(merge),
            "joined": _joined(merge),
            "scale": _scale(merge),
            "limbs": _limbs(merge),
            "rules": _rules(merge),
            "sigma": _sigma(inputs),
        }
    return {name: table for name, table in found.items() if table.rows}


def figure(
    metrics: Mapping[str, Any],
    dotted: str,
    form: str | Callable[[float], str] = "{:,}",
    factor: float = 1.0,
) -> Cell:
    """A figure of ``metrics.json`` as a cell; a dash where it is not known."""
    value = look_up(metrics, dotted)
    if value is None:
        return Cell(says="–", metric=dotted)
    shown = value if factor == 1.0 else factor * value
    says = form.format(shown) if isinstance(form, str) else form(shown)
    return Cell(says=says, metric=dotted, value=value)


def _share(value: float) -> str:
    return format_percent(value, 1)


def _frames(metrics: Mapping[str, Any]) -> Table:
    rows = []
    for place in (*(f"cameras.{name}" for name in metrics["cameras"]), "total"):
        name = place.partition(".")[2] or "all cameras"
        rows.append(
            (
                Cell(says=name),
                figure(metrics, f"{place}.frames"),
                figure(metrics, f"{place}.frames_registered"),
                figure(metrics, f"{place}.coverage", _share),
                figure(metrics, f"{place}.keyframes"),
                figure(metrics, f"{place}.registration.median_inliers", "{:.0f}")
                if place != "total"
                else Cell(says=""),
            )
        )
    heads = ("Camera", "Frames", "Registered", "Share", "Keyframes", "Median inliers")
    return Table(caption="Table 1. Frames registered", heads=heads, rows=tuple(rows))


def _map(metrics: Mapping[str, Any]) -> Table:
    places = [f"cameras.{name}" for name in metrics["cameras"]]
    places += [f"models.{index}" for index in range(len(metrics["models"]))] + ["total"]
    rows = []
    for place in places:
        kind, _, name = place.partition(".")
        says = {"cameras": name, "models": f"map {name}", "total": "all"}[kind]
        rows.append(
            (
                Cell(says=says),
                figure(metrics, f"{place}.points"),
                figure(metrics, f"{place}.measurements"),
                figure(metrics, f"{place}.mean_reprojection_error_px", "{:.2f} px"),
            )
        )
    return Table(
        caption="Table 2. The map",
        heads=("Seen by", "Points", "Measurements", "Mean reprojection error"),
        rows=tuple(rows),
        note="Pixels at the size the frames were worked at.",
    )


def _residuals(merge: Mapping[str, Any]) -> Table:
    metrics = {"merge": merge}
    most = max((each["residual_m"]["p95"] for each in merge.get("cameras", {}).values()), default=0.0)
    rows = []
    for name, each in merge.get("cameras", {}).items():
        place = f"merge.cameras.{name}"
        last = figure(metrics, f"{place}.residual_m.p95", "{:.2f} cm", 100.0)
        rows.append(
            (
                Cell(says=name),
                figure(metrics, f"{place}.measurements"),
                figure(metrics, f"{place}.dropped_as_gross_errors"),
                figure(metrics, f"{place}.down_weighted"),
                figure(metrics, f"{place}.longest_gap_s", "{:.2f} s"),
                figure(metrics, f"{place}.residual_m.p50", "{:.2f} cm", 100.0),
                Cell(**{**_fields(last), "share": each["residual_m"]["p95"] / most if most else 0.0}),
                figure(metrics, f"{place}.residual_deg.p95", "{:.2f}°"),
            )
        )
    heads = (
        "Camera",
        "Poses",
        "Dropped",
        "Weakened",
        "Longest gap",
        "Off, median",
        "Off, 95 %",
        "Turned, 95 %",
    )
    return Table(caption="Residual of each camera against the solved body", heads=heads, rows=tuple(rows))


def _gaps(merge: Mapping[str, Any], key: str, caption: str) -> Table:
    """Distances of each joint: median, and 95 % with a bar."""
    metrics, gaps = {"merge": merge}, merge.get(key, {})
    most = max((each["p95"] for each in gaps.values()), default=0.0)
    rows = []
    for role in gaps:
        last = figure(metrics, f"merge.{key}.{role}.p95", "{:.2f} mm", 1000.0)
        share = gaps[role]["p95"] / most if most else 0.0
        rows.append(
            (
                Cell(says=role),
                figure(metrics, f"merge.{key}.{role}.p50", "{:.2f} mm", 1000.0),
                Cell(**{**_fields(last), "share": share}),
            )
        )
    return Table(caption=caption, heads=("Joint", "Off, median", "Off, 95 %"), rows=tuple(rows))


def _mounts(merge: Mapping[str, Any]) -> Table:
    metrics = {"merge": merge}
    rows = []
    for name, mount in merge.get("mounts", {}).items():
        place = f"merge.mounts.{name}"
        rows.append(
            (
                Cell(says=name),
                Cell(says=str(mount["role"])),
                figure(metrics, f"{place}.roll_deg", "{:.0f}°"),
                figure(metrics, f"{place}.from_prior_deg", "{:.1f}°"),
                figure(metrics, f"{place}.from_prior_m", "{:.1f} cm", 100.0),
                figure(metrics, f"{place}.sigma_deg", "± {:.1f}°"),
                figure(metrics, f"{place}.sigma_m", "± {:.1f} cm", 100.0),
            )
        )
    heads = ("Camera", "On", "Roll", "Turned from assumed", "Moved from assumed", "Known to", "Known to")
    return Table(caption="Mounts found", heads=heads, rows=tuple(rows))


def _joined(merge: Mapping[str, Any]) -> Table:
    metrics = {"merge": merge}
    rows = tuple(
        (
            Cell(says=name),
            figure(metrics, f"merge.joined_cameras.{name}.sigma_deg", "± {:.1f}°"),
            figure(metrics, f"merge.joined_cameras.{name}.sigma_m", "± {:.1f} cm", 100.0),
        )
        for name in merge.get("joined_cameras", {})
    )
    return Table(
        caption="Cameras placed by the body alone",
        heads=("Camera", "Known to", "Known to"),
        rows=rows,
        note="Their map shares no view with the main one.",
    )


def _scale(merge: Mapping[str, Any]) -> Table:
    scale = merge.get("scale", {})
    rows = tuple(
        (
            *_source(merge, f"merge.scale.sources.{index}"),
            Cell(says="used" if source["used"] else "not used"),
        )
        for index, source in enumerate(scale.get("sources", ()))
    )
    return Table(
        caption="What the metric scale rests on",
        heads=("Source", "Known to", "Off the scale taken", ""),
        rows=rows,
        note=_agreement(scale),
    )


def _limbs(merge: Mapping[str, Any]) -> Table:
    limbs = merge.get("scale", {}).get("limbs", {})
    rows = tuple(
        _source(merge, f"merge.scale.limbs.alone.{index}") for index in range(len(limbs.get("alone", ())))
    )
    return Table(
        caption="The scale each limb alone would give",
        heads=("Limb", "Known to", "Off the scale taken"),
        rows=rows,
        note=_agreement(limbs),
    )


def _source(merge: Mapping[str, Any], place: str) -> tuple[Cell, ...]:
    metrics = {"merge": merge}
    return (
        Cell(says=str(look_up(metrics, f"{place}.name"))),
        figure(metrics, f"{place}.relative_sigma", "± {:.1%}"),
        figure(metrics, f"{place}.off", "{:+.1%}"),
    )


def _agreement(told: Mapping[str, Any]) -> str:
    """How far sources disagree, against what their own uncertainty lets expect."""
    freedom = told.get("degrees_of_freedom")
    if not freedom:
        return ""
    return f"χ² {told['chi2']:.1f}; about {freedom} is to be expected where all are right."


def _rules(merge: Mapping[str, Any]) -> Table:
    metrics, activity = {"merge": merge}, merge.get("activity", {})
    rows = []
    for name, share in activity.get("rules_active", {}).items():
        often = figure(metrics, f"merge.activity.rules_active.{name}", _share)
        pressed = name in activity.get("rules_pressed_m", {})
        place = f"merge.activity.rules_pressed_m.{name}"
        far = [figure(metrics, f"{place}.{q}", "{:.1f} cm", 100.0) for q in ("p50", "p95")]
        rows.append(
            (
                Cell(says=str(name)),
                Cell(**{**_fields(often), "share": float(share)}),
                *(far if pressed else (Cell(says="–"), Cell(says="–"))),
            )
        )
    return Table(
        caption="Soft rules: how often each one pressed, and how far off it was then",
        heads=("Rule", "Share of the time", "Median", "95 %"),
        rows=tuple(rows),
        note="A rule that presses all the time fights the measurements: check the mount and the activity.",
    )


def _sigma(inputs: ReportInputs) -> Table:
    sigma = None if inputs.merge is None else joint_sigma_m(inputs.merge)
    if inputs.merge is None or sigma is None:
        return Table(caption="", heads=(), rows=())
    rows = []
    known = np.isfinite(sigma).any(axis=0)
    most = float(np.nanpercentile(sigma[:, known], 95, axis=0).max()) if known.any() else 0.0
    for joint in np.flatnonzero(known):
        middle, high = np.nanpercentile(sigma[:, joint], [50, 95])
        share = float(high) / most if most else 0.0
        rows.append(
            (
                Cell(says=inputs.merge.skeleton.joints[joint]),
                Cell(says=f"{100 * middle:.1f} cm"),
                Cell(says=f"{100 * high:.1f} cm", share=share),
            )
        )
    return Table(
        caption="Uncertainty of each joint's position (one standard deviation)",
        heads=("Joint", "Median", "95 %"),
        rows=tuple(rows),
    )


def _fields(cell: Cell) -> dict[str, Any]:
    return {"says": cell.says, "metric": cell.metric, "value": cell.value}


def headline_figures(metrics: Mapping[str, Any]) -> Iterable[tuple[str, Cell]]:
    """The few figures that stand at the top of the page."""
    yield "frames registered", figure(metrics, "total.frames_registered")
    yield "of all frames", figure(metrics, "total.coverage", _share)
    yield "map error", figure(metrics, "total.mean_reprojection_error_px", "{:.2f} px")
    yield "points in the map", figure(metrics, "total.points")
    if "merge" in metrics:
        worst = max(
            metrics["merge"].get("cameras", {}).items(),
            key=lambda item: item[1]["longest_gap_s"],
            default=None,
        )
        if worst is not None:
            place = f"merge.cameras.{worst[0]}.longest_gap_s"
            yield "longest gap", figure(metrics, place, "{:.2f} s")
        yield "metric scale", figure(metrics, "merge.scale.relative_sigma", "± {:.1%}")
