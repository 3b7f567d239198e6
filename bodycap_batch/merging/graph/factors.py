"""The factors of the graphs: joints, hinges, camera measurements and mounts. All are GTSAM's own C++ factors.

Letters of the keys: ``b`` for a bone's pose at a tick, ``v`` for a bone's velocity at a tick, ``m`` for the
four points of a mount. The motion graph also uses ``e`` (pose) and ``w`` (velocity) between the ticks.
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

POINTS_PER_MOUNT = 4
"""Number of points that represent a mount. Each measured camera pose and each mount prior adds one factor per
point to the graph."""
MAX_BONES = 64
"""Maximum number of bones of a graph. The keys of one bone at two successive ticks differ by this number."""
GEMAN_MCCLURE_C = 6.0
"""Scale of the Geman-McClure loss, in sigmas of a six-dimensional residual. Such a residual typically has a
length of 2.4 sigmas. Gross errors are removed before the graph is built. Evidence:
docs/decisions/merging.md."""
HINGE_SLACK_RATIO = 2.0
"""Sigma of the distances that define a hinge, divided by the sigma of the gap at a joint. Evidence: none."""
_AXIS_WEIGHT = 0.1
"""Ratio of the information of a mount's axis point to the information of the mount's centre point. The ratio
is small, so that the rotation of the mount hardly depends on its translation."""


def bone_key(tick: int, bone: int) -> int:
    """Return the key of a bone's pose at a tick."""
    return int(gtsam.symbol("b", tick * MAX_BONES + bone))


def velocity_key(tick: int, bone: int) -> int:
    """Return the key of a bone's velocity at a tick, a 6-vector in the bone's frame, rotation first."""
    return int(gtsam.symbol("v", tick * MAX_BONES + bone))


def mount_keys(camera: int) -> list[int]:
    """Return the keys of a mount's points in the bone's frame: the centre point, then three axis points."""
    first = POINTS_PER_MOUNT * camera
    return [int(gtsam.symbol("m", first + point)) for point in range(POINTS_PER_MOUNT)]


class MotionState(NamedTuple):
    """The keys of one bone's state (pose and velocity) at one time."""

    time_ns: int
    pose_key: int
    velocity_key: int


@dataclass(frozen=True, slots=True)
class MountPoints:
    """Four points, fixed to a camera, that together measure the camera's pose.

    The centre point has the standard deviation ``sigma_m``. Each axis point has a tenth of the centre point's
    information. The distance of the axis points from the centre point is chosen so that the points measure
    the rotation with the standard deviation ``sigma_rad``.

    Attributes:
        sigma_rad: Sigma of the pose's rotation per axis, radians.
        sigma_m: Sigma of the pose's position per axis, metres.
    """

    sigma_rad: float
    sigma_m: float

    AXIS_WHITENING_RATIO: ClassVar[float] = float(np.sqrt(_AXIS_WEIGHT))
    """Ratio of the centre point's sigma to an axis point's sigma. It is less than 1."""

    @property
    def axis_sigma_m(self) -> float:
        """Standard deviation (metres) of an axis point per axis."""
        return float(self.sigma_m / np.sqrt(_AXIS_WEIGHT))

    @property
    def radius_m(self) -> float:
        """Distance r (metres) of the axis points from the centre point.

        With the sigma σ of an axis point, the information about the rotation is 2 r² / σ².
        """
        return float(self.axis_sigma_m / (np.sqrt(2.0) * self.sigma_rad))

    def x_in_cam(self) -> FloatArray:
        """Return the points (4,3) in the camera's frame, the centre point first."""
        return np.vstack([np.zeros(3), self.radius_m * np.eye(3)])


def geman_mcclure(noise: Any) -> Any:
    """Return a GTSAM noise model that adds the Geman-McClure loss to `noise`."""
    kernel = gtsam.noiseModel.mEstimator.GemanMcClure.Create(GEMAN_MCCLURE_C)
    return gtsam.noiseModel.Robust.Create(kernel, noise)


class JointFactors:
    """The factors of the body itself: ball joints with a rotation prior, and hinges.

    Args:
        bones: The graph's bones.
        hinges: The graph's hinges.
        prior_scale: Factor on the sigmas of the rotation prior.
        slack_m: Slack of a joint: sigma of its gap, metres.
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
        """Add the joint and hinge factors of one tick to a graph."""
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
    """Add the measured poses of a camera whose mount is unknown.

    Args:
        graph: Graph that receives the factors.
        bones: N keys of poses: the pose of the camera's bone at each measurement.
        camera: Index of the camera; it determines the keys of the mount.
        world_from_cam: (N,4,4) measured poses of the camera.
        points: Points of the mount.
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
        graph: Graph that receives the factors.
        camera: Index of the camera; it determines the keys of the mount.
        joint_from_cam: (4,4) mean of the prior.
        points: Points of the mount.
        sigma_rad: Sigma of the prior's rotation per axis, radians.
        sigma_m: Sigma of the prior's position per axis, metres.
    """
    centre, *axes = mount_keys(camera)
    noise = gtsam.noiseModel.Isotropic.Sigma(3, sigma_m)
    graph.add(gtsam.PriorFactorPoint3(centre, joint_from_cam[:3, 3], noise))
    # Three arms of length r, each with noise σ, measure the rotation with the sigma σ / (r √2).
    arm = gtsam.noiseModel.Isotropic.Sigma(3, points.radius_m * np.sqrt(2.0) * sigma_rad)
    for axis, key in enumerate(axes):
        graph.add(gtsam.BetweenFactorPoint3(centre, key, points.radius_m * joint_from_cam[:3, axis], arm))


def mount_from_points(values: Any, camera: int, points: MountPoints) -> FloatArray:
    """Fit joint_from_cam (4,4) to the four points of a mount.

    The rotation is fitted to the axis points relative to the centre point.
    """
    centre, *axes = (np.asarray(values.atPoint3(key)) for key in mount_keys(camera))
    rotation = nearest_rotation((np.array(axes) - centre).T)
    out = np.eye(4)
    out[:3, :3] = rotation
    weight = _AXIS_WEIGHT
    shifted = [axes[i] - points.radius_m * rotation[:, i] for i in range(3)]
    out[:3, 3] = (centre + weight * np.sum(shifted, axis=0)) / (1.0 + 3.0 * weight)
    return out


def mount_jacobian(joint_from_cam: FloatArray, points: MountPoints) -> FloatArray:
    """Return the derivatives (6,12) of a mount with respect to the coordinates of its four points.

    Args:
        joint_from_cam: (4,4) pose of the camera in the joint's frame.
        points: Points of the mount.

    Returns:
        (6,12) matrix from changes of the points' coordinates to the right perturbation of joint_from_cam,
        rotation first.
    """
    rotation, translation = np.zeros((3, 12)), np.zeros((3, 12))
    translation[:, :3] = np.eye(3)
    for axis in range(3):
        cross = skew(points.radius_m * joint_from_cam[:3, axis])
        rotation[:, 3 + 3 * axis : 6 + 3 * axis] = cross / (2.0 * points.radius_m**2)
        rotation[:, :3] -= cross / (2.0 * points.radius_m**2)
        translation[:, 3 + 3 * axis : 6 + 3 * axis] = _AXIS_WEIGHT * np.eye(3)
    for axis in range(3):
        # An axis point minus the rotated arm is another measurement of the centre.
        translation += _AXIS_WEIGHT * skew(points.radius_m * joint_from_cam[:3, axis]) @ rotation
    translation /= 1.0 + 3.0 * _AXIS_WEIGHT
    return np.vstack([joint_from_cam[:3, :3].T @ rotation, joint_from_cam[:3, :3].T @ translation])


def insert_mount_points(values: Any, camera: int, joint_from_cam: FloatArray, points: MountPoints) -> None:
    """Insert the four points of a mount into GTSAM's initial values."""
    x_in_joint = points.x_in_cam() @ joint_from_cam[:3, :3].T + joint_from_cam[:3, 3]
    for key, x in zip(mount_keys(camera), x_in_joint, strict=True):
        values.insert(key, x)


def values_from_poses(poses: FloatArray) -> Any:
    """Return GTSAM values that hold the poses (T,B,4,4) of the bones."""
    values = gtsam.Values()
    for tick in range(poses.shape[0]):
        for bone in range(poses.shape[1]):
            values.insert(bone_key(tick, bone), gtsam.Pose3(poses[tick, bone]))
    return values


def poses_from_values(values: Any, ticks: int, bones: int) -> FloatArray:
    """Return the poses (T,B,4,4) of the bones from GTSAM values."""
    return np.array(
        [[values.atPose3(bone_key(tick, bone)).matrix() for bone in range(bones)] for tick in range(ticks)]
    )
