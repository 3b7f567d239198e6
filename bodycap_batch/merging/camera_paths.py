"""The cameras' paths in the world, with measured centres or with centres solved together with the body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodycap_batch.core.arrays import IntArray
from bodycap_batch.merging.cameras.track import CameraTrack, is_uncalibrated, transform_trajectory
from bodycap_batch.merging.graph.motion_graph import MotionSolution
from bodycap_batch.model.geometry import Similarity
from bodycap_batch.model.scene import FrameStatus, Trajectory
from bodycap_batch.model.skeleton import Mount


def trajectory_in_world(trajectory: Trajectory, world_from_map: Similarity, dropped: IntArray) -> Trajectory:
    """Return the trajectory in the world, without the poses that are gross errors.

    Args:
        trajectory: Trajectory of one camera in the gauge of the main map.
        world_from_map: Similarity from the main map to the world.
        dropped: (N,) numbers of the frames with gross errors.

    Returns:
        The trajectory in metres. Frames with gross errors have no pose and the status POSE_JUMP.
    """
    in_world = transform_trajectory(trajectory, world_from_map, "world")
    poses, covariance = np.array(in_world.gauge_from_cam), np.array(in_world.covariance)
    status = list(trajectory.status)
    poses[dropped], covariance[dropped] = np.nan, np.nan
    for frame in dropped.tolist():
        status[frame] = FrameStatus.POSE_JUMP
    return replace(in_world, gauge_from_cam=poses, covariance=covariance, status=tuple(status))


def with_solved_centres(
    trajectory: Trajectory,
    track: CameraTrack,
    mount: Mount,
    solution: MotionSolution,
    world_from_solved: Similarity,
) -> Trajectory:
    """Return the trajectory with the camera centres of the solved motion.

    The motion graph combines the measured poses of all cameras with the skeleton. The joints of the skeleton
    connect the cameras, which reduces local errors of the map. The motion prior reduces noise. Evidence:
    docs/decisions/body_calibration.md.

    Each centre moves a fraction of the way to the solved centre. This fraction is the robust weight of the
    measured pose in the solution. The weight is small if the measured and the solved centre differ by
    centimetres, because either of the two may be wrong. The measured orientations remain unchanged, because
    joints do not determine orientations to a tenth of a degree. A camera with an uncalibrated mount keeps its
    measured path.

    Args:
        trajectory: The measured trajectory of the camera in the world.
        track: The measured poses of the camera in the motion graph: those at its place before a slip.
        mount: The solved mount of the camera.
        solution: The solved motion.
        world_from_solved: Rigid transform from the solved frame of reference to the world.

    Returns:
        The trajectory with moved centres.
    """
    if is_uncalibrated(mount):
        return trajectory
    solved = world_from_solved.apply_to_poses(solution.world_from_cam[track.camera])
    if mount.slip is not None:
        solved = mount.slip.as_moved(solved, track.times_ns)
    poses = np.array(trajectory.gauge_from_cam)
    measured, weight = poses[track.frames, :3, 3], solution.residuals[track.camera].weights
    poses[track.frames, :3, 3] = measured + weight[:, None] * (solved[:, :3, 3] - measured)
    return replace(trajectory, gauge_from_cam=poses)
