"""A body that moves, and the poses of its joints and of the cameras on it at any time."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.geometry import make_transform
from bodycap_batch.model.skeleton import Mount, SkeletonModel, forward_kinematics
from bodycap_batch.synthetic.stabilisation import turn_of_pictures


class MovingBody(Protocol):
    """A body that moves: its skeleton, and its pose at any time."""

    skeleton: SkeletonModel

    def pose(self, t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return root positions (T,3) in the world (m) and local rotations (T,J,3,3) at common times (T,)."""
        ...


def joint_poses_at(motion: MovingBody, t_s: FloatArray) -> FloatArray:
    """Return the poses world_from_joint (T,J,4,4) of all joints at common times (T,) in seconds."""
    return forward_kinematics(motion.skeleton, *motion.pose(np.asarray(t_s, dtype=np.float64)))


def camera_poses_at(motion: MovingBody, mount: Mount, t_s: FloatArray) -> FloatArray:
    """Return the poses world_from_cam (T,4,4) of a mounted camera at common times (T,) in seconds."""
    joint = motion.skeleton.index_of_role(mount.role)
    return np.asarray(joint_poses_at(motion, t_s)[:, joint] @ mount.joint_from_cam)


def picture_poses_at(motion: MovingBody, mount: Mount, t_s: FloatArray, *, stabilised: bool) -> FloatArray:
    """Return the poses world_from_picture (T,4,4) of a camera's pictures at common times (T,) in seconds.

    Pictures that are not stabilised have the pose of the camera.
    """
    poses = camera_poses_at(motion, mount, t_s)
    if not stabilised:
        return poses
    turns = turn_of_pictures(lambda times_s: camera_poses_at(motion, mount, times_s), t_s)
    return np.asarray(poses @ make_transform(turns, np.zeros(3)))
