"""Detection of stationary cameras: a camera on a table, or a frozen one, while others of its map move."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.model.merge_data import MergeInputs
from bodycap_batch.model.scene import Trajectory

_MAX_DEVIATION_RATIO, _MAX_DEVIATION_RAD = 0.005, float(np.radians(0.3))
"""A stationary camera deviates from its median position by less than the first value, as a ratio of the
deviation of the camera of its map that moves most. It rotates by less than the second value (radians).
Evidence: docs/decisions/merging.md."""
_MAX_NOISE_FACTOR = 2.0
"""Noise widens both bounds by this factor at most, so that noisy poses alone exclude no moving camera."""
_WINDOW_FRAMES = 15
"""Localised frames that are averaged: half a second at 30 fps. Noise is independent between frames, a
movement of the body is not."""
_PERCENTILE, _PERCENTILE_SIGMAS = 90.0, 2.5
"""Deviations are judged by this percentile. For Gaussian noise with one sigma on three axes, the 90th
percentile of the norm is 2.5 sigmas (chi distribution with three degrees of freedom)."""
_MIN_DURATION_RATIO = 0.5
"""Smallest localised time of a stationary camera, as a ratio of that of the camera localised longest: a
person who stands still for a second shows nothing about the rest. Evidence: none."""


@dataclass(frozen=True, slots=True)
class _CameraPath:
    """The localised frames of one camera.

    Attributes:
        gauge: Of the positions.
        times_ns: (N,) common time.
        centres: (N,3) positions, map units.
        rotations: N orientations.
        sigma_rad: Median rotation sigma per axis.
        sigma_map: Median sigma of the centre per axis, map units.
    """

    gauge: str
    times_ns: IntArray
    centres: FloatArray
    rotations: Rotation
    sigma_rad: float
    sigma_map: float

    def deviations_during(self, first_ns: int, last_ns: int) -> FloatArray:
        """Return the distances (M,) of the centres in a time span from their median; map units."""
        inside = self.centres[(self.times_ns >= first_ns) & (self.times_ns <= last_ns)]
        return (
            np.asarray(np.linalg.norm(inside - np.median(inside, axis=0), axis=1)) if len(inside) else inside
        )


def stationary_cameras(inputs: MergeInputs, trajectories: Sequence[Trajectory]) -> list[str]:
    """Find cameras that stand still while another one of their map moves.

    Args:
        inputs: The clocks.
        trajectories: Of cameras with at least half a second of localised frames.
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
    """Return whether a camera keeps its position while another one of its map moves."""
    span = int(path.times_ns.min()), int(path.times_ns.max())
    deviations = [other.deviations_during(*span) for other in others if other.gauge == path.gauge]
    largest = max(
        float(np.percentile(each, _PERCENTILE)) for each in deviations if len(each) >= _WINDOW_FRAMES
    )
    centred = path.centres - np.median(path.centres, axis=0)
    return _deviates_little(centred, _MAX_DEVIATION_RATIO * largest, path.sigma_map)


def _deviates_little(deviations: FloatArray, limit: float, sigma: float) -> bool:
    """Return whether deviations (N,3) are below a limit in the mean of windows, and single ones up to noise.

    Args:
        deviations: From the mean or median, per frame.
        limit: For a camera without noise.
        sigma: Noise of one frame per axis.
    """
    count = len(deviations) // _WINDOW_FRAMES
    windows = deviations[: count * _WINDOW_FRAMES].reshape(-1, _WINDOW_FRAMES, 3).mean(axis=1)
    with_noise = float(np.hypot(limit, _PERCENTILE_SIGMAS * sigma / np.sqrt(_WINDOW_FRAMES)))
    bound = min(with_noise, _MAX_NOISE_FACTOR * limit)
    mean, single = (
        float(np.percentile(np.linalg.norm(each, axis=1), _PERCENTILE)) for each in (windows, deviations)
    )
    return mean < bound and single < np.sqrt(_WINDOW_FRAMES) * bound
