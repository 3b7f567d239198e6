"""The calibration graph: estimate mounts and body poses at sampled ticks, for a given metric scale.

The module `calibration_covariance` estimates the uncertainty of a solution.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.merging.body.bones import JOINT_SLACK_M, Bone, hinges
from bodycap_batch.merging.body.initial_poses import fill_gaps, pose_bones
from bodycap_batch.merging.body.t_pose import with_t_pose_prior
from bodycap_batch.merging.body_calibration.hinge_test import (
    FREE_SIGMA_M,
    hinge_violation_sigma,
    observable_hinges,
    with_hinge_slack,
)
from bodycap_batch.merging.body_calibration.mount_covariance import JOINT_PRIOR_SCALE, LinearisedCalibration
from bodycap_batch.merging.body_calibration.samples import CalibrationSamples
from bodycap_batch.merging.graph.attitude_factors import AttitudeFactors
from bodycap_batch.merging.graph.error_modes import BodyModel
from bodycap_batch.merging.graph.factors import (
    POINTS_PER_MOUNT,
    JointFactors,
    add_mount_measurements,
    add_mount_prior,
    bone_key,
    insert_mount_points,
    mount_from_points,
    mount_jacobian,
    mount_keys,
    poses_from_values,
    values_from_poses,
)
from bodycap_batch.merging.graph.joint_priors import samples_per_gesture, widen_joint_priors
from bodycap_batch.merging.graph.linearisation import linearise
from bodycap_batch.merging.graph.optimiser import levenberg_marquardt
from bodycap_batch.model.geometry import invert
from bodycap_batch.model.skeleton import Mount, SkeletonModel


class CalibrationGraph:
    """The calibration graph of a set of cameras. Each solution starts from the previous solution.

    The sigmas of camera centres and joint gaps are constant in map units, because these sigmas describe
    errors of the map. Sigmas that are constant in metres would favour a small scale, because a small scale
    makes all residuals small.

    Attributes:
        bones: Original bones, before `widen_joint_priors` and `test_hinges` changed their priors.
        samples: Camera poses at the sampled ticks. If other poses of the same cameras at the same ticks
            replace them, the next solution starts from the last solution.
        priors: By camera, its mount prior.
        scale: Scale of the last solution, metres per map unit.
        slack_factor: Factor on the sigma of the joint gaps.
        mounts: By camera, joint_from_cam (4,4) of the last solution.

    Args:
        skeleton: The skeleton of the body.
        bones: Bones of the graph.
        samples: Camera poses at the sampled ticks.
        priors: By camera, its mount prior.
        provisional: Approximate scale, metres per map unit. The scale converts the sigma of a joint gap to
            map units. In metres, this sigma is `JOINT_SLACK_M` times √n. The number n is the number of
            samples that share one error of the map.
        step: Function that is called after each iteration. It may raise an exception to stop the work.
    """

    def __init__(
        self,
        skeleton: SkeletonModel,
        bones: Sequence[Bone],
        samples: CalibrationSamples,
        priors: Mapping[str, Mount],
        provisional: float,
        step: Callable[[], None],
    ) -> None:
        self._skeleton, self.bones, self.samples = skeleton, tuple(bones), samples
        self._rest_bones, self._t_pose_bones = tuple(bones), with_t_pose_prior(skeleton, bones)
        self._hinges = hinges(skeleton, tuple(bones))
        self.priors, self._step = priors, step
        self._slack_map = JOINT_SLACK_M * np.sqrt(samples.correlated_samples) / provisional
        self._values: Any = None
        self.scale, self._first_joint_factor = 1.0, 0
        self.slack_factor = 1.0
        self.mounts = {name: np.array(priors[name].joint_from_cam) for name in samples.cameras}

    def leave_out_map_errors(self) -> None:
        """Reduce the sigmas of the camera poses and of the joint gaps to those of one sample alone.

        What samples share as an error of the map does not move one map against another one.
        """
        samples = self.samples
        share = samples.white_noise_share
        self.samples = replace(
            samples,
            sigma_rad=np.sqrt(share) * samples.sigma_rad,
            sigma_map=np.sqrt(share) * samples.sigma_map,
            white_noise_share=1.0,
        )
        self._slack_map /= np.sqrt(samples.correlated_samples)

    def solve(self, scale: float, iterations: int = 30) -> float:
        """Solve the graph at a scale.

        Args:
            scale: Metres per map unit.
            iterations: Maximum number of Levenberg-Marquardt steps.

        Returns:
            The cost: half the sum of the squared, robustly weighted residuals.
        """
        poses = self._metric_poses(scale)
        points = self.samples.mount_points(scale)
        graph = self._graph(poses, scale)
        start = self._initial_values(poses, scale)
        last = [key for camera in range(len(self.samples.cameras)) for key in mount_keys(camera)]
        self._values, _ = levenberg_marquardt(graph, start, iterations=iterations, last=last, step=self._step)
        self.scale = scale
        for camera, name in enumerate(self.samples.cameras):
            self.mounts[name] = mount_from_points(self._values, camera, points[camera])
        return float(graph.error(self._values))

    def widen_joint_priors(self) -> None:
        """Widen the joint rotation priors that the last solution contradicts."""
        # The ticks of a T-pose have a separate prior. They are no evidence for the posture at other ticks.
        usual = ~self.samples.posture.t_pose
        if usual.any():
            poses, times_ns = self.poses()[usual], self.samples.times_ns[usual]
            self._rest_bones = widen_joint_priors(self._skeleton, self.bones, poses, times_ns)

    def test_hinges(self) -> bool:
        """Test the hinges that cameras can contradict, and loosen the violated hinges.

        A hinge violation lasts for a whole gesture, so the samples of one gesture are not independent. If a
        hinge is violated, all samples of one gesture together therefore get the weight of one sample. With
        full weights, a violated hinge would distort the mounts.

        Returns:
            True if a hinge is violated. The graph then has loosened hinges and must be solved again.
        """
        tested = observable_hinges(self._hinges, self.samples.bones)
        if not tested:
            return False
        before = self._rest_bones, self._hinges, self._values, dict(self.mounts)
        free = with_hinge_slack(self._rest_bones, {hinge.lower: FREE_SIGMA_M for hinge in tested})
        self._set_rest_bones(free, repetitions=1.0)
        self.solve(self.scale)
        violated = with_hinge_slack(self._rest_bones, hinge_violation_sigma(self.linearised()))
        self._set_rest_bones(violated, repetitions=samples_per_gesture(self.samples.times_ns))
        if not self.hinge_violation_m():
            self._rest_bones, self._hinges, self._values, self.mounts = before
            return False
        return True

    def hinge_violation_m(self) -> dict[str, float]:
        """Return the size of each hinge violation, as `test_hinges` estimated it.

        Returns:
            By role of the bone below the hinge, the sigma of the distance between the far end of this bone
            and the plane of the hinge, metres. Hinges without a violation are missing.
        """
        return {bone.role: bone.off_hinge_m for bone in self._rest_bones if bone.off_hinge_m > 0.0}

    def poses(self) -> FloatArray:
        """Return the bone poses world_from_bone (K,B,4,4) of the last solution, metres."""
        return poses_from_values(self._values, self.samples.valid.shape[1], len(self.bones))

    def linearised(self) -> LinearisedCalibration:
        """Return the graph linearised at the last solution."""
        cameras = self.samples.cameras
        all_points = self.samples.mount_points(self.scale)
        linear = linearise(self._graph(self._metric_poses(self.scale), self.scale), self._values)
        return LinearisedCalibration(
            linear=linear,
            body=BodyModel(bones=self._rest_bones, hinges=self._hinges),
            world_from_bone=self.poses(),
            mount_columns={
                name: np.concatenate([linear.columns[key] + np.arange(3) for key in mount_keys(camera)])
                for camera, name in enumerate(cameras)
            },
            mount_jacobian={
                name: mount_jacobian(self.mounts[name], all_points[camera])
                for camera, name in enumerate(cameras)
            },
            first_joint_factor=self._first_joint_factor,
            t_pose=self.samples.posture.t_pose,
            named_mounts=self._named_mounts(),
        )

    def measurement_factors(self, camera: int) -> IntArray:
        """Return the factor indices (N,4) of a camera's N measured poses. Each pose has four factors."""
        first = self._prior_factors()[camera] + POINTS_PER_MOUNT
        count = int(self.samples.valid[camera].sum())
        return np.asarray(
            first + POINTS_PER_MOUNT * np.arange(count)[:, None] + np.arange(POINTS_PER_MOUNT),
            dtype=np.int64,
        )

    def _prior_factors(self) -> IntArray:
        """Return the index (C,) of the first factor of each camera's mount prior."""
        counts = POINTS_PER_MOUNT * (1 + self.samples.valid.sum(axis=1))
        return np.asarray(np.cumsum(counts) - counts, dtype=np.int64)

    def _named_mounts(self) -> IntArray:
        """Return the indices of the factors of mount rotations that only the camera's name gives."""
        named = np.array([self.priors[name].by_name for name in self.samples.cameras], dtype=bool)
        # The first factor of a prior is for the centre, the others are for the rotation.
        return np.asarray((self._prior_factors()[named][:, None] + np.arange(1, POINTS_PER_MOUNT)).ravel())

    def _set_rest_bones(self, bones: tuple[Bone, ...], repetitions: float) -> None:
        """Set the bones, and reduce the weight of their hinges.

        Args:
            bones: The new bones of the graph.
            repetitions: Number of samples of one gesture. The weight of each hinge is divided by this number.
        """
        self._rest_bones = bones
        self._hinges = tuple(
            replace(hinge, sigma_m=float(np.sqrt(repetitions)) * hinge.sigma_m)
            for hinge in hinges(self._skeleton, bones)
        )

    def _metric_poses(self, scale: float) -> FloatArray:
        """Return the measured camera poses (C,K,4,4), with the centres in metres."""
        poses = self.samples.map_from_cam.copy()
        poses[..., :3, 3] *= scale
        return poses

    def _graph(self, world_from_cam: FloatArray, scale: float) -> Any:
        """Build the factor graph.

        The factors have this order. First, for each camera: the prior of its mount, then its measurements.
        Second, for each tick: the joints and hinges. Third, for each tick: the posture.
        """
        samples, graph = self.samples, gtsam.NonlinearFactorGraph()
        all_points = samples.mount_points(scale)
        for camera, name in enumerate(samples.cameras):
            prior, points = self.priors[name], all_points[camera]
            add_mount_prior(
                graph,
                camera,
                prior.joint_from_cam,
                points,
                sigma_rad=prior.sigma_rad,
                sigma_m=prior.sigma_m,
            )
            ticks = np.flatnonzero(samples.valid[camera])
            bone_keys = [bone_key(tick, samples.bones[camera]) for tick in ticks.tolist()]
            add_mount_measurements(graph, bone_keys, camera, world_from_cam[camera, ticks], points)
        usual, t_pose = self._joint_factors(scale)
        self._first_joint_factor = int(graph.size())
        for tick in range(samples.valid.shape[1]):
            (t_pose if samples.posture.t_pose[tick] else usual).add(graph, tick)
        posture = AttitudeFactors(self.bones, samples.posture)
        for tick in range(samples.valid.shape[1]):
            posture.add(graph, tick)
        return graph

    def _joint_factors(self, scale: float) -> tuple[JointFactors, JointFactors]:
        """Return the joint factors of ticks outside a T-pose, and the joint factors of ticks in a T-pose.

        The T-pose prior has the weight of a single tick, distributed over all ticks of the T-pose.
        """
        slack_m = scale * self.slack_factor * self._slack_map
        repetitions = float(np.sqrt(max(self.samples.posture.t_pose.sum(), 1)))
        return (
            JointFactors(self._rest_bones, self._hinges, prior_scale=JOINT_PRIOR_SCALE, slack_m=slack_m),
            JointFactors(self._t_pose_bones, self._hinges, prior_scale=repetitions, slack_m=slack_m),
        )

    def _initial_values(self, world_from_cam: FloatArray, scale: float) -> Any:
        """Return the initial values: the last solution, moved to the new scale.

        Before the first solution, inverse kinematics from the measured camera poses gives the initial values.
        """
        if self._values is not None:
            return self._with_mounts(self._rescaled(scale / self.scale), scale)
        samples = self.samples
        measured = {
            bone: fill_gaps(world_from_cam[camera], samples.valid[camera]) @ invert(self.mounts[name])
            for camera, (name, bone) in reversed(
                list(enumerate(zip(samples.cameras, samples.bones, strict=True)))
            )
            if samples.valid[camera].any()
        }
        poses = pose_bones(self._skeleton, self.bones, measured)
        return self._with_mounts(values_from_poses(poses), scale)

    def _with_mounts(self, values: Any, scale: float) -> Any:
        """Insert the points of all mounts into the values, and return the values."""
        for camera, points in enumerate(self.samples.mount_points(scale)):
            insert_mount_points(values, camera, self.mounts[self.samples.cameras[camera]], points)
        return values

    def _rescaled(self, ratio: float) -> Any:
        """Return the last solution, moved to another scale.

        The body of each tick moves as a whole and keeps its shape.

        Args:
            ratio: Ratio of the new scale to the scale of the last solution.
        """
        poses = self.poses()
        shift = (ratio - 1.0) * poses[:, :1, :3, 3]
        poses[..., :3, 3] += shift
        return values_from_poses(poses)
