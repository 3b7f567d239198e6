"""Read the values of the criteria from the metrics. The table of the criteria gives bounds and texts."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from bodycap_batch.core.percent import format_percent
from bodycap_batch.model.camera_clock import ESTIMATED_SOURCES
from bodycap_batch.model.map_diagnostics import MapDiagnostics
from bodycap_batch.model.relative_pose import MIN_INSTANTS
from bodycap_batch.model.skeleton_presets import split_side
from bodycap_batch.report.grades import Grade
from bodycap_batch.report.metric_paths import metric_at, metric_path

Metrics = Mapping[str, Any]
"""The content of ``metrics.json``."""

_TWISTING_SEGMENT = "ForeArm"
"""Name of the segment that twists: a camera at the wrist rotates relative to one near the elbow."""
_MAX_MEAN_POSTURE_SIGMAS = 0.6
"""Maximum distance of the mean posture from the rest pose that is not poor, in sigmas of the everyday range.
Evidence: docs/decisions/report.md."""
_TRUSTED_LENS_ERROR_PX = 1.0
"""Maximum mean reprojection error with which lenses that were estimated with the map count as corrected. A
wrong camera model leaves a larger error. Evidence: docs/decisions/report.md."""
_BODY_HEIGHT_M = 1.7
"""Body height (metres) with which an error of the scale is shown. Source: `MEAN_HEIGHT_M`."""
ADVICE_SEPARATOR = "; to reduce this, "
"""Text that separates the finding from the advice in the sentences that merging gives."""
_LIMBS = {"Shoulder": "arm", "Arm": "arm", "ForeArm": "arm", "Hand": "arm", "Neck": "head", "Head": "head"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """What a criterion reads from the metrics.

    Attributes:
        value: The value; None if the criterion is not numerical.
        metric: Dotted path of the value in ``metrics.json``; "" if it is derived from several values.
        words: Values of the placeholders in the texts of the criterion.
        best: The grade is not better than this, whatever the value is.
        worst: The grade is not worse than this, whatever the value is.
    """

    value: float | None = None
    metric: str = ""
    words: Mapping[str, Any] = field(default_factory=dict)
    best: Grade = Grade.GOOD
    worst: Grade = Grade.POOR


Reader = Callable[[Metrics], Reading | None]
"""Function that reads the value of a criterion; it returns None if the metrics hold no such value."""


def _largest(items: Iterable[tuple[str, Any]], key: Callable[[Any], float]) -> tuple[str, Any]:
    """Return the entry with the largest key; ("", None) without entries."""
    return max(items, key=lambda item: key(item[1]), default=("", None))


def at(path: str) -> Reader:
    """Return a function that reads the number at a path in ``metrics.json``."""

    def read(metrics: Metrics) -> Reading | None:
        value = metric_at(metrics, path)
        return None if value is None else Reading(value=float(value), metric=path)

    return read


def largest(group: str, *keys: str, where: Callable[[Any], Any] = bool) -> Reader:
    """Return a function that reads the largest value in a group, and the name of its entry.

    Args:
        group: Path of a mapping in ``metrics.json``.
        keys: Keys of the value in an entry. An entry without a value is ignored.
        where: Returns whether an entry counts.
    """

    def read(metrics: Metrics) -> Reading | None:
        path = metric_path(*keys)
        entries = {name: each for name, each in (metric_at(metrics, group) or {}).items() if where(each)}
        values = {
            name: value for name, each in entries.items() if (value := metric_at(each, path)) is not None
        }
        name, value = _largest(values.items(), float)
        if value is None:
            return None
        place = f"{group}.{metric_path(name, *keys)}"
        return Reading(value=float(value), metric=place, words={"name": name, **entries[name]})

    return read


def says(path: str) -> Reader:
    """Return a function that reads a finding that merging states in words."""

    def read(metrics: Metrics) -> Reading | None:
        found = metric_at(metrics, path)
        return (
            Reading(words={**found, "names": " and ".join(sorted(found.get("cameras", ())))})
            if found
            else None
        )

    return read


def read_scale_sources(metrics: Metrics) -> Reading | None:
    """Read how probable the disagreement between the scales is, if all scales are correct."""
    scale = metric_at(metrics, "merge.scale") or {}
    freedom = int(scale.get("degrees_of_freedom") or 0)
    if freedom < 1:
        return None
    from scipy.special import chdtrc  # scipy.stats takes a second to import.

    return Reading(
        value=float(chdtrc(freedom, float(scale["chi2"]))),
        words={
            "sources": " and ".join(source["name"] for source in scale.get("sources", ())),
            "chi2": float(scale["chi2"]),
            "freedom": f"{freedom} {'degree' if freedom == 1 else 'degrees'}",
        },
    )


def main_cameras(metrics: Metrics) -> dict[str, Any]:
    """Return the metrics of the cameras that have a path in the main frame, by camera name."""
    return {
        name: camera
        for name, camera in metrics["cameras"].items()
        if camera["frame"] == metrics["frame"] and camera["frames_registered"]
    }


def cameras_in_own_maps(metrics: Metrics) -> set[str]:
    """Return the names of the cameras whose map is not the main map."""
    frames = {model["frame"] for model in metrics.get("models", ())} - {metrics["frame"]}
    return {name for name, camera in metrics["cameras"].items() if camera["frame"] in frames}


def unknown_clocks(metrics: Metrics) -> list[str]:
    """Return the names of the cameras with an unknown clock."""
    return sorted(name for name, clock in metrics.get("clocks", {}).items() if clock["source"] == "none")


def clock_notes(metrics: Metrics, cameras: Iterable[str]) -> str:
    """Return the notes about the clocks of some cameras as one text."""
    notes = metrics.get("clock_notes", {})
    return "; ".join(f"{name}: {note}" for name in cameras for note in notes.get(name, ()))


def diagnostics(metrics: Metrics) -> MapDiagnostics:
    """Return mapping's diagnostics."""
    return MapDiagnostics.from_log(metrics.get("mapping", {}))


def as_sentence(text: str) -> str:
    """Return a text with a capital letter and a full stop; "" stays empty."""
    if not text:
        return ""
    return f"{text[:1].upper()}{text[1:]}{'' if text.endswith(('.', '!', '?')) else '.'}"


def read_path_uncertainty(metrics: Metrics) -> Reading | None:
    """Read the largest sigma of a path, as a share of the extent of the longest path."""
    cameras = {
        name: camera
        for name, camera in main_cameras(metrics).items()
        if camera.get("sigma") is not None and camera["extent"]
    }
    name, worst = _largest(cameras.items(), lambda camera: float(camera["sigma"]))
    if worst is None:
        return None
    share = float(worst["sigma"]) / max(float(camera["extent"]) for camera in cameras.values())
    return Reading(value=share, words={"camera": name, "percent": f"{100 * share:.2g} %"})


def read_rotation_only(metrics: Metrics) -> Reading | None:
    """Read which cameras have rotations without positions, and the largest sigma of a rotation per axis."""
    found = {
        name: float(camera["sigma_deg"]) / 3**0.5
        for name, camera in metrics["cameras"].items()
        if camera.get("frames_rotation_only")
    }
    if not found:
        return None
    return Reading(words={"cameras": ", ".join(sorted(found)), "sigma": max(found.values())})


def read_links(metrics: Metrics) -> Reading | None:
    """Read the largest share of a camera's frames, in all maps, that the tracks of its video contradict."""
    shares = {
        name: sum(path["contradicted"] for path in paths) / compared
        for name, paths in metrics.get("mapping", {}).get("links", {}).items()
        if (compared := sum(path["compared"] for path in paths))
    }
    name, share = _largest(shares.items(), float)
    if share is None:
        return None
    numbers = {frame: n for n, frame in enumerate(dict.fromkeys(each["frame"] for each in metrics["models"]))}
    where = [
        "frames {} to {}".format(*path["contradicted_frames"])
        + (f" in map_{number}" if (number := numbers.get(path["frame"], 0)) else "")
        for path in metrics["mapping"]["links"][name]
        if path["contradicted"]
    ]
    words = {"camera": name, "where": f" ({'; '.join(where)})" if where else ""}
    return Reading(value=share, metric=metric_path("mapping", "links", name), words=words)


def read_unconfirmed(metrics: Metrics) -> Reading | None:
    """Read how many points were left out because no later view confirms them, per point of the maps."""
    removed, kept = metrics.get("mapping", {}).get("unconfirmed_points"), metrics["total"].get("points")
    if removed is None or not kept:
        return None
    return Reading(value=int(removed) / int(kept), words={"removed": int(removed), "kept": int(kept)})


def read_misplaced(metrics: Metrics) -> Reading | None:
    """Read the share of one camera's keyframes that were left out because they contradict the map."""
    found = {name: frames for name, frames in diagnostics(metrics).misplaced.items() if frames}
    shares = {
        name: len(frames) / (len(frames) + int(metrics["cameras"][name]["keyframes"]))
        for name, frames in found.items()
        if name in metrics["cameras"]
    }
    name, share = _largest(shares.items(), float)
    if share is None:
        return None
    frames = found[name]
    if len(frames) == 1:
        what, was = f"one keyframe ({format_percent(share, 1)}) contradicts", "was"
        where = f"frame {frames[0]}"
    else:
        what, was = f"{len(frames)} keyframes ({format_percent(share, 1)}) contradict", "were"
        where = f"frames {min(frames)} to {max(frames)}"
    words = {"camera": name, "what": what, "was": was, "where": where}
    # A single keyframe of a right map can contradict it, for example a blurred one.
    return Reading(value=share, words=words, worst=Grade.GOOD if len(frames) == 1 else Grade.POOR)


def read_joined_cameras(metrics: Metrics) -> Reading | None:
    """Read which cameras only the body's movement places in the room."""
    joined = sorted(metrics.get("merge", {}).get("joined_cameras", {}))
    return Reading(words={"cameras": ", ".join(joined)}) if joined else None


def read_reach(metrics: Metrics) -> Reading | None:
    """Read the share of the distances between cameras that are within the body's reach."""
    reach = diagnostics(metrics).reach
    if not reach or "within_reach" not in reach:
        return None
    share = float(reach["within_reach"])
    unused = sorted(metrics.get("merge", {}).get("unused_cameras", {}))
    doubt = "" if reach["judged"] else ", even with the best scale"
    if unused and share < 1.0:
        doubt += f", including cameras that are not part of the body ({' and '.join(unused)})"
    elif not reach["judged"]:
        doubt += "; the body, the clocks or the map are wrong"
    return Reading(
        value=share,
        metric="mapping.reach.within_reach",
        words={"percent": format_percent(share, 1), "distances": reach["distances"], "doubt": doubt},
        worst=Grade.FAIR if unused else Grade.POOR,
    )


def read_shared_segment(metrics: Metrics) -> Reading | None:
    """Read the relative rotation (degrees) of cameras on one bone that noise does not explain."""
    merge = metrics.get("merge", {})
    unused, mounts = set(merge.get("unused_cameras", {})), merge.get("mounts", {})
    found = []
    for pair in metrics.get("relative_poses", ()):
        if pair["instants"] < MIN_INSTANTS or pair["spread_deg"] is None or {*pair["cameras"]} & unused:
            continue
        explained = pair["explained_deg"] or 0.0
        rest = 0.0 if pair["rigid"] else math.sqrt(max(0.0, pair["spread_deg"] ** 2 - explained**2))
        roles = {split_side(mounts[name]["role"])[1] for name in pair["cameras"] if name in mounts}
        found.append((_TWISTING_SEGMENT not in roles, rest, pair))
    # Cameras on a bone that does not twist come first: their rotation has no other explanation.
    stiff, rest, worst = max(found, key=lambda entry: entry[:2], default=(False, 0.0, None))
    if worst is None:
        return None
    return Reading(
        value=rest,
        words={
            "cameras": " and ".join(worst["cameras"]),
            "spread": worst["spread_deg"],
            "instants": worst["instants"],
            "noise": float(worst["explained_deg"] or 0.0),
        },
        worst=Grade.POOR if stiff else Grade.FAIR,
    )


def read_lenses(metrics: Metrics) -> Reading | None:
    """Read the largest relative error of a given focal length, according to the map."""
    found, error = diagnostics(metrics), metrics["total"]["mean_reprojection_error_px"]
    misfits = dict(found.misfit_factors or {})
    trusted = error is not None and float(error) <= _TRUSTED_LENS_ERROR_PX
    wrong = {name: each for name, each in misfits.items() if not (trusted and name in found.recalibrated)}
    name, factor = _largest((wrong or misfits).items(), lambda each: abs(each - 1.0))
    if factor is None:
        return None
    then = "" if wrong else "; therefore the lens was estimated together with the map"
    return Reading(
        value=abs(float(factor) - 1.0),
        words={
            "camera": name,
            "lens": _lens_that_fits(factor),
            "then": then,
            "lenses": "; ".join(f"{each} has {_lens_that_fits(misfits[each])}" for each in sorted(misfits)),
        },
        # The map can contradict a lens with a correct focal length.
        best=Grade.FAIR,
        worst=Grade.POOR if wrong else Grade.FAIR,
    )


def _lens_that_fits(factor: float) -> str:
    """Describe the lens that fits the pictures by the ratio of its focal length to the given one."""
    percent = round(100 * abs(factor - 1.0))
    # The ratio can be 1 if only the principal point is wrong.
    return (
        f"a focal length {percent} % {'longer' if factor > 1.0 else 'shorter'}" if percent else "another lens"
    )


read_frozen = largest(
    "cameras", "status", "FROZEN", where=lambda camera: camera.get("status", {}).get("FROZEN")
)


def read_skeleton(metrics: Metrics) -> Reading | None:
    """Read what is uncertain about the skeleton file."""
    skeleton = metrics["merge"].get("skeleton")
    if not skeleton:
        return None
    says = "; ".join((*skeleton["warnings"], *skeleton["notes"]))
    return Reading(words={"says": says}, worst=Grade.FAIR if skeleton["warnings"] else Grade.GOOD)


def read_scale(metrics: Metrics) -> Reading | None:
    """Read the relative sigma of the metric scale, and what would reduce it."""
    merge = metrics["merge"]
    scale = merge.get("scale", {})
    sigma = scale.get("relative_sigma")
    if sigma is None:
        return None
    used = {source["name"] for source in scale.get("sources", ()) if source["used"]}
    how = [
        "for a distance, `merge: {known_distance: [torso:0, torso:120, 2.50]}` in the job file, the metres "
        "between the camera's places in two frames",
        "for a board, `merge: {marker_board: {square_m: 0.1, columns: 7, rows: 5}}`",
    ]
    if len({mount["role"] for mount in merge.get("mounts", {}).values()}) == 1:
        action = "wear a camera on another bone as well (a hand, an upper arm or the head)"
    elif used & {"known distance", "marker board"}:
        action = ""
    elif "mean stature" in used:
        action = "give the height of the person, or put a board of printed squares on the floor"
        how.insert(0, "for the height, `--height 1.75`")
    else:
        action = "put a board of printed squares on the floor, or measure how far the person walks"
    if "skeleton" not in used:
        how.append("the person's own skeleton (`--skeleton subject.bvh`) is more accurate than the height")
    t_pose = "" if merge.get("t_pose") or not action else ", or stand in a T-pose for two seconds first"
    return Reading(
        value=float(sigma),
        metric="merge.scale.relative_sigma",
        words={
            "percent": format_percent(sigma, 1),
            "height": f"{100.0 * _BODY_HEIGHT_M * sigma:.0f} cm",
            "action": as_sentence(f"{action}{t_pose}"),
            "how": as_sentence("; ".join(how)) if action else "",
        },
    )


def read_mounts(metrics: Metrics) -> Reading | None:
    """Read the largest sigma (degrees) of a mount's rotation, and what would reduce it."""
    reading = largest("merge.mounts", "sigma_deg")(metrics)
    if reading is None:
        return None
    advice = str(reading.words.get("known_to", "")).partition(ADVICE_SEPARATOR)[2]
    measure = f"measure how {reading.words['name']} sits on its bone"
    words = {
        "action": as_sentence(f"at the start of the take, {advice}" if advice else measure),
        "how": f"{f'Or {measure}, and give' if advice else 'Give'} it in the job file: `joint_from_cam` of "
        "the camera.",
    }
    return replace(reading, words={**reading.words, **words})


def read_postures(metrics: Metrics) -> Reading | None:
    """Read the distance of the postures from the rest pose, in sigmas of the everyday range."""
    sigmas = metrics["merge"].get("posture_sigmas", {})
    means = metrics["merge"].get("mean_posture_sigmas", {})
    if not sigmas:
        return None
    limbs: dict[str, list[float]] = {}
    for role, value in sigmas.items():
        side, part = split_side(role)
        limb = _LIMBS.get(part, "leg" if side else "trunk")
        limbs.setdefault(f"{side.lower()} {limb}".strip(), []).append(value)
    worst = max(limbs, key=lambda limb: (_rms(limbs[limb]), limb))
    mean = f" ({_rms(means.values()):.2f} in the mean over the capture)" if means else ""
    is_rare = _rms(means.values()) > _MAX_MEAN_POSTURE_SIGMAS
    return Reading(
        value=_rms(sigmas.values()),
        words={"mean": mean, "limb": worst},
        best=Grade.POOR if is_rare else Grade.GOOD,
    )


def _rms(values: Iterable[float]) -> float:
    squares = [value**2 for value in values]
    return math.sqrt(sum(squares) / max(1, len(squares)))


def read_contradicted_clocks(metrics: Metrics) -> Reading | None:
    """Read which stated clocks the recordings contradict."""
    names = metrics.get("contradicted_clocks", ())
    return Reading(words={"notes": clock_notes(metrics, names)}) if names else None


def read_clock(metrics: Metrics) -> Reading | None:
    """Read the largest sigma (seconds) of an estimated clock offset."""
    read = largest("clocks", "sigma_s", where=lambda clock: clock["source"] in ESTIMATED_SOURCES)
    return None if metrics.get("contradicted_clocks") else read(metrics)
