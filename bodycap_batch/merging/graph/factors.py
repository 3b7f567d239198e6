"""The factors of the graphs: joints, hinges, camera measurements and mounts, all from GTSAM's own C++.

Keys: ``b`` for a bone's pose at a tick, ``v`` for its velocity, ``m`` for the four points of a mount.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import gtsam
import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.body.bones import JOINT_SLACK_M, Bone, Hinge
from bodycap_batch.model.geometry import nearest_rotation, skew

MAX_BONES = 64
"""Stride of a tick in the keys; a graph has at most this many bones."""
GEMAN_MCCLURE_C = 6.0
"""Scale of the robust loss in sigmas of a six-dimensional residual, which typically has a length of 2.4.
Gross errors are removed before. Evidence: docs/decisions/merging.md."""
HINGE_SLACK_RATIO = 2.0
"""Sigma of a hinge's distances over that of a joint's gap. Evidence: none."""
_AXIS_WEIGHT = 0.1
"""Information of a mount's axis point over that of its centre point. It is small, so that the rotation of the
mount hardly depends on its translation."""


def bone_key(tick: int, bone: int) -> int:
    """Return the key of a bone's pose."""
    return int(gtsam.symbol("b", tick * MAX_BONES + bone))


def velocity_key(tick: int, bone: int) -> int:
    """Return the key of a bone's velocity, a 6-vector in the bone's own frame, rotation first."""
    return int(gtsam.symbol("v", tick * MAX_BONES + bone))


def mount_keys(camera: int) -> list[int]:
    """Return the keys of a mount's centre point and three axis points, which are in the bone's frame."""
    return [int(gtsam.symbol("m", 4 * camera + point)) for point in range(4)]


class MotionState(NamedTuple):
    """The keys of one bone's state at one time."""

    time_ns: int
    pose_key: int
    velocity_key: int


@dataclass(frozen=True, slots=True)
class MountPoints:
    """Four points fixed to a camera that together measure its pose.

    The centre point has the standard deviation ``sigma_m``. Each axis point has a tenth of its information,
    at the distance from the centre at which the points measure the rotation to ``sigma_rad``.

    Attributes:
        sigma_rad: Rotation sigma of the pose, per axis.
        sigma_m: Position sigma of the pose, per axis.
    """

    sigma_rad: float
    sigma_m: float

    AXIS_WHITENING_RATIO: ClassVar[float] = float(np.sqrt(_AXIS_WEIGHT))
    """A shift in sigmas of an axis point over the same shift in sigmas of the centre point."""

    @property
    def axis_sigma_m(self) -> float:
        """Standard deviation of an axis point."""
        return float(self.sigma_m / np.sqrt(_AXIS_WEIGHT))

    @property
    def radius_m(self) -> float:
        """Distance r of the axis points from the centre: the information of the rotation is 2 r² / σ²."""
        return float(self.axis_sigma_m / (np.sqrt(2.0) * self.sigma_rad))

    def x_in_cam(self) -> FloatArray:
        """Return the points (4,3), the centre first."""
        return np.vstack([np.zeros(3), self.radius_m * np.eye(3)])


def geman_mcclure(noise: Any) -> Any:
    """Return a noise model with the Geman-McClure loss."""
    kernel = gtsam.noiseModel.mEstimator.GemanMcClure.Create(GEMAN_MCCLURE_C)
    return gtsam.noiseModel.Robust.Create(kernel, noise)


class JointFactors:
    """The body's own factors: ball joints with a rotation prior, and hinges.

    Args:
        bones: The graph's bones.
        hinges: Of the graph.
        prior_scale: Factor on the sigmas of the rotation prior.
        slack_m: Sigma of a joint's gap.
    """

    def __init__(
        self,
        bones: Sequence[Bone],
        hinges: Sequence[Hinge],
        *,
        prior_scale: float = 1.0,
        slack_m: float = JOINT_SLACK_M,
    ) -> None:
        self._hinges = hinges
        self._children = [(index, bone) for index, bone in enumerate(bones) if bone.parent >= 0]
        self._rest = {
            index: gtsam.Pose3(gtsam.Rot3(bone.mean_rotation), bone.offset_m)
            for index, bone in self._children
        }
        self._noise = {index: _joint_noise(bone, prior_scale, slack_m) for index, bone in self._children}
        self._hinge_noises = [
            gtsam.noiseModel.Isotropic.Sigma(1, float(np.hypot(HINGE_SLACK_RATIO * slack_m, hinge.sigma_m)))
            for hinge in hinges
        ]
        self._anchors = [
            [gtsam.Pose3(gtsam.Rot3(), anchor) for anchor in hinge.anchors_m] for hinge in hinges
        ]

    def add(self, graph: Any, tick: int) -> None:
        """Add the factors of one tick to a graph."""
        for index, bone in self._children:
            parent, child = bone_key(tick, bone.parent), bone_key(tick, index)
            graph.add(gtsam.BetweenFactorPose3(parent, child, self._rest[index], self._noise[index]))
        for hinge, anchors, noise in zip(self._hinges, self._anchors, self._hinge_noises, strict=True):
            upper, following = bone_key(tick, hinge.upper), bone_key(tick, hinge.following)
            for anchor in anchors:
                graph.add(gtsam.RangeFactorWithTransformPose3(upper, following, hinge.range_m, noise, anchor))


def _joint_noise(bone: Bone, prior_scale: float, slack_m: float) -> Any:
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = prior_scale**2 * bone.rotation_covariance
    covariance[3:, 3:] = slack_m**2 * np.eye(3)
    return gtsam.noiseModel.Gaussian.Covariance(covariance)


def add_mount_measurements(
    graph: Any, bones: Sequence[int], camera: int, world_from_cam: FloatArray, points: MountPoints
) -> None:
    """Add the measured poses of a camera with an unknown mount.

    Args:
        graph: Receives the factors.
        bones: N keys of the bone's poses.
        camera: Index of the camera, for its mount's keys.
        world_from_cam: (N,4,4) measured poses.
        points: The points of the mount.
    """
    x_in_world = points.x_in_cam() @ world_from_cam[:, :3, :3].swapaxes(1, 2) + world_from_cam[:, None, :3, 3]
    sigmas = (points.sigma_m, points.axis_sigma_m, points.axis_sigma_m, points.axis_sigma_m)
    noises = [geman_mcclure(gtsam.noiseModel.Isotropic.Sigma(3, sigma)) for sigma in sigmas]
    keys = mount_keys(camera)
    for bone, measured in zip(bones, x_in_world, strict=True):
        for key, x, noise in zip(keys, measured, noises, strict=True):
            graph.add(gtsam.GPSFactorArmCalib(bone, key, x, noise))


def add_mount_prior(
    graph: Any,
    camera: int,
    joint_from_cam: FloatArray,
    points: MountPoints,
    *,
    sigma_rad: float,
    sigma_m: float,
) -> None:
    """Add the prior of a mount, from the camera's name or from the job.

    Args:
        graph: Receives the factors.
        camera: Index of the camera.
        joint_from_cam: (4,4) the prior's mean.
        points: The points of the mount.
        sigma_rad: Of the rotation, per axis.
        sigma_m: Of the position, per axis.
    """
    centre, *axes = mount_keys(camera)
    noise = gtsam.noiseModel.Isotropic.Sigma(3, sigma_m)
    graph.add(gtsam.PriorFactorPoint3(centre, joint_from_cam[:3, 3], noise))
    # Three differences of length r with noise σ measure the rotation to σ / (r √2).
    arm = gtsam.noiseModel.Isotropic.Sigma(3, points.radius_m * np.sqrt(2.0) * sigma_rad)
    for axis, key in enumerate(axes):
        graph.add(gtsam.BetweenFactorPoint3(centre, key, points.radius_m * joint_from_cam[:3, axis], arm))


def mount_from_points(values: Any, camera: int, points: MountPoints) -> FloatArray:
    """Fit joint_from_cam (4,4) to a mount's four points, the rotation about the centre point."""
    centre, *axes = (np.asarray(values.atPoint3(key)) for key in mount_keys(camera))
    rotation = nearest_rotation((np.array(axes) - centre).T)
    out = np.eye(4)
    out[:3, :3] = rotation
    weight = _AXIS_WEIGHT
    shifted = [axes[i] - points.radius_m * rotation[:, i] for i in range(3)]
    out[:3, 3] = (centre + weight * np.sum(shifted, axis=0)) / (1.0 + 3.0 * weight)
    return out


def mount_jacobian(joint_from_cam: FloatArray, points: MountPoints) -> FloatArray:
    """Return the derivatives (6,12) of a mount by its four points.

    Args:
        joint_from_cam: (4,4) the mount.
        points: The points of the mount.

    Returns:
        From changes of the points' coordinates to the right perturbation of joint_from_cam, rotation first.
    """
    rotation, translation = np.zeros((3, 12)), np.zeros((3, 12))
    translation[:, :3] = np.eye(3)
    for axis in range(3):
        cross = skew(points.radius_m * joint_from_cam[:3, axis])
        rotation[:, 3 + 3 * axis : 6 + 3 * axis] = cross / (2.0 * points.radius_m**2)
        rotation[:, :3] -= cross / (2.0 * points.radius_m**2)
        translation[:, 3 + 3 * axis : 6 + 3 * axis] = _AXIS_WEIGHT * np.eye(3)
    for axis in range(3):
        # An axis point minus the rotated arm is a second measurement of the centre.
        translation += _AXIS_WEIGHT * skew(points.radius_m * joint_from_cam[:3, axis]) @ rotation
    translation /= 1.0 + 3.0 * _AXIS_WEIGHT
    return np.vstack([joint_from_cam[:3, :3].T @ rotation, joint_from_cam[:3, :3].T @ translation])


def insert_mount_points(values: Any, camera: int, joint_from_cam: FloatArray, points: MountPoints) -> None:
    """Insert a mount's four points into initial values."""
    x_in_joint = points.x_in_cam() @ joint_from_cam[:3, :3].T + joint_from_cam[:3, 3]
    for key, x in zip(mount_keys(camera), x_in_joint, strict=True):
        values.insert(key, x)


def values_from_poses(poses: FloatArray) -> Any:
    """Return GTSAM values with bone poses (T,B,4,4)."""
    values = gtsam.Values()
    for tick in range(poses.shape[0]):
        for bone in range(poses.shape[1]):
            values.insert(bone_key(tick, bone), gtsam.Pose3(poses[tick, bone]))
    return values
