"""The task that selects the keyframes of a camera."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bodycap_batch.config.options import KeyframeOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.tasks.inputs import CaptureRef
from bodycap_batch.tasks.loading import load_capture
from bodycap_batch.tasks.stage import VISION_LIBRARIES, VISION_MODULES, Stage, write_summary


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyframesTask:
    """Select the keyframes of one camera.

    Attributes:
        options: The stage's options.
        capture: The video of the camera.
    """

    options: KeyframeOptions
    capture: CaptureRef


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
        selection = select_keyframes(camera, task.options, context, keeper)
    if (kept := keeper.kept_frames()) is not None:
        write_dataclass(kept, files, KEPT_NAME)
    write_dataclass(selection, files, "keyframes")
    notes = [f"{camera.name}: {note}" for note in damage_notes(camera, selection.damaged)]
    notes += frozen_notes(camera.name, selection.frozen, camera.common_times_ns() / 1e9)
    write_summary(files, frames=selection.frame_count, keyframes=len(selection.frames), notes=notes)


KEYFRAMES = Stage(
    name="keyframes",
    task=KeyframesTask,
    function=run_keyframes,
    libraries=VISION_LIBRARIES,
    modules=VISION_MODULES,
)
