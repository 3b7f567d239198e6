"""What to change next time: plain sentences, each tied to something that was measured in this job."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.percent import percent
from bodycap_batch.model.map_diagnostics import MapDiagnostics
from bodycap_batch.model.scene import Map
from bodycap_batch.report.inputs import ReportInputs
from bodycap_batch.report.losses import Cause
from bodycap_batch.report.placing import common_times_s
from bodycap_batch.report.verdict import other_lens

_MATTERS = 0.02
"""Share of all frames from which a cause is worth a change of habit."""
_FORWARD_DEG = 25.0
_FORWARD_SHARE = 0.6
_THIN_LINK = 0.03
_END_S = 0.6
"""From here on the verdict calls a gap poor."""
_NARROW_DEG = 3.0
_SCALE_WELL_KNOWN, _MOUNT_WELL_KNOWN_DEG, _ARM_M = 0.02, 4.0, 0.6
_T_POSE = re.compile(r",? or stand in a T-pose for two seconds first")
_BETTER = "; to know it better, "
"""Where merging's sentence about a constant turns to what would help."""

_DO = {
    Cause.DARK: "Switch lights on or film by day, and keep sleeves and straps away from the lens.",
    Cause.FAST: "Turn and swing more slowly, or film at 60 frames per second or more.",
    Cause.BLUR: "Use more light and a shutter of 1/240 s or shorter: sharp frames at high gain beat "
    "smooth ones.",
    Cause.PLAIN: "Put up posters or patterned cloth where the cameras look, or turn the cameras away "
    "from plain walls and ceilings.",
    Cause.SHALLOW: "Turn the camera so that it sees something near as well as something far, spread over the "
    "whole picture.",
    Cause.UNKNOWN_PLACE: "Turn the camera so that less of the own body is in its picture, keep other people "
    "out, and walk past each place more than once.",
    Cause.NO_MAP: "Let every camera see the same places as the others: walk a loop and look around "
    "in each place.",
}
_WAS = {
    Cause.DARK: "hardly any light reached the camera",
    Cause.FAST: "the camera turned more than 8° from one frame to the next",
    Cause.BLUR: "the picture was blurred (sharpness below 60 % of the frames beside it)",
    Cause.PLAIN: "the camera looked at plain surfaces (under 30 % of its usual corners)",
    Cause.SHALLOW: "the points in view did not fix the position (too far, or bunched together)",
    Cause.UNKNOWN_PLACE: "the picture was sharp and textured, but it showed what the map does not hold",
    Cause.NO_MAP: "the camera has no map to stand on",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Advice:
    """One change.

    Attributes:
        do: What to do.
        because: What was measured.
        weight: Larger comes first.
    """

    do: str
    because: str
    weight: float


def advise(inputs: ReportInputs, lost: Mapping[str, Counter[Cause]]) -> list[Advice]:
    """What would have helped most, first.

    Args:
        inputs: The results.
        lost: Lost frames by camera and cause.
    """
    found = [
        *_of_losses(inputs, {name: each for name, each in lost.items() if name not in _mirrored(inputs)}),
        *_of_mirrored(inputs),
        *_of_lenses(inputs),
        *_of_overlap(inputs),
        *_of_motion(inputs),
        *_of_ends(inputs),
        *_of_body(inputs),
    ]
    return sorted(_t_pose_once(found), key=lambda each: -each.weight)


def _t_pose_once(found: Sequence[Advice]) -> list[Advice]:
    """A T-pose helps several constants at once: said once, before what else each of them would take."""
    helped = [each for each in found if _T_POSE.search(each.do)]
    if len(helped) < 2:
        return list(found)
    others = [replace(each, do=_T_POSE.sub("", each.do)) if each in helped else each for each in found]
    once = Advice(
        do="Stand still for two seconds before you start, arms stretched out to the sides (a T-pose): it "
        "tells more of every constant below that is not well known.",
        because=f"no T-pose was seen, and {len(helped)} of the body's constants are not well known",
        weight=max(each.weight for each in helped) + 1e-3,
    )
    return [*others, once]


def _map_diagnostics(inputs: ReportInputs) -> MapDiagnostics:
    """Return what mapping reports, from the metrics; empty without metrics."""
    return MapDiagnostics.from_log((inputs.metrics or {}).get("mapping", {}))


def _mirrored(inputs: ReportInputs) -> Sequence[str]:
    """Cameras that the map left out for it."""
    return _map_diagnostics(inputs).flipped_cameras


def _of_mirrored(inputs: ReportInputs) -> Iterator[Advice]:
    """A flipped picture: nothing that is done in front of the camera mends it."""
    if names := _mirrored(inputs):
        yield Advice(
            do=f"Flip the video of {', '.join(names)} back (ffmpeg -i in -vf hflip out.mp4), and switch the "
            "mirroring of the front camera or the app off.",
            because="it shows what the other cameras see with left and right exchanged, and was left out",
            weight=3.0,
        )
    for one, other in _map_diagnostics(inputs).undecided_groups:
        yield Advice(
            do=f"See whether text reads backwards in the video of {', '.join(one)} or {', '.join(other)}: "
            "flip that one back (ffmpeg -i in -vf hflip out.mp4). If none does, cover wall mirrors.",
            because="they see mirror images of each other, and nothing tells which is right",
            weight=3.0,
        )


def _of_lenses(inputs: ReportInputs) -> Iterator[Advice]:
    """Calibrations that the map contradicts: nothing else can be right before they are."""
    misfits = _map_diagnostics(inputs).misfit_factors
    if misfits:
        fits = "; ".join(f"{name} has {other_lens(factor)}" for name, factor in sorted(misfits.items()))
        yield Advice(
            do="Run again with `calibration: auto`, or calibrate in the mode that was filmed in, with "
            "stabilisation and digital zoom off.",
            because=f"by the pictures, {fits} than the calibration says",
            weight=3.0,
        )


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}{'' if text.endswith(('.', '!', '?')) else '.'}"


def _of_losses(inputs: ReportInputs, lost: Mapping[str, Counter[Cause]]) -> Iterator[Advice]:
    total = sum(len(each.trajectory.status) for each in inputs.registrations)
    if not total:
        return
    everywhere: Counter[Cause] = sum(lost.values(), Counter())
    for cause, frames in everywhere.most_common():
        if frames < _MATTERS * total:
            continue
        where = [f"{counts[cause]} of {name}" for name, counts in sorted(lost.items()) if counts[cause]]
        because = f"{frames} frames were lost where {_WAS[cause]} ({', '.join(where)})"
        yield Advice(do=_DO[cause], because=because, weight=1.0 + frames / total)


def shared_points(maps: tuple[Map, ...], cameras: tuple[str, ...]) -> IntArray:
    """(C,C) points of the maps that both cameras see; the diagonal counts a camera's own."""
    out = np.zeros((len(cameras), len(cameras)), dtype=np.int64)
    number = {name: index for index, name in enumerate(cameras)}
    for scene in maps:
        owner = np.array([number.get(name, -1) for name in scene.keyframe_camera], dtype=np.int64)
        seen = np.zeros((len(scene.points), len(cameras)), dtype=np.int64)
        owners = owner[scene.obs_keyframe]
        seen[scene.obs_point[owners >= 0], owners[owners >= 0]] = 1
        out += seen.T @ seen
    return out


def _of_overlap(inputs: ReportInputs) -> Iterator[Advice]:
    if len(inputs.cameras) < 2 or not inputs.maps:
        return
    shared = shared_points(inputs.maps, inputs.cameras)
    for index, name in enumerate(inputs.cameras):
        own = int(shared[index, index])
        best = int(np.delete(shared[index], index).max(initial=0))
        if own and best < _THIN_LINK * own:
            yield Advice(
                do=f"Let {name} see what the other cameras see: hold it forward for a few steps, and walk "
                "the same places twice.",
                because=f"it shares only {best:,} of its {own:,} points with any other camera",
                weight=1.5,
            )


def _of_motion(inputs: ReportInputs) -> Iterator[Advice]:
    forward = []
    for registration in inputs.registrations:
        poses = registration.trajectory.gauge_from_cam[registration.trajectory.localised]
        # A tenth of a walk's steps: enough for a direction above the noise of neighbouring frames.
        step = max(1, len(poses) // 40)
        move = poses[step::step, :3, 3] - poses[:-step:step, :3, 3][: len(poses[step::step])]
        length = np.linalg.norm(move, axis=1)
        axis = poses[:-step:step, :3, 2][: len(move)]
        cosine = np.abs((move * axis).sum(axis=1)) / np.maximum(length, 1e-12)
        moving = length > 0.2 * np.median(length) if len(length) else np.zeros(0, dtype=bool)
        if moving.sum() >= 5:
            forward.append(float((cosine[moving] > np.cos(np.radians(_FORWARD_DEG))).mean()))
    narrow = _median_triangulation_deg(inputs.maps[0]) if inputs.maps else None
    straight = bool(forward) and min(forward) > _FORWARD_SHARE
    if straight or (narrow is not None and narrow < _NARROW_DEG):
        angle = "" if narrow is None else f"half of the map's points are seen under less than {narrow:.1f}°"
        along = (
            f"every camera moved along its own line of sight {percent(min(forward))} of the way"
            if straight
            else ""
        )
        yield Advice(
            do="Start with a few steps to the side and an arc around something near: depth comes from "
            "sideways movement.",
            because=" and ".join(part for part in (along, angle) if part),
            weight=1.2,
        )


def _of_ends(inputs: ReportInputs) -> Iterator[Advice]:
    """Cameras that were not there yet when the motion begins, or no longer when it ends."""
    merge = inputs.merge
    if merge is None or not merge.trajectories:
        return
    ends = merge.times_ns()[[0, -1]] * 1e-9
    seen = {}
    for path in merge.trajectories:
        times = common_times_s(inputs, path.camera, path.times_ns)[path.localised]
        if len(times):
            seen[path.camera] = (float(times[0]), float(times[-1]))
    late = {name: first for name, (first, _) in seen.items() if first - ends[0] > _END_S}
    early = {name: last for name, (_, last) in seen.items() if ends[1] - last > _END_S}
    cuts = [f"start_s: {max(late.values()):.2f}"] if late else []
    cuts += [f"end_s: {min(early.values()):.2f}"] if early else []
    missing = [f"{name} has no measurement before {time:.2f} s" for name, time in late.items()]
    missing += [f"{name} has no measurement after {time:.2f} s" for name, time in early.items()]
    # One camera may have ended before another began: no cut helps then.
    left = min(early.values(), default=ends[1]) - max(late.values(), default=ends[0])
    cut = f"; this capture can be cut with {' and '.join(cuts)} under `capture`" if left > 0.0 else ""
    if missing:
        yield Advice(
            do=f"Start all cameras before the movement and stop them after it{cut}.",
            because=f"the motion runs from {ends[0]:.2f} s to {ends[1]:.2f} s, but {', '.join(missing)}",
            weight=1.4,
        )


def _median_triangulation_deg(scene: Map) -> float | None:
    """Median over points of the widest angle between the rays of its first and any other observation."""
    if len(scene.obs_point) == 0:
        return None
    rays = scene.map_from_cam[scene.obs_keyframe, :3, 3] - scene.points[scene.obs_point]
    rays = rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    order = np.argsort(scene.obs_point, kind="stable")
    point = scene.obs_point[order]
    first = order[np.searchsorted(point, point)]
    cosine = np.clip((rays[order] * rays[first]).sum(axis=1), -1.0, 1.0)
    widest = np.full(len(scene.points), 1.0)
    np.minimum.at(widest, point, cosine)
    return float(np.degrees(np.arccos(np.median(widest[np.unique(point)]))))


def _of_body(inputs: ReportInputs) -> Iterator[Advice]:
    """What the solver itself says would make a constant better known."""
    if inputs.merge is None:
        return
    report: Mapping[str, Any] = inputs.merge.report
    sides = report.get("exchanged_sides", {})
    if sides:
        yield Advice(
            do="Exchange the names (or mounts) of the left and the right cameras, and run again.",
            because=str(sides["says"]),
            weight=2.8,
        )
    clocks = report.get("doubted_clocks", {})
    if clocks:
        offsets = ", ".join(
            f"about {doubt['offset_s']:.1f} for {name}" for name, doubt in sorted(clocks.items())
        )
        yield Advice(
            do="Clap once in view of all cameras and state each one's `offset_s` (the time of the clap in "
            f"the first video less that in this one), or try {offsets}.",
            because="; ".join(str(doubt["says"]) for _, doubt in sorted(clocks.items())),
            weight=2.5,
        )
    scale = report.get("scale", {})
    sigma = scale.get("relative_sigma")
    if sigma is not None and sigma > _SCALE_WELL_KNOWN:
        _, _, better = str(scale.get("known_to", "")).partition(_BETTER)
        ways = [better] if better else []
        if all(source["name"] != "skeleton" for source in scale.get("sources", ())):
            ways.append("give the subject's own skeleton (--skeleton subject.bvh)")
        if ways:
            yield Advice(
                do=_sentence(", or ".join(ways)),
                because=f"the metric scale rests on the {scale.get('source')} and is known to {sigma:.1%}: "
                f"{100 * _ARM_M * sigma:.1f} cm on the length of an arm",
                weight=1.1 + sigma,
            )
    for hinge in report.get("loose_hinges", {}).values():
        known, _, way = str(hinge["known_to"]).partition(_BETTER)
        yield Advice(do=_sentence(way), because=known, weight=1.1 + hinge["sigma_m"])
    for name, mount in report.get("mounts", {}).items():
        known, _, way = str(mount.get("known_to", "")).partition(_BETTER)
        if way or mount["sigma_deg"] > _MOUNT_WELL_KNOWN_DEG:
            state = f"state how {name} sits, measured (joint_from_cam)"
            yield Advice(
                do=_sentence(f"{way}; or {state}" if way else state),
                because=known if way else f"the mount of {name} is known to {mount['sigma_deg']:.0f}° only",
                weight=1.0 + mount["sigma_deg"] / 1000.0,
            )
