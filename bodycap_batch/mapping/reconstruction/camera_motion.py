"""The motion of cameras with rolling shutters until their rows are exposed, and its expected errors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.rolling_shutter import row_delay
from bodycap_batch.model.rotation_path import PosePath, RotationPath

_RATE_ERROR_FACTOR = 3.0
"""Factor of the expected errors of the angular velocities of keyframes and of their changes, because the
poses beside a keyframe are inexact, too. Evidence: docs/decisions/mapping.md."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RowMotion:
    """The expected motion of a camera from frame times until pixels are exposed.

    Attributes:
        delay_s: (M,) time of the exposure minus the time of the frame, seconds.
        turn: (M,3) rotation vector from the camera at the exposure to the camera at the time of the frame,
            rad.
        shift: (M,3) motion of the camera until the exposure, in its axes at the time of the frame, map units.
    """

    delay_s: FloatArray
    turn: FloatArray
    shift: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraMotion:
    """The path of a camera with a rolling shutter.

    Attributes:
        camera: The camera model, with the direction of the rows.
        path: The path through the poses of the frames.
        readout_s: Readout time, seconds.
        readout_sigma_s: Standard deviation of the readout time, seconds; 0 if it is given.
        interval_s: Frame interval, seconds.
        error_scales: (N,3) factors of the expected errors of the velocities of each frame; None if an
            adjustment has not determined them.
    """

    camera: Camera
    path: PosePath
    readout_s: float
    readout_sigma_s: float
    interval_s: float
    error_scales: FloatArray | None = None

    def until_exposure(self, frame: IntArray, px: FloatArray) -> RowMotion:
        """Return the motion until pixels (M,2) of frames (M,) are exposed."""
        turn, shift = self.path.turn_and_shift(self.camera, frame, px, self.readout_s)
        return RowMotion(delay_s=row_delay(self.camera, px) * self.readout_s, turn=turn, shift=shift)

    def errors(self, frame: IntArray) -> FloatArray:
        """Return the expected errors (F,3) of the velocities of frames (F,), along each axis.

        They are the errors of the angular velocity, rad/s; of its change in a frame interval, rad/s; and of
        the velocity, map units per second.
        """
        errors = np.stack(self.path.velocity_errors(), axis=1)[frame]
        scales = 1.0 if self.error_scales is None else self.error_scales[frame]
        return np.asarray(errors * [_RATE_ERROR_FACTOR, _RATE_ERROR_FACTOR, 1.0] * scales)


def camera_motions(
    lenses: Mapping[str, Camera],
    poses: Mapping[str, tuple[FloatArray, IntArray]],
    rotations: Mapping[str, RotationPath],
    readout_s: Mapping[str, float],
    readout_sigma_s: Mapping[str, float],
    error_scales: Mapping[str, FloatArray] | None = None,
) -> dict[str, CameraMotion]:
    """Return the motion of each camera with poses and a readout time, by camera name.

    Args:
        lenses: Camera models by camera name.
        poses: Poses map_from_cam (N,4,4) and times (N,) in nanoseconds of the frames, by camera name.
        rotations: Rotations of the cameras between frames without poses, by camera name.
        readout_s: Readout times (seconds) by camera name.
        readout_sigma_s: Their standard deviations (seconds) by camera name; 0 for a camera without an entry.
        error_scales: See `CameraMotion`, by camera name.
    """
    return {
        name: CameraMotion(
            camera=lenses[name],
            # Shrunk velocities are too slow where a hand shakes, so readout times would be too long.
            path=PosePath.create(map_from_cam, times_ns, rotations.get(name), shrunk=False),
            readout_s=readout_s[name],
            readout_sigma_s=readout_sigma_s.get(name, 0.0),
            interval_s=1e-9 * float(np.median(np.diff(times_ns))),
            error_scales=(error_scales or {}).get(name),
        )
        for name, (map_from_cam, times_ns) in poses.items()
        if name in lenses and readout_s.get(name)
    }
