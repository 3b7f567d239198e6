"""Smooth the camera centres that are less certain than a prediction from the camera's motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodycap_batch.config.lost_frames import LEAST_LOST, LEAST_POSED
from bodycap_batch.core.arrays import BoolArray
from bodycap_batch.core.mechanisms import Mechanism, is_on, record_act
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
    """Move the centres of weakly observed frames towards the path of the frames around them.

    During a fast movement, few points are observed. A centre may then be less certain than its prediction
    from the neighbouring frames. Such a centre is replaced by the weighted mean of the centre and its
    prediction. The rotation changes too, according to its correlation with the centre.

    At the end of a lost interval the path is known on one side only. Lost frames are therefore recovered
    before the path is smoothed. Evidence: docs/decisions/registration.md.

    Args:
        path: Trajectory of one camera, whose poses were estimated frame by frame.
        adjustable: (N,) True for frames whose centres may move; all frames by default.

    Returns:
        The trajectory with moved centres. The covariances are unchanged: neighbouring frames share the error
        of the map, which smoothing does not reduce. `error_px` and `inliers` are unchanged too, because they
        describe the measured pose.

    Source: see `smooth_centres`.
    """
    frames_with_pose = np.flatnonzero(path.localised)
    if len(frames_with_pose) < LEAST_POSED or not is_on(Mechanism.PATH_SMOOTHING):
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
            record_act(Mechanism.PATH_SMOOTHING)
            matrices[frame] = invert(estimates[frame].conditioned_on_centre(smoothed.positions[frame])[0])
    return replace(path, gauge_from_cam=matrices)


def smooth_if_final(path: Trajectory) -> Trajectory:
    """Smooth the weak centres of a trajectory if no recovery follows. Recovery needs the measured poses."""
    return smooth_weak_centres(path) if (~path.localised).sum() < LEAST_LOST else path
