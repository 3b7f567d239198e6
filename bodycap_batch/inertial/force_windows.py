"""Weighted means of the specific force of an inertial sensor and of its acceleration along the solved path.

In the gauge of a map, force = acceleration + gravity · up. Both sides are multiplied by a smooth weight and
integrated over a window. Twice integrated by parts, the acceleration becomes the path times the second
derivative of the weight, so that no path is differentiated.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.inertial.samples import InertialSamples, pinned_orientations
from bodycap_batch.model.geometry import skew
from bodycap_batch.model.gyro_rates import GyroOrientation
from bodycap_batch.model.inertial_camera import ForceWindows
from bodycap_batch.model.scene import Trajectory

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

_HALF_WIDTH_S = 0.4
"""Half of the length of a window, seconds. In 0.8 s, a position error of 4 mm per frame at 30 frames per
second gives an error of 0.03 m/s², a fiftieth of the accelerations of a walk. Evidence: none."""
_MAX_FRAME_GAP_S = 0.15
"""Maximum time (seconds) between two localised frames of a window. Evidence: none."""
_MAX_WINDOWS = 2000
"""Maximum number of windows of a camera. Longer recordings have a larger step between windows."""


def force_windows(
    trajectory: Trajectory, samples: InertialSamples, rotation_sigma_rad: FloatArray
) -> ForceWindows:
    """Return the weighted means of force and acceleration over all windows with poses and samples.

    Args:
        trajectory: The poses of the camera.
        samples: The samples of its sensor.
        rotation_sigma_rad: (3,) standard deviation of the rotation between sensor and camera, radians.
    """
    from scipy.interpolate import CubicSpline

    frames = np.flatnonzero(trajectory.localised)
    frame_s = trajectory.seconds[frames]
    kept = np.flatnonzero(np.diff(frame_s, prepend=-np.inf) > 0.0)
    frames, frame_s = frames[kept], frame_s[kept]
    middles_s = _middles(frame_s, samples)
    rows = []
    if len(middles_s):
        poses = trajectory.gauge_from_cam[frames]
        times_s = samples.times_s
        oriented = GyroOrientation(times_s, samples.rate_rad_s)
        rotation = pinned_orientations(oriented, frame_s, poses[:, :3, :3], times_s)
        path = CubicSpline(frame_s, poses[:, :3, 3])
        for middle_s in middles_s.tolist():
            first, last = np.searchsorted(times_s, [middle_s - _HALF_WIDTH_S, middle_s + _HALF_WIDTH_S])
            inside = slice(int(first), int(last))
            rows.append(
                _window(times_s[inside], middle_s, rotation[inside], samples.force_m_s2[inside], path)
            )
    rows = [row for row in rows if all(np.isfinite(part).all() for part in row[1:])]
    columns = list(zip(*rows, strict=True)) or [()] * 6
    shapes = ((), (3,), (3, 3), (3, 3), (3,), (3, 3))
    arrays = [np.array(column).reshape(-1, *shape) for column, shape in zip(columns, shapes, strict=True)]
    names = ("times_s", "force", "rotation", "turned_force", "acceleration", "lever")
    return ForceWindows(rotation_sigma_rad=rotation_sigma_rad, **dict(zip(names, arrays, strict=True)))


def _middles(frame_s: FloatArray, samples: InertialSamples) -> FloatArray:
    """Return the middles of the windows that localised frames and samples cover without a gap."""
    if len(frame_s) < 2 or frame_s[-1] - frame_s[0] <= 2.0 * _HALF_WIDTH_S:
        return np.zeros(0)
    start_s, end_s = frame_s[0] + _HALF_WIDTH_S, frame_s[-1] - _HALF_WIDTH_S
    step_s = max(_HALF_WIDTH_S, (end_s - start_s) / _MAX_WINDOWS)
    middles_s = np.arange(start_s, end_s + 1e-9, step_s)
    covered = samples.covers(middles_s - _HALF_WIDTH_S, middles_s + _HALF_WIDTH_S)
    wide = np.flatnonzero(np.diff(frame_s) > _MAX_FRAME_GAP_S)
    for index in wide.tolist():
        covered &= (middles_s + _HALF_WIDTH_S <= frame_s[index]) | (
            middles_s - _HALF_WIDTH_S >= frame_s[index + 1]
        )
    return np.asarray(middles_s[covered])


def _window(
    times_s: FloatArray, middle_s: float, rotation: FloatArray, force: FloatArray, path: CubicSpline
) -> tuple[float | FloatArray, ...]:
    """Return the middle of a window, and the weighted means of its samples in the order of `ForceWindows`."""
    u = (times_s - middle_s) / _HALF_WIDTH_S
    step = np.gradient(times_s) if len(times_s) > 1 else np.zeros(len(times_s))
    flat = np.maximum(1.0 - u**2, 0.0)
    weight = step * flat**3
    total = float(weight.sum())
    weight /= total
    # The second derivative of the weight, corrected so that a straight path has no acceleration.
    bend = step * (24.0 * u**2 * flat - 6.0 * flat**2) / (_HALF_WIDTH_S**2 * total)
    basis = np.stack([weight, weight * u, weight * u**2], axis=1)
    moments = np.stack([np.ones_like(u), u, u**2])
    wanted = np.array([0.0, 0.0, 2.0 / _HALF_WIDTH_S**2])
    bend += basis @ np.linalg.solve(moments @ basis, wanted - moments @ bend)
    in_gauge = np.einsum("nij,nj->ni", rotation, force)
    turned = rotation @ skew(force)
    return (
        middle_s,
        weight @ in_gauge,
        np.einsum("n,nij->ij", weight, rotation),
        np.einsum("n,nij->ij", weight, turned),
        bend @ np.asarray(path(times_s)),
        np.einsum("n,nij->ij", bend, rotation),
    )
