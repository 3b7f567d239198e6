"""The task that registers a camera's frames."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bodycap_batch.core.context import StageContext
from bodycap_batch.tasks.loading import load_capture, load_keyframes, load_map, load_registration
from bodycap_batch.tasks.stage import SEEING, VISION, Json, Stage, write_summary

if TYPE_CHECKING:
    from bodycap_batch.capture import CaptureCamera
    from bodycap_batch.model.scene import Registration


def _registration(options: Json, arguments: Json, context: StageContext, files: Path) -> None:
    from bodycap_batch.config import RegistrationOptions
    from bodycap_batch.model.rolling_shutter import has_visible_rolling_shutter
    from bodycap_batch.registration import register_frames

    camera = load_capture(arguments, context.threads).cameras[0]
    selection = load_keyframes(arguments["selection"])
    previous = load_registration(arguments["previous"]) if arguments.get("previous") else None
    maps = load_map(arguments["map"]).maps
    found = register_frames(
        camera, maps, selection, RegistrationOptions.model_validate(options), context, previous
    )
    known = camera.rolling_shutter_known
    rolling = (
        bool(camera.rolling_shutter_s)
        if known
        else has_visible_rolling_shutter(found, maps, allow_sideways=camera.may_be_sideways)
    )
    save_registration(found, camera, files, rolling=rolling)


def save_registration(
    found: Registration,
    camera: CaptureCamera,
    files: Path,
    *,
    rolling: bool,
    notes: Sequence[str] = (),
) -> None:
    """Keep a camera's poses with what the stages after it need to know of the camera."""
    from bodycap_batch.formats.dataclass_files import write_dataclass
    from bodycap_batch.model.merge_data import CameraClock

    write_dataclass(found, files, "registration")
    clock = CameraClock(
        nominal_fps=camera.nominal_fps,
        offset_s=camera.offset_s,
        rolling_shutter_s=camera.rolling_shutter_s,
    )
    write_dataclass(clock, files, "clock")
    write_dataclass(camera.camera, files, "camera")
    write_summary(
        files,
        frames=len(found.trajectory.status),
        localised=int(found.trajectory.localised.sum()),
        wanted=[int(frame) for frame in found.wanted_keyframes],
        rolling=rolling,
        notes=list(notes),
    )


REGISTRATION = Stage(function=_registration, libraries=(*VISION, "pycolmap"), modules=(*SEEING, "pycolmap"))
