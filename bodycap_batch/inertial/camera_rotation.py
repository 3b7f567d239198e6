"""The rotation of a camera over time: from its gyroscope where it can be used, else from its pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodycap_batch.core.arrays import IntArray
from bodycap_batch.inertial.alignment import align_sensor
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.gyro_rates import GyroRates
from bodycap_batch.model.rotation_fit import fit_rotation_path
from bodycap_batch.model.rotation_path import RotationPath
from bodycap_batch.model.scene import KeyframeSelection, Trajectory
from bodycap_batch.telemetry.streams import GYROSCOPE, CameraTelemetry, Stream


def camera_rotation(
    selection: KeyframeSelection,
    lens: Camera,
    times_ns: IntArray,
    readout_s: float,
    solved: Trajectory | None = None,
) -> RotationPath | None:
    """Return the rotation of a camera over time.

    Where the gyroscope of the camera agrees with its pictures and has samples, it gives the rotation. Matches
    between adjacent frames give it elsewhere, if the camera has a rolling shutter.

    Args:
        selection: The keyframes of the camera, with the matches and what the gyroscope measured.
        lens: Intrinsics of the camera.
        times_ns: (N,) frame times, nanoseconds.
        readout_s: Readout time, seconds; 0 for a global shutter.
        solved: Poses of the camera from an earlier round. They relate the gyroscope to the camera more
            exactly than the matches. None if there are none.

    Returns:
        The rotation; None if neither of them gives it.
    """
    gyro = selection.gyro
    if gyro is not None and solved is not None:
        gyro = related_to_poses(gyro, solved)
    measured = None if gyro is None else RotationPath.from_gyro(times_ns, gyro)
    if gyro is not None and measured is not None and measured.measured().all():
        return measured
    if not readout_s or selection.matches is None:
        return measured
    pictures = fit_rotation_path(selection.matches, lens, times_ns, readout_s)
    return pictures if gyro is None else RotationPath.from_gyro(times_ns, gyro, pictures)


def related_to_poses(gyro: GyroRates, solved: Trajectory) -> GyroRates | None:
    """Return what a gyroscope measured, with the relation to the camera that solved poses give.

    Returns:
        The angular velocities; unchanged if there are too few poses, and None if the poses contradict them.
    """
    stream = Stream(
        key=GYROSCOPE,
        name=GYROSCOPE,
        unit="rad/s",
        times_s=gyro.times_s,
        values=gyro.rate_rad_s,
        rate_hz=1.0 / float(np.median(np.diff(gyro.times_s))),
        gaps_s=tuple((float(start), float(end)) for start, end in gyro.gaps_s),
    )
    if solved.localised.sum() < 2:
        return gyro
    telemetry = CameraTelemetry(streams={GYROSCOPE: stream}, axes_known=True)
    aligned = align_sensor(solved, telemetry)
    if aligned.comparison.fit is None:
        return gyro
    if aligned.samples is None:
        return None
    return replace(
        gyro,
        times_s=aligned.samples.times_s,
        rate_rad_s=aligned.samples.rate_rad_s,
        gaps_s=np.array(aligned.samples.gaps_s).reshape(-1, 2),
    )
