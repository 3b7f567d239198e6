"""Relate the gyroscope of a camera to its pictures before poses exist, from matches of adjacent frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.model.frame_matches import FrameMatches
from bodycap_batch.model.geometry import so3_log
from bodycap_batch.model.gyro_rates import GyroRates
from bodycap_batch.model.rotation_fit import MatchedRays, fit_to_rays
from bodycap_batch.telemetry.comparison import judge_rotations
from bodycap_batch.telemetry.match_fit import fit_to_matches
from bodycap_batch.telemetry.picture_rotation import PictureRotation
from bodycap_batch.telemetry.streams import CameraTelemetry

_MAX_FOCAL_CHANGE = 0.06
"""Maximum difference of the focal ratio from 1. With a larger one, the angles that the pictures of a camera
without a calibration show are wrong. The flow of near walls changes the ratio by some
percent. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RelatedGyro:
    """The gyroscope of a camera, related to its pictures.

    Attributes:
        rates: What it measured; None if it cannot be used.
        reason: Sentence that says why it is used or not.
    """

    rates: GyroRates | None
    reason: str


def relate_gyro(camera: CaptureCamera, matches: FrameMatches, telemetry: CameraTelemetry) -> RelatedGyro:
    """Estimate rotation, bias and delay of a gyroscope, and the readout time, from matches of pictures.

    Args:
        camera: The camera.
        matches: Matches between adjacent frames.
        telemetry: The telemetry of the camera.
    """
    gyro = telemetry.gyro
    if gyro is None or len(gyro.times_s) < 2:
        return RelatedGyro(rates=None, reason="the camera recorded no gyroscope")
    times_s = np.asarray(camera.times_ns * 1e-9, dtype=np.float64)
    stated_s = camera.rolling_shutter_s if camera.rolling_shutter_known else None
    rays = MatchedRays.of(matches, camera.camera, len(times_s))
    path = fit_to_rays(rays, camera.times_ns, stated_s or 0.0, with_rates=False)
    step, known = path.steps()
    compared = judge_rotations(
        _rotations(step[known], times_s, known), gyro, telemetry, focal_known=camera.calibrated
    )
    if compared.verdict != "agrees" or compared.fit is None:
        return RelatedGyro(rates=None, reason=compared.reason)
    if abs(compared.fit.focal_ratio - 1.0) > _MAX_FOCAL_CHANGE:
        reason = f"the focal length is wrong by a factor of {compared.fit.focal_ratio:.2f}"
        return RelatedGyro(rates=None, reason=reason)
    better = None
    if stated_s is not None or not camera.may_be_sideways:
        better = fit_to_matches(rays, times_s, gyro, camera.camera, compared.fit, stated_s)
    fit, readout_s, readout_sigma_s = better or (compared.fit, float("nan"), float("inf"))
    on_clock_s, rate_rad_s = fit.in_camera(gyro)
    rates = GyroRates(
        times_s=on_clock_s,
        rate_rad_s=rate_rad_s,
        gaps_s=np.array(gyro.gaps_s).reshape(-1, 2) - fit.delay_s,
        readout_s=readout_s,
        readout_sigma_s=readout_sigma_s,
    )
    return RelatedGyro(rates=rates, reason=compared.reason)


def _rotations(step: FloatArray, times_s: FloatArray, known: BoolArray) -> PictureRotation:
    return PictureRotation(
        start_s=times_s[:-1][known],
        end_s=times_s[1:][known],
        turn_rad=-so3_log(step).reshape(-1, 3),
    )
