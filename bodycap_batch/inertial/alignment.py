"""Estimate how an inertial sensor relates to its camera, from the solved poses of the camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.inertial.samples import InertialSamples, samples_of_fit
from bodycap_batch.model.geometry import so3_log
from bodycap_batch.model.gyro_rates import GyroOrientation
from bodycap_batch.model.scene import Trajectory
from bodycap_batch.telemetry.comparison import PictureGyroComparison, judge_rotations
from bodycap_batch.telemetry.gyro_fit import GyroFit, RateIntegral
from bodycap_batch.telemetry.picture_rotation import PictureRotation
from bodycap_batch.telemetry.streams import CameraTelemetry

_MAX_STEP_S = 0.1
"""Maximum time (seconds) between successive localised frames of a pair: three frames at 30 frames per second.
Evidence: none."""
_PAIR_S, _PAIR_RAD = 0.15, 0.35
"""Maximum time (seconds) and maximum sum of the rotations (radians) between the two frames of a pair, unless
they are successive. The longer the time, the less the noise of the poses counts; the less the rotation, the
nearer it is to the integral of the rate. Evidence: none."""
_ROUNDS = 3
"""Number of fits. Each one corrects the rotations for the change of the axis within a pair of frames, with
the rates of the fit before. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorAlignment:
    """How an inertial sensor relates to its camera.

    Attributes:
        comparison: The comparison of the solved poses with the gyroscope.
        samples: The samples in the axes and on the clock of the camera. None if the sensor does not agree
            with the pictures, so that it cannot be used.
    """

    comparison: PictureGyroComparison
    samples: InertialSamples | None = None

    @property
    def fit(self) -> GyroFit | None:
        """The fit, if the sensor can be used."""
        return None if self.samples is None else self.comparison.fit


def align_sensor(trajectory: Trajectory, telemetry: CameraTelemetry) -> SensorAlignment:
    """Estimate delay, rotation, bias and rate of a gyroscope from the solved poses of its camera.

    Args:
        trajectory: The poses of the camera's frames.
        telemetry: The telemetry of the camera.
    """
    gyro = telemetry.gyro
    if gyro is None or len(gyro.times_s) < 2:
        reason = "the camera recorded no gyroscope"
        return SensorAlignment(comparison=PictureGyroComparison(verdict="unknown", reason=reason))
    seen = rotations_between_frames(trajectory)
    corrected = seen
    for _ in range(_ROUNDS):
        compared = judge_rotations(corrected, gyro, telemetry, focal_known=True)
        if compared.verdict != "agrees" or compared.fit is None:
            return SensorAlignment(comparison=compared)
        samples = samples_of_fit(gyro, telemetry.accelerometer, compared.fit)
        corrected = replace(seen, turn_rad=seen.turn_rad - _axis_change(seen, samples))
    return SensorAlignment(comparison=compared, samples=samples)


def rotations_between_frames(trajectory: Trajectory) -> PictureRotation:
    """Return the rotation from each localised frame to a later one.

    The later frame is the last one within `_PAIR_S` and `_PAIR_RAD`, at least the next one. Pairs overlap,
    but hardly two of them have a frame at the same end, so their errors are nearly independent.
    """
    frames = np.flatnonzero(trajectory.localised)
    times_s = trajectory.seconds[frames]
    rotation = trajectory.gauge_from_cam[frames][:, :3, :3]
    step_rad = np.linalg.norm(so3_log(np.swapaxes(rotation[:-1], 1, 2) @ rotation[1:]), axis=1)
    step_s = np.diff(times_s)
    near = (step_s > 0.0) & (step_s <= _MAX_STEP_S)
    first = np.flatnonzero(near)
    last, turned = first + 1, step_rad[first]
    while True:
        following = np.minimum(last, len(near) - 1)
        longer = (last < len(near)) & near[following]
        longer &= times_s[np.minimum(last + 1, len(times_s) - 1)] - times_s[first] <= _PAIR_S
        longer &= turned + step_rad[following] <= _PAIR_RAD
        if not longer.any():
            break
        turned = turned + np.where(longer, step_rad[following], 0.0)
        last = last + longer
    return PictureRotation(
        start_s=times_s[first],
        end_s=times_s[last],
        turn_rad=so3_log(np.swapaxes(rotation[first], 1, 2) @ rotation[last]).reshape(-1, 3),
    )


def _axis_change(pairs: PictureRotation, samples: InertialSamples) -> FloatArray:
    """Return rotation vector minus integral of the rate (N,3), radians, for each pair of frames.

    The two differ if the axis of the rotation changes between the frames.
    """
    oriented = GyroOrientation(samples.times_s, samples.rate_rad_s)
    first, second = oriented.at(pairs.start_s), oriented.at(pairs.end_s)
    exact = so3_log(np.swapaxes(first, 1, 2) @ second)
    plain = RateIntegral(samples.times_s, samples.rate_rad_s).between(pairs.start_s, pairs.end_s)
    outside = ~samples.covers(pairs.start_s, pairs.end_s)
    return np.where(outside[:, None], 0.0, exact - plain)
