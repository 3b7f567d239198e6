"""The factor graph's pieces: joints, hinges, camera measurements, mounts; all of them GTSAM's own C++.

Keys: ``b`` a bone's pose at a tick, ``v`` its velocity, ``m`` the four points that stand for a mount.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import gtsam
import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.body.bones import JOINT_SLACK_M, Bone, Hinge

MAX_BONES = 64
GEMAN_MCCLURE_C = 6.0
"""In sigmas of a six-dimensional residual, whose typical length is 2.4: at 3 the motion model wins over right
measurements of violent motion (palm 6.4 cm off instead of 0.6); gross errors have been dropped before."""
_MIN_DAMPING = 1e-5
"""Damping is raised tenfold from here until the error falls; each try is a solve, at the end all in vain."""
HINGE_SLACK_RATIO = 2.0
"""Sigma of a hinge's distances over that of a joint's gap."""
_AXIS_WEIGHT = 0.1
"""Information of a mount's axis points over its centre's: small, so that turning and moving decouple."""


def bone_key(tick: int, bone: int) -> int:
    """Key of a bone's pose."""
    return int(gtsam.symbol("b", tick * MAX_BONES + bone))


def velocity_key(tick: int, bone: int) -> int:
    """Key of a bone's velocity (6-vector, in its own frame, rotation first)."""
    return int(gtsam.symbol("v", tick * MAX_BONES + bone))


def mount_keys(camera: int) -> list[int]:
    """Keys of a mount's centre point and its three axis points, in the bone's frame."""
    return [int(gtsam.symbol("m", 4 * camera + point)) for point in range(4)]


@dataclass(frozen=True, slots=True)
class MountPoints:
    """Four points fixed in a camera that carry a pose measurement of the given precision.

    The centre point has standard deviation ``sigma_m``; the axis points have a tenth of its information and
    lie as far out as makes them fix the rotation to ``sigma_rad``.
    """

    sigma_rad: float
    sigma_m: float

    AXIS_WHITENING_RATIO: ClassVar[float] = float(np.sqrt(_AXIS_WEIGHT))
    """A shift of all four points in sigmas of an axis point over the same in sigmas of the centre point."""

    @property
    def axis_sigma_m(self) -> float:
        """Standard deviation of an axis point."""
        return float(self.sigma_m / np.sqrt(_AXIS_WEIGHT))

    @property
    def radius_m(self) -> float:
        """Distance of the axis points from the centre: rotation information is 2 r² / σ²."""
        return float(self.axis_sigma_m / (np.sqrt(2.0) * self.sigma_rad))

    def x_in_cam(self) -> FloatArray:
        """(4,3) the points."""
        return np.vstack([np.zeros(3), self.radius_m * np.eye(3)])


def geman_mcclure(noise: Any) -> Any:
    """Wrap a noise model in Geman-McClure's loss."""
    kernel = gtsam.noiseModel.mEstimator.GemanMcClure.Create(GEMAN_MCCLURE_C)
    return gtsam.noiseModel.Robust.Create(kernel, noise)


class JointFactors:
    """Adds the body's own factors of a tick: ball joints with a pose prior, and hinges.

    Args:
        bones: The graph's bones.
        joints: Its hinges.
        prior_scale: Widens the pose prior.
        slack_m: Sigma of a joint's gap.
    """

    def __init__(
        self,
        bones: Sequence[Bone],
        joints: Sequence[Hinge],
        *,
        prior_scale: float = 1.0,
        slack_m: float = JOINT_SLACK_M,
    ) -> None:
        self._hinges = joints
        self._children = [(index, bone) for index, bone in enumerate(bones) if bone.parent >= 0]
        self._rest = {
            index: gtsam.Pose3(gtsam.Rot3(bone.mean_rotation), bone.offset_m)
            for index, bone in self._children
        }
        self._noise = {index: _joint_noise(bone, prior_scale, slack_m) for index, bone in self._children}
        self._hinge_noises = [
            gtsam.noiseModel.Isotropic.Sigma(1, float(np.hypot(HINGE_SLACK_RATIO * slack_m, hinge.sigma_m)))
            for hinge in joints
        ]
        self._anchors = [
            [gtsam.Pose3(gtsam.Rot3(), anchor) for anchor in hinge.anchors_m] for hinge in joints
        ]

    def add(self, graph: Any, tick: int) -> None:
        """Add the factors of one tick."""
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
    """Measure a bone through a camera whose mount is unknown.

    Args:
        graph: Receives the factors.
        bones: Keys of the bone's poses (N).
        camera: Index of the camera, for its mount's keys.
        world_from_cam: (N,4,4) measured poses.
        points: The points that stand for the mount.
    """
    x_in_world = points.x_in_cam() @ world_from_cam[:, :3, :3].swapaxes(1, 2) + world_from_cam[:, None, :3, 3]
    sigmas = (points.sigma_m, points.axis_sigma_m, points.axis_sigma_m, points.axis_sigma_m)
    noises = [geman_mcclure(gtsam.noiseModel.Isotropic.Sigma(3, sigma)) for sigma in sigmas]
    keys = mount_keys(camera)
    for bone, measured in zip(bones, x_in_world, strict=True):
        for key, x, noise in zip(keys, measured, noises, strict=True):
            graph.add(gtsam.GPSFactorArmCalib(bone, key, x, noise))


def add_mount_prior(
    graph: Any, camera: int, joint_from_cam: FloatArray, points: MountPoints, sigmas: tuple[float, float]
) -> None:
    """Hold a mount near what its name or the job says.

    Args:
        graph: Receives the factors.
        camera: Index of the camera.
        joint_from_cam: (4,4) the prior's mean.
        points: The points that stand for the mount.
        sigmas: Of the rotation (rad) and the position (m), per axis.
    """
    centre, *axes = mount_keys(camera)
    noise = gtsam.noiseModel.Isotropic.Sigma(3, sigmas[1])
    graph.add(gtsam.PriorFactorPoint3(centre, joint_from_cam[:3, 3], noise))
    # Three differences of length r with noise σ fix the rotation to σ / (r √2).
    arm = gtsam.noiseModel.Isotropic.Sigma(3, points.radius_m * np.sqrt(2.0) * sigmas[0])
    for axis, key in enumerate(axes):
        graph.add(gtsam.BetweenFactorPoint3(centre, key, points.radius_m * joint_from_cam[:3, axis], arm))


def mount_from_points(values: Any, camera: int, points: MountPoints) -> FloatArray:
    """Read joint_from_cam (4,4) off a mount's four points by a rigid fit about the centre point."""
    centre, *axes = (np.asarray(values.atPoint3(key)) for key in mount_keys(camera))
    u, _, vt = np.linalg.svd((np.array(axes) - centre).T)
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    out = np.eye(4)
    out[:3, :3] = rotation
    weight = _AXIS_WEIGHT
    shifted = [axes[i] - points.radius_m * rotation[:, i] for i in range(3)]
    out[:3, 3] = (centre + weight * np.sum(shifted, axis=0)) / (1.0 + 3.0 * weight)
    return out


def mount_jacobian(joint_from_cam: FloatArray, points: MountPoints) -> FloatArray:
    """(6,12) from changes of a mount's four points to joint_from_cam's right perturbation, rotation first."""
    turn, shift = np.zeros((3, 12)), np.zeros((3, 12))
    shift[:, :3] = np.eye(3)
    for axis in range(3):
        arm = points.radius_m * joint_from_cam[:3, axis]
        cross = np.array([[0.0, -arm[2], arm[1]], [arm[2], 0.0, -arm[0]], [-arm[1], arm[0], 0.0]])
        turn[:, 3 + 3 * axis : 6 + 3 * axis] = cross / (2.0 * points.radius_m**2)
        turn[:, :3] -= cross / (2.0 * points.radius_m**2)
        shift[:, 3 + 3 * axis : 6 + 3 * axis] = _AXIS_WEIGHT * np.eye(3)
    for axis in range(3):
        # An axis point less the turned arm is a second look at the centre.
        arm = points.radius_m * joint_from_cam[:3, axis]
        cross = np.array([[0.0, -arm[2], arm[1]], [arm[2], 0.0, -arm[0]], [-arm[1], arm[0], 0.0]])
        shift += _AXIS_WEIGHT * cross @ turn
    shift /= 1.0 + 3.0 * _AXIS_WEIGHT
    return np.vstack([joint_from_cam[:3, :3].T @ turn, joint_from_cam[:3, :3].T @ shift])


def insert_mount_points(values: Any, camera: int, joint_from_cam: FloatArray, points: MountPoints) -> None:
    """Put a mount's four points among the start values."""
    x_in_joint = points.x_in_cam() @ joint_from_cam[:3, :3].T + joint_from_cam[:3, 3]
    for key, x in zip(mount_keys(camera), x_in_joint, strict=True):
        values.insert(key, x)


def levenberg_marquardt(
    graph: Any,
    values: Any,
    *,
    iterations: int,
    last: Sequence[int] = (),
    step: Callable[[], None] | None = None,
    tolerance: float = 1e-5,
) -> tuple[Any, int]:
    """Run Levenberg-Marquardt until the error hardly falls.

    Args:
        graph: The factors.
        values: The start.
        iterations: Most steps.
        last: Keys eliminated last (calibration shared by all ticks).
        step: Called after each iteration; may raise to stop.
        tolerance: Relative decrease of the error below which an iteration was the last.

    Returns:
        The solution and the iterations taken.
    """
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(iterations)
    params.setlambdaLowerBound(_MIN_DAMPING)
    if last:
        params.setOrdering(gtsam.Ordering.ColamdConstrainedLastNonlinearFactorGraph(graph, list(last)))
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, params)
    error = optimizer.error()
    for count in range(1, iterations + 1):
        optimizer.iterate()
        if step is not None:
            step()
        decrease, error = error - optimizer.error(), optimizer.error()
        if decrease <= tolerance * max(error, 1e-9):
            return optimizer.values(), count
    return optimizer.values(), iterations


def gauss_newton_then_lm(
    graph: Any, values: Any, *, iterations: int, step: Callable[[], None], tolerance: float
) -> tuple[Any, int]:
    """Gauss-Newton steps while each lowers the error, what is left by `levenberg_marquardt`.

    A step without damping takes two thirds of a damped one's time: damping is a factor more for every state.

    Args:
        graph: The factors.
        values: The start, near the solution.
        iterations: Most steps.
        step: Called after each iteration; may raise to stop.
        tolerance: Relative decrease of the error below which an iteration was the last.

    Returns:
        The solution and the iterations taken.
    """
    optimizer = gtsam.GaussNewtonOptimizer(graph, values, gtsam.GaussNewtonParams())
    error = optimizer.error()
    for count in range(1, iterations + 1):
        try:
            optimizer.iterate()
        except RuntimeError:
            # A state that only damping holds.
            break
        step()
        decrease = error - optimizer.error()
        if decrease >= 0.0:
            # What `values` gives lives in the optimiser until its next step.
            values = gtsam.Values(optimizer.values())
        if abs(decrease) <= tolerance * max(error, 1e-9):
            # Robust weights let full steps end a hair above the best one.
            return values, count
        if not decrease >= 0.0:
            break
        error -= decrease
    found, more = levenberg_marquardt(
        graph, values, iterations=max(iterations - count, 1), step=step, tolerance=tolerance
    )
    return found, count + more


def values_from_poses(poses: FloatArray) -> Any:
    """Values of bone poses (T,B,4,4)."""
    values = gtsam.Values()
    for tick in range(poses.shape[0]):
        for bone in range(poses.shape[1]):
            values.insert(bone_key(tick, bone), gtsam.Pose3(poses[tick, bone]))
    return values
