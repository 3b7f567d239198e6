"""The task that writes the undistorted clip of a camera."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import numpy as np

from bodycap_batch.core.context import StageContext
from bodycap_batch.model.camera import with_two_focal_lengths
from bodycap_batch.model.pinhole import pinhole_of
from bodycap_batch.tasks.inputs import ArtefactRef, CaptureRef
from bodycap_batch.tasks.loading import load_capture, load_map
from bodycap_batch.tasks.stage import RESULTS_FOLDER


@dataclass(frozen=True, slots=True, kw_only=True)
class UndistortTask:
    """Write the undistorted clip of a camera.

    Attributes:
        camera: Name of the camera.
        capture: The video of this camera.
        map: The map, with the lens.
        export: The result files, with the facts about the animated cameras: the frame of the video that each
            frame shows, picture size, rate and timecode.
    """

    camera: str
    capture: CaptureRef
    map: ArtefactRef
    export: ArtefactRef


def run_undistort(task: UndistortTask, context: StageContext, files: Path) -> None:
    """Write the clip of the camera."""
    from bodycap_batch.export.camera_files import CAMERA_FACTS_FILE
    from bodycap_batch.preview import UndistortedClip, write_undistorted_clip

    text = (task.export.path / RESULTS_FOLDER / CAMERA_FACTS_FILE).read_text(encoding="utf-8")
    facts, maps = json.loads(text), load_map(task.map.path).maps
    own = facts["cameras"][task.camera]
    size, numbers = (own["width_px"], own["height_px"]), np.array(own["video_frame"], dtype=np.int64)
    # The facts count the frames of the whole video, and so must the camera.
    whole = task.capture.config.model_copy(update={"start_s": None, "end_s": None})
    camera = load_capture(replace(task.capture, config=whole), threads=context.threads).camera(task.camera)
    index = np.searchsorted(camera.frame_numbers, np.maximum(numbers, 0))
    lens = next(scene.cameras[task.camera] for scene in maps if task.camera in scene.cameras)
    clip = UndistortedClip(
        path=files / RESULTS_FOLDER / f"{task.camera}.mp4",
        camera=replace(camera, camera=camera.camera.scaled(*size), mask=None),
        lens=with_two_focal_lengths(lens).scaled(*size),
        pinhole=pinhole_of(lens, *size),
        frames=np.where(numbers >= 0, index, -1),
        rate=Fraction(facts["rate"]),
        timecode=facts.get("start_timecode", ""),
    )
    write_undistorted_clip(clip, context)
