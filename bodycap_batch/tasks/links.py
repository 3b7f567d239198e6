"""The task that compares the final poses of a camera with the tracks of its video."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bodycap_batch.core.context import StageContext
from bodycap_batch.formats.dataclass_files import read_dataclass
from bodycap_batch.model.path_uncertainty import path_uncertainty
from bodycap_batch.model.point_tracks import PointTracks
from bodycap_batch.model.scene import OtherPaths
from bodycap_batch.tasks.inputs import ArtefactRef
from bodycap_batch.tasks.loading import TRACKS, load_keyframes, load_map, load_registration
from bodycap_batch.tasks.registered_cameras import OTHER_PATHS
from bodycap_batch.tasks.stage import write_summary


@dataclass(frozen=True, slots=True, kw_only=True)
class LinksTask:
    """Compare the poses of one camera with the tracks of its video.

    Attributes:
        keyframes: The camera's selected keyframes, with the tracks.
        map: All maps.
        registration: The camera's final registration.
    """

    keyframes: ArtefactRef
    map: ArtefactRef
    registration: ArtefactRef


def run_links(task: LinksTask, context: StageContext, files: Path) -> None:
    """Store how many frames of each path the tracks confirm and contradict, and how certain the path is."""
    from bodycap_batch.evaluate.track_check import TrackedVideo, check_with_tracks, count_frames

    registration = task.registration.path
    path = load_registration(registration).trajectory
    paths = [path]
    if (registration / f"{OTHER_PATHS}.json").exists():
        paths += read_dataclass(OtherPaths, registration, OTHER_PATHS).trajectories
    certainty = path_uncertainty(path)
    found = {
        "frame": path.gauge,
        "posed": bool(path.localised.any()),
        "sigma": certainty["sigma"],
        "extent": certainty["extent"],
    }
    keyframes = task.keyframes.path
    if not (keyframes / f"{TRACKS}.json").exists():
        write_summary(files, links=[], **found)
        return
    tracks = read_dataclass(PointTracks, keyframes, TRACKS)
    chain, maps = load_keyframes(keyframes).rotation_chain, load_map(task.map.path).maps
    scenes = {scene.gauge: scene for scene in maps if tracks.camera in scene.cameras}

    def show(done: int, total: int) -> None:
        context.check_cancelled()
        context.progress(done, total, "frames compared")

    links = []
    for path in (each for each in paths if each.gauge in scenes and each.registered.any()):
        scene = scenes[path.gauge]
        video = TrackedVideo(
            tracks=tracks,
            lens=scene.cameras[path.camera],
            times_s=path.seconds,
            readout_s=scene.readout_s.get(path.camera, 0.0),
            rotation_chain=chain,
        )
        compared = check_with_tracks(video, path.gauge_from_cam, show)
        links.append({"frame": path.gauge, **count_frames(compared)})
    write_summary(files, links=links, **found)
