"""The task that selects the keyframes of a camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.capture.damage import damage_notes
from bodycap_batch.capture.kept import KEPT_NAME, FrameKeeper
from bodycap_batch.capture.masks import without_regions
from bodycap_batch.config.options import KeyframeOptions
from bodycap_batch.core.arrays import BoolArray, IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.core.mechanisms import Mechanism, is_on, record_act
from bodycap_batch.formats.dataclass_files import write_dataclass
from bodycap_batch.model.copied_frames import copied_notes
from bodycap_batch.model.frozen_frames import frozen_notes
from bodycap_batch.model.lens_estimate import LensEstimate
from bodycap_batch.model.point_tracks import STORED_STEP, PointTracks
from bodycap_batch.model.rotation_chain import RotationChain
from bodycap_batch.tasks.inputs import CaptureRef, FileRef
from bodycap_batch.tasks.loading import TRACKS, load_capture
from bodycap_batch.tasks.stage import write_summary

if TYPE_CHECKING:
    from bodycap_batch.telemetry.streams import CameraTelemetry


_PROGRESS_FRAMES = 30
"""Number of frames between two reports of progress: a third of a second of work."""
_MIN_MOVING_SHARE = 0.02
"""Share of the pictures that moves by itself, below which nothing is left out: the edges of near things and
reflections have up to 1.6 % in rooms in which nothing moves. Evidence: docs/decisions/tracks.md."""


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
    from bodycap_batch.keyframes import select_keyframes
    from bodycap_batch.telemetry.camera_rates import relate_gyro
    from bodycap_batch.tracks import fixed_notes

    camera = load_capture(task.capture, threads=context.threads).cameras[0]
    size = camera.camera
    telemetry, telemetry_notes = _telemetry(camera, task)
    shown = regions_and_lens(camera, context)
    regions, moving, lens = shown.fixed, shown.moving, shown.lens
    in_room = without_regions(camera.mask, regions, (size.width_px, size.height_px))
    camera = replace(camera, mask=in_room)
    with FrameKeeper(files, size.width_px, size.height_px, camera.should_keep_all) as keeper:
        selection = select_keyframes(camera, task.options, context, keeper, with_matches=task.with_gyro)
    if selection.pictures is not None and len(moving):
        # The tracks are of all frames; the selection counts only those that are no copies.
        moving = moving[selection.pictures.frames]
    selection = replace(selection, fixed_regions=regions, moving_regions=moving, lens=lens)
    copies = copied_notes(camera.times_ns, selection.pictures)
    frames = np.arange(len(camera.times_ns)) if selection.pictures is None else selection.pictures.frames
    selection = replace(selection, rotation_chain=_rotation_chain(camera, shown, frames))
    camera = camera.only(selection.pictures)
    if telemetry is not None:
        assert selection.matches is not None
        selection = replace(selection, gyro=relate_gyro(camera, selection.matches, telemetry).rates)
    if (kept := keeper.kept_frames()) is not None:
        write_dataclass(kept.only(selection.pictures), files, KEPT_NAME)
    write_dataclass(selection, files, "keyframes")
    if shown.tracks is not None:
        write_dataclass(shown.tracks.chosen(frames, STORED_STEP), files, TRACKS)
    notes = [f"{camera.name}: {note}" for note in [*copies, *damage_notes(camera, selection.damaged)]]
    notes += frozen_notes(camera.name, selection.frozen, camera.common_times_ns() / 1e9)
    notes += [*telemetry_notes, *fixed_notes(camera.name, regions)]
    write_summary(
        files,
        frames=selection.frame_count,
        keyframes=len(selection.frames),
        lens=lens is not None and lens.is_determined,
        notes=notes,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackFindings:
    """What the tracks of a video show.

    Attributes:
        fixed: (R,C) mask of the regions that are fixed to the camera.
        moving: (N,R,C) mask of those that move by themselves in each frame; empty if nothing does.
        lens: The lens of a camera that needs one; None if it is given, or if the tracks do not determine it.
        tracks: The tracks in the room; None if there are none.
    """

    fixed: BoolArray
    moving: BoolArray
    lens: LensEstimate | None
    tracks: PointTracks | None


def regions_and_lens(camera: CaptureCamera, context: StageContext) -> TrackFindings:
    """Return what the tracks of a video show. A video of fewer than two frames shows nothing."""
    from bodycap_batch.tracks import (
        estimate_lens,
        find_fixed_regions,
        find_moving_regions,
        find_moving_tracks,
        track_video,
    )

    regions, moving, lens = np.zeros((1, 1), dtype=bool), np.zeros((0, 0, 0), dtype=bool), None
    wants_lens = camera.camera.refine and is_on(Mechanism.LENS_FROM_TRACKS)
    used = (Mechanism.FIXED_REGIONS, Mechanism.MOVING_REGIONS)
    if len(camera.times_ns) < 2 or not (wants_lens or any(map(is_on, used))):
        return TrackFindings(fixed=regions, moving=moving, lens=None, tracks=None)

    def show(done: int, total: int) -> None:
        context.check_cancelled()
        if done % _PROGRESS_FRAMES == 0:
            context.progress(done, total, "frames searched for hands")

    def show_lens(done: int, total: int) -> None:
        context.check_cancelled()
        context.progress(done, total, "steps to the lens")

    tracks = track_video(camera, show)
    if is_on(Mechanism.FIXED_REGIONS):
        regions = find_fixed_regions(tracks, camera.times_ns)
        record_act(Mechanism.FIXED_REGIONS, int(regions.any()))
    tracks = tracks.outside(regions)
    if wants_lens:
        lens = estimate_lens(tracks, camera.times_ns, show_lens)
    context.progress(0, 0, "searching what moves by itself")
    if is_on(Mechanism.MOVING_REGIONS) and (lens is not None or not camera.camera.refine):
        alone = find_moving_tracks(tracks, camera.camera if lens is None else lens.lens, camera.times_ns)
        found = find_moving_regions(tracks, alone)
        is_enough = bool(found.mean() >= _MIN_MOVING_SHARE)
        record_act(Mechanism.MOVING_REGIONS, int(is_enough))
        moving = found if is_enough else moving
        tracks = tracks.outside(found) if is_enough else tracks
        if lens is not None and is_enough:
            lens = estimate_lens(tracks, camera.times_ns, show_lens)
    return TrackFindings(fixed=regions, moving=moving, lens=lens, tracks=tracks)


def _rotation_chain(camera: CaptureCamera, shown: TrackFindings, frames: IntArray) -> RotationChain | None:
    """Return how the camera turns; None if its lens or its tracks are unknown."""
    from bodycap_batch.tracks import measure_rotation_chain

    known = not camera.camera.refine or (shown.lens is not None and shown.lens.is_determined)
    if shown.tracks is None or not known or not is_on(Mechanism.CONTINUITY):
        return None
    lens, sigma = (camera.camera, 0.0) if shown.lens is None else (shown.lens.lens, shown.lens.focal_sigma)
    return measure_rotation_chain(shown.tracks, lens, sigma, frames)


def _telemetry(camera: CaptureCamera, task: KeyframesTask) -> tuple[CameraTelemetry | None, list[str]]:
    """Return the telemetry of the camera if it is used, and notes for the user."""
    from bodycap_batch.telemetry import read_telemetry
    from bodycap_batch.telemetry.comparison import all_times_ns

    if not task.with_gyro:
        return None, []
    try:
        config = task.capture.config.cameras[0]
        return read_telemetry(camera.videos, all_times_ns(camera, config), config.samples), []
    except CaptureError as error:
        return None, [f"{camera.name}: {error.one_line}; its samples are not used"]
