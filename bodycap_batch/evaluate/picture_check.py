"""Measure how many delivered frames of a results folder the pictures confirm."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.capture.masks import without_regions
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.errors import JobError
from bodycap_batch.evaluate.fresh_features import FrameFeatures, detect_features
from bodycap_batch.evaluate.right_frames import (
    Pictures,
    RightFrames,
    find_right_frames,
    join_paths,
)
from bodycap_batch.evaluate.two_view import Outcome
from bodycap_batch.formats.tum import TimedPoses, read_tum
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import poses_at
from bodycap_batch.tracks import (
    find_fixed_regions,
    find_moving_regions,
    find_moving_tracks,
    measure_rotation_chain,
    track_video,
)

_TIME_TOLERANCE = 0.25
"""Maximum difference between the times of a pose and its frame, as a fraction of the frame interval."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DeliveredCamera:
    """What a results folder delivers of one camera.

    Attributes:
        paths: The delivered poses map_from_camera, one path for each map. The scales, axes and origins of the
            maps differ.
        lens: The delivered intrinsics.
        readout_s: Time from the exposure of the first row to that of the last row; 0 for a global shutter.
    """

    paths: tuple[TimedPoses, ...]
    lens: Camera
    readout_s: float = 0.0


def read_delivered(results: Path) -> dict[str, DeliveredCamera]:
    """Read the paths and the intrinsics of a results folder, by camera name.

    The folder must hold ``trajectories/<camera>.tum`` and a COLMAP model in ``colmap/<n>/`` for each camera.
    Paths in other maps are in folders of ``trajectories/``. Cameras without a pose are left out.

    Raises:
        JobError: The folder holds no paths or no map, or a file is malformed.
    """
    files = sorted((results / "trajectories").rglob("*.tum"))
    if not files:
        raise JobError(
            f"{results} holds no camera paths",
            hint="give the folder of a finished job, with trajectories/<camera>.tum in it",
        )
    lenses = _lenses(results / "colmap")
    paths = defaultdict[str, list[TimedPoses]](list)
    for file in files:
        if len((path := read_tum(file)).times_ns):
            paths[file.stem].append(path)
    if paths and not lenses:
        raise JobError(
            f"{results} holds rotations without a map, so there is no lens to compare them with pictures",
            hint="compare them with true rotations: bodycap evaluate RESULT TRUTH",
        )
    readouts = _readouts(results / "metrics.json")
    return {
        name: DeliveredCamera(
            paths=tuple(found),
            lens=replace(lenses[name], sideways=bool(readouts.get(name, {}).get("sideways", False))),
            readout_s=float(readouts.get(name, {}).get("seconds") or 0.0),
        )
        for name, found in paths.items()
        if name in lenses
    }


def _readouts(metrics: Path) -> dict[str, dict[str, Any]]:
    """Return the readout time of each camera that the figures of a job state; empty without such figures."""
    try:
        mapping = json.loads(metrics.read_bytes())["mapping"]
    except (OSError, ValueError, KeyError):
        return {}
    return {
        name: readout
        for group in (mapping.get("readouts_from_matches", {}), *mapping.get("rolling_shutter", ()))
        for name, readout in group.items()
    }


def _lenses(models: Path) -> dict[str, Camera]:
    """Return the intrinsics of each camera from the largest model that has it."""
    import pycolmap

    lenses: dict[str, Camera] = {}
    for folder in sorted(models.glob("*/"), key=lambda path: (len(path.name), path.name)):
        scene = pycolmap.Reconstruction(str(folder))
        for image in scene.images.values():
            camera = image.camera
            lens = Camera(
                model=camera.model.name, width_px=camera.width, height_px=camera.height, params=camera.params
            )
            lenses.setdefault(image.name.rpartition("/")[0], lens)
    return lenses


def check_with_pictures(
    delivered: Mapping[str, DeliveredCamera],
    cameras: Mapping[str, CaptureCamera],
    progress: Callable[[str, int, int], None],
) -> dict[str, RightFrames]:
    """Compare delivered poses with measurements in the pictures, for each camera.

    Args:
        delivered: Paths and intrinsics, by camera name.
        cameras: The videos, by camera name. Cameras without a delivered path are not compared.
        progress: Receives the camera's name, the number of finished frames and of all frames.

    Raises:
        JobError: A delivered camera has no video.
    """
    missing = sorted(set(delivered) - set(cameras))
    if missing:
        raise JobError(
            f"there is no video of camera {', '.join(missing)}",
            hint=f"the videos are of: {', '.join(sorted(cameras))}",
        )
    return {
        name: _check_camera(each, cameras[name], partial(progress, name)) for name, each in delivered.items()
    }


def _check_camera(
    delivered: DeliveredCamera, camera: CaptureCamera, progress: Callable[[int, int], None]
) -> RightFrames:
    count, paths = len(camera.times_ns), len(delivered.paths)
    pictures = read_pictures(
        camera, delivered.lens, delivered.readout_s, lambda done: progress(done // 2, count)
    )
    found = []
    for number, path in enumerate(delivered.paths):
        poses = poses_of_frames(path, camera)
        show = partial(_show_part, progress, number, paths)
        found.append(find_right_frames(pictures, poses, show))
    return join_paths(found)


def _show_part(progress: Callable[[int, int], None], number: int, parts: int, done: int, total: int) -> None:
    """Show the progress of one of several paths, in the second half of the whole."""
    progress((total + (number * total + done) // parts) // 2, total)


def read_pictures(
    camera: CaptureCamera, lens: Camera, readout_s: float, progress: Callable[[int], None]
) -> Pictures:
    """Return the features of all frames of a camera that lie in the room.

    A hand that moves, or that is fixed to the camera, follows other motions than the room. The tracks that
    find it here use the lens, but no pose and no map.

    Args:
        camera: The camera with its video.
        lens: Intrinsics of the camera.
        readout_s: Time from the exposure of the first row to that of the last row; 0 for a global shutter.
        progress: Receives the number of finished frames.
    """
    size, count = (camera.camera.width_px, camera.camera.height_px), len(camera.times_ns)
    tracks = track_video(camera, lambda done, _: progress(done // 2))
    fixed = find_fixed_regions(tracks, camera.times_ns)
    tracks = tracks.outside(fixed)
    lens_here = lens.scaled(*size)
    moving = find_moving_regions(tracks, find_moving_tracks(tracks, lens_here, camera.times_ns))
    chain = measure_rotation_chain(tracks.outside(moving), lens_here, 0.0, np.arange(count))
    camera = replace(camera, mask=without_regions(camera.mask, fixed, size), moving_regions=moving)
    features: list[FrameFeatures | None] = [None] * count
    for index, image in camera.read_decodable(np.arange(count)):
        in_picture = lens.scaled(image.shape[1], image.shape[0])
        features[index] = detect_features(image, in_picture, partial(camera.is_unmasked, frame=index))
        progress((count + index) // 2)
    return Pictures(features, np.asarray(camera.times_ns * 1e-9), readout_s, chain)


def poses_of_frames(poses: TimedPoses, camera: CaptureCamera) -> FloatArray:
    """Return the pose (N,4,4) of each of the N frames of a video; NaN for a frame without a pose."""
    interval_ns = np.median(np.diff(camera.times_ns)) if len(camera.times_ns) > 1 else 1e9
    snap_ns = int(_TIME_TOLERANCE * interval_ns)
    out, found = poses_at(
        poses.times_ns, poses.world_from_cam, camera.times_ns, max_gap_ns=0, snap_ns=snap_ns
    )
    out[~found] = np.nan
    return out


def to_dict(found: Mapping[str, RightFrames]) -> dict[str, Any]:
    """Return the outcomes of all cameras as plain JSON values."""
    return {
        name: {
            "frames": len(each.outcome),
            "delivered": sum(outcome is not None for outcome in each.outcome),
            **{_KEYS[outcome]: each.count(outcome) for outcome in Outcome},
            "wrong_frames": [index for index, outcome in enumerate(each.outcome) if outcome is Outcome.WRONG],
            "rotations": {_KEYS[outcome]: each.links.get(outcome, 0) for outcome in Outcome},
            "positions": {_KEYS[outcome]: each.positions.get(outcome, 0) for outcome in Outcome},
        }
        for name, each in found.items()
    }


_KEYS = {Outcome.RIGHT: "right", Outcome.WRONG: "wrong", Outcome.UNMEASURABLE: "not_measurable"}
"""Key of each outcome in the JSON values."""
