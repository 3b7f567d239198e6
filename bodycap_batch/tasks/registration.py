"""The task that registers the frames of a camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.config.options import RegistrationOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.formats.dataclass_files import write_dataclass
from bodycap_batch.model.camera_clock import FrameTiming
from bodycap_batch.model.scene import Registration
from bodycap_batch.tasks.inputs import ArtefactRef, CaptureRef
from bodycap_batch.tasks.loading import load_capture, load_keyframes, load_map, load_registration
from bodycap_batch.tasks.registered_cameras import registration_summary
from bodycap_batch.tasks.stage import write_summary
from bodycap_batch.tasks.typed_json import omitted_from_key

NOT_ROUNDS = omitted_from_key("rounds")
"""Metadata of a dataclass field; it omits the option `rounds` from the artefact's key. It sets which rounds
run, and does not change the result of a single round."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationTask:
    """Register every frame of one camera.

    Attributes:
        options: The stage's options.
        capture: The video of the camera.
        keyframes: The camera's selected keyframes, by camera name (one entry).
        map: The map.
        previous: The camera's registration against the map of an earlier round. The tracks of this
            registration are reused. None in the first round.
    """

    options: RegistrationOptions = field(metadata=NOT_ROUNDS)
    capture: CaptureRef
    keyframes: Mapping[str, ArtefactRef]
    map: ArtefactRef
    previous: ArtefactRef | None


def run_registration(task: RegistrationTask, context: StageContext, files: Path) -> None:
    """Register the camera's frames and store their poses."""
    from bodycap_batch.registration import register_frames, withdraw_contradicted_poses

    camera = load_capture(task.capture, task.keyframes, threads=context.threads).cameras[0]
    selection = load_keyframes(task.keyframes[camera.name].path)
    previous = None if task.previous is None else load_registration(task.previous.path)
    scene = load_map(task.map.path)
    maps = scene.maps
    found = register_frames(camera, maps, selection, task.options, context, previous)
    found = withdraw_contradicted_poses(found, maps, scene.diagnostics.misplaced.get(camera.name, ()))
    save_registration(found, camera, files)


def save_registration(
    found: Registration,
    camera: CaptureCamera,
    files: Path,
    *,
    notes: Sequence[str] = (),
) -> None:
    """Store the poses of a camera, the timing of its frames and its camera model.

    Args:
        found: Poses and observations of the camera.
        camera: The camera.
        files: Folder of the artefact.
        notes: Notes for the user.
    """
    write_dataclass(found, files, "registration")
    timing = FrameTiming(nominal_fps=camera.nominal_fps, rolling_shutter_s=camera.rolling_shutter_s)
    write_dataclass(timing, files, "timing")
    write_dataclass(camera.camera, files, "camera")
    write_summary(files, **registration_summary(found), notes=list(notes))
