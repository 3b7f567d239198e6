"""Measure how the camera turns from frame to frame, from the optical flow alone."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.arrays import FloatArray, IntArray, interpolated, set_array
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.optical_flow import (
    GreyImage,
    detect_corners,
    fit_rotation,
    track_points,
    unit_directions,
)
from bodycap_batch.telemetry.streams import Stream

WORK_PX = 480
"""Long side (pixels) of the images whose flow is measured. Corners of larger images make no difference, since
the mean over all corners is needed. Evidence: none."""
_CORNERS = 120
"""Maximum number of corners of a frame. Evidence: none."""
_SPACING_PX = 12.0
"""Minimum distance (pixels) between two corners. Evidence: none."""
_MIN_POINTS = 20
"""Minimum number of tracked corners for a rotation. A rotation has three unknowns; the other corners show
which of them belong to the wearer or to near things. Evidence: none."""
_ROUNDS = 8
"""Number of times that the weights of a robust rotation are computed. Evidence: none."""
_WINDOW_FRAMES, _MAX_WINDOWS = 150, 3
"""Number of successive frames in a window, and maximum number of windows. Together they take some seconds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureRotation:
    """Rotations of a camera between pairs of successive frames, as the pictures show them.

    Attributes:
        start_s: (N,) time of the first frame of each pair on the clock of the camera, seconds.
        end_s: (N,) time of the second frame of each pair, seconds.
        turn_rad: (N,3) rotation vector of the camera from the first to the second frame, in the frame of the
            camera, radians. It is turned by the angular rate times the interval.
    """

    start_s: FloatArray
    end_s: FloatArray
    turn_rad: FloatArray

    def __post_init__(self) -> None:
        count = len(self.start_s)
        set_array(self, "start_s", (count,))
        set_array(self, "end_s", (count,))
        set_array(self, "turn_rad", (count, 3))

    def chosen(self, keep: IntArray) -> PictureRotation:
        """Return selected pairs."""
        return replace(
            self,
            start_s=self.start_s[keep],
            end_s=self.end_s[keep],
            turn_rad=self.turn_rad[keep],
        )


def measure_picture_rotation(camera: CaptureCamera, gyro: Stream) -> PictureRotation:
    """Measure the rotations of a camera in up to three windows in which its gyroscope turns most.

    Args:
        camera: The camera. A small work size is enough (`WORK_PX`).
        gyro: The gyroscope; it only selects the windows.

    Raises:
        CaptureError: The video cannot be read.
    """
    rows: list[tuple[float, float, FloatArray]] = []
    times_s = np.asarray(camera.times_ns * 1e-9, dtype=np.float64)
    for window in _windows(times_s, gyro):
        before: tuple[int, GreyImage] | None = None
        for index, image in camera.read_decodable(window):
            if before is not None and before[0] == index - 1:
                found = _rotation_between(camera.camera, before[1], image)
                if found is not None:
                    rows.append((float(times_s[index - 1]), float(times_s[index]), found))
            before = (index, image)
    return PictureRotation(
        start_s=np.array([row[0] for row in rows]),
        end_s=np.array([row[1] for row in rows]),
        turn_rad=np.array([row[2] for row in rows]).reshape(-1, 3),
    )


def _windows(times_s: FloatArray, gyro: Stream) -> list[IntArray]:
    """Return the indices of the frames of each window, in the order of time.

    The windows are those in which the mean rates of the intervals between frames differ most from their
    median. Faster changes, such as the vibration of a motor, do not show in the pictures.
    """
    count = len(times_s)
    edges = np.unique(np.linspace(0, count, max(1, round(count / _WINDOW_FRAMES)) + 1).round().astype(int))
    steps = np.diff(gyro.times_s, prepend=gyro.times_s[0])[:, None]
    total = np.cumsum(gyro.values * steps, axis=0)
    rates = np.diff(interpolated(times_s, gyro.times_s, total), axis=0) / np.diff(times_s)[:, None]
    size = np.linalg.norm(rates - np.median(rates, axis=0), axis=1) if len(rates) else np.zeros(0)
    activity = np.array([float(size[start:end].mean()) for start, end in itertools.pairwise(edges.tolist())])
    best = np.sort(np.argsort(-np.nan_to_num(activity), kind="stable")[:_MAX_WINDOWS])
    return [np.arange(edges[index], edges[index + 1]) for index in best.tolist()]


def _rotation_between(camera: Camera, first: GreyImage, second: GreyImage) -> FloatArray | None:
    """Return the rotation vector of the camera between two images; None if too few corners were tracked."""
    from scipy.spatial.transform import Rotation

    px = detect_corners(first, _CORNERS, _SPACING_PX)
    tracked = track_points(first, second, px)
    rays = [camera.unproject(each[tracked.ok].astype(np.float64)) for each in (px, tracked.px)]
    valid = np.isfinite(rays[0]).all(axis=1) & np.isfinite(rays[1]).all(axis=1)
    if valid.sum() < _MIN_POINTS:
        return None
    one, other = (unit_directions(each[valid]) for each in rays)
    second_from_first = fit_rotation(one, other, _ROUNDS)
    return np.asarray(-Rotation.from_matrix(second_from_first).as_rotvec())
