"""The motion graph of a timeline: bones in continuous time, measurements at any time, fixed mounts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import gtsam
import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.merging.body.bones import Bone, hinges
from bodycap_batch.merging.body.initial_poses import fill_gaps, pose_bones
from bodycap_batch.merging.cameras.track import (
    MAX_COARSE_GAP_NS,
    MIN_SIGMA_M,
    MIN_SIGMA_RAD,
    CameraTrack,
    nearest_times,
)
from bodycap_batch.merging.graph.error_modes import BodyModel
from bodycap_batch.merging.graph.factors import (
    GEMAN_MCCLURE_C,
    MAX_BONES,
    JointFactors,
    MotionState,
    bone_key,
    geman_mcclure,
    poses_from_values,
    velocity_key,
)
from bodycap_batch.merging.graph.foot_contact import FootContact
from bodycap_batch.merging.graph.joint_distance_limits import DistanceLimit
from bodycap_batch.merging.graph.motion_prior import add_motion_prior
from bodycap_batch.merging.graph.optimiser import levenberg_marquardt
from bodycap_batch.model.geometry import interpolate_pose, invert, pose_vectors, so3_log
from bodycap_batch.model.merge_data import ON_TICK_TOLERANCE_NS
from bodycap_batch.model.skeleton import SkeletonModel

_TOLERANCE = 1e-4
"""Minimum relative decrease of the error per step. The solver stops after a smaller decrease. Convergence is
quadratic: after such a step, joints move by less than 0.1 mm."""


@dataclass(frozen=True, slots=True)
class MeasurementResiduals:
    """The differences between the measured and the solved poses of one camera.

    Attributes:
        distance_m: (N,) distances between the measured and the solved centres.
        angle_rad: (N,) angles between the measured and the solved orientations.
        weights: (N,) robust weights of the measurements; 1 is the full weight.
    """

    distance_m: FloatArray
    angle_rad: FloatArray
    weights: FloatArray


@dataclass(frozen=True, slots=True)
class JointUncertainty:
    """How well the joints of the bones are known.

    Attributes:
        centre_m2: (T,B,3,3) covariance, m², of each joint's centre relative to the first bone's joint centre,
            in the axes of the solution.
        flexion_rad2: (T,B) variance, rad², of the flexion of each hinge, at the bone below it. NaN for bones
            whose joint is not a hinge.
    """

    centre_m2: FloatArray
    flexion_rad2: FloatArray

    def blended(self, later: JointUncertainty, low: int, weight: FloatArray) -> JointUncertainty:
        """Return this uncertainty, continued by that of a later window.

        Args:
            later: The uncertainty from the tick `low` on.
            low: First tick of the later window.
            weight: (S,) weights of the later window at the ticks that both contain.
        """

        def join(one: FloatArray, other: FloatArray) -> FloatArray:
            factor = weight.reshape(-1, *[1] * (one.ndim - 1))
            both = (1.0 - factor) * one[low:] + factor * other[: len(weight)]
            return np.concatenate([one[:low], both, other[len(weight) :]])

        return JointUncertainty(
            join(self.centre_m2, later.centre_m2), join(self.flexion_rad2, later.flexion_rad2)
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionSolution:
    """The solved motion.

    Attributes:
        world_from_bone: (T,B,4,4) pose of each bone at each tick.
        residuals: By camera, the differences between its measured and its solved poses.
        world_from_cam: By camera, (N,4,4) solved pose at each measurement, from bone and mount.
        iterations: Number of iterations of the optimiser.
        errors: By kind of factor, half the sum of the squared residuals.
        uncertainty: How well the joints are known; None if it was not computed.
    """

    world_from_bone: FloatArray
    residuals: Mapping[str, MeasurementResiduals]
    world_from_cam: Mapping[str, FloatArray]
    iterations: int
    errors: Mapping[str, float]
    uncertainty: JointUncertainty | None = None


class MotionGraph:
    """The factor graph of a timeline, or of one window of a timeline.

    Attributes:
        graph: Factors of the graph: measurements, smoothness, joints, limits.
        values: Values of all variables at the solution; None before `solve`.
        body: Bones and hinges of the graph.
        tick_times_ns: (T,) times of the timeline's ticks.
        tracks: Measurements of each camera, poses in metres.
        mounts: joint_from_cam (4,4) by camera. The solver holds the mounts fixed.
        chains: States of each bone, in the order of time.
        measured_keys: By camera, the key of the bone's pose at each measurement.

    A measurement between ticks gets a separate state in the chain of its bone. GTSAM's
    ``WnoaInterpFactorPose3`` would interpolate without such a state, but it crashes with robust noise.

    Args:
        skeleton: The body.
        bones: The graph's bones.
        tick_times_ns: (T,) times of the timeline's ticks.
        tracks: Tracks without outliers, poses in metres.
        mounts: joint_from_cam (4,4) by camera.
        limits: Soft limits of distances, and foot contacts.
    """

    def __init__(
        self,
        skeleton: SkeletonModel,
        bones: Sequence[Bone],
        tick_times_ns: IntArray,
        tracks: Sequence[CameraTrack],
        mounts: Mapping[str, FloatArray],
        limits: Sequence[DistanceLimit | FootContact] = (),
    ) -> None:
        self._skeleton, self._bones, self.tick_times_ns = skeleton, bones, tick_times_ns
        self.tracks, self.mounts, self._limits = tracks, mounts, limits
        self.body = BodyModel(bones=bones, hinges=hinges(skeleton, tuple(bones)))
        self.graph = gtsam.NonlinearFactorGraph()
        self.values: Any = None
        self._factor_counts: dict[str, int] = {}
        self.measured_keys: dict[str, list[int]] = {}
        self.chains: list[list[MotionState]] = []
        self._add_measurements()
        self._add_motion()
        self._add_joints()
        self._add_limits()

    @property
    def first_joint(self) -> int:
        """Index of the first joint factor in the graph."""
        return self._factor_counts["measurements"] + self._factor_counts["smoothness"]

    def solve(self, iterations: int, step: Callable[[], None]) -> MotionSolution:
        """Optimise the graph.

        Args:
            iterations: Maximum number of iterations.
            step: Called after each iteration. It may raise an exception to stop the work.
        """
        self.values, count = levenberg_marquardt(
            self.graph, self.initial_values(), iterations=iterations, step=step, tolerance=_TOLERANCE
        )
        poses = poses_from_values(self.values, len(self.tick_times_ns), len(self._bones))
        return self._read(poses, count)

    def _node_keys(self) -> list[dict[int, tuple[int, int]]]:
        """Return for each bone, by tick time, the pose key and the velocity key of the bone's state."""
        ticks = self.tick_times_ns.tolist()
        return [
            {time: (bone_key(tick, bone), velocity_key(tick, bone)) for tick, time in enumerate(ticks)}
            for bone in range(len(self._bones))
        ]

    def _add_measurements(self) -> None:
        nodes = self._node_keys()
        count_off_ticks = [0] * len(self._bones)
        times_off_ticks: list[dict[int, int]] = [{} for _ in self._bones]
        for track in self.tracks:
            keys = []
            noises = _measurement_noises(track, self.mounts[track.camera])
            poses = track.map_from_cam @ invert(self.mounts[track.camera])
            ticks = nearest_times(self.tick_times_ns, track.times_ns).tolist()
            measurements = zip(track.times_ns.tolist(), ticks, poses, noises, strict=True)
            for time, tick_time, pose, noise in measurements:
                state_time = tick_time
                if abs(tick_time - time) > ON_TICK_TOLERANCE_NS:
                    # Measurements of one bone within 1 ms share a state, because two states with almost
                    # equal times make the equations singular.
                    state_time = _merge_state_time(times_off_ticks[track.bone], time)
                    if state_time not in nodes[track.bone]:
                        index = count_off_ticks[track.bone] * MAX_BONES + track.bone
                        nodes[track.bone][state_time] = (
                            int(gtsam.symbol("e", index)),
                            int(gtsam.symbol("w", index)),
                        )
                        count_off_ticks[track.bone] += 1
                key = nodes[track.bone][state_time][0]
                self.graph.add(gtsam.PriorFactorPose3(key, gtsam.Pose3(pose), geman_mcclure(noise)))
                keys.append(key)
            self.measured_keys[track.camera] = keys
        self.chains = [sorted(MotionState(time, *keys) for time, keys in chain.items()) for chain in nodes]
        self._factor_counts["measurements"] = int(self.graph.size())

    def _add_motion(self) -> None:
        before = self.graph.size()
        measured_ns = (
            min(int(track.times_ns[0]) for track in self.tracks),
            max(int(track.times_ns[-1]) for track in self.tracks),
        )
        for bone, chain in zip(self._bones, self.chains, strict=True):
            add_motion_prior(
                self.graph, bone, chain, start_ns=int(self.tick_times_ns[0]), measured_ns=measured_ns
            )
        self._factor_counts["smoothness"] = int(self.graph.size() - before)

    def _add_joints(self) -> None:
        before = self.graph.size()
        joints = JointFactors(self._bones, self.body.hinges)
        for tick in range(len(self.tick_times_ns)):
            joints.add(self.graph, tick)
        self._factor_counts["joints"] = int(self.graph.size() - before)

    def _add_limits(self) -> None:
        before = self.graph.size()
        for tick in range(len(self.tick_times_ns)):
            for limit in self._limits:
                limit.add(self.graph, tick)
        self._factor_counts["rules"] = int(self.graph.size() - before)

    def initial_values(self) -> Any:
        """Return initial values of all states, from the measurements and inverse kinematics."""
        measured = {}
        for track in reversed(self.tracks):
            poses, valid = track.poses_at(self.tick_times_ns, max_gap_ns=MAX_COARSE_GAP_NS)
            # If all frames are far apart, no pose is valid. The poses are then interpolated nevertheless.
            filled = fill_gaps(poses, valid) if valid.any() else poses
            measured[track.bone] = filled @ invert(self.mounts[track.camera])
        poses = pose_bones(self._skeleton, self._bones, measured)
        tick_s = 1e-9 * (self.tick_times_ns - self.tick_times_ns[0])
        values = gtsam.Values()
        for bone, chain in enumerate(self.chains):
            state_s = 1e-9 * (np.array([state.time_ns for state in chain]) - self.tick_times_ns[0])
            at_states, velocities = _initial_states(poses[:, bone], tick_s, state_s)
            for state, pose, velocity in zip(chain, at_states, velocities, strict=True):
                values.insert(state.pose_key, gtsam.Pose3(pose))
                values.insert(state.velocity_key, velocity)
        return values

    def _read(self, poses: FloatArray, count: int) -> MotionSolution:
        residuals, world_from_cam = {}, {}
        for track in self.tracks:
            mount = self.mounts[track.camera]
            keys = self.measured_keys[track.camera]
            solved = np.array([self.values.atPose3(key).matrix() for key in keys]).reshape(-1, 4, 4) @ mount
            world_from_cam[track.camera] = solved
            residuals[track.camera] = measurement_residuals(track, solved)
        errors, first = {}, 0
        for kind, size in self._factor_counts.items():
            errors[kind] = float(sum(self.graph.at(i).error(self.values) for i in range(first, first + size)))
            first += size
        return MotionSolution(
            world_from_bone=poses,
            residuals=residuals,
            world_from_cam=world_from_cam,
            iterations=count,
            errors=errors,
        )


def measurement_residuals(track: CameraTrack, world_from_cam: FloatArray) -> MeasurementResiduals:
    """Compare the measured poses of a track with the solved poses.

    Args:
        track: N measurements, poses in metres.
        world_from_cam: (N,4,4) solved poses of the camera.
    """
    measured_from_solved = invert(track.map_from_cam) @ world_from_cam
    half = np.linalg.cholesky(camera_covariance(track))
    whitened = np.linalg.solve(half, pose_vectors(measured_from_solved)[..., None])
    return MeasurementResiduals(
        distance_m=np.linalg.norm(measured_from_solved[:, :3, 3], axis=1),
        angle_rad=np.linalg.norm(so3_log(measured_from_solved[:, :3, :3]), axis=1),
        weights=_geman_mcclure_weight(np.linalg.norm(whitened[..., 0], axis=1)),
    )


def _merge_state_time(times: dict[int, int], time_ns: int) -> int:
    """Return the time of a state that is within `ON_TICK_TOLERANCE_NS` of a measurement.

    If there is no such state, add the time of the measurement to `times` and return it.

    Args:
        times: Times of a bone's states between ticks. The keys are the times divided by the tolerance.
        time_ns: Time of the measurement.
    """
    cell = time_ns // ON_TICK_TOLERANCE_NS
    near = [times[index] for index in (cell - 1, cell, cell + 1) if index in times]
    found = next((time for time in near if abs(time - time_ns) <= ON_TICK_TOLERANCE_NS), time_ns)
    return times.setdefault(found // ON_TICK_TOLERANCE_NS, found)


def camera_covariance(track: CameraTrack) -> FloatArray:
    """Return the covariance (N,6,6) of each measured pose in the camera's frame, rotation first."""
    variances = np.empty((len(track.times_ns), 6))
    variances[:, :3] = np.maximum(track.sigma_rad, MIN_SIGMA_RAD)[:, None] ** 2
    variances[:, 3:] = np.maximum(track.sigma_map, MIN_SIGMA_M)[:, None] ** 2
    return np.asarray(variances[:, :, None] * np.eye(6))


def _measurement_noises(track: CameraTrack, joint_from_cam: FloatArray) -> list[Any]:
    """Return the noise of the bone's pose at each measurement.

    It is the noise of the camera's pose, propagated through the mount.
    """
    adjoint = gtsam.Pose3(joint_from_cam).AdjointMap()
    covariance = adjoint @ camera_covariance(track) @ adjoint.T
    return [gtsam.noiseModel.Gaussian.Covariance(each) for each in covariance]


def _geman_mcclure_weight(norm: FloatArray) -> FloatArray:
    """Return the robust weights of residuals with the given norms in sigmas."""
    squared = GEMAN_MCCLURE_C**2
    return np.asarray((squared / (squared + norm**2)) ** 2)


def _initial_states(
    poses: FloatArray, tick_s: FloatArray, state_s: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Interpolate poses at the times of states, and compute velocities from pose differences.

    Args:
        poses: (T,4,4) poses at the ticks.
        tick_s: (T,) times of the ticks in seconds.
        state_s: (N,) times of the states in seconds.

    Returns:
        Poses (N,4,4) and velocities (N,6) at the states.
    """
    last = len(tick_s) - 1
    if last == 0:
        return np.repeat(poses, len(state_s), axis=0), np.zeros((len(state_s), 6))
    first = np.clip(np.searchsorted(tick_s, state_s, side="right") - 1, 0, last - 1)
    span = tick_s[first + 1] - tick_s[first]
    alpha = np.clip((state_s - tick_s[first]) / span, 0.0, 1.0)
    step = invert(poses[first]) @ poses[first + 1]
    return interpolate_pose(poses[first], poses[first + 1], alpha), pose_vectors(step) / span[:, None]


def joint_gaps(bones: Sequence[Bone], world_from_bone: FloatArray) -> dict[str, FloatArray]:
    """Return by role the distance (T,), metres, of each bone's joint from the joint's place on the parent."""
    out = {}
    for index, bone in enumerate(bones):
        if bone.parent >= 0:
            expected = world_from_bone[:, bone.parent] @ np.append(bone.offset_m, 1.0)
            out[bone.role] = np.linalg.norm(world_from_bone[:, index, :3, 3] - expected[:, :3], axis=1)
    return out


class PostureDeviation(NamedTuple):
    """Deviation of a joint's rotation from the rest pose, in sigmas of its everyday range.

    Both values are the root mean square over the three axes.

    Attributes:
        rms: Root mean square over the ticks. It is below 1 for most activities.
        mean: Deviation of the mean rotation. Large swings give a smaller mean than a wrong place of a camera.
    """

    rms: float
    mean: float


def posture_deviations(bones: Sequence[Bone], world_from_bone: FloatArray) -> dict[str, PostureDeviation]:
    """Return by role how far each joint's rotation is from the rest pose.

    Args:
        bones: Bones of the graph.
        world_from_bone: (T,B,4,4) solved poses of the bones.
    """
    out = {}
    for index, bone in enumerate(bones):
        if bone.parent >= 0:
            parent = np.swapaxes(world_from_bone[:, bone.parent, :3, :3], 1, 2)
            turn = so3_log(bone.mean_rotation.T @ parent @ world_from_bone[:, index, :3, :3])
            sigmas = turn @ np.linalg.cholesky(np.linalg.inv(bone.rotation_covariance))
            out[bone.role] = PostureDeviation(
                rms=float(np.sqrt(np.square(sigmas).mean())),
                mean=float(np.sqrt(np.square(sigmas.mean(axis=0)).mean())),
            )
    return out


def hinge_deviations(
    skeleton: SkeletonModel, bones: Sequence[Bone], world_from_bone: FloatArray
) -> dict[str, FloatArray]:
    """Return how far the far end of each hinge's lower bone is from the plane of the hinge.

    For an elbow, the lower bone is the forearm, and its far end is the wrist.

    Returns:
        By role of the bone that starts at this far end: (T,) distances, metres.
    """
    out = {}
    for hinge in hinges(skeleton, tuple(bones)):
        axis = hinge.anchors_m[0] - hinge.anchors_m.mean(axis=0)
        upper = world_from_bone[:, hinge.upper]
        joint = np.einsum("tij,j->ti", upper[:, :3, :3], hinge.anchors_m.mean(axis=0)) + upper[:, :3, 3]
        along = np.einsum("tij,j->ti", upper[:, :3, :3], axis / np.linalg.norm(axis))
        end = world_from_bone[:, hinge.following, :3, 3]
        out[bones[hinge.following].role] = np.abs(((end - joint) * along).sum(axis=1))
    return out
