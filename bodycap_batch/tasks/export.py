"""The task that writes the result files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bodycap_batch.capture.timeline import join_chapters
from bodycap_batch.config.options import ExportOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.model.scene import MapResult
from bodycap_batch.model.take import Timecode, exact_rate
from bodycap_batch.tasks.inputs import ArtefactRef, CaptureRef, paths_of
from bodycap_batch.tasks.loading import load_capture, load_clocks, load_keyframes, load_map
from bodycap_batch.tasks.motion import load_motion
from bodycap_batch.tasks.registered_cameras import RegisteredCameras
from bodycap_batch.tasks.stage import RESULTS_FOLDER, read_summary, write_summary
from bodycap_batch.tasks.typed_json import omitted_from_key

if TYPE_CHECKING:
    from bodycap_batch.export.export_inputs import VideoFacts


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportTask:
    """Write the result files.

    Attributes:
        options: The stage's options. The option `preview` is not part of the artefact's key, because a
            separate stage renders the preview.
        take: Name of the take, which is that of the job.
        capture: The videos of all cameras: their picture sizes and timecodes.
        map: The map.
        registrations: The registration of each camera, by camera name.
        clocks: The clocks of all cameras.
        keyframes: The selected keyframes of each camera, by camera name.
        links: What the tracks of each camera's video show about its paths, by camera name.
        merge: The skeleton's motion; None if there is no motion.
        failure: The reason why the skeleton that the job asks for is missing; None if no skeleton is missing.
        freed: By name of each camera whose given lens is not used, its given focal length over the width.
        segments: For each body segment with several cameras, the names of these cameras.
    """

    options: ExportOptions = field(metadata=omitted_from_key("preview"))
    take: str
    capture: CaptureRef
    map: ArtefactRef
    registrations: Mapping[str, ArtefactRef]
    clocks: ArtefactRef
    keyframes: Mapping[str, ArtefactRef]
    links: Mapping[str, ArtefactRef]
    merge: ArtefactRef | None
    failure: str | None
    freed: Mapping[str, float]
    segments: tuple[tuple[str, ...], ...]


def run_export(task: ExportTask, context: StageContext, files: Path) -> None:
    """Write the result files; the notes in the summary say which parts are empty and left out."""
    from bodycap_batch.export import LEFT_OUT, ExportInputs, export_results

    scene = load_map(task.map.path)
    paths = paths_of(task.registrations.values())
    clocks = load_clocks(task.clocks.path)
    found = RegisteredCameras.load(paths, scene.maps, clocks)
    merge = None if task.merge is None else load_motion(task.merge)
    inputs = ExportInputs(
        out_dir=files / RESULTS_FOLDER,
        maps=scene.maps,
        trajectories=found.trajectories,
        clocks=found.clocks,
        reference_camera=clocks.reference,
        selections=tuple(load_keyframes(artefact.path) for artefact in task.keyframes.values()),
        merge=merge,
        partial_reason=task.failure,
        row_fraction=found.row_fraction,
        inertial=found.inertial,
        other_paths=found.other_paths,
        relative_poses=found.relative_poses(task.segments),
        take=task.take,
        videos=_video_facts(task.capture),
        log={
            **log_of(scene, task.freed),
            "reach": read_summary(task.clocks.path)["distances"],
            "links": {name: read_summary(each.path)["links"] for name, each in task.links.items()},
        },
    )
    export_results(inputs, task.options, context)
    metrics = json.loads((inputs.out_dir / "metrics.json").read_text(encoding="utf-8"))
    write_summary(files, notes=metrics[LEFT_OUT])


def log_of(scene: MapResult, freed: Mapping[str, float]) -> Mapping[str, Any]:
    """Return the log of the maps, with how each lens differs from a given one that is not used."""
    found = {name: lens for each in reversed(scene.maps) for name, lens in each.cameras.items()}
    factors = {
        name: round(found[name].focal_px / found[name].width_px / given, 3)
        for name, given in freed.items()
        if name in found
    }
    if not factors:
        return scene.log
    before = scene.diagnostics
    return replace(
        before,
        misfit_factors={**(before.misfit_factors or {}), **factors},
        recalibrated=(*before.recalibrated, *factors),
    ).to_log()


def _video_facts(capture: CaptureRef) -> dict[str, VideoFacts]:
    """Return what the files for 3D programs state about the video of each camera."""
    from bodycap_batch.clocks.container_times import read_timecode
    from bodycap_batch.export.export_inputs import VideoFacts

    facts = {}
    sidecars = {camera.name: camera.timestamps for camera in capture.config.cameras}
    for camera in load_capture(capture).cameras:
        first = camera.videos[0]
        width, height = first.shown_size
        times_ns = join_chapters(camera.videos, sidecars[camera.name]).times_ns
        facts[camera.name] = VideoFacts(
            width_px=width,
            height_px=height,
            timecode=Timecode.parse(read_timecode(first), exact_rate(first.fps or 30.0)),
            first_frame_ns=int(times_ns[0]),
        )
    return facts
