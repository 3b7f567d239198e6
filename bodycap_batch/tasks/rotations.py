"""The task that measures the rotations of a camera whose positions are not known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bodycap_batch.config.path_bounds import MAX_CONTRADICTED, MAX_UNCERTAINTY
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.mechanisms import Mechanism, record_act
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.scene import KeyframeSelection, Map, Trajectory
from bodycap_batch.tasks.inputs import ArtefactRef, CaptureRef
from bodycap_batch.tasks.loading import load_capture, load_keyframes, load_map, load_registration
from bodycap_batch.tasks.registered_cameras import replace_registration

_PROGRESS_FRAMES = 10
"""Number of frames between two reports of progress."""
_START_SIGMA = 0.3
"""Relative standard deviation of the focal length of a lens that is neither given nor measured: usual lenses
of worn cameras have 60° to 120°. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RotationsTask:
    """Measure the rotations of one camera, and withdraw its positions.

    Attributes:
        capture: The video of the camera.
        keyframes: The camera's selected keyframes, by camera name (one entry).
        map: All maps.
        registration: The camera's registration.
    """

    capture: CaptureRef
    keyframes: Mapping[str, ArtefactRef]
    map: ArtefactRef
    registration: ArtefactRef


def contradicted_share(links: Mapping[str, Any]) -> float:
    """Return the share of the compared frames of a camera, in all maps, that the video contradicts.

    Args:
        links: The summary of the stage `links`.
    """
    compared = sum(path["compared"] for path in links["links"])
    return float(sum(path["contradicted"] for path in links["links"]) / max(compared, 1))


def confirmed_frames(links: Mapping[str, Mapping[str, Any]]) -> int:
    """Return the number of compared frames that the videos confirm, of all cameras."""
    paths = [path for each in links.values() for path in each["links"]]
    return int(sum(path["compared"] - path["contradicted"] for path in paths))


def without_positions(links: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the names of the cameras whose positions say nothing.

    Their path has no pose, the video contradicts it, or its positions are as uncertain as it is long. Poses
    of further maps, whose place is unknown, do not count.

    Args:
        links: The summaries of the stage `links`, by camera name.
    """
    longest = dict[str, float]()
    for each in links.values():
        longest[each["frame"]] = max(longest.get(each["frame"], 0.0), each["extent"] or 0.0)
    out = []
    for name, each in links.items():
        is_noise = (each["sigma"] or 0.0) > MAX_UNCERTAINTY * longest[each["frame"]]
        if not each["posed"] or is_noise or contradicted_share(each) > MAX_CONTRADICTED:
            out.append(name)
    return sorted(out)


def run_rotations(task: RotationsTask, context: StageContext, files: Path) -> None:
    """Store the camera's registration with its rotations alone; as it was if the camera moves."""
    from bodycap_batch.tracks import measure_pure_rotation, rotations_alone, track_video

    camera = load_capture(task.capture, task.keyframes, threads=context.threads).cameras[0]
    selection = load_keyframes(task.keyframes[camera.name].path)
    before = load_registration(task.registration.path)
    scene = _map_of(task.map.path, before.trajectory)

    def show(done: int, total: int) -> None:
        context.check_cancelled()
        if done % _PROGRESS_FRAMES == 0:
            context.progress(done, total, "frames followed")

    tracks = track_video(camera, show)
    if len(selection.moving_regions):
        tracks = tracks.outside(selection.moving_regions)
    context.progress(0, 0, "measuring how the camera turns")
    lens, lens_sigma = lens_for_rotations(camera.camera, selection)
    turn = measure_pure_rotation(tracks, lens.scaled(tracks.width_px, tracks.height_px), lens_sigma)
    record_act(Mechanism.PURE_ROTATION, int(turn is not None))
    found = before
    if turn is not None:
        found = replace(before, trajectory=rotations_alone(before.trajectory, turn, scene))
    replace_registration(found, task.registration.path, files)


def _map_of(path: Path, trajectory: Trajectory) -> Map | None:
    """Return the map of a path, or the empty map; None if no map contains the camera."""
    maps = load_map(path).maps
    return next((each for each in maps if each.gauge == trajectory.gauge or not each.keyframe_camera), None)


def lens_for_rotations(start: Camera, selection: KeyframeSelection) -> tuple[Camera, float]:
    """Return the lens of the camera and the relative sigma of its focal length."""
    if not start.refine:
        return start, 0.0
    return (
        (start, _START_SIGMA) if selection.lens is None else (selection.lens.lens, selection.lens.focal_sigma)
    )
