"""Convert a capture and the stage's options into the inputs of a mapping run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from bodycap_batch.capture import Capture
from bodycap_batch.config import MapOptions
from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.mapping.camera_intrinsics import CameraIntrinsics
from bodycap_batch.mapping.mapping_context import MappingContext
from bodycap_batch.mapping.reconstruction.mapper_options import make_mapper_options
from bodycap_batch.model.optical_flow import pixel_scale


def make_mapping_context(
    workspace: Path,
    capture: Capture,
    options: MapOptions,
    calibrated_ids: Sequence[int],
    stage: StageContext,
    skeletal_above: int,
) -> MappingContext:
    """Return the context of a mapping run.

    Args:
        workspace: Folder of the database.
        capture: All cameras.
        options: The stage's options.
        calibrated_ids: Database ids of the calibrated cameras.
        stage: Threads, progress, cancellation.
        skeletal_above: Maximum number of keyframes of a map that is not large (`MappingContext.is_large`).
    """
    scale = threshold_scale(capture)
    return MappingContext(
        workspace=workspace,
        intrinsics=intrinsics_of(capture),
        mapper_options=lambda: make_mapper_options(options, calibrated_ids, scale),
        calibrated_ids=calibrated_ids,
        stage=stage,
        frame_numbers={camera.name: camera.frame_numbers for camera in capture.cameras},
        skeletal_above=skeletal_above,
    )


def frame_times_ns(capture: Capture) -> dict[str, IntArray]:
    """Return the times (N,) of all frames of each camera on its own clock, nanoseconds, by camera name.

    The clocks are not yet known. Times of different cameras are compared only to choose pairs of keyframes
    that are likely to see the same place. Therefore a new clock does not change the map.
    """
    return {camera.name: camera.times_ns for camera in capture.cameras}


def intrinsics_of(capture: Capture) -> dict[str, CameraIntrinsics]:
    """Return the intrinsics of each camera, by camera name."""
    return {item.name: CameraIntrinsics(item.camera, item.calibrated) for item in capture.cameras}


def threshold_scale(capture: Capture) -> float:
    """Return the factor that multiplies pixel thresholds.

    Each camera's image size gives a factor (`pixel_scale`). The largest factor is used for all cameras.
    """
    return max(pixel_scale(item.camera.width_px, item.camera.height_px) for item in capture.cameras)


def calibrated_camera_ids(capture: Capture, ids: Mapping[str, int]) -> list[int]:
    """Return the sorted database ids of the calibrated cameras.

    Args:
        capture: All cameras.
        ids: Database ids of all cameras in the database, by camera name.
    """
    return sorted(number for name, number in ids.items() if capture.camera(name).calibrated)
