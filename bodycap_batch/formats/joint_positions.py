"""True joint positions in a file ``joints.npz``: names, times and centres of joints, without orientations."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray, set_array
from bodycap_batch.core.errors import JobError
from bodycap_batch.model.skeleton import Motion, SkeletonModel

_SIDES = {"Left": (1.0, 0.0, 0.0), "Right": (-1.0, 0.0, 0.0)}
"""Direction of each side in the T-pose: the left side is at +x."""

ROLE_BY_TRUTH_NAME = {
    "root": "Hips", "torso": "Spine1", "head": "Head", "left_palm": "LeftHand", "right_palm": "RightHand",
    "left_elbow": "LeftForeArm", "right_elbow": "RightForeArm", "left_shoulder": "LeftArm",
    "right_shoulder": "RightArm", "left_knee": "LeftLeg", "right_knee": "RightLeg", "left_hip": "LeftUpLeg",
    "right_hip": "RightUpLeg", "left_ankle": "LeftFoot", "right_ankle": "RightFoot",
}  # fmt: skip
"""Anatomical role of each joint in the ground truth file ``gt/joints.npz``, by the joint's name in this
file."""

_ABOVE: dict[str, tuple[str, tuple[float, float, float]]] = {
    "Spine1": ("Hips", (0.0, 0.0, 1.0)),
    "Head": ("Spine1", (0.0, 0.0, 1.0)),
    **{
        side + role: (above if above in ("Hips", "Spine1") else side + above, along or out)
        for side, out in _SIDES.items()
        for role, above, along in (
            ("Arm", "Spine1", None),
            ("ForeArm", "Arm", None),
            ("Hand", "ForeArm", None),
            ("UpLeg", "Hips", None),
            ("Leg", "UpLeg", (0.0, 0.0, -1.0)),
            ("Foot", "Leg", (0.0, 0.0, -1.0)),
        )
    },
}
"""By role: the role of the parent, and the direction of the bone from there in the T-pose."""
_LOW_PERCENTILE = 5.0
"""Percentile of the heights of the ankles that is taken as their height on the floor. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JointPositions:
    """The centres of J joints at T times.

    Attributes:
        times_ns: (T,) times, nanoseconds.
        roles: (J,) anatomical role of each joint.
        x_in_world_m: (T,J,3) centres in the world, metres.
    """

    times_ns: IntArray
    roles: tuple[str, ...]
    x_in_world_m: FloatArray

    def __post_init__(self) -> None:
        set_array(self, "times_ns", (None,), np.int64)
        set_array(self, "x_in_world_m", (len(self.times_ns), len(self.roles), 3))


def read_joint_positions(path: Path) -> JointPositions:
    """Read the joints with a known role from a file with the arrays ``names``, ``t`` and ``world``.

    Raises:
        JobError: The file cannot be read.
    """
    try:
        with np.load(path, allow_pickle=False) as content:
            names, seconds, world = (np.asarray(content[key]) for key in ("names", "t", "world"))
        kept = [index for index, name in enumerate(names.tolist()) if name in ROLE_BY_TRUTH_NAME]
        return JointPositions(
            times_ns=np.round(seconds * 1e9).astype(np.int64),
            roles=tuple(ROLE_BY_TRUTH_NAME[str(names[index])] for index in kept),
            x_in_world_m=world[:, kept].astype(np.float64),
        )
    except (OSError, KeyError, ValueError, IndexError) as error:
        raise JobError(
            f"the file cannot be read as a file of joint positions: {error}",
            path=path,
            hint="give a .npz file that contains the arrays names, t and world",
        ) from error


def motion_from_positions(positions: JointPositions) -> Motion | None:
    """Return a motion whose bones have the directions of the bones between the joints.

    The bones have their median lengths, and rotations about their own axes are arbitrary. All joints count as
    measured.

    Returns:
        The motion; None if the hips are missing or there are fewer than two times.
    """
    if "Hips" not in positions.roles or len(positions.times_ns) < 2:
        return None
    centre = {role: positions.x_in_world_m[:, joint] for joint, role in enumerate(positions.roles)}
    bones = [role for role in _ABOVE if role in centre and _ABOVE[role][0] in centre]
    ticks = len(positions.times_ns)
    joints, parents, offsets = ["Hips"], [-1], [np.zeros(3)]
    rotation = [np.tile(np.eye(3), (ticks, 1, 1))]
    for role in bones:
        above, along = _ABOVE[role]
        way = centre[role] - centre[above]
        length = float(np.median(np.linalg.norm(way, axis=1)))
        # Each bone has a joint of its own at its upper end, because bones with one parent do not move as one.
        joints += [f"{role}Bone", role]
        parents += [joints.index(above), len(joints) - 2]
        offsets += [np.zeros(3), length * np.array(along)]
        rotation += 2 * [_rotation_between(np.array(along), way)]
    world = np.stack(rotation, axis=1)
    local = world.copy()
    local[:, 1:] = np.swapaxes(world[:, parents[1:]], -1, -2) @ world[:, 1:]
    offsets[0] = np.array([0.0, 0.0, _standing_height_m(joints, parents, offsets, centre)])
    skeleton = SkeletonModel(
        name="joint positions",
        joints=tuple(joints),
        parents=np.array(parents),
        offsets_m=np.array(offsets),
        end_offsets_m=np.full((len(joints), 3), np.nan),
        roles=tuple("" if name.endswith("Bone") else name for name in joints),
        bvh_channels=tuple(() for _ in joints),
    )
    return Motion(
        skeleton=skeleton,
        fps=float(1e9 / np.median(np.diff(positions.times_ns))),
        start_ns=int(positions.times_ns[0]),
        root_in_world_m=centre["Hips"],
        local_rotation=local,
        observed=np.ones(local.shape[:2], dtype=bool),
    )


def _standing_height_m(
    joints: list[str], parents: list[int], offsets: list[FloatArray], centre: dict[str, FloatArray]
) -> float:
    """Return the height (metres) of the hips at which the ankles have their height on the floor."""
    feet = [role for role in ("LeftFoot", "RightFoot") if role in joints]
    if not feet:
        return 0.0
    down = 0.0
    joint = joints.index(feet[0])
    while joint > 0:
        down -= float(offsets[joint][2])
        joint = parents[joint]
    heights = np.concatenate([centre[role][:, 2] for role in feet])
    return down + max(float(np.percentile(heights, _LOW_PERCENTILE)), 0.0)


def _rotation_between(start: FloatArray, way: FloatArray) -> FloatArray:
    """Return rotations (T,3,3) that turn a unit vector (3,) to the directions of vectors (T,3)."""
    from scipy.spatial.transform import Rotation

    end = way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
    axis = np.cross(np.broadcast_to(start, end.shape), end)
    sine, cosine = np.linalg.norm(axis, axis=1), end @ start
    # Opposite vectors have no common normal: any axis across them is as good.
    across = np.cross(start, np.roll(start, 1))
    axis = np.where(sine[:, None] > 1e-9, axis / np.maximum(sine, 1e-9)[:, None], across)
    return np.asarray(Rotation.from_rotvec(axis * np.arctan2(sine, cosine)[:, None]).as_matrix())
