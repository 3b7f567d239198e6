"""The body: joints, rest pose, mounts, motion and forward kinematics.

Rest pose and motion are in ``world`` axes: Z up, the body faces −Y, its left is +X, metres. Every
joint's frame is aligned with the world in the zero pose.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, set_array
from bodycap_batch.model.geometry import make_transform


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
        tpose_rotation: (J,3,3) parent_from_joint rotations of the T-pose, where the zero pose is another one.
        file_rotation: (J,3,3) how each joint of the file stands in this zero pose, where it is the file's
            T-pose and not its zero pose (`with_tpose_as_zero_pose`).
    """

    name: str
    joints: tuple[str, ...]
    parents: IntArray
    offsets_m: FloatArray
    end_offsets_m: FloatArray
    roles: tuple[str, ...]
    bvh_channels: tuple[tuple[str, ...], ...]
    tpose_rotation: FloatArray | None = None
    file_rotation: FloatArray | None = None

    def __post_init__(self) -> None:
        count = len(self.joints)
        set_array(self, "parents", (count,), np.int64)
        set_array(self, "offsets_m", (count, 3))
        set_array(self, "end_offsets_m", (count, 3), finite=False)
        for name in ("tpose_rotation", "file_rotation"):
            if getattr(self, name) is not None:
                set_array(self, name, (count, 3, 3))
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
        by_name: Whether how it is turned, and how well that is known, rests on the camera's name alone.
    """

    camera: str
    role: str
    joint_from_cam: FloatArray
    sigma_rad: float
    sigma_m: float
    by_name: bool = False

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
        hips_in_root_m: (T,3) position of the root's first child in the root's frame where it travels on its
            own (a root on the floor that carries the hips); None where every bone keeps its length.
    """

    skeleton: SkeletonModel
    fps: float
    start_ns: int
    root_in_world_m: FloatArray
    local_rotation: FloatArray
    observed: BoolArray
    hips_in_root_m: FloatArray | None = None

    def __post_init__(self) -> None:
        ticks, count = len(self.root_in_world_m), len(self.skeleton.joints)
        set_array(self, "root_in_world_m", (ticks, 3))
        set_array(self, "local_rotation", (ticks, count, 3, 3))
        set_array(self, "observed", (ticks, count), np.bool_)
        if self.hips_in_root_m is not None:
            set_array(self, "hips_in_root_m", (ticks, 3))
            if count < 2:
                raise ValueError("hips_in_root_m: the root has no child")

    def local_position_m(self) -> FloatArray:
        """(T,J,3) joint centres in their parent's frame; the root's in the world."""
        out = np.tile(self.skeleton.offsets_m, (len(self.root_in_world_m), 1, 1))
        out[:, 0] = self.root_in_world_m
        if self.hips_in_root_m is not None:
            out[:, 1] = self.hips_in_root_m
        return out

    def times_ns(self) -> IntArray:
        """(T,) common time of each tick."""
        ticks = np.arange(len(self.root_in_world_m))
        return np.asarray(self.start_ns + np.round(ticks * (1e9 / self.fps)), dtype=np.int64)

    def world_from_joint(self) -> FloatArray:
        """(T,J,4,4) joint poses."""
        local = make_transform(self.local_rotation, self.local_position_m())
        return _chain_poses(self.skeleton, local)


def forward_kinematics(
    skeleton: SkeletonModel, root_in_world_m: FloatArray, local_rotation: FloatArray
) -> FloatArray:
    """Joint poses (T,J,4,4) from root positions (T,3) and local rotations (T,J,3,3)."""
    local = make_transform(local_rotation, skeleton.offsets_m)
    local[:, 0, :3, 3] = root_in_world_m
    return _chain_poses(skeleton, local)


def rest_pose(skeleton: SkeletonModel) -> FloatArray:
    """Joint poses (J,4,4) of the skeleton standing at the origin in its T-pose (without one, its zero pose).

    Its root stands as high as the skeleton says; where that says nothing, so that the lowest point of the
    body touches the floor.
    """
    count = len(skeleton.joints)
    local = skeleton.tpose_rotation
    rotation = np.tile(np.eye(3), (count, 1, 1)) if local is None else local
    pose: FloatArray = forward_kinematics(skeleton, np.zeros((1, 3)), rotation[None])[0]
    height = float(skeleton.offsets_m[0, 2])
    if height <= 0.0:
        tips = pose[:, :3, 3] + np.einsum(
            "jab,jb->ja", pose[:, :3, :3], np.nan_to_num(skeleton.end_offsets_m)
        )
        height = -float(min(tips[:, 2].min(), pose[:, 2, 3].min()))
    pose[:, 2, 3] += height
    return pose


def with_tpose_as_zero_pose(skeleton: SkeletonModel) -> SkeletonModel:
    """The same body with its T-pose as zero pose; `with_file_zero_pose` leads a motion of it back."""
    if skeleton.tpose_rotation is None:
        return skeleton
    world: FloatArray = rest_pose(skeleton)[:, :3, :3]
    above = np.concatenate([np.eye(3)[None], world[skeleton.parents[1:]]])
    return replace(
        skeleton,
        offsets_m=np.einsum("jab,jb->ja", above, skeleton.offsets_m),
        end_offsets_m=np.einsum("jab,jb->ja", world, skeleton.end_offsets_m),
        tpose_rotation=None,
        file_rotation=world,
    )


def with_file_zero_pose(motion: Motion) -> Motion:
    """The same motion on the rig as its file has it, where that has another zero pose."""
    skeleton = motion.skeleton
    world = skeleton.file_rotation
    if world is None:
        return motion
    above = np.concatenate([np.eye(3)[None], world[skeleton.parents[1:]]])
    back = np.swapaxes(above, -1, -2)
    rig = replace(
        skeleton,
        offsets_m=np.einsum("jab,jb->ja", back, skeleton.offsets_m),
        end_offsets_m=np.einsum("jba,jb->ja", world, skeleton.end_offsets_m),
        tpose_rotation=back @ world,
        file_rotation=None,
    )
    return replace(motion, skeleton=rig, local_rotation=back @ motion.local_rotation @ world)


def _chain_poses(skeleton: SkeletonModel, parent_from_joint: FloatArray) -> FloatArray:
    """Joint poses (T,J,4,4) from poses in the parents (T,J,4,4), the root's in the world."""
    out: FloatArray = parent_from_joint.copy()
    for joint in range(1, len(skeleton.joints)):
        out[:, joint] = out[:, skeleton.parents[joint]] @ parent_from_joint[:, joint]
    return out
