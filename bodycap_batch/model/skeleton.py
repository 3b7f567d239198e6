"""The body: skeleton, camera mounts, motion and forward kinematics.

All coordinates are in metres and in world axes: Z is up, the body faces −Y, and the left side of the body is
on +X. In the zero pose, all joint rotations are the identity, so the axes of every joint are the world axes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, set_array
from bodycap_batch.model.geometry import interpolate_rotation, invert, make_transform

_MAX_SOLE_M = 0.15
"""Maximum height, metres, of the lowest joint of the feet above or below the floor. Derivation: the ankles of
adults, which some skeletons end with, are 6 to 10 cm above the sole."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SkeletonModel:
    """The skeleton of a body: a tree of J joints in its zero pose.

    Attributes:
        name: Name of the preset or the file.
        joints: (J,) joint names. The root comes first, and every parent comes before its children.
        parents: (J,) index of the parent of each joint; −1 for the root.
        offsets_m: (J,3) joint centres in the frames of the parents, metres. For the root: its position in the
            world when the body stands.
        end_offsets_m: (J,3) far ends of the bones in the frames of their joints, metres. NaN for joints with
            children.
        roles: (J,) anatomical (HumanIK) name of each joint; "" for a joint without a role.
        bvh_channels: (J,) channel names of each joint from a BVH file; () for the default order.
        tpose_rotation: (J,3,3) parent_from_joint rotations of the T-pose; None if the T-pose is the zero
            pose.
        file_rotation: (J,3,3) world_from_joint rotations of the T-pose in the original file. Only a skeleton
            from `with_tpose_as_zero_pose` has this value; otherwise None.
        outer: The same skeleton with the joints that are not below the hips. Only a skeleton from
            `without_outer_joints` that lacks such joints has this value; otherwise None.
        notes: Sentences about how the file was understood.
        warnings: Sentences about what the user should correct in the file.
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
    outer: SkeletonModel | None = None
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

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
        """Return the index of the joint with this anatomical role; None if no joint has this role."""
        return self.roles.index(role) if role in self.roles else None

    def path_to_root(self, joint: int) -> list[int]:
        """Return the index of a joint, followed by its ancestors up to the root."""
        path = [joint]
        while self.parents[path[-1]] >= 0:
            path.append(int(self.parents[path[-1]]))
        return path

    def subtree(self, joint: int) -> list[int]:
        """Return the index of a joint and the indices of all joints below it, parents first."""
        return [other for other in range(joint, len(self.joints)) if joint in self.path_to_root(other)]


@dataclass(frozen=True, slots=True, kw_only=True)
class MountSlip:
    """A step of a camera on its bone: the strap slipped, and the camera stays at its new place.

    Attributes:
        time_ns: Common time of the first frame after the slip, nanoseconds.
        before_from_after: (4,4) pose of the camera after the slip, in its axes before the slip, metres.
        sigma_rad: Standard deviation of the rotation, radians per axis.
        sigma_m: Standard deviation of the translation, metres per axis.
    """

    time_ns: int
    before_from_after: FloatArray
    sigma_rad: float
    sigma_m: float

    def __post_init__(self) -> None:
        set_array(self, "before_from_after", (4, 4))

    def scaled(self, ratio: float) -> MountSlip:
        """Return the slip at another metric scale: all lengths multiplied by `ratio`."""
        step = self.before_from_after.copy()
        step[:3, 3] *= ratio
        return replace(self, before_from_after=step, sigma_m=ratio * self.sigma_m)

    def as_before(self, poses: FloatArray, times_ns: IntArray) -> FloatArray:
        """Return the poses that the camera would have at its place before the slip.

        Args:
            poses: (N,4,4) poses of the camera, metres.
            times_ns: (N,) common times of the poses.

        Returns:
            (N,4,4) poses; those before the slip remain unchanged.
        """
        return self._stepped(poses, times_ns, invert(self.before_from_after))

    def as_moved(self, poses: FloatArray, times_ns: IntArray) -> FloatArray:
        """Return the inverse of `as_before`: from the place before the slip to the actual place.

        Args:
            poses: (N,4,4) poses at the place before the slip, metres.
            times_ns: (N,) common times of the poses.

        Returns:
            (N,4,4) poses of the camera.
        """
        return self._stepped(poses, times_ns, self.before_from_after)

    def _stepped(self, poses: FloatArray, times_ns: IntArray, step: FloatArray) -> FloatArray:
        after = (times_ns >= self.time_ns)[:, None, None]
        return np.asarray(np.where(after, poses @ step, poses))


@dataclass(frozen=True, slots=True, kw_only=True)
class Mount:
    """The pose of a camera in the frame of its bone.

    Attributes:
        camera: Camera name.
        role: Anatomical name of the joint at which the bone starts (``Spine1``, ``LeftHand`` …).
        joint_from_cam: (4,4) nominal or estimated pose of the camera in the frame of this joint, metres.
        sigma_rad: Standard deviation of the rotation, radians per axis.
        sigma_m: Standard deviation of the position, metres per axis.
        by_name: True if the rotation and its standard deviation were chosen only from the name of the camera,
            because the job does not give a rotation.
        slip: The slip after which the camera has another pose on the bone; None without one.
    """

    camera: str
    role: str
    joint_from_cam: FloatArray
    sigma_rad: float
    sigma_m: float
    by_name: bool = False
    slip: MountSlip | None = None

    def __post_init__(self) -> None:
        set_array(self, "joint_from_cam", (4, 4))


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """The poses of a skeleton in the world at T ticks with a constant rate.

    Attributes:
        skeleton: The skeleton, with J joints.
        fps: Ticks per second.
        start_ns: Common time of tick 0, nanoseconds.
        root_in_world_m: (T,3) positions of the root in the world, metres.
        local_rotation: (T,J,3,3) parent_from_joint rotations; for the root, world_from_root. In the zero
            pose, all rotations are the identity.
        observed: (T,J) True if cameras measured the joint at the tick; False if only priors determine its
            pose.
        hips_in_root_m: (T,3) positions of the hips in the frame of the root, metres. Given only for a
            skeleton whose root is on the floor: its hips are the first child of the root and move freely
            relative to the root. None for all other skeletons, whose bones have constant lengths.
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
        """Return the joint centres (T,J,3) in the frames of the parents, metres.

        The centre of the root is given in the world.
        """
        out = np.tile(self.skeleton.offsets_m, (len(self.root_in_world_m), 1, 1))
        out[:, 0] = self.root_in_world_m
        if self.hips_in_root_m is not None:
            out[:, 1] = self.hips_in_root_m
        return out

    def times_ns(self) -> IntArray:
        """Return the common time (T,) of each tick, nanoseconds."""
        ticks = np.arange(len(self.root_in_world_m))
        return np.asarray(self.start_ns + np.round(ticks * (1e9 / self.fps)), dtype=np.int64)

    def world_from_joint(self) -> FloatArray:
        """Return the joint poses (T,J,4,4) in the world, metres."""
        local = make_transform(self.local_rotation, self.local_position_m())
        return _chain_poses(self.skeleton, local)


def forward_kinematics(
    skeleton: SkeletonModel, root_in_world_m: FloatArray, local_rotation: FloatArray
) -> FloatArray:
    """Return the joint poses (T,J,4,4) in the world for bones of constant length.

    Args:
        skeleton: The skeleton, with J joints.
        root_in_world_m: (T,3) positions of the root in the world, metres.
        local_rotation: (T,J,3,3) parent_from_joint rotations; for the root, world_from_root.
    """
    local = make_transform(local_rotation, skeleton.offsets_m)
    local[:, 0, :3, 3] = root_in_world_m
    return _chain_poses(skeleton, local)


def local_rotations(skeleton: SkeletonModel, world_from_joint: FloatArray) -> FloatArray:
    """Return the rotations parent_from_joint (T,J,3,3) for world_from_joint rotations (T,J,3,3).

    The rotation of the root remains unchanged.
    """
    out = world_from_joint.copy()
    parent = world_from_joint[:, skeleton.parents[1:]]
    out[:, 1:] = np.swapaxes(parent, -1, -2) @ world_from_joint[:, 1:]
    return out


def pose_joint(
    skeleton: SkeletonModel, joint: int, world: FloatArray, rotation: FloatArray | None = None
) -> None:
    """Write the pose of a joint that follows from that of its parent.

    Args:
        skeleton: The skeleton.
        joint: Index of the joint; not the root.
        world: (T,J,4,4) poses in the world, metres; changed in place.
        rotation: (T,3,3) rotations parent_from_joint; None for a joint without rotation.
    """
    own = make_transform(np.eye(3) if rotation is None else rotation, skeleton.offsets_m[joint])
    world[:, joint] = world[:, skeleton.parents[joint]] @ own


def bend_spine(
    skeleton: SkeletonModel, joint: int, rotation: FloatArray, root: FloatArray, world: FloatArray
) -> None:
    """Write the poses of all joints above a joint: their orientations change evenly up to that of the root.

    Joints without a role are helpers, and most of them have no length. They rotate with their parent.

    Args:
        skeleton: The skeleton.
        joint: Index of the joint, whose pose is known.
        rotation: (T,3,3) orientation of this joint in the world as the start of the bend.
        root: (T,3,3) orientation of the root in the world.
        world: (T,J,4,4) poses in the world, metres; changed in place.
    """
    path = skeleton.path_to_root(joint)
    bending = [step for step in range(1, len(path)) if skeleton.roles[path[step]] or path[step] == path[-1]]
    for step in range(1, len(path)):
        fraction = np.full(len(world), (np.searchsorted(bending, step) + 1) / len(bending))
        turned = interpolate_rotation(rotation, root, fraction)
        child = path[step - 1]
        centre = world[:, child, :3, 3] - turned @ skeleton.offsets_m[child]
        world[:, path[step]] = make_transform(turned, centre)


def rest_pose(skeleton: SkeletonModel) -> FloatArray:
    """Return the joint poses (J,4,4) in the world when the skeleton stands at the origin in its T-pose.

    A skeleton without a separate T-pose stands in its zero pose. The height of the root is taken from its
    entry in `offsets_m`, if the feet are then near the floor. Otherwise the body is raised or lowered until
    the lowest point of the feet touches the floor; without feet, the lowest point of the skeleton.
    """
    count = len(skeleton.joints)
    local = skeleton.tpose_rotation
    rotation = np.tile(np.eye(3), (count, 1, 1)) if local is None else local
    pose: FloatArray = forward_kinematics(skeleton, np.zeros((1, 3)), rotation[None])[0]
    tips = pose[:, :3, 3] + np.einsum("jab,jb->ja", pose[:, :3, :3], np.nan_to_num(skeleton.end_offsets_m))
    feet = [role.endswith("Foot") for role in skeleton.roles]
    for joint, parent in enumerate(skeleton.parents.tolist()):
        feet[joint] = feet[joint] or (parent >= 0 and feet[parent])
    lowest = np.minimum(tips[:, 2], pose[:, 2, 3])[np.array(feet) if any(feet) else slice(None)]
    height = float(skeleton.offsets_m[0, 2])
    is_near = -_MAX_SOLE_M <= lowest.min() + height <= _MAX_SOLE_M
    pose[:, 2, 3] += height if is_near and height > 0.0 else -lowest.min()
    return pose


def with_tpose_as_zero_pose(skeleton: SkeletonModel) -> SkeletonModel:
    """Return a skeleton of the same body whose zero pose is the T-pose.

    `with_file_zero_pose` converts a motion of the returned skeleton back to the zero pose of the file.
    """
    if skeleton.tpose_rotation is None:
        return skeleton
    world: FloatArray = rest_pose(skeleton)[:, :3, :3]
    above = np.concatenate([world[:1], world[skeleton.parents[1:]]])
    return replace(
        skeleton,
        offsets_m=np.einsum("jab,jb->ja", above, skeleton.offsets_m),
        end_offsets_m=np.einsum("jab,jb->ja", world, skeleton.end_offsets_m),
        tpose_rotation=None,
        file_rotation=world,
    )


def with_file_zero_pose(motion: Motion) -> Motion:
    """Convert a motion to the skeleton with the zero pose of the original file.

    This function reverses `with_tpose_as_zero_pose`. If the skeleton of the motion was not made by that
    function, the motion is returned unchanged.
    """
    skeleton = motion.skeleton
    world = skeleton.file_rotation
    if world is None:
        return motion
    parent = np.concatenate([np.eye(3)[None], world[skeleton.parents[1:]]])
    inverse = np.swapaxes(parent, -1, -2)
    file_skeleton = replace(
        skeleton,
        offsets_m=np.einsum("jba,jb->ja", np.concatenate([world[:1], parent[1:]]), skeleton.offsets_m),
        end_offsets_m=np.einsum("jba,jb->ja", world, skeleton.end_offsets_m),
        tpose_rotation=inverse @ world,
        file_rotation=None,
    )
    return replace(motion, skeleton=file_skeleton, local_rotation=inverse @ motion.local_rotation @ world)


def without_outer_joints(skeleton: SkeletonModel) -> SkeletonModel:
    """Return the skeleton from the hips downwards.

    Joints above the hips (a root on the floor, an armature) and beside them (targets, props) are no part of
    the body. `with_outer_joints` adds them to a motion. A skeleton without hips is returned unchanged, and a
    skeleton in which another joint with a role is not below the hips.
    """
    hips = skeleton.index_of_role("Hips")
    below = np.arange(len(skeleton.joints)) == hips
    for joint in range(1, len(below)):
        below[joint] |= below[skeleton.parents[joint]]
    if below.all() or any(role and not below[joint] for joint, role in enumerate(skeleton.roles)) or not hips:
        return skeleton
    kept = np.flatnonzero(below)
    offsets = skeleton.offsets_m[kept]
    offsets[0] = _from_root(skeleton, hips) + skeleton.offsets_m[0]
    rotations = (skeleton.tpose_rotation, skeleton.file_rotation)
    tpose, file = (None if rotation is None else rotation[kept] for rotation in rotations)
    return replace(
        skeleton,
        joints=tuple(skeleton.joints[joint] for joint in kept),
        parents=np.concatenate([[-1], np.searchsorted(kept, skeleton.parents[kept[1:]])]),
        offsets_m=offsets,
        end_offsets_m=skeleton.end_offsets_m[kept],
        roles=tuple(skeleton.roles[joint] for joint in kept),
        bvh_channels=tuple(skeleton.bvh_channels[joint] for joint in kept),
        tpose_rotation=tpose,
        file_rotation=file,
        outer=skeleton,
    )


def with_outer_joints(motion: Motion) -> Motion:
    """Return the motion with the joints that `without_outer_joints` removed.

    These joints keep their orientation of the T-pose. They move with the hips.
    """
    outer = motion.skeleton.outer
    if outer is None:
        return motion
    kept = [outer.joints.index(name) for name in motion.skeleton.joints]
    ticks, count = len(motion.root_in_world_m), len(outer.joints)
    local = np.tile(np.eye(3), (ticks, count, 1, 1))
    observed = np.zeros((ticks, count), dtype=np.bool_)
    local[:, kept], observed[:, kept] = motion.local_rotation, motion.observed
    root = motion.root_in_world_m - _from_root(outer, kept[0])
    return replace(motion, skeleton=outer, root_in_world_m=root, local_rotation=local, observed=observed)


def _from_root(skeleton: SkeletonModel, joint: int) -> FloatArray:
    """Return the position (3,) of a joint in the frame of the root in the zero pose, metres."""
    return np.asarray(skeleton.offsets_m[skeleton.path_to_root(joint)[:-1]].sum(axis=0))


def _chain_poses(skeleton: SkeletonModel, parent_from_joint: FloatArray) -> FloatArray:
    """Multiply the poses parent_from_joint (T,J,4,4) along the tree to joint poses (T,J,4,4) in the world."""
    out: FloatArray = parent_from_joint.copy()
    for joint in range(1, len(skeleton.joints)):
        out[:, joint] = out[:, skeleton.parents[joint]] @ parent_from_joint[:, joint]
    return out
