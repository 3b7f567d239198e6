"""The cameras' paths in the world: as measured, or every frame solved together with the body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.merging.cameras.track import CameraTrack, is_uncalibrated, transform_trajectory
from bodycap_batch.merging.graph.motion_graph import MotionSolution
from bodycap_batch.model.geometry import Similarity
from bodycap_batch.model.scene import FrameStatus, Trajectory
from bodycap_batch.model.skeleton import Mount


def trajectory_in_world(trajectory: Trajectory, world_from_map: Similarity, dropped: IntArray) -> Trajectory:
    """The trajectory in the world, without the poses that proved to be gross errors."""
    placed = transform_trajectory(trajectory, world_from_map, "world")
    poses, covariance = np.array(placed.gauge_from_cam), np.array(placed.covariance)
    status = list(trajectory.status)
    poses[dropped], covariance[dropped] = np.nan, np.nan
    for frame in dropped.tolist():
        status[frame] = FrameStatus.POSE_JUMP
    return replace(placed, gauge_from_cam=poses, covariance=covariance, status=tuple(status))


def with_solved_centres(
    trajectory: Trajectory,
    track: CameraTrack,
    mount: Mount,
    solution: MotionSolution,
    world_from_solved: Similarity,
) -> Trajectory:
    """The trajectory with each localised frame where the body's joint solution has its camera.

    All frames of all cameras are unknowns of one problem with the skeleton: a stretch of map that is off by
    half a centimetre is pulled back by the joints it shares with the other cameras, and noise by the motion.
    Camera error over all frames: walk12 3.1 to 3.0 mm, walk131 3.7 to 3.5, cpl_lab 2.35 to 2.28, room131
    15.2 to 13.6, and with cameras on the upper arms, too, room12 5.4 to 3.7. With keyframes' landmarks as
    unknowns of the same problem it was no better: 3.1, 3.7, 2.5, 3.5 to 4.1 (room12).

    A pose moves as far as the body believed it: where both differ by centimetres, either may be wrong.
    Orientations stay measured: joints say nothing about a tenth of a degree (walk131: 0.23° instead of
    0.11°). A camera whose mount was not calibrated keeps its measured path.

    Args:
        trajectory: In the world, as measured.
        track: The measurements the solution rests on.
        mount: Of this camera, as solved.
        solution: The solved motion.
        world_from_solved: From the solution's axes.
    """
    if is_uncalibrated(mount):
        return trajectory
    solved = world_from_solved.apply_to_poses(solution.world_from_cam[track.camera])
    poses = np.array(trajectory.gauge_from_cam)
    poses[track.frames] = _blend_centres(poses[track.frames], solved, solution.weights[track.camera])
    return replace(trajectory, gauge_from_cam=poses)


def _blend_centres(measured: FloatArray, solved: FloatArray, weight: FloatArray) -> FloatArray:
    """Measured poses (N,4,4) with centres moved to the solved ones, by their weight (N,)."""
    out = measured.copy()
    out[:, :3, 3] += weight[:, None] * (solved[:, :3, 3] - measured[:, :3, 3])
    return out
