"""The bones that are variables of the graph, and the prior of each joint."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.model.skeleton import SkeletonModel
from bodycap_batch.model.skeleton_presets import rest_positions, segment_axes, split_side

JOINT_SLACK_M = 0.005
"""Slack of a joint, metres per axis. The slack is the sigma of the gap between a bone's joint and the place
of this joint on the parent bone. The slack allows for soft tissue, and lets the optimiser move the bones more
freely. Evidence: none."""

HINGE_ARM_M = 0.3
"""Distance (metres) between a hinge's joint and each of its two anchors. The anchors are on the hinge's axis.
Evidence: none."""


@dataclass(frozen=True, slots=True)
class _JointPrior:
    """Prior of a joint's rotation and of its bone's acceleration.

    Attributes:
        relaxed_flexion_deg: Flexion (degrees) of the joint while the person stands relaxed.
        sigma_deg: Sigmas (degrees) of the rotation about the along, forward and flexion axes, see
            `anatomical_axes`.
        psd_rotation: Power spectral density of the rotational acceleration, rad²/s³.
        psd_translation: Power spectral density of the translational acceleration, m²/s³.
    """

    relaxed_flexion_deg: float
    sigma_deg: tuple[float, float, float]
    psd_rotation: float
    psd_translation: float


_PRIORS = {
    "Hips": _JointPrior(0.0, (30.0, 15.0, 15.0), 2.4, 1.5),
    "Spine": _JointPrior(0.0, (8.0, 8.0, 10.0), 2.4, 1.5),
    "Spine1": _JointPrior(0.0, (8.0, 8.0, 10.0), 2.4, 1.5),
    "Neck": _JointPrior(0.0, (12.0, 10.0, 12.0), 3.0, 2.0),
    "Head": _JointPrior(0.0, (25.0, 12.0, 15.0), 3.0, 2.0),
    "Shoulder": _JointPrior(0.0, (4.0, 6.0, 6.0), 5.0, 2.0),
    "Arm": _JointPrior(0.0, (45.0, 30.0, 40.0), 18.0, 2.4),
    "ForeArm": _JointPrior(25.0, (40.0, 40.0, 40.0), 24.0, 6.0),
    "Hand": _JointPrior(0.0, (10.0, 15.0, 25.0), 30.0, 12.0),
    "UpLeg": _JointPrior(5.0, (12.0, 12.0, 30.0), 12.0, 2.4),
    "Leg": _JointPrior(-15.0, (20.0, 20.0, 35.0), 18.0, 6.0),
    "Foot": _JointPrior(0.0, (10.0, 10.0, 20.0), 18.0, 24.0),
    "ToeBase": _JointPrior(0.0, (5.0, 5.0, 20.0), 18.0, 24.0),
}
"""Prior of each joint, by part of the body. The sigmas describe the everyday range of each joint: two sigmas
are about half of the range of motion in D. A. Neumann, "Kinesiology of the Musculoskeletal System". The power
spectral densities were measured on people who walked and reached for things."""
_BONE_AFTER_HINGE = {"ForeArm": "Hand", "Leg": "Foot"}
"""Next bone of the limb, for each bone that starts at a hinge."""


class LimbChain(NamedTuple):
    """The bones of a limb below a given bone.

    Attributes:
        following: Next bone of the limb; None if the next bone is the end of the limb.
        end: Bone at the end of the limb.
    """

    following: str | None
    end: str


LIMB_CHAINS = {
    "Arm": LimbChain("ForeArm", "Hand"),
    "ForeArm": LimbChain(None, "Hand"),
    "UpLeg": LimbChain("Leg", "Foot"),
    "Leg": LimbChain(None, "Foot"),
}
"""The bones of the limb below each limb bone. The key is the role of the limb bone, without its side."""
_REST_ABDUCTION_DEG = {"Arm": 10.0, "UpLeg": 0.0}
"""Abduction (degrees) of limbs that hang in the rest pose. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Hinge:
    """A hinge joint, such as an elbow or a knee, at which a limb bends in one plane.

    The joint at the far end of the lower bone stays in this plane, because its distances from two points on
    the hinge's axis are equal.

    Attributes:
        upper: Index of the bone above the hinge.
        lower: Index of the bone that starts at the hinge.
        following: Index of the bone that starts at the lower bone's far end.
        anchors_m: (2,3) positions of the two points in the upper bone's frame.
        range_m: Distance (metres) of each point from the following bone's joint.
        sigma_m: Sigma (metres) of this distance due to violations of the hinge. The slack of a joint is not
            included. The value comes from `off_hinge_m` of the lower bone.
    """

    upper: int
    lower: int
    following: int
    anchors_m: FloatArray
    range_m: float
    sigma_m: float = 0.0

    def axis(self) -> FloatArray:
        """Return the axis (3,) of the hinge in the upper bone's frame; a positive turn bends the elbow."""
        across = self.anchors_m[0] - self.anchors_m[1]
        return np.asarray(across / np.linalg.norm(across))


@dataclass(frozen=True, slots=True, kw_only=True)
class Bone:
    """A bone of the graph.

    Attributes:
        joint: Index of the bone's joint in the skeleton.
        role: Anatomical name.
        parent: Index of the parent bone among the bones, −1 for the first bone.
        offset_m: (3,) centre of the bone's joint in the parent bone's frame.
        mean_rotation: (3,3) parent_from_bone in the rest pose.
        rotation_covariance: (3,3) covariance, rad², of the joint's rotation in the bone's own axes.
        psd: (6,) power spectral density of the bone's acceleration: three rotations (rad²/s³), then three
            translations (m²/s³).
        off_hinge_m: Sigma (metres) of the distance between the bone's far end and the plane of its hinge. The
            slack of a joint is not included. The value is 0 if the motion obeys the hinge.
    """

    joint: int
    role: str
    parent: int
    offset_m: FloatArray
    mean_rotation: FloatArray
    rotation_covariance: FloatArray
    psd: FloatArray
    off_hinge_m: float = 0.0


def kinematic_chain(skeleton: SkeletonModel, mounted_roles: Iterable[str]) -> tuple[Bone, ...]:
    """Return the bones with cameras and the bones between them, parents before their children.

    Args:
        skeleton: The body.
        mounted_roles: Roles of the bones with a camera. The skeleton has a joint for each role.
    """
    joints = [skeleton.roles.index(role) for role in set(mounted_roles)]
    chains = [skeleton.path_to_root(joint) for joint in joints]
    top = max(set.intersection(*(set(chain) for chain in chains)))
    between = {joint for chain in chains for joint in chain if joint >= top and skeleton.roles[joint]}
    kept = sorted(between | {top})
    order = {joint: index for index, joint in enumerate(kept)}
    rest = rest_positions(skeleton)
    return tuple(_make_bone(skeleton, joint, order, rest) for joint in kept)


def bones_to_root(bones: Sequence[Bone], bone: int) -> list[int]:
    """Return the indices of a bone and its ancestors in the graph, the bone first and the first bone last."""
    chain = [bone]
    while bones[chain[-1]].parent >= 0:
        chain.append(bones[chain[-1]].parent)
    return chain


def _make_bone(skeleton: SkeletonModel, joint: int, order: dict[int, int], rest: FloatArray) -> Bone:
    above = next((j for j in skeleton.path_to_root(joint)[1:] if j in order), None)
    role = skeleton.roles[joint]
    prior = _PRIORS[split_side(role)[1]] if role else _PRIORS["Spine"]
    axes = anatomical_axes(skeleton, role)
    covariance = np.diag(np.radians(prior.sigma_deg) ** 2)
    return Bone(
        joint=joint,
        role=role,
        parent=-1 if above is None else order[above],
        offset_m=rest[joint] - (rest[above] if above is not None else 0.0),
        mean_rotation=_rest_rotation(skeleton, role, prior),
        rotation_covariance=axes @ covariance @ axes.T,
        psd=np.repeat([prior.psd_rotation, prior.psd_translation], 3),
    )


def anatomical_axes(skeleton: SkeletonModel, role: str) -> FloatArray:
    """Return a bone's along, forward and flexion axes as columns (3,3), in the bone's frame.

    The flexion axis is along × forward, so that the matrix is a rotation on both sides of the body.
    """
    axes = segment_axes(skeleton, role)
    return np.column_stack([axes[:, 0], axes[:, 1], np.cross(axes[:, 0], axes[:, 1])])


def _rest_rotation(skeleton: SkeletonModel, role: str, prior: _JointPrior) -> FloatArray:
    """Return the bone's rotation parent_from_bone (3,3) while the person stands relaxed with hanging arms."""
    side, part = split_side(role)
    flexion = so3_exp([0.0, 0.0, np.radians(prior.relaxed_flexion_deg)])
    axes = anatomical_axes(skeleton, role)
    if part in _REST_ABDUCTION_DEG:
        tilt = np.radians(_REST_ABDUCTION_DEG[part])
        outward = 1.0 if side == "Left" else -1.0
        along = np.array([outward * np.sin(tilt), 0.0, -np.cos(tilt)])
        forward = np.array([0.0, -1.0, 0.0])
        hanging = np.column_stack([along, forward, np.cross(along, forward)])
        return np.asarray(hanging @ flexion @ axes.T)
    if part in _BONE_AFTER_HINGE:
        upper = anatomical_axes(skeleton, side + {"ForeArm": "Arm", "Leg": "UpLeg"}[part])
        return np.asarray(upper @ flexion @ axes.T)
    return np.eye(3)


def hinges(skeleton: SkeletonModel, bones: tuple[Bone, ...]) -> tuple[Hinge, ...]:
    """Return the hinges (elbows and knees) whose lower bone has a following bone in the graph."""
    index = {bone.role: position for position, bone in enumerate(bones)}
    out = []
    for bone in bones:
        side, part = split_side(bone.role)
        following = index.get(side + _BONE_AFTER_HINGE[part]) if part in _BONE_AFTER_HINGE else None
        if following is None or bone.parent < 0:
            continue
        axis = anatomical_axes(skeleton, bones[bone.parent].role)[:, 2]
        length = float(np.linalg.norm(bones[following].offset_m))
        out.append(
            Hinge(
                upper=bone.parent,
                lower=index[bone.role],
                following=following,
                anchors_m=bone.offset_m + HINGE_ARM_M * np.array([axis, -axis]),
                range_m=float(np.hypot(HINGE_ARM_M, length)),
                sigma_m=bone.off_hinge_m,
            )
        )
    return tuple(out)
