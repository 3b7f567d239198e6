"""Turn the localised frames of a camera into regular, smoothed signals of its motion."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from bodycap_batch.config.mounts import TRUNK_ROLES
from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, set_array
from bodycap_batch.model.geometry import continuous_quat_xyzw, rotation_from_quat_xyzw

STEP_S = 0.04
"""Time between the samples of the signals, seconds. Origin: the smoothing leaves frequencies below 8 Hz."""
_FINE_STEPS = 4
"""Number of interpolated samples in each step, on which the smoothing works."""
_SMOOTHING_S = 0.05
"""Standard deviation of the smoothing of positions and rotations, seconds. Origin: it reduces the noise of
poses, and the movements of a limb are slower. Evidence: none."""
BAND_EDGES_S = (0.2, 0.6)
"""Standard deviations of the smoothing, seconds, that divides velocity and turn rate into three bands: shocks
of steps, swings, slow movements. Evidence: none."""
_MAX_GAP_S = 0.21
"""Maximum time between two frames for an interpolation, seconds. Origin: three frames at 15 fps."""
_GAP_MARGIN_S = 0.06
"""Time before and after a gap that is not used, seconds, because the smoothing mixes it with the gap."""
_ENERGY_S = 0.3
"""Standard deviation of the smoothing of the energy that weights the samples, seconds. Evidence: none."""
_OUTLIER_RATIO = 8.0
"""Minimum ratio of the deviation of a gross error to the median deviation. Evidence: none."""
_OUTLIER_STEPS = 4.0
"""Minimum ratio of the deviation of a gross error to the usual movement between frames. Evidence: none."""
_MAX_OUTLIER_SHARE = 0.3
"""Maximum share of gross errors. If there are more, no frame is left out. Evidence: none."""
_MIN_FRAMES = 20
"""Least number of frames of a usable path. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraPath:
    """The localised frames of one camera.

    Attributes:
        camera: Name of the camera.
        role: Role of the bone that the camera is mounted on.
        times_ns: (N,) times on the camera's own clock, nanoseconds, increasing.
        map_from_cam: (N,4,4) poses of the camera. All cameras have the same gauge, of any scale.
    """

    camera: str
    role: str
    times_ns: IntArray
    map_from_cam: FloatArray

    def __post_init__(self) -> None:
        set_array(self, "times_ns", (None,), np.int64)
        set_array(self, "map_from_cam", (len(self.times_ns), 4, 4))
        if (np.diff(self.times_ns) <= 0).any():
            raise ValueError("times_ns: must increase")

    @property
    def is_on_trunk(self) -> bool:
        """True if the camera is mounted on the trunk or the head."""
        return self.role in TRUNK_ROLES


@dataclass(frozen=True, slots=True)
class MotionSignals:
    """The motion of a camera at regular times, in the axes of the map.

    Attributes:
        first_step: Time of the first sample on the camera's clock, in steps of `STEP_S`.
        present: (N,) 1 where the camera was localised, else 0.
        position: (3,N) smoothed positions, map units.
        map_from_cam: (3,3,N) smoothed rotations.
        velocities: (B,3,N) velocities of each band, map units per second.
        turn_rates: (B,3,N) turn rates of each band, radians per second.
        velocity_weights: (B,N) weights of the samples of each velocity; 0 where the camera was lost.
        turn_weights: (B,N) weights of the samples of each turn rate.
    """

    first_step: int
    present: FloatArray
    position: FloatArray
    map_from_cam: FloatArray
    velocities: FloatArray
    turn_rates: FloatArray
    velocity_weights: FloatArray
    turn_weights: FloatArray

    @property
    def count(self) -> int:
        """Number of samples."""
        return len(self.present)

    @property
    def present_s(self) -> float:
        """Time in which the camera was localised, seconds."""
        return float(self.present.sum()) * STEP_S

    def part(self, start: int, stop: int) -> MotionSignals:
        """Return the samples from `start` to `stop`, in samples."""
        start, stop = max(start, 0), min(stop, self.count)
        names = [each.name for each in fields(self) if each.name != "first_step"]
        parts = {name: getattr(self, name)[..., start:stop] for name in names}
        return MotionSignals(first_step=self.first_step + start, **parts)


def motion_signals(path: CameraPath) -> MotionSignals | None:
    """Interpolate and smooth a path.

    Returns:
        The signals; None if the path has too few frames.
    """
    keep = _without_gross_errors(path.map_from_cam)
    times_s = np.asarray(1e-9 * path.times_ns[keep], dtype=np.float64)
    if len(times_s) < _MIN_FRAMES:
        return None
    first, last = int(np.ceil(times_s[0] / STEP_S)), int(np.floor(times_s[-1] / STEP_S))
    if last - first < 2:
        return None
    fine = (first + np.arange((last - first) * _FINE_STEPS + 1) / _FINE_STEPS) * STEP_S
    step_s = STEP_S / _FINE_STEPS
    after = np.clip(np.searchsorted(times_s, fine), 1, len(times_s) - 1)
    present = _eroded(times_s[after] - times_s[after - 1] <= _MAX_GAP_S, round(_GAP_MARGIN_S / step_s))
    poses = path.map_from_cam[keep]
    position = _smoothed(_interpolated(fine, times_s, poses[:, :3, 3]), _SMOOTHING_S / step_s)
    quat = continuous_quat_xyzw(poses[:, :3, :3])
    quat = _smoothed(_interpolated(fine, times_s, quat), _SMOOTHING_S / step_s)
    rotation = rotation_from_quat_xyzw(quat)
    velocity = np.gradient(position, step_s, axis=0)
    turn_rate = _turn_rate(rotation, step_s)
    keep_steps = slice(None, None, _FINE_STEPS)
    mask = present[keep_steps].astype(np.float64)
    if mask.sum() < 2:
        return None
    velocities = np.array([band[keep_steps].T for band in _bands(velocity, step_s)])
    turn_rates = np.array([band[keep_steps].T for band in _bands(turn_rate, step_s)])
    return MotionSignals(
        first_step=first,
        present=mask,
        position=position[keep_steps].T.copy(),
        map_from_cam=np.moveaxis(rotation[keep_steps], 0, -1).copy(),
        velocities=velocities,
        turn_rates=turn_rates,
        velocity_weights=np.array([_weights(band, mask) for band in velocities]),
        turn_weights=np.array([_weights(band, mask) for band in turn_rates]),
    )


def _without_gross_errors(map_from_cam: FloatArray) -> BoolArray:
    """Return which poses (N,) are not gross errors."""
    keep = np.ones(len(map_from_cam), dtype=bool)
    for _ in range(2):
        poses = map_from_cam[keep]
        if len(poses) < _MIN_FRAMES:
            break
        bad = _is_far(poses[:, :3, 3]) | _is_far(continuous_quat_xyzw(poses[:, :3, :3]))
        if bad.mean() > _MAX_OUTLIER_SHARE:
            break
        keep[np.flatnonzero(keep)[bad]] = False
    return keep


def _is_far(values: FloatArray) -> BoolArray:
    """Return which values (N,K) are farther from the median of their neighbours than movement explains."""
    from scipy.ndimage import median_filter

    away = np.linalg.norm(values - median_filter(values, size=(7, 1), mode="nearest"), axis=1)
    steps = np.linalg.norm(np.diff(values, axis=0), axis=1)
    # The middle of seven moving values is at most three steps from their median. Half of 15 steps is usual.
    usual = median_filter(np.append(steps, steps[-1]), size=15, mode="nearest")
    limit = np.maximum(_OUTLIER_RATIO * float(np.median(away)), _OUTLIER_STEPS * usual)
    return np.asarray(away > limit + 1e-12)


def _interpolated(at_s: FloatArray, times_s: FloatArray, values: FloatArray) -> FloatArray:
    """Interpolate values (N,K) linearly at times (T,)."""
    return np.stack([np.interp(at_s, times_s, column) for column in values.T], axis=1)


def _smoothed(values: FloatArray, sigma: float) -> FloatArray:
    """Smooth values (N,...) over time; sigma in samples."""
    from scipy.ndimage import gaussian_filter1d

    return np.asarray(gaussian_filter1d(values, sigma, axis=0, mode="nearest"))


def _eroded(mask: BoolArray, count: int) -> BoolArray:
    """Return the mask (N,) without the `count` samples next to those that are False."""
    from scipy.ndimage import binary_erosion

    return np.asarray(binary_erosion(mask, np.ones(2 * count + 1, dtype=bool), border_value=1))


def _turn_rate(rotation: FloatArray, step_s: float) -> FloatArray:
    """Return the turn rates (N,3) of rotations (N,3,3) in the axes of the map, radians per second."""
    # The turn in a step is so small that the skew part of the rotation is the rotation vector.
    turn = np.einsum("nik,njk->nij", rotation[2:], rotation[:-2])
    rate = 0.5 * np.stack(
        [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], axis=1
    )
    rate = rate / (2.0 * step_s)
    return np.concatenate([rate[:1], rate, rate[-1:]])


def _bands(values: FloatArray, step_s: float) -> list[FloatArray]:
    """Divide a signal (N,3) into bands, the fastest one first."""
    bands = []
    for edge_s in BAND_EDGES_S:
        slow = _smoothed(values, edge_s / step_s)
        bands.append(values - slow)
        values = slow
    return [*bands, values]


def _weights(band: FloatArray, present: FloatArray) -> FloatArray:
    """Return weights (N,) that reduce the influence of short, strong movements of (3,N)."""
    energy = _smoothed((band**2).sum(axis=0), _ENERGY_S / STEP_S)
    typical = float(np.median(energy[present > 0])) + 1e-300
    return np.asarray(present * typical / (energy + typical))
