"""Centres that pixels tell worse than motion does, moved to where both have them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodycap_batch.config.lost_frames import LEAST_LOST, LEAST_POSED
from bodycap_batch.core.arrays import BoolArray
from bodycap_batch.model.geometry import invert
from bodycap_batch.model.scene import Trajectory
from bodycap_batch.registration.recovery.guided_localisation import PoseEstimate
from bodycap_batch.registration.recovery.motion_prior import (
    MAX_DISAGREEMENT,
    MotionStatistics,
    smooth_centres,
    times_in_intervals,
)


def smooth_weak_centres(path: Trajectory, adjustable: BoolArray | None = None) -> Trajectory:
    """A camera's path on which the centres of weakly seen frames follow their neighbours.

    Where a violent move leaves few points, a centre is known worse than the path's own evenness from frame to
    frame tells it. Such centres are moved to where both have them, and the turn follows as far as the points
    tie it to the centre. Errors of all frames before and after: walk12 0.31, 0.30 cm, room12 0.54, 0.50,
    walk131 0.37, 0.34, room131 1.78, 1.63, a rendered one with arms thrown about 1.84, 1.61 (the worst 12.8,
    9.9). With half and twice as much unevenness room12 has 0.49 and 0.51, walk131 0.37 and 0.35.

    At an end of a lost stretch a path is told from one side only: to be steadied after lost frames were
    looked for. (Before it, the rendered one's worst is 14.4.)

    Args:
        path: Poses of one camera, solved frame by frame.
        movable: (N,) frames whose centres may move; all by default.

    Returns:
        The same with centres moved. The covariances stay: neighbours share the map's error, which smoothing
        does not take out. With the smoothed ones walk12's normalised squared error rises from 1.4 to 2.2 an
        axis; with these it stays. So do ``error_px`` and ``inliers``: they tell how well pixels fixed
        the pose that was measured.

    Source: as for `smooth_centres`.
    """
    frames_with_pose = np.flatnonzero(path.localised)
    if len(frames_with_pose) < LEAST_POSED:
        return path
    times = times_in_intervals(path.times_ns)
    statistics = MotionStatistics.estimate(times, path.gauge_from_cam[:, :3, 3])
    if statistics is None:
        return path
    estimates = {frame: PoseEstimate.from_trajectory(path, frame) for frame in frames_with_pose.tolist()}
    positions = {frame: fix.position for frame, fix in estimates.items()}
    weak = {
        frame
        for frame, position in positions.items()
        if np.sqrt(np.linalg.eigvalsh(position.covariance)[-1]) > statistics.cubic_residual_sigma
    }
    smoothed = smooth_centres(np.arange(len(times)), times, positions, positions.keys() - weak, statistics)
    matrices = path.gauge_from_cam.copy()
    for frame in sorted(weak):
        if (adjustable is None or adjustable[frame]) and smoothed.disagreement[frame] < MAX_DISAGREEMENT:
            matrices[frame] = invert(estimates[frame].conditioned_on_centre(smoothed.positions[frame])[0])
    return replace(path, gauge_from_cam=matrices)


def smooth_if_final(path: Trajectory) -> Trajectory:
    """Smooth the weak centres of a trajectory, unless recovery follows: recovery needs poses as measured."""
    return smooth_weak_centres(path) if (~path.localised).sum() < LEAST_LOST else path
