"""Detection of stationary cameras, such as a camera on a table, while other cameras of their map move."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.model.merge_data import MergeInputs
from bodycap_batch.model.scene import Trajectory

_MAX_DEVIATION_RATIO, _MAX_DEVIATION_RAD = 0.005, float(np.radians(0.3))
"""Maximum deviations of a stationary camera. The first value is for the deviation from the median position,
as a ratio to the deviation of the camera that moves most in the map. The second value is for the deviation
from the mean orientation, in radians. Evidence: docs/decisions/merging.md."""
_MAX_NOISE_FACTOR = 2.0
"""Maximum factor by which noise widens the maximum deviations of position and rotation. Without this maximum,
moving cameras with noisy poses would be treated as stationary."""
WINDOW_FRAMES = 15
"""Number of localised frames that are averaged: half a second at 30 fps. The average reduces noise, because
noise is independent between frames. A movement of the body is not independent between frames, so it
remains."""
_PERCENTILE, PERCENTILE_SIGMAS = 90.0, 2.5
"""Percentile of the deviations that is compared with the bounds, and the value of this percentile in sigmas
of the noise. For Gaussian noise with the same sigma on all three axes, the 90th percentile of the norm is 2.5
sigmas (chi distribution with three degrees of freedom)."""
_MIN_DURATION_RATIO = 0.5
"""Minimum localised time of a stationary camera, as a ratio to the longest localised time of all cameras. A
camera with a shorter localised time is not treated as stationary. In a short time, it may stand still only
because the person stands still. Evidence: none."""


@dataclass(frozen=True, slots=True)
class _CameraPath:
    """The localised frames of one camera.

    Attributes:
        gauge: Name of the gauge of the positions.
        times_ns: (N,) times on the common clock.
        centres: (N,3) positions of the camera, map units.
        rotations: N orientations of the camera.
        sigma_rad: Median sigma of the rotation per axis, radians.
        sigma_map: Median sigma of the centre per axis, map units.
    """

    gauge: str
    times_ns: IntArray
    centres: FloatArray
    rotations: Rotation
    sigma_rad: float
    sigma_map: float

    def deviations_during(self, first_ns: int, last_ns: int) -> FloatArray:
        """Return the distances (M,), map units, of the centres in a time span to their median position."""
        inside = self.centres[(self.times_ns >= first_ns) & (self.times_ns <= last_ns)]
        return (
            np.asarray(np.linalg.norm(inside - np.median(inside, axis=0), axis=1)) if len(inside) else inside
        )


def stationary_cameras(inputs: MergeInputs, trajectories: Sequence[Trajectory]) -> list[str]:
    """Find cameras that stand still while another camera of their map moves.

    Args:
        inputs: The inputs of the merge stage. Only the clocks are used.
        trajectories: Trajectories of the cameras with at least `WINDOW_FRAMES` localised frames.

    Returns:
        The names of the stationary cameras.
    """
    paths = {each.camera: _camera_path(inputs, each) for each in trajectories}
    seconds = {
        camera: len(path.times_ns) / inputs.clocks[camera].nominal_fps for camera, path in paths.items()
    }
    longest = max(seconds.values(), default=0.0)
    return [
        camera
        for camera, path in paths.items()
        if seconds[camera] >= _MIN_DURATION_RATIO * longest
        and _keeps_orientation(path)
        and _keeps_position(path, paths.values())
    ]


def _camera_path(inputs: MergeInputs, trajectory: Trajectory) -> _CameraPath:
    frames = trajectory.localised
    poses = trajectory.gauge_from_cam[frames]
    variances = np.median(np.diagonal(trajectory.covariance[frames], axis1=1, axis2=2), axis=0)
    return _CameraPath(
        gauge=trajectory.gauge,
        times_ns=inputs.clocks[trajectory.camera].common_times_ns(trajectory.times_ns[frames]),
        centres=poses[:, :3, 3],
        rotations=Rotation.from_matrix(poses[:, :3, :3]),
        sigma_rad=float(np.sqrt(variances[:3].mean())),
        sigma_map=float(np.sqrt(variances[3:].mean())),
    )


def _keeps_orientation(path: _CameraPath) -> bool:
    deviations = (path.rotations.mean().inv() * path.rotations).as_rotvec()
    return _deviates_little(deviations, _MAX_DEVIATION_RAD, path.sigma_rad)


def _keeps_position(path: _CameraPath, others: Iterable[_CameraPath]) -> bool:
    """Return True if a camera keeps its position while another camera of its map moves."""
    span = int(path.times_ns.min()), int(path.times_ns.max())
    deviations = [other.deviations_during(*span) for other in others if other.gauge == path.gauge]
    largest = max(
        float(np.percentile(each, _PERCENTILE)) for each in deviations if len(each) >= WINDOW_FRAMES
    )
    centred = path.centres - np.median(path.centres, axis=0)
    return _deviates_little(centred, _MAX_DEVIATION_RATIO * largest, path.sigma_map)


def _deviates_little(deviations: FloatArray, limit: float, sigma: float) -> bool:
    """Return True if deviations (N,3) are below a limit.

    Means over windows of frames must be below the limit. Single frames must be below a bound that allows for
    the noise of one frame.

    Args:
        deviations: (N,3) deviation of each frame from the mean or the median.
        limit: Maximum deviation of a camera without noise.
        sigma: Sigma of the noise of one frame per axis.
    """
    count = len(deviations) // WINDOW_FRAMES
    windows = deviations[: count * WINDOW_FRAMES].reshape(-1, WINDOW_FRAMES, 3).mean(axis=1)
    bound = with_noise(limit, PERCENTILE_SIGMAS * sigma / float(np.sqrt(WINDOW_FRAMES)))
    mean, single = (
        float(np.percentile(np.linalg.norm(each, axis=1), _PERCENTILE)) for each in (windows, deviations)
    )
    return mean < bound and single < np.sqrt(WINDOW_FRAMES) * bound


def with_noise(limit: float, noise: float) -> float:
    """Return a limit of a deviation, widened by its noise, at most by `_MAX_NOISE_FACTOR`."""
    return min(float(np.hypot(limit, noise)), _MAX_NOISE_FACTOR * limit)
