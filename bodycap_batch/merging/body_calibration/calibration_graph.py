"""Mounts and metric scale from free motion: one graph over sampled ticks, solved along a line of scales."""

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
from bodycap_batch.merging.body_calibration.hinge_test import FREE_M, loosened, off_hinges, told
from bodycap_batch.merging.body_calibration.joint_variability import passing_shares
from bodycap_batch.merging.body_calibration.mount_covariance import (
    JOINED,
    MEASURED,
    Eliminated,
    SolvedMounts,
    kinds_of,
)
from bodycap_batch.merging.body_calibration.samples import Samples
from bodycap_batch.merging.graph.attitude_factors import AttitudeFactors
from bodycap_batch.merging.graph.error_modes import (
    POSTURE_BIAS_SHARE,
    BodyModel,
    ErrorModes,
    map_error_modes,
    mount_perturbation,
    posture_bias_modes,
    scale_modes,
    stack_modes,
)
from bodycap_batch.merging.graph.factors import (
    JointFactors,
    MountPoints,
    add_mount_measurements,
    add_mount_prior,
    bone_key,
    insert_mount_points,
    mount_from_points,
    mount_jacobian,
    mount_keys,
    values_from_poses,
)
from bodycap_batch.merging.graph.joint_priors import samples_per_gesture, widen_joint_priors
from bodycap_batch.merging.graph.linearisation import LinearisedGraph, linearise
from bodycap_batch.merging.graph.optimiser import levenberg_marquardt
from bodycap_batch.model.geometry import invert
from bodycap_batch.model.skeleton import Mount, SkeletonModel
from bodycap_batch.model.skeleton_presets import NAMED_SIGMA_RAD, NOMINAL_SIGMA_RAD

PRIOR_SCALE = 4.0
"""The pose prior counts once per tick here; its sigmas are widened, or it would outvote the cameras."""
_FLEETING = float(np.sqrt(1.0 - POSTURE_BIAS_SHARE**2))
"""Of a joint's everyday range, what comes and goes."""


class Calibration:
    """The calibration graph at any scale, warm-started from the last one solved.

    What is uncertain in map units (camera centres, and with them the joints' gaps) keeps its sigma there:
    sigmas fixed in metres would reward a small scale for making all residuals small.

    Args:
        skeleton: The body.
        bones: The graph's bones.
        samples: The camera poses.
        priors: Mount priors by camera.
        provisional: A scale near the right one, at which a joint's gap has its nominal sigma.
        step: Called after each iteration; may raise to stop.
    """

    def __init__(
        self,
        skeleton: SkeletonModel,
        bones: Sequence[Bone],
        samples: Samples,
        priors: Mapping[str, Mount],
        provisional: float,
        step: Callable[[], None],
    ) -> None:
        self._skeleton, self._bones, self._samples = skeleton, bones, samples
        self._at_ease, self._t_posed = tuple(bones), with_t_pose_prior(skeleton, bones)
        self._hinges = hinges(skeleton, tuple(bones))
        self._priors, self._step = priors, step
        self._slack_map = JOINT_SLACK_M * np.sqrt(samples.repeats) / provisional
        self._values: Any = None
        self._scale, self._first_joint = 1.0, 0
        self.slack_factor = 1.0
        self.mounts = {name: np.array(priors[name].joint_from_cam) for name in samples.cameras}

    @property
    def samples(self) -> Samples:
        """The camera poses in use."""
        return self._samples

    def move(self, samples: Samples) -> None:
        """Use other camera poses of the same cameras and ticks; the last solution stays the start."""
        self._samples = samples

    def solve(self, scale: float, iterations: int = 30) -> float:
        """Solve at a scale; return the cost (half the sum of squares, robust).

        Args:
            scale: Metres per map unit.
            iterations: Most Levenberg-Marquardt steps.
        """
        poses = self._samples.map_from_cam.copy()
        poses[..., :3, 3] *= scale
        points = self._samples.points(scale)
        graph = self._graph(poses, scale)
        start = self._start(poses, scale)
        last = [key for camera in range(len(self._samples.cameras)) for key in mount_keys(camera)]
        self._values, _ = levenberg_marquardt(graph, start, iterations=iterations, last=last, step=self._step)
        self._scale = scale
        for camera, name in enumerate(self._samples.cameras):
            self.mounts[name] = mount_from_points(self._values, camera, points[camera])
        return float(graph.error(self._values))

    def widen_postures(self) -> None:
        """Widen the joint priors where the last solution shows other postures; see `widen_joint_priors`."""
        # A T-pose is asked for: it has a prior of its own, and says nothing about the posture at other ticks.
        usual = ~self._samples.posture.t_pose
        if usual.any():
            poses, times_ns = self.poses()[usual], self._samples.times_ns[usual]
            self._at_ease = widen_joint_priors(self._skeleton, self._bones, poses, times_ns)

    def test_hinges(self) -> bool:
        """Let go of the hinges that cameras can contradict, and keep those loose that give.

        What a joint does beside its hinge it does for as long as a gesture lasts: all samples of one count as
        one, or the hinge would bend the mounts with the weight of them all.

        Returns:
            Whether any of them gives.
        """
        tested = told(self._hinges, self._samples.bones)
        if not tested:
            return False
        kept = self._at_ease, self._hinges, self._values, dict(self.mounts)
        self._use(loosened(self._at_ease, {hinge.lower: FREE_M for hinge in tested}), once=1.0)
        self.solve(self._scale)
        self._use(
            loosened(self._at_ease, off_hinges(self.solved())),
            once=samples_per_gesture(self._samples.times_ns),
        )
        if not self.off_hinge_m():
            self._at_ease, self._hinges, self._values, self.mounts = kept
            return False
        return True

    def _use(self, bones: tuple[Bone, ...], once: float) -> None:
        self._at_ease = bones
        self._hinges = tuple(
            replace(hinge, sigma_m=float(np.sqrt(once)) * hinge.sigma_m)
            for hinge in hinges(self._skeleton, bones)
        )

    def off_hinge_m(self) -> dict[str, float]:
        """By role, sigma by which a hinge's distances are off beyond a joint's slack; of those that give."""
        return {bone.role: bone.off_hinge_m for bone in self._at_ease if bone.off_hinge_m > 0.0}

    def spread(
        self,
        sigma_log: float,
        slope: Mapping[str, FloatArray],
        placed: Mapping[str, tuple[float, float]],
        bodies: Sequence[tuple[ErrorModes, ErrorModes]] = (),
    ) -> tuple[ErrorModes, ErrorModes]:
        """How far off the last solution may be, and what comes and goes while it is used.

        Constant are the noise's effect, the wearer's habits and the scale, and the mounts with them; a map's
        bends and passing postures move single stretches of the motion only.

        Args:
            sigma_log: Sigma of the scale's logarithm.
            slope: By camera, change of joint_from_cam (4,4) per unit of log scale.
            placed: By camera whose map was joined by the body, sigmas (rad, m) of where it lies.
            bodies: How bones may differ from those believed, between people and between rigs; how another
                rig is built says nothing of how well this one's mounts are known.
        """
        samples, cameras = self._samples, self._samples.cameras
        mounts = self.solved()
        solved = mounts.eliminated()
        factors = self.row_variance(mounts, solved)
        bent = self._bent(mounts, solved)
        person = [
            posture_bias_modes(self._at_ease, cameras, POSTURE_BIAS_SHARE),
            *(people for people, _ in bodies),
        ]
        follow = {name: mount_perturbation(self.mounts[name], slope[name]) for name in cameras}
        bends = np.sqrt(bent) * np.stack([samples.sigma_rad, self._scale * samples.sigma_map], axis=1)
        bends = np.hypot(bends, [placed.get(name, (0.0, 0.0)) for name in cameras])
        constant = stack_modes(
            [
                mounts.spread(solved, factors, stack_modes(person)),
                scale_modes(self._bones, sigma_log, follow),
            ]
        )
        passing = [
            posture_bias_modes(self._bones, cameras, self._passing(mounts, solved)),
            map_error_modes(self._bones, dict(zip(cameras, bends, strict=True))),
            *(mounts.followed(solved, rigs) for _, rigs in bodies),
        ]
        return constant, stack_modes(passing)

    def _passing(self, mounts: SolvedMounts, solved: Eliminated) -> FloatArray:
        """Share (B,) of each joint's everyday range that comes and goes."""
        usual = np.flatnonzero(~self._samples.posture.t_pose)
        times_ns = self._samples.times_ns[usual]
        return np.sqrt(passing_shares(mounts, solved, (usual, times_ns), PRIOR_SCALE))

    def _bent(self, mounts: SolvedMounts, solved: Eliminated) -> float:
        """Variance of the measurements beyond their own noise, as a share of what was believed."""
        white, repeats = self._samples.white_share, self._samples.repeats
        # The map's error was widened by what samples share of it: one sample alone shows the plain one.
        return max(mounts.variance(solved, MEASURED, white + (1.0 - white) / repeats) - white, 0.0)

    def row_variance(self, mounts: SolvedMounts, solved: Eliminated) -> FloatArray:
        """Variance factor (5,) of each kind of the graph's rows, from the residuals."""
        repeats = self._samples.repeats
        measured = self._samples.white_share + repeats * self._bent(mounts, solved)
        # What is left of a gap may repeat itself as the map's error does.
        joint_gaps = repeats * mounts.variance(solved, JOINED, 1.0 / repeats)
        # Rotations are weighed at the pose prior's widened sigmas; what comes and goes differs by sample.
        posed = (_FLEETING / PRIOR_SCALE) ** 2
        return np.array([1.0, measured, joint_gaps, posed, (NAMED_SIGMA_RAD / NOMINAL_SIGMA_RAD) ** 2])

    def measurement_shifts(self, linear: LinearisedGraph, directions: FloatArray) -> FloatArray:
        """How the residuals change as the measured cameras move: rows (R,P).

        Args:
            linear: Derivatives of the last solution.
            directions: (C,K,P,6) turn (rad) and shift (m) of each camera, in the axes of the map.
        """
        samples, first = self._samples, 0
        bones, all_points = self.poses(), samples.points(self._scale)
        out = np.zeros((linear.matrix.shape[0], directions.shape[2]))
        for camera in range(len(samples.cameras)):
            first += 4  # the prior of the mount's four points
            ticks = np.flatnonzero(samples.valid[camera])
            rotation = samples.map_from_cam[camera, ticks, :3, :3]
            for point, key in enumerate(mount_keys(camera)):
                factors = first + point + 4 * np.arange(len(ticks))
                arm = rotation @ all_points[camera].x_in_cam()[point]
                shift = directions[camera, ticks, :, 3:] + np.cross(
                    directions[camera, ticks, :, :3], arm[:, None]
                )
                in_bone = np.einsum("kji,kpj->kip", bones[ticks, samples.bones[camera], :3, :3], shift)
                derivative = linear.pose_jacobians(factors, 3, [key] * len(ticks))[..., :3]
                rows = linear.first_row[factors][:, None] + np.arange(3)
                out[rows] = derivative @ in_bone
            first += 4 * len(ticks)
        return out

    def reweigh(self, mounts: SolvedMounts, solved: Eliminated) -> None:
        """Weigh measurements and gaps by what the last solution left of them, never by less than believed.

        Residuals that are smaller than a map's usual error say that this map is better.
        """
        samples = self._samples
        factors = self.row_variance(mounts, solved)
        measured = min(float(factors[MEASURED]), 1.0)
        self._samples = replace(
            samples,
            sigma_rad=np.sqrt(measured) * samples.sigma_rad,
            sigma_map=np.sqrt(measured) * samples.sigma_map,
            white_share=samples.white_share / measured,
        )
        self._slack_map *= float(np.sqrt(min(float(factors[JOINED]), 1.0)))

    def unit_shifts(self, mounts: SolvedMounts) -> FloatArray:
        """How the residuals (R,) change per unit of log scale because their sigmas do.

        Centres and gaps are uncertain in map units: their residuals shrink as the map grows. Without this
        share the smallest scale would look best. How far a camera is turned does not depend on the scale.
        """
        linear, samples, first = mounts.linear, self._samples, 0
        out = np.where(mounts.kinds == JOINED, -linear.rhs, 0.0)
        for camera in range(len(samples.cameras)):
            first += 4  # the prior of the mount's four points
            factors = first + 4 * np.arange(int(samples.valid[camera].sum()))
            centre = linear.first_row[factors][:, None] + np.arange(3)
            for point, share in enumerate((1.0, *[MountPoints.AXIS_WHITENING_RATIO] * 3)):
                out[centre + 3 * point] = -share * linear.rhs[centre]
            first += 4 * len(factors)
        return out

    def solved(self) -> SolvedMounts:
        """The last solution's derivatives, for what depends on it."""
        cameras = self._samples.cameras
        all_points = self._samples.points(self._scale)
        poses = self._samples.map_from_cam.copy()
        poses[..., :3, 3] *= self._scale
        graph = self._graph(poses, self._scale)
        linear = linearise(graph, self._values)
        body = BodyModel(bones=self._at_ease, hinges=self._hinges)
        each, last = body.factors_per_tick, self._samples.valid.shape[1]
        posed = np.flatnonzero(self._samples.posture.t_pose)
        stated = (self._first_joint + each * posed[:, None] + np.arange(each)).reshape(-1)
        return SolvedMounts(
            linear=linear,
            body=body,
            world_from_bone=self.poses(),
            mount_columns={
                name: np.concatenate([linear.columns[key] + np.arange(3) for key in mount_keys(camera)])
                for camera, name in enumerate(cameras)
            },
            mount_change={
                name: mount_jacobian(self.mounts[name], all_points[camera])
                for camera, name in enumerate(cameras)
            },
            kinds=kinds_of(
                linear, (self._first_joint, self._first_joint + each * last), stated, self._named()
            ),
            first_joint=self._first_joint,
        )

    def solved_mounts(self, spread: ErrorModes) -> tuple[Mount, ...]:
        """The mounts of the last solution with their sigmas."""
        out = []
        for name in self._samples.cameras:
            variance = (spread.mounts[name] ** 2).sum(axis=1)
            out.append(
                Mount(
                    camera=name,
                    role=self._priors[name].role,
                    joint_from_cam=self.mounts[name],
                    sigma_rad=float(np.sqrt(variance[:3].mean())),
                    sigma_m=float(np.sqrt(variance[3:].mean())),
                )
            )
        return tuple(out)

    def _named(self) -> IntArray:
        """Factors of how cameras are turned that rest on the camera's name."""
        out, first = [], 0
        for camera, name in enumerate(self._samples.cameras):
            if self._priors[name].by_name:
                out += [first + 1, first + 2, first + 3]  # the first is the centre's
            first += 4 + 4 * int(self._samples.valid[camera].sum())
        return np.array(out, dtype=np.int64)

    def _graph(self, world_from_cam: FloatArray, scale: float) -> Any:
        samples, graph = self._samples, gtsam.NonlinearFactorGraph()
        all_points = samples.points(scale)
        for camera, name in enumerate(samples.cameras):
            prior, points = self._priors[name], all_points[camera]
            add_mount_prior(
                graph, camera, prior.joint_from_cam, points, sigma_rad=prior.sigma_rad, sigma_m=prior.sigma_m
            )
            ticks = np.flatnonzero(samples.valid[camera])
            measured = [bone_key(tick, samples.bones[camera]) for tick in ticks.tolist()]
            add_mount_measurements(graph, measured, camera, world_from_cam[camera, ticks], points)
        usual, t_pose = self._joint_factors(scale)
        self._first_joint = int(graph.size())
        for tick in range(samples.valid.shape[1]):
            (t_pose if samples.posture.t_pose[tick] else usual).add(graph, tick)
        posture = AttitudeFactors(self._bones, samples.posture)
        for tick in range(samples.valid.shape[1]):
            posture.add(graph, tick)
        return graph

    def _joint_factors(self, scale: float) -> tuple[JointFactors, JointFactors]:
        """The body's factors at usual ticks, and in a T-pose (which counts once over all of its ticks)."""
        slack_m = scale * self.slack_factor * self._slack_map
        once = float(np.sqrt(max(self._samples.posture.t_pose.sum(), 1)))
        return (
            JointFactors(self._at_ease, self._hinges, prior_scale=PRIOR_SCALE, slack_m=slack_m),
            JointFactors(self._t_posed, self._hinges, prior_scale=once, slack_m=slack_m),
        )

    def _start(self, world_from_cam: FloatArray, scale: float) -> Any:
        if self._values is not None:
            return self._with_mounts(self._rescaled(scale / self._scale), scale)
        samples = self._samples
        measured = {
            bone: fill_gaps(world_from_cam[camera], samples.valid[camera]) @ invert(self.mounts[name])
            for camera, (name, bone) in reversed(
                list(enumerate(zip(samples.cameras, samples.bones, strict=True)))
            )
            if samples.valid[camera].any()
        }
        poses = pose_bones(self._skeleton, self._bones, measured)
        return self._with_mounts(values_from_poses(poses), scale)

    def _with_mounts(self, values: Any, scale: float) -> Any:
        for camera, points in enumerate(self._samples.points(scale)):
            insert_mount_points(values, camera, self.mounts[self._samples.cameras[camera]], points)
        return values

    def _rescaled(self, ratio: float) -> Any:
        """Take the last solution to another scale: each tick's body keeps its shape and moves as a whole."""
        poses = self.poses()
        shift = (ratio - 1.0) * poses[:, :1, :3, 3]
        poses[..., :3, 3] += shift
        return values_from_poses(poses)

    def poses(self) -> FloatArray:
        """World_from_bone (K,B,4,4) of the last solution."""
        ticks = self._samples.valid.shape[1]
        return np.array(
            [
                [self._values.atPose3(bone_key(tick, bone)).matrix() for bone in range(len(self._bones))]
                for tick in range(ticks)
            ]
        )
