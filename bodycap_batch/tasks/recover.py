"""The task that recovers the lost frames of a camera after the poses of its other frames are final."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from bodycap_batch.config.options import RegistrationOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.tasks.inputs import ArtefactRef, CaptureRef, paths_of
from bodycap_batch.tasks.loading import load_capture, load_keyframes, load_map, load_registration
from bodycap_batch.tasks.registration import NOT_ROUNDS, save_registration


@dataclass(frozen=True, slots=True, kw_only=True)
class RecoverTask:
    """Recover the lost frames of one camera with the help of the other cameras.

    Attributes:
        options: Options of the stage `registration`.
        cameras: Names of the cameras. The first camera is the one to recover; the other cameras help.
        capture: The videos of these cameras, in the order of `cameras`.
        keyframes: The selected keyframes of each camera, by camera name.
        map: The map.
        registrations: The registration of each camera, by camera name, in the order of `cameras`.
    """

    options: RegistrationOptions = field(metadata=NOT_ROUNDS)
    cameras: tuple[str, ...]
    capture: CaptureRef
    keyframes: Mapping[str, ArtefactRef]
    map: ArtefactRef
    registrations: Mapping[str, ArtefactRef]


def run_recover(task: RecoverTask, context: StageContext, files: Path) -> None:
    """Recover the lost frames of the task's first camera; store all poses of this camera."""
    from bodycap_batch.registration import (
        RecoveryInputs,
        recover_lost_frames,
        with_rotation,
    )

    capture = load_capture(task.capture, task.keyframes, threads=context.threads)
    paths = paths_of(task.registrations.values())
    scene = load_map(task.map.path)
    selections = {name: load_keyframes(item.path) for name, item in task.keyframes.items()}
    inputs = RecoveryInputs(
        capture=capture,
        # A generator loads one registration at a time: the tracks of a long video need much memory.
        registrations=(
            with_rotation(camera, load_registration(path), scene.maps, selections[camera.name])
            for camera, path in zip(capture.cameras, paths, strict=True)
        ),
        maps=scene.maps,
        selection=selections[task.cameras[0]],
        misplaced=scene.diagnostics.misplaced.get(task.cameras[0], ()),
    )
    registration = recover_lost_frames(load_registration(paths[0]), inputs, task.options, context)
    save_registration(registration, capture.cameras[0], files)
