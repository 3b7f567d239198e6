"""The body: joints, rest pose, mounts, motion and forward kinematics.

Rest pose and motion are in ``world`` axes: Z up, the body faces −Y, its left is +X, metres. Every
joint's frame is aligned with the world in the zero pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.arrays import BoolArray, FloatArray, IntArray, set_array
from bodycap_batch.geometry import make_transform


@dataclass(frozen=True, slots=True, kw_only=True)
class SkeletonModel:
    """A tree of joints in its zero pose.

    Attributes:
        name: Preset or file name.
        joints: (J,) joint names; a parent stands before its children, the root first.
        parents: (J,) index of the parent, −1 for the root.
        offsets_m: (J,3) joint centre in the parent's frame at zero pose (the root's own is its
            standing position).
        end_offsets_m: (J,3) the bone's far end in the joint's frame; NaN where it has children.
        roles: (J,) the anatomical (HumanIK) name of each joint, "" where it has none.
        bvh_channels: (J,) channel names as a file gave them, or () for the default order.
    """

    name: str
    joints: tuple[str, ...]
    parents: IntArray
    offsets_m: FloatArray
    end_offsets_m: FloatArray
    roles: tuple[str, ...]
    bvh_channels: tuple[tuple[str, ...], ...]

    def __post_init__(self) -> None:
        count = len(self.joints)
        set_array(self, "parents", (count,), np.int64)
        set_array(self, "offsets_m", (count, 3))
        set_array(self, "end_offsets_m", (count, 3), finite=False)
        if len(self.roles) != count or len(self.bvh_channels) != count:
            raise ValueError("roles and bvh_channels need one entry per joint")
        if count == 0 or self.parents[0] != -1 or (self.parents[1:] >= np.arange(1, count)).any():
            raise ValueError("the root comes first and a parent before its children")
        if (self.parents[1:] < 0).any() or len(set(self.joints)) != count:
            raise ValueError("one root, and every joint name once")

    def index_of_role(self, role: str) -> int | None:
        """Index of the joint that plays an anatomical role, or None."""
        return self.roles.index(role) if role in self.roles else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Mount:
    """How a camera sits on the body.

    Attributes:
        camera: Camera name.
        role: Anatomical name of the joint whose bone carries it (``Spine1``, ``LeftHand`` …).
        joint_from_cam: (4,4) nominal or solved pose of the camera in the joint's frame.
        sigma_rad: Uncertainty of the rotation, per axis.
        sigma_m: Uncertainty of the position, per axis.
    """

    camera: str
    role: str
    joint_from_cam: FloatArray
    sigma_rad: float
    sigma_m: float

    def __post_init__(self) -> None:
        set_array(self, "joint_from_cam", (4, 4))


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """A skeleton moving on a constant-rate timeline, in the world.

    Attributes:
        skeleton: The skeleton that moves.
        fps: Frames per second.
        start_ns: Common time of tick 0.
        root_in_world_m: (T,3) root position.
        local_rotation: (T,J,3,3) parent_from_joint rotations (zero pose = identity; the root's is
            world_from_root).
        observed: (T,J) True where cameras measured the joint rather than a prior.
    """

    skeleton: SkeletonModel
    fps: float
    start_ns: int
    root_in_world_m: FloatArray
    local_rotation: FloatArray
    observed: BoolArray

    def __post_init__(self) -> None:
        ticks, count = len(self.root_in_world_m), len(self.skeleton.joints)
        set_array(self, "root_in_world_m", (ticks, 3))
        set_array(self, "local_rotation", (ticks, count, 3, 3))
        set_array(self, "observed", (ticks, count), np.bool_)

    def times_ns(self) -> IntArray:
        """(T,) common time of each tick."""
        ticks = np.arange(len(self.root_in_world_m))
        return np.asarray(self.start_ns + np.round(ticks * (1e9 / self.fps)), dtype=np.int64)

    def world_from_joint(self) -> FloatArray:
        """(T,J,4,4) joint poses."""
        return forward_kinematics(self.skeleton, self.root_in_world_m, self.local_rotation)


def forward_kinematics(
    skeleton: SkeletonModel, root_in_world_m: FloatArray, local_rotation: FloatArray
) -> FloatArray:
    """Joint poses (T,J,4,4) from root positions (T,3) and local rotations (T,J,3,3)."""
    out = np.zeros((len(root_in_world_m), len(skeleton.joints), 4, 4))
    out[:, 0] = make_transform(local_rotation[:, 0], root_in_world_m)
    for joint in range(1, len(skeleton.joints)):
        parent = out[:, skeleton.parents[joint]]
        parent_from_joint = make_transform(local_rotation[:, joint], skeleton.offsets_m[joint])
        out[:, joint] = parent @ parent_from_joint
    return out
