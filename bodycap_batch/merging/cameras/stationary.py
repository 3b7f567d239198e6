"""Cameras that nobody wears: left on a table, or frozen, while the others of their map move."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.model.merge_data import MergeInputs
from bodycap_batch.model.scene import Trajectory

_MAX_DEVIATION_RATIO, _MAX_DEVIATION_RAD = 0.005, float(np.radians(0.3))
"""A camera strays so little, beside the one of its map that strays furthest, and turns so little where it
lies on a table: one does by 0.0004 and 0.01 deg; 15 worn ones of five captures by more than 0.8 and 5 deg."""
_MAX_NOISE_FACTOR = 2.0
"""Noise widens both by that much at most: no worn camera is left out for what its poses are not known by."""
_WINDOW_FRAMES = 15
"""Localised frames whose mean pose counts: half a second at 30 fps. Noise is a matter of single frames."""
_PERCENTILE, _PERCENTILE_SIGMAS = 90.0, 2.5
"""Nine tenths of the time; so many sigmas per axis is what noise in three axes strays for that long."""
_MIN_DURATION_RATIO = 0.5
"""Share of the time of the camera localised longest: who stands ready for a second does not show the rest."""


@dataclass(frozen=True, slots=True)
class _CameraPath:
    """The localised frames of one camera: common times (N,), centres (N,3), map units, and attitudes."""

    gauge: str
    times_ns: IntArray
    centres: FloatArray
    turns: Rotation
    sigmas: tuple[float, float]

    def during(self, first_ns: int, last_ns: int) -> FloatArray:
        """How far single frames stray (M,) from their middle within a time, map units; none without any."""
        inside = self.centres[(self.times_ns >= first_ns) & (self.times_ns <= last_ns)]
        return (
            np.asarray(np.linalg.norm(inside - np.median(inside, axis=0), axis=1)) if len(inside) else inside
        )


def stationary_cameras(inputs: MergeInputs, trajectories: Sequence[Trajectory]) -> list[str]:
    """Cameras that stand still while another of their map moves, for as long as they were localised.

    Args:
        inputs: The clocks.
        trajectories: Of cameras with at least half a second of localised frames.
    """
    paths = {each.camera: _path(inputs, each) for each in trajectories}
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


def _path(inputs: MergeInputs, trajectory: Trajectory) -> _CameraPath:
    frames = trajectory.localised
    poses = trajectory.gauge_from_cam[frames]
    variances = np.median(np.diagonal(trajectory.covariance[frames], axis1=1, axis2=2), axis=0)
    return _CameraPath(
        trajectory.gauge,
        inputs.clocks[trajectory.camera].common_times_ns(trajectory.times_ns[frames]),
        poses[:, :3, 3],
        Rotation.from_matrix(poses[:, :3, :3]),
        (float(np.sqrt(variances[:3].mean())), float(np.sqrt(variances[3:].mean()))),
    )


def _keeps_orientation(path: _CameraPath) -> bool:
    return _deviates_little(
        (path.turns.mean().inv() * path.turns).as_rotvec(), _MAX_DEVIATION_RAD, path.sigmas[0]
    )


def _keeps_position(path: _CameraPath, others: Iterable[_CameraPath]) -> bool:
    """Whether a camera's centre stays where it is while another's of its map strays."""
    span = int(path.times_ns.min()), int(path.times_ns.max())
    strays = [other.during(*span) for other in others if other.gauge == path.gauge]
    furthest = max(float(np.percentile(each, _PERCENTILE)) for each in strays if len(each) >= _WINDOW_FRAMES)
    return _deviates_little(
        path.centres - np.median(path.centres, axis=0), _MAX_DEVIATION_RATIO * furthest, path.sigmas[1]
    )


def _deviates_little(off: FloatArray, still: float, sigma: float) -> bool:
    """Whether windows' means of offsets (N,3) stay within a bound, and single frames as noise lets them."""
    windows = off[: len(off) // _WINDOW_FRAMES * _WINDOW_FRAMES].reshape(-1, _WINDOW_FRAMES, 3).mean(axis=1)
    bound = min(
        float(np.hypot(still, _PERCENTILE_SIGMAS * sigma / np.sqrt(_WINDOW_FRAMES))),
        _MAX_NOISE_FACTOR * still,
    )
    mean, single = (
        float(np.percentile(np.linalg.norm(each, axis=1), _PERCENTILE)) for each in (windows, off)
    )
    return mean < bound and single < np.sqrt(_WINDOW_FRAMES) * bound
