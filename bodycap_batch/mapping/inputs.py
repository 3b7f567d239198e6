"""Options and inputs of a mapping run, in the form that COLMAP takes them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from bodycap_batch.capture import Capture
from bodycap_batch.config import MapOptions
from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.mapping.reconstruction.reconstruct import mapper_options
from bodycap_batch.mapping.workspace import MappingContext
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.optical_flow import pixel_scale


def make_mapping_context(
    workspace: Path, capture: Capture, options: MapOptions, constant: Sequence[int], context: StageContext
) -> MappingContext:
    """What mending a model takes: the workspace, the lenses and the mapper's settings."""
    scale = threshold_scale(capture)
    return MappingContext(
        workspace=workspace,
        lenses=intrinsics_of(capture),
        settings=lambda: mapper_options(options, constant, scale),
        constant=constant,
        context=context,
        frame_numbers={camera.name: camera.frame_numbers for camera in capture.cameras},
    )


def common_times_ns(capture: Capture) -> dict[str, IntArray]:
    """Times of all frames of each camera on the common clock, in nanoseconds."""
    return {camera.name: camera.common_times_ns() for camera in capture.cameras}


def intrinsics_of(capture: Capture) -> dict[str, tuple[Camera, bool]]:
    """Intrinsics of each camera, and whether they are calibrated."""
    return {item.name: (item.camera, item.calibrated) for item in capture.cameras}


def threshold_scale(capture: Capture) -> float:
    """Factor on pixel thresholds: that of the largest image."""
    return max(pixel_scale(item.camera.width_px, item.camera.height_px) for item in capture.cameras)


def calibrated_camera_ids(capture: Capture, ids: Mapping[str, int]) -> list[int]:
    """Database ids of the calibrated cameras."""
    return sorted(number for name, number in ids.items() if capture.camera(name).calibrated)
