"""Relate the world of a job to the Earth, from the GPS positions of its cameras."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.export.export_inputs import ExportInputs
from bodycap_batch.model.earth import EarthPlace, place_on_earth
from bodycap_batch.model.scene import Trajectory

_MAX_GAP_S = 0.5
"""Maximum time (seconds) from a GPS position to the frames before and after it. A person walks less than the
error of GPS in it."""


def earth_of_world(inputs: ExportInputs) -> EarthPlace | None:
    """Return the place of the world on the Earth; None without a body, or without enough GPS positions."""
    if inputs.merge is None:
        return None
    cameras = []
    for path in inputs.merge.trajectories:
        sensor = inputs.inertial.get(path.camera)
        if sensor is not None and sensor.gps is not None:
            cameras.append((sensor.gps, _positions_at(path, sensor.gps.times_s)))
    return place_on_earth(cameras)


def _positions_at(path: Trajectory, times_s: FloatArray) -> FloatArray:
    """Return the positions (N,3) of a camera at times (N,), seconds; NaN between distant frames."""
    out = np.full((len(times_s), 3), np.nan)
    frames = np.flatnonzero(path.localised)
    if len(frames) < 2:
        return out
    seconds, place = path.seconds[frames], path.gauge_from_cam[frames, :3, 3]
    after = np.searchsorted(seconds, times_s)
    inside = (after > 0) & (after < len(seconds))
    before = np.clip(after - 1, 0, len(seconds) - 1)
    inside &= seconds[np.minimum(after, len(seconds) - 1)] - seconds[before] <= _MAX_GAP_S
    for axis in range(3):
        out[inside, axis] = np.interp(times_s[inside], seconds, place[:, axis])
    return out
