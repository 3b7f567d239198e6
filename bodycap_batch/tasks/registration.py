"""The task that registers a camera's frames."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bodycap_batch.context import StageContext
from bodycap_batch.tasks.loading import load_capture, load_keyframes, load_map, load_registration
from bodycap_batch.tasks.stage import SEEING, VISION, Json, Stage, write_summary

if TYPE_CHECKING:
    from bodycap_batch.capture import CaptureCamera
    from bodycap_batch.scene import Registration


def _registration(options: Json, arguments: Json, context: StageContext, files: Path) -> None:
    from bodycap_batch.config import RegistrationOptions
    from bodycap_batch.registration import LEAST_LOST, recover_lost, register_frames
    from bodycap_batch.rolling_shutter import looks_rolling

    camera = load_capture(arguments).cameras[0]
    selection = load_keyframes(arguments["selection"])
    previous = load_registration(arguments["previous"]) if arguments.get("previous") else None
    options_ = RegistrationOptions.model_validate(options)
    maps = load_map(arguments["map"]).maps
    found = register_frames(camera, maps, selection, options_, context, previous)
    tracked = int(found.trajectory.localised.sum())
    scene = next((each for each in maps if each.gauge == found.trajectory.gauge), None)
    growing = previous is None and len(found.wanted_keyframes) > 0
    if scene is not None and not growing and tracked <= len(found.trajectory.status) - LEAST_LOST:
        capture = load_capture({"capture": arguments["cameras"]})
        found = recover_lost(found, scene, capture, options_, context)
    known = camera.rolling_shutter_known
    rolling = bool(camera.rolling_shutter_s) if known else looks_rolling(found, maps)
    save_registration(found, camera, files, rolling=rolling, tracked=tracked)


def save_registration(
    found: Registration,
    camera: CaptureCamera,
    files: Path,
    *,
    rolling: bool,
    tracked: int | None = None,
    notes: Sequence[str] = (),
) -> None:
    """Keep a camera's poses with what the stages after it need to know of the camera."""
    from bodycap_batch.body import CameraClock
    from bodycap_batch.formats.bundle import write_bundle

    write_bundle(found, files, "registration")
    clock = CameraClock(
        nominal_fps=camera.nominal_fps,
        offset_s=camera.offset_s,
        rolling_shutter_s=camera.rolling_shutter_s,
    )
    write_bundle(clock, files, "clock")
    write_bundle(camera.camera, files, "camera")
    write_summary(
        files,
        frames=len(found.trajectory.status),
        # Those that tracking found: they tell whether the map grew where it should.
        localised=int(found.trajectory.localised.sum()) if tracked is None else tracked,
        wanted=[int(frame) for frame in found.wanted_keyframes],
        rolling=rolling,
        notes=list(notes),
    )


REGISTRATION = Stage(function=_registration, libraries=(*VISION, "pycolmap"), modules=(*SEEING, "pycolmap"))
