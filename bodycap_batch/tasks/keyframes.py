"""The task that selects the keyframes of a camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from bodycap_batch.config.options import KeyframeOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.tasks.inputs import CaptureRef, FileRef
from bodycap_batch.tasks.loading import load_capture
from bodycap_batch.tasks.stage import VISION_LIBRARIES, VISION_MODULES, Stage, write_summary

if TYPE_CHECKING:
    from bodycap_batch.capture import CaptureCamera
    from bodycap_batch.model.scene import KeyframeSelection


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyframesTask:
    """Select the keyframes of one camera.

    Attributes:
        options: The stage's options.
        capture: The video of the camera.
        with_gyro: True to use the gyroscope of the camera for its rotation.
        samples: The file with inertial samples beside the video; None if the samples are in the video, or if
            they are not used.
    """

    options: KeyframeOptions
    capture: CaptureRef
    with_gyro: bool = False
    samples: FileRef | None = None


def run_keyframes(task: KeyframesTask, context: StageContext, files: Path) -> None:
    """Select the keyframes; store them with copies of decoded frames and notes for the user."""
    from bodycap_batch.capture.damage import damage_notes
    from bodycap_batch.capture.kept import KEPT_NAME, FrameKeeper
    from bodycap_batch.formats.dataclass_files import write_dataclass
    from bodycap_batch.keyframes import select_keyframes
    from bodycap_batch.model.frozen_frames import frozen_notes

    camera = load_capture(task.capture, threads=context.threads).cameras[0]
    size = camera.camera
    with FrameKeeper(files, size.width_px, size.height_px, camera.should_keep_all) as keeper:
        selection = select_keyframes(camera, task.options, context, keeper, with_matches=task.with_gyro)
    selection, gyro_notes = _with_gyro(selection, camera, task) if task.with_gyro else (selection, [])
    if (kept := keeper.kept_frames()) is not None:
        write_dataclass(kept, files, KEPT_NAME)
    write_dataclass(selection, files, "keyframes")
    notes = [f"{camera.name}: {note}" for note in damage_notes(camera, selection.damaged)]
    notes += frozen_notes(camera.name, selection.frozen, camera.common_times_ns() / 1e9)
    notes += gyro_notes
    write_summary(files, frames=selection.frame_count, keyframes=len(selection.frames), notes=notes)


def _with_gyro(
    selection: KeyframeSelection, camera: CaptureCamera, task: KeyframesTask
) -> tuple[KeyframeSelection, list[str]]:
    """Return the selection with what the gyroscope of the camera measured, and notes for the user."""
    from bodycap_batch.core.errors import CaptureError
    from bodycap_batch.telemetry import read_telemetry
    from bodycap_batch.telemetry.camera_rates import relate_gyro
    from bodycap_batch.telemetry.comparison import all_times_ns

    try:
        times_ns = all_times_ns(camera, task.capture.config.cameras[0])
        telemetry = read_telemetry(camera.videos, times_ns, camera.name)
    except CaptureError as error:
        return selection, [f"{camera.name}: {error.one_line}; its samples are not used"]
    assert selection.matches is not None
    related = relate_gyro(camera, selection.matches, telemetry)
    return replace(selection, gyro=related.rates), []


KEYFRAMES = Stage(
    name="keyframes",
    task=KeyframesTask,
    function=run_keyframes,
    libraries=VISION_LIBRARIES,
    modules=VISION_MODULES,
)
