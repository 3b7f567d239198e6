"""The task that selects a camera's keyframes."""

from __future__ import annotations

from pathlib import Path

from bodycap_batch.core.context import StageContext
from bodycap_batch.tasks.loading import load_capture
from bodycap_batch.tasks.stage import SEEING, VISION, Json, Stage, write_summary


def _keyframes(options: Json, arguments: Json, context: StageContext, files: Path) -> None:
    from bodycap_batch.capture.kept import KEPT_NAME, FrameKeeper
    from bodycap_batch.config import KeyframeOptions
    from bodycap_batch.formats.dataclass_files import write_dataclass
    from bodycap_batch.keyframes import select_keyframes

    camera = load_capture(arguments, context.threads).cameras[0]
    size = camera.camera
    with FrameKeeper(files, size.width_px, size.height_px, camera.should_keep_all) as keeper:
        selection = select_keyframes(camera, KeyframeOptions.model_validate(options), context, keeper)
    if (kept := keeper.kept_frames()) is not None:
        write_dataclass(kept, files, KEPT_NAME)
    write_dataclass(selection, files, "keyframes")
    write_summary(files, frames=selection.frame_count, keyframes=len(selection.frames))


KEYFRAMES = Stage(function=_keyframes, libraries=VISION, modules=SEEING)
