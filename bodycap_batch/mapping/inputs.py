"""Convert a capture and the stage's options into the inputs of a mapping run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from bodycap_batch.capture import Capture
from bodycap_batch.config import MapOptions
from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.mechanisms import Mechanism, record_act
from bodycap_batch.mapping.camera_intrinsics import CameraIntrinsics
from bodycap_batch.mapping.mapping_context import MappingContext
from bodycap_batch.mapping.matching.database import read_camera_ids
from bodycap_batch.mapping.reconstruction.mapper_options import make_mapper_options
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.optical_flow import pixel_scale
from bodycap_batch.model.scene import KeyframeSelection, MapResult


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
        times_ns=frame_times_ns(capture),
        lens_sigma={
            number: capture.camera(name).lens_sigma
            for name, number in read_camera_ids(workspace).items()
            if capture.camera(name).lens_sigma
        },
    )


def frame_times_ns(capture: Capture) -> dict[str, IntArray]:
    """Return the times (N,) of all frames of each camera on its own clock, nanoseconds, by camera name.

    The clocks are not yet known. Times of different cameras are compared only to choose pairs of keyframes
    that are likely to see the same place. Therefore a new clock does not change the map.
    """
    return {camera.name: camera.times_ns for camera in capture.cameras}


def intrinsics_of(capture: Capture) -> dict[str, CameraIntrinsics]:
    """Return the intrinsics of each camera, and how it turns, by camera name."""
    return {
        item.name: CameraIntrinsics(item.camera, item.calibrated, item.rotation_chain, item.times_ns)
        for item in capture.cameras
    }


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


def with_estimated_lenses(capture: Capture, selections: Sequence[KeyframeSelection]) -> Capture:
    """Return the capture with the lenses that the tracks determine, as if they were given.

    Args:
        capture: All cameras.
        selections: The keyframes of the cameras, with the lens that their tracks determine.
    """
    lenses = {
        item.camera: (item.lens.lens, item.lens.focal_sigma)
        for item in selections
        if item.lens is not None and item.lens.is_determined and capture.camera(item.camera).camera.refine
    }
    record_act(Mechanism.LENS_FROM_TRACKS, len(lenses))
    return _with_lenses(capture, lenses)


def with_map_lenses(capture: Capture, previous: MapResult) -> Capture:
    """Return the capture with the lenses of an earlier map, for the cameras whose lens tracks determined.

    A lens that nothing but the map determines is refined again with each extension: in a small map it may be
    far off.
    """
    mapped = {name: camera for item in reversed(previous.maps) for name, camera in item.cameras.items()}
    unknown = {item.name for item in capture.cameras if item.lens_sigma}
    return _with_lenses(capture, {name: (mapped[name], 0.0) for name in sorted(unknown & mapped.keys())})


def with_lenses_of_maps(capture: Capture, previous: MapResult) -> Capture:
    """Return the capture with the lenses of an earlier map, as if they were given.

    A camera has one lens. The largest map with the camera determines it.
    """
    mapped = {name: camera for item in reversed(previous.maps) for name, camera in item.cameras.items()}
    return _with_lenses(capture, {name: (camera, 0.0) for name, camera in sorted(mapped.items())})


def _with_lenses(capture: Capture, lenses: Mapping[str, tuple[Camera, float]]) -> Capture:
    """Return the capture with lenses that were not given.

    Args:
        capture: All cameras.
        lenses: By camera name, the intrinsics and the relative standard deviation of the focal length. With
            0, the intrinsics stay constant.
    """
    if not lenses:
        return capture
    cameras = tuple(
        replace(
            item,
            camera=replace(lenses[item.name][0], refine=False, sideways=item.camera.sideways),
            calibrated=True,
            lens_sigma=lenses[item.name][1],
        )
        if item.name in lenses
        else item
        for item in capture.cameras
    )
    return replace(capture, cameras=cameras)
