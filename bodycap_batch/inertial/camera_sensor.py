"""Use the inertial sensor of one camera after its frames are registered."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.config.options import TelemetryOptions
from bodycap_batch.inertial.alignment import align_sensor
from bodycap_batch.inertial.force_windows import force_windows
from bodycap_batch.inertial.gap_filling import FilledGaps, constants_of_clip, fill_gaps
from bodycap_batch.model.earth import GpsFixes
from bodycap_batch.model.gravity import fit_gravity
from bodycap_batch.model.inertial_camera import InertialCamera, SensorRelation
from bodycap_batch.model.scene import Trajectory
from bodycap_batch.telemetry.gyro_fit import GyroFit
from bodycap_batch.telemetry.streams import CameraTelemetry, GpsTrack

_MAX_DILUTION = 10.0
"""Maximum dilution of precision of a used position. Origin: receivers call a larger one poor."""
_SIGMA_PER_DILUTION_M, _UNKNOWN_SIGMA_M = 2.5, 5.0
"""Standard deviation of a horizontal coordinate (metres) per dilution of precision, and if the dilution is
unknown. Origin: usual range errors of consumer's receivers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class UsedSensor:
    """What the sensor of a camera gives.

    Attributes:
        camera: Its relation to the camera, and what it measures.
        trajectory: The poses of the camera, with the frames that the sensor added.
    """

    camera: InertialCamera
    trajectory: Trajectory


def use_sensor(trajectory: Trajectory, telemetry: CameraTelemetry, options: TelemetryOptions) -> UsedSensor:
    """Estimate how the sensor of a camera relates to its solved poses, and use what it measures.

    Args:
        trajectory: The poses of the camera's frames.
        telemetry: The telemetry of the camera.
        options: Which uses of the telemetry are on.
    """
    aligned = align_sensor(trajectory, telemetry)
    windows, filled = None, FilledGaps(trajectory=trajectory, filled=0, refused=0)
    if aligned.fit is not None and aligned.samples is not None:
        windows = force_windows(trajectory, aligned.samples, aligned.fit.rotation_sigma_rad)
        gravity = fit_gravity([windows]) if options.gaps else None
        constants = None if gravity is None else constants_of_clip(aligned.fit, gravity)
        if constants is not None:
            filled = fill_gaps(trajectory, aligned.samples, constants)
    camera = InertialCamera(
        camera=trajectory.camera,
        gauge=trajectory.gauge,
        source=telemetry.source,
        verdict=aligned.comparison.verdict,
        reason=aligned.comparison.reason,
        relation=None if aligned.fit is None else _relation(aligned.fit),
        windows=windows if options.gravity and windows is not None and len(windows.times_s) else None,
        filled=filled.filled,
        refused=filled.refused,
        gps=_gps_fixes(telemetry.gps) if options.gps and telemetry.gps is not None else None,
    )
    return UsedSensor(camera=camera, trajectory=filled.trajectory)


def _gps_fixes(track: GpsTrack) -> GpsFixes | None:
    """Return the usable positions of a GPS receiver; None if there are none."""
    unknown = ~np.isfinite(track.dilution)
    usable = (track.fix != 0) & (unknown | (track.dilution < _MAX_DILUTION))
    if not usable.any():
        return None
    sigma_m = np.where(unknown, _UNKNOWN_SIGMA_M, _SIGMA_PER_DILUTION_M * np.nan_to_num(track.dilution))
    return GpsFixes(
        times_s=track.times_s[usable],
        latitude_longitude_deg=track.latitude_longitude_deg[usable],
        altitude_m=track.altitude_m[usable],
        sigma_m=np.maximum(sigma_m[usable], _SIGMA_PER_DILUTION_M),
    )


def _relation(fit: GyroFit) -> SensorRelation:
    return SensorRelation(
        delay_s=fit.delay_s,
        delay_sigma_s=fit.delay_sigma_s,
        drift=fit.drift,
        drift_sigma=fit.drift_sigma,
        cam_from_sensor=fit.cam_from_sensor,
        rotation_sigma_rad=np.asarray(fit.rotation_sigma_rad),
        bias_rad_s=fit.bias_rad_s,
        bias_sigma_rad_s=np.asarray(fit.bias_sigma_rad_s),
        r_squared=fit.r_squared,
        pairs=fit.pairs,
    )
