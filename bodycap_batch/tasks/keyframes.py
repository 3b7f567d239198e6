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
    from bodycap_batch.core.arrays import BoolArray
    from bodycap_batch.model.lens_estimate import LensEstimate
    from bodycap_batch.telemetry.streams import CameraTelemetry


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
    from bodycap_batch.capture.masks import without_regions
    from bodycap_batch.formats.dataclass_files import write_dataclass
    from bodycap_batch.keyframes import select_keyframes
    from bodycap_batch.model.copied_frames import copied_notes
    from bodycap_batch.model.frozen_frames import frozen_notes
    from bodycap_batch.telemetry.camera_rates import relate_gyro
    from bodycap_batch.tracks import fixed_notes

    camera = load_capture(task.capture, threads=context.threads).cameras[0]
    size = camera.camera
    telemetry, telemetry_notes = _telemetry(camera, task)
    regions, lens = regions_and_lens(camera, context)
    in_room = without_regions(camera.mask, regions, (size.width_px, size.height_px))
    camera = replace(camera, mask=in_room)
    with FrameKeeper(files, size.width_px, size.height_px, camera.should_keep_all) as keeper:
        selection = select_keyframes(camera, task.options, context, keeper, with_matches=task.with_gyro)
    selection = replace(selection, fixed_regions=regions, lens=lens)
    copies = copied_notes(camera.times_ns, selection.pictures)
    camera = camera.only(selection.pictures)
    if telemetry is not None:
        assert selection.matches is not None
        selection = replace(selection, gyro=relate_gyro(camera, selection.matches, telemetry).rates)
    if (kept := keeper.kept_frames()) is not None:
        write_dataclass(kept.only(selection.pictures), files, KEPT_NAME)
    write_dataclass(selection, files, "keyframes")
    notes = [f"{camera.name}: {note}" for note in [*copies, *damage_notes(camera, selection.damaged)]]
    notes += frozen_notes(camera.name, selection.frozen, camera.common_times_ns() / 1e9)
    notes += [*telemetry_notes, *fixed_notes(camera.name, regions)]
    write_summary(files, frames=selection.frame_count, keyframes=len(selection.frames), notes=notes)


def regions_and_lens(camera: CaptureCamera, context: StageContext) -> tuple[BoolArray, LensEstimate | None]:
    """Return the regions that are fixed to the camera, and the lens of a camera that needs one.

    A video of fewer than two frames shows neither.
    """
    import numpy as np

    from bodycap_batch.core.mechanisms import Mechanism, is_on, record_act
    from bodycap_batch.tracks import estimate_lens, find_fixed_regions, track_video

    regions = np.zeros((1, 1), dtype=bool)
    wants_lens = camera.camera.refine and is_on(Mechanism.LENS_FROM_TRACKS)
    if len(camera.times_ns) < 2 or not (wants_lens or is_on(Mechanism.FIXED_REGIONS)):
        return regions, None
    tracks = track_video(camera, context)
    if is_on(Mechanism.FIXED_REGIONS):
        regions = find_fixed_regions(tracks, camera.times_ns)
        record_act(Mechanism.FIXED_REGIONS, int(regions.any()))
    if not wants_lens:
        return regions, None
    context.progress(0, 0, "estimating the lens")
    return regions, estimate_lens(tracks.outside(regions), camera.times_ns)


def _telemetry(camera: CaptureCamera, task: KeyframesTask) -> tuple[CameraTelemetry | None, list[str]]:
    """Return the telemetry of the camera if it is used, and notes for the user."""
    from bodycap_batch.core.errors import CaptureError
    from bodycap_batch.telemetry import read_telemetry
    from bodycap_batch.telemetry.comparison import all_times_ns

    if not task.with_gyro:
        return None, []
    try:
        config = task.capture.config.cameras[0]
        return read_telemetry(camera.videos, all_times_ns(camera, config), config.samples), []
    except CaptureError as error:
        return None, [f"{camera.name}: {error.one_line}; its samples are not used"]


KEYFRAMES = Stage(
    name="keyframes",
    task=KeyframesTask,
    function=run_keyframes,
    libraries=VISION_LIBRARIES,
    modules=(*VISION_MODULES, "bodycap_batch.keyframes", "pycolmap"),
)
