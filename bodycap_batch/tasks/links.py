"""The task that compares the final poses of a camera with the tracks of its video."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bodycap_batch.config.path_bounds import MAX_WITHDRAWN
from bodycap_batch.core.context import StageContext
from bodycap_batch.tasks.inputs import ArtefactRef
from bodycap_batch.tasks.loading import TRACKS, load_keyframes, load_map, load_registration
from bodycap_batch.tasks.registered_cameras import OTHER_PATHS, replace_registration
from bodycap_batch.tasks.stage import Stage, write_summary


@dataclass(frozen=True, slots=True, kw_only=True)
class LinksTask:
    """Compare the poses of one camera with the tracks of its video, and withdraw those that they contradict.

    Attributes:
        keyframes: The camera's selected keyframes, with the tracks.
        map: All maps.
        registration: The camera's final registration.
    """

    keyframes: ArtefactRef
    map: ArtefactRef
    registration: ArtefactRef


def run_links(task: LinksTask, context: StageContext, files: Path) -> None:
    """Store what the tracks show about each path, and the registration if poses of it are withdrawn.

    The summary holds how many frames of each path the tracks confirm and contradict, and how certain the path
    is. It counts the poses before those that are contradicted were withdrawn.
    """
    from dataclasses import replace

    import numpy as np

    from bodycap_batch.core.mechanisms import Mechanism, is_on, record_act
    from bodycap_batch.evaluate.track_check import (
        TrackedVideo,
        check_with_tracks,
        contradicted_frames,
        count_frames,
    )
    from bodycap_batch.formats.dataclass_files import read_dataclass, write_dataclass
    from bodycap_batch.model.path_uncertainty import path_uncertainty
    from bodycap_batch.model.point_tracks import PointTracks
    from bodycap_batch.model.scene import FrameStatus, OtherPaths

    before = task.registration.path
    registration = load_registration(before)
    paths = [registration.trajectory]
    if (before / f"{OTHER_PATHS}.json").exists():
        paths += read_dataclass(OtherPaths, before, OTHER_PATHS).trajectories
    certainty = path_uncertainty(paths[0])
    found = {
        "frame": paths[0].gauge,
        "posed": bool(paths[0].localised.any()),
        "sigma": certainty["sigma"],
        "extent": certainty["extent"],
    }
    keyframes = task.keyframes.path
    if not (keyframes / f"{TRACKS}.json").exists():
        write_summary(files, links=[], withdrawn=0, **found)
        return
    tracks = read_dataclass(PointTracks, keyframes, TRACKS)
    chain, maps = load_keyframes(keyframes).rotation_chain, load_map(task.map.path).maps
    scenes = {scene.gauge: scene for scene in maps if tracks.camera in scene.cameras}

    def show(done: int, total: int) -> None:
        context.check_cancelled()
        context.progress(done, total, "frames compared")

    links = []
    gone = np.zeros((len(paths), len(paths[0].status)), dtype=bool)
    for path, wrong in zip(paths, gone, strict=True):
        if path.gauge not in scenes or not path.registered.any():
            continue
        scene = scenes[path.gauge]
        video = TrackedVideo(
            tracks=tracks,
            lens=scene.cameras[path.camera],
            times_s=path.seconds,
            readout_s=scene.readout_s.get(path.camera, 0.0),
            rotation_chain=chain,
        )
        compared = check_with_tracks(video, path.gauge_from_cam, show)
        counts = count_frames(compared)
        if is_on(Mechanism.WITHDRAWN_POSES) and counts["contradicted"] <= MAX_WITHDRAWN * counts["compared"]:
            wrong[:] = path.localised & contradicted_frames(compared)
        links.append({"frame": path.gauge, **counts, "withdrawn": int(wrong.sum())})
    withdrawn = int(gone.sum())
    record_act(Mechanism.WITHDRAWN_POSES, withdrawn)
    if not withdrawn:
        write_summary(files, links=links, withdrawn=0, **found)
        return
    status = np.where(gone.any(axis=0), FrameStatus.CONTRADICTED, paths[0].status)
    kept = [path.without(wrong, FrameStatus.CONTRADICTED) for path, wrong in zip(paths, gone, strict=True)]
    path = replace(kept[0], status=tuple(map(FrameStatus, status)))
    registration = replace(registration, trajectory=path)
    replace_registration(registration, before, files, links=links, withdrawn=withdrawn, **found)
    if len(kept) > 1:
        write_dataclass(OtherPaths(trajectories=tuple(kept[1:])), files, OTHER_PATHS)


LINKS = Stage(
    name="links",
    task=LinksTask,
    function=run_links,
    libraries=("numpy", "scipy", "opencv-python-headless|opencv-python", "pycolmap"),
    modules=("bodycap_batch.evaluate.track_check",),
)
