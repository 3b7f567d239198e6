"""Correct the keypoints of keyframes for rolling shutters before the map is built from them."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from bodycap_batch.capture import Capture
from bodycap_batch.core.arrays import IntArray
from bodycap_batch.formats.dataclass_files import read_dataclass, write_dataclass
from bodycap_batch.inertial import camera_rotation
from bodycap_batch.mapping.intrinsics.readout_time import (
    Readout,
    groups_of_equal_cameras,
    judged_readout,
    stated_readout,
    weighted_mean,
)
from bodycap_batch.model.optical_flow import pixel_scale
from bodycap_batch.model.rotation_path import TurningShutter
from bodycap_batch.model.scene import KeyframeSelection, Map

_MAX_DISPLACEMENT_PX = 4.0
"""Maximum displacement of the keypoints of a camera by a rolling shutter that is not corrected, px of an
image with a long side of 640 px. If it is larger, right matches contradict the geometry of their pairs.
Origin: COLMAP's limit of the deviation of a match."""
_DISPLACED_PERCENT = 95.0
"""Percentile of the displacements of keypoints that is compared with a limit. Evidence: none."""
_MIN_POSSIBLE_S = 0.0001
"""Smallest readout time with which an adjustment looks for a short one, seconds. It only makes the
displacements proportional to something."""
_GRID = 8
"""Number of rows and of columns of the pixels whose displacement is computed. Evidence: none."""
_MAX_SIGMAS = 3.0
"""Maximum difference of two readout times that agree, in its standard deviations. Evidence: none."""
_FOLDER = "shutters"
"""Name of the folder with the shutters, in the workspace folder. Each camera with a rolling shutter has a
file."""


def known_readouts(capture: Capture) -> dict[str, Readout]:
    """Return the readout times that are given in the job and are not 0, by camera name."""
    return {
        camera.name: replace(stated_readout(camera.rolling_shutter_s), sideways=camera.camera.sideways)
        for camera in capture.cameras
        if camera.rolling_shutter_known and camera.rolling_shutter_s
    }


def uncorrected_shutters(
    capture: Capture, readouts: Mapping[str, Readout], corrected: Collection[str]
) -> tuple[str, ...]:
    """Return the names of the cameras that may have a rolling shutter for which no keypoint was corrected.

    Args:
        capture: The cameras of the map.
        readouts: Readout times from matches between adjacent frames, by camera name. A camera without such
            matches has none.
        corrected: Names of the cameras whose keypoints were corrected.
    """
    out = []
    for camera in capture.cameras:
        name, found = camera.name, readouts.get(camera.name)
        if camera.rolling_shutter_known:
            may_roll = bool(camera.rolling_shutter_s)
        else:
            may_roll = found is None or not found.excludes_rolling
        if may_roll and name not in corrected:
            out.append(name)
    return tuple(out)


def with_gyroscopes(
    readouts: Mapping[str, Readout], selections: Sequence[KeyframeSelection]
) -> dict[str, Readout]:
    """Return the readout times together with those that were estimated with gyroscopes, by camera name.

    The mean of both is used, weighted by their information. If they contradict each other, the one with the
    smaller standard deviation is used.

    Args:
        readouts: Readout times from matches between adjacent frames.
        selections: The keyframes of the cameras, with what the gyroscopes measured.
    """
    out = dict(readouts)
    for selection in selections:
        own, gyro = readouts.get(selection.camera), selection.gyro
        if own is None or gyro is None or not gyro.readout_sigma_s or not np.isfinite(gyro.readout_s):
            continue
        value = np.array([gyro.readout_s, own.best_s])
        sigma = np.array([gyro.readout_sigma_s, own.sigma_s])
        agree = abs(value[0] - value[1]) <= _MAX_SIGMAS * float(np.hypot(*sigma))
        used = np.isfinite(sigma) & (agree | (sigma == sigma.min()))
        best_s, sigma_s = weighted_mean(value[used], sigma[used])
        out[selection.camera] = judged_readout(best_s, sigma_s, sideways=own.sideways)
    return out


def readouts_of_maps(maps: Sequence[Map]) -> dict[str, Readout]:
    """Return the readout times for which maps are corrected, by camera name."""
    out: dict[str, Readout] = {}
    for scene_map in maps:
        for name, seconds in scene_map.readout_s.items():
            sideways = name in scene_map.cameras and scene_map.cameras[name].sideways
            sigma_s = scene_map.readout_sigma_s.get(name, 0.0)
            out.setdefault(name, Readout(seconds, sigma_s, "of the map", seconds, sideways))
    return out


def turning_shutters(
    capture: Capture, selections: Sequence[KeyframeSelection], readouts: Mapping[str, Readout]
) -> dict[str, TurningShutter]:
    """Estimate the rotation of each camera with a rolling shutter, from its gyroscope or its pictures.

    Args:
        capture: All cameras.
        selections: The keyframes of the cameras, with the matches between adjacent frames.
        readouts: The readout times by camera name.

    Returns:
        The shutters by camera name. Cameras without a rotation or without a readout time have none.
    """
    out = {}
    for selection in selections:
        readout = readouts.get(selection.camera)
        if readout is None or not readout.seconds:
            continue
        camera = capture.camera(selection.camera)
        lens = replace(camera.camera, sideways=readout.sideways)
        path = camera_rotation(selection, lens, camera.times_ns, readout.seconds)
        if path is not None:
            out[selection.camera] = TurningShutter(lens, path, readout.seconds)
    return out


def possible_readouts(
    capture: Capture, selections: Sequence[KeyframeSelection], readouts: Mapping[str, Readout]
) -> dict[str, Readout]:
    """Return short readout times that matches do not exclude, by camera name.

    If matches find no rolling shutter, the readout time is shorter than 2 ms. Where a camera turns fast, this
    still displaces keypoints far. Such a readout time is an unknown of the adjustment of the map, together
    with those of equal cameras. It does not determine the direction of the rows, so cameras with an unknown
    direction are left out.

    Args:
        capture: All cameras.
        selections: Keyframes of each camera, with the matches between adjacent frames.
        readouts: Readout times from these matches, by camera name.
    """
    short = {
        name: item
        for name, item in readouts.items()
        if item.excludes_rolling and not capture.camera(name).may_be_sideways
    }
    trial = {
        name: replace(item, seconds=abs(item.best_s) + 2.0 * item.sigma_s) for name, item in short.items()
    }
    shutters = turning_shutters(capture, selections, trial)
    frames = {item.camera: np.asarray(item.frames) for item in selections}
    fast = {
        name
        for name, shutter in shutters.items()
        if grid_displacement_px(shutter, frames[name]) > _MAX_DISPLACEMENT_PX
    }
    groups = groups_of_equal_cameras(capture.cameras)
    return {
        name: replace(short[name], seconds=_at_least(short[name].best_s, _MIN_POSSIBLE_S))
        for group in groups
        for name in group
        if name in shutters and not fast.isdisjoint(group)
    }


def _at_least(value: float, size: float) -> float:
    """Return a value whose absolute value is at least the given size, with the same sign."""
    return math.copysign(max(abs(value), size), value)


def grid_displacement_px(shutter: TurningShutter, frames: IntArray) -> float:
    """Return how far a rolling shutter displaces evenly spaced pixels.

    Args:
        shutter: The shutter.
        frames: (K,) frames of the camera.

    Returns:
        The 95th percentile, px of an image with a long side of 640 px; 0 if there are no frames.
    """
    lens = shutter.camera
    if len(frames) == 0:
        return 0.0
    inside = (np.arange(_GRID) + 0.5) / _GRID
    grid = np.stack(np.meshgrid(inside * lens.width_px, inside * lens.height_px), axis=-1).reshape(-1, 2)
    px = np.tile(grid, (len(frames), 1))
    moved = np.linalg.norm(shutter.px_at_mid_row(np.repeat(frames, len(grid)), px) - px, axis=1)
    return float(np.percentile(moved, _DISPLACED_PERCENT)) / pixel_scale(lens.width_px, lens.height_px)


def write_shutters(workspace: Path, shutters: Mapping[str, TurningShutter]) -> None:
    """Store shutters in a workspace. New keyframes are corrected with them when the map is extended."""
    folder = workspace / _FOLDER
    for name, shutter in sorted(shutters.items()):
        folder.mkdir(exist_ok=True)
        write_dataclass(shutter, folder, name)


def read_shutters(workspace: Path, names: Iterable[str]) -> dict[str, TurningShutter]:
    """Read the shutters of some cameras from a workspace, by camera name.

    Cameras without a stored shutter have no entry.
    """
    folder = workspace / _FOLDER
    return {
        name: read_dataclass(TurningShutter, folder, name)
        for name in names
        if (folder / f"{name}.json").exists()
    }
