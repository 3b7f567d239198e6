"""Read the inputs of a stage: the videos, and the artefacts that earlier stages stored."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from bodycap_batch.capture import Capture, open_capture
from bodycap_batch.capture.kept import KEPT_NAME, KeptFrames
from bodycap_batch.capture.masks import without_regions
from bodycap_batch.formats.dataclass_files import read_dataclass
from bodycap_batch.model.camera_clock import CaptureClocks
from bodycap_batch.model.scene import KeyframeSelection, MapResult, Registration
from bodycap_batch.tasks.inputs import ArtefactRef, CaptureRef

CLOCKS_NAME = "clocks"
"""Name of the file, without suffix, that holds the clocks of a capture."""

TRACKS = "tracks"
"""Name of the file, without suffix, that holds the tracks of a camera's video."""


def load_capture(
    capture: CaptureRef,
    keyframes: Mapping[str, ArtefactRef] | None = None,
    *,
    clocks: CaptureClocks | None = None,
    threads: int = 0,
) -> Capture:
    """Open the videos of a task.

    Args:
        capture: The cameras and their videos.
        keyframes: The artefact with the keyframes of each camera, by camera name. It lists the damaged
            frames, and the frames that are no copies of the frame before: only the latter are used. If an
            artefact holds stored copies of decoded frames, these are read instead of the video. None to read
            all frames from the videos.
        clocks: The clocks of all cameras; None for a task that does not relate times of different cameras.
        threads: Number of threads of each video decoder; 0 lets the decoder choose.
    """
    opened = open_capture(capture.config, threads)
    stored = keyframes or {}
    cameras = []
    for camera in opened.cameras:
        artefact = stored.get(camera.name)
        if artefact is not None:
            selection = load_keyframes(artefact.path)
            size = (camera.camera.width_px, camera.camera.height_px)
            camera = replace(  # noqa: PLW2901
                camera.only(selection.pictures),
                damaged=selection.damaged,
                mask=without_regions(camera.mask, selection.fixed_regions, size),
                rotation_chain=selection.rotation_chain,
                moving_regions=selection.moving_regions if len(selection.moving_regions) else None,
            )
        clock = camera.clock if clocks is None else clocks.cameras.get(camera.name, camera.clock)
        cameras.append(replace(camera, kept=_kept_frames(artefact), clock=clock))
    return replace(opened, cameras=tuple(cameras))


def _kept_frames(keyframes: ArtefactRef | None) -> KeptFrames | None:
    if keyframes is None or not (keyframes.path / f"{KEPT_NAME}.json").exists():
        return None
    return read_dataclass(KeptFrames, keyframes.path, KEPT_NAME)


def load_keyframes(path: Path) -> KeyframeSelection:
    """Read the selected keyframes of a camera from an artefact's folder."""
    return read_dataclass(KeyframeSelection, path, "keyframes")


def load_map(path: Path) -> MapResult:
    """Read a map and the path of its workspace from an artefact's folder."""
    return read_dataclass(MapResult, path, "map")


def load_clocks(path: Path) -> CaptureClocks:
    """Read the clocks of all cameras from an artefact's folder."""
    return read_dataclass(CaptureClocks, path, CLOCKS_NAME)


def load_registration(path: Path) -> Registration:
    """Read the poses and observations of a camera from an artefact's folder."""
    return read_dataclass(Registration, path, "registration")
