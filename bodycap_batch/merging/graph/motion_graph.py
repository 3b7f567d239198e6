"""All ticks at once: bones in continuous time, every measurement at its own timestamp, mounts held."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Protocol

import gtsam
import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.merging.body.bones import Bone, hinges
from bodycap_batch.merging.body.initial_poses import fill_gaps, pose_bones
from bodycap_batch.merging.cameras.track import MIN_SIGMA_M, MIN_SIGMA_RAD, CameraTrack
from bodycap_batch.merging.graph.error_modes import BodyModel, ErrorModes
from bodycap_batch.merging.graph.factors import (
    GEMAN_MCCLURE_C,
    MAX_BONES,
    JointFactors,
    bone_key,
    gauss_newton_then_lm,
    geman_mcclure,
    velocity_key,
)
from bodycap_batch.merging.graph.foot_contact import FootContact
from bodycap_batch.merging.graph.joint_covariance import SolvedGraph, joint_covariance
from bodycap_batch.merging.graph.joint_limits import DistanceLimit
from bodycap_batch.model.geometry import interpolate_pose, invert, so3_log
from bodycap_batch.model.skeleton import SkeletonModel

ON_TICK_TOLERANCE_NS = 1_000_000
"""A measurement this close to a tick counts there: at 3 m/s the hand moves 3 mm in a millisecond."""

_TOLERANCE = 1e-4
"""Convergence is quadratic: after a step that lowers the error by 1e-4, joints move by less than 0.1 mm."""

_VELOCITY_SIGMA = np.array([8.0, 8.0, 8.0, 3.0, 3.0, 3.0])
"""Weak prior on the first and last velocity, where the motion model has one neighbour only (rad/s, m/s)."""
_REST_VELOCITY_SIGMA = np.array([1.0, 1.0, 1.0, 0.3, 0.3, 0.3])
"""Before the first and after the last measurement of all cameras the body rests instead of flying on."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionSolution:
    """Bones at every tick.

    Attributes:
        world_from_bone: (T,B,4,4).
        residual_m: By camera, (N,) distance of the measured centre from the solved one.
        residual_rad: By camera, (N,) angle between them.
        weights: By camera, (N,) robust weight of each measurement, 1 = kept whole.
        world_from_cam: By camera, (N,4,4) where its bone and mount have it at each measurement.
        iterations: Steps the optimiser took.
        errors: Half the sum of squares by kind of factor.
        joint_covariance: (T,B,3,3) of each bone's joint centre minus the first bone's, m²; None if not asked.
    """

    world_from_bone: FloatArray
    residual_m: Mapping[str, FloatArray]
    residual_rad: Mapping[str, FloatArray]
    weights: Mapping[str, FloatArray]
    world_from_cam: Mapping[str, FloatArray]
    iterations: int
    errors: Mapping[str, float]
    joint_covariance: FloatArray | None = None


class SolverProgress(Protocol):
    """Reports the progress of the optimisation, and stops it when asked."""

    def __call__(self, what: str = "", /) -> None:
        """Count an iteration; with a name, report that another part of the computation begins."""


class MotionGraph:
    """The graph over the whole timeline.

    A measurement off the ticks gets a state of its own in the bone's motion chain. GTSAM's
    ``WnoaInterpFactorPose3`` would interpolate without the extra state, but crashes when its noise is robust.

    Args:
        skeleton: The body.
        bones: The graph's bones.
        tick_times_ns: (T,) the timeline.
        tracks: Cleaned tracks, poses in metres.
        mounts: joint_from_cam (4,4) by camera.
        rules: Soft rules of the activity, and feet that stand.
    """

    def __init__(
        self,
        skeleton: SkeletonModel,
        bones: Sequence[Bone],
        tick_times_ns: IntArray,
        tracks: Sequence[CameraTrack],
        mounts: Mapping[str, FloatArray],
        rules: Sequence[DistanceLimit | FootContact] = (),
    ) -> None:
        self._skeleton, self._bones, self._times = skeleton, bones, tick_times_ns
        self._tracks, self._mounts, self._rules = tracks, mounts, rules
        self._graph = gtsam.NonlinearFactorGraph()
        self._sizes: dict[str, int] = {}
        self._measured_keys: dict[str, list[int]] = {}
        self._chains: list[list[tuple[int, int, int]]] = []
        self._add_measurements()
        self._add_motion()
        self._add_joints()
        self._add_rules()

    def solve(
        self, iterations: int, step: SolverProgress, spread: ErrorModes | None = None
    ) -> MotionSolution:
        """Optimise and read the result off.

        Args:
            iterations: Most steps.
            step: Called after each, and with the name of each part of the computation; may raise to stop.
            spread: How far off the calibration may be; None leaves the joints' covariance out.
        """
        if spread is not None:
            step("solving")
        values, count = gauss_newton_then_lm(
            self._graph, self._start(), iterations=iterations, step=step, tolerance=_TOLERANCE
        )
        poses = np.array(
            [
                [values.atPose3(bone_key(tick, bone)).matrix() for bone in range(len(self._bones))]
                for tick in range(len(self._times))
            ]
        )
        solution = self._read(values, poses, count)
        if spread is None:
            return solution
        covariance = joint_covariance(self._solved(values), poses, spread, step)
        return replace(solution, joint_covariance=covariance)

    def _solved(self, values: Any) -> SolvedGraph:
        return SolvedGraph(
            graph=self._graph,
            values=values,
            body=BodyModel(bones=self._bones, hinges=hinges(self._skeleton, tuple(self._bones))),
            tick_times_ns=self._times,
            chains=self._chains,
            tracks=self._tracks,
            measured_keys=self._measured_keys,
            mounts=self._mounts,
            first_joint=self._sizes["measurements"] + self._sizes["smoothness"],
        )

    def _node_keys(self) -> list[dict[int, tuple[int, int]]]:
        """Per bone: time of each state -> its pose and velocity keys, ticks first."""
        ticks = self._times.tolist()
        return [
            {time: (bone_key(tick, bone), velocity_key(tick, bone)) for tick, time in enumerate(ticks)}
            for bone in range(len(self._bones))
        ]

    def _add_measurements(self) -> None:
        nodes = self._node_keys()
        extra = [0] * len(self._bones)
        taken: list[dict[int, int]] = [{} for _ in self._bones]
        for track in self._tracks:
            keys = []
            noises = _measurement_noises(track, self._mounts[track.camera])
            poses = track.map_from_cam @ invert(self._mounts[track.camera])
            for time, pose, noise in zip(track.times_ns.tolist(), poses, noises, strict=True):
                node = self._nearest_tick(time)
                if abs(node - time) > ON_TICK_TOLERANCE_NS:
                    # Cameras of one bone share a state: two states closer than this are singular.
                    node = _merge_state_time(taken[track.bone], time)
                    if node not in nodes[track.bone]:
                        index = extra[track.bone] * MAX_BONES + track.bone
                        nodes[track.bone][node] = (
                            int(gtsam.symbol("e", index)),
                            int(gtsam.symbol("w", index)),
                        )
                        extra[track.bone] += 1
                key = nodes[track.bone][node][0]
                self._graph.add(gtsam.PriorFactorPose3(key, gtsam.Pose3(pose), geman_mcclure(noise)))
                keys.append(key)
            self._measured_keys[track.camera] = keys
        self._chains = [sorted((time, *keys) for time, keys in chain.items()) for chain in nodes]
        self._sizes["measurements"] = int(self._graph.size())

    def _nearest_tick(self, time_ns: int) -> int:
        after = int(np.clip(np.searchsorted(self._times, time_ns), 1, max(len(self._times) - 1, 1)))
        candidates = self._times[max(after - 1, 0) : after + 1].tolist()
        return int(min(candidates, key=lambda tick: abs(tick - time_ns)))

    def _add_motion(self) -> None:
        before = self._graph.size()
        start = int(self._times[0])
        weak = gtsam.noiseModel.Diagonal.Sigmas(_VELOCITY_SIGMA)
        calm = gtsam.noiseModel.Diagonal.Sigmas(_REST_VELOCITY_SIGMA)
        seen_from = min(int(track.times_ns[0]) for track in self._tracks)
        seen_to = max(int(track.times_ns[-1]) for track in self._tracks)
        for bone, chain in zip(self._bones, self._chains, strict=True):
            states = [
                gtsam.StateData(pose, velocity, 1e-9 * (time - start)) for time, pose, velocity in chain
            ]
            for first, second in pairwise(states):
                self._graph.add(gtsam.WnoaMotionFactorPose3(first, second, bone.psd))
            for time, _, velocity in chain:
                outside = time < seen_from or time > seen_to
                if outside or time in (chain[0][0], chain[-1][0]):
                    noise = calm if outside else weak
                    self._graph.add(gtsam.PriorFactorVector(velocity, np.zeros(6), noise))
        self._sizes["smoothness"] = int(self._graph.size() - before)

    def _add_joints(self) -> None:
        before = self._graph.size()
        joints = JointFactors(self._bones, hinges(self._skeleton, tuple(self._bones)))
        for tick in range(len(self._times)):
            joints.add(self._graph, tick)
        self._sizes["joints"] = int(self._graph.size() - before)

    def _add_rules(self) -> None:
        before = self._graph.size()
        for tick in range(len(self._times)):
            for rule in self._rules:
                rule.add(self._graph, tick)
        self._sizes["rules"] = int(self._graph.size() - before)

    def _start(self) -> Any:
        measured = {}
        for track in reversed(self._tracks):
            poses, valid = track.poses_at(self._times, max_gap_ns=200_000_000)
            # Frames that are all far apart are joined as they are.
            whole = fill_gaps(poses, valid) if valid.any() else poses
            measured[track.bone] = whole @ invert(self._mounts[track.camera])
        poses = pose_bones(self._skeleton, self._bones, measured)
        seconds = 1e-9 * (self._times - self._times[0])
        values = gtsam.Values()
        for bone, chain in enumerate(self._chains):
            times = 1e-9 * (np.array([time for time, _, _ in chain]) - self._times[0])
            at_states, velocities = _initial_states(poses[:, bone], seconds, times)
            for (_, pose_key, speed_key), pose, velocity in zip(chain, at_states, velocities, strict=True):
                values.insert(pose_key, gtsam.Pose3(pose))
                values.insert(speed_key, velocity)
        return values

    def _read(self, values: Any, poses: FloatArray, count: int) -> MotionSolution:
        residual_m, residual_rad, weights, world_from_cam = {}, {}, {}, {}
        for track in self._tracks:
            mount = self._mounts[track.camera]
            keys = self._measured_keys[track.camera]
            solved = np.array([values.atPose3(key).matrix() for key in keys]).reshape(-1, 4, 4) @ mount
            world_from_cam[track.camera] = solved
            residual_m[track.camera], residual_rad[track.camera], weights[track.camera] = (
                measurement_residuals(track, solved)
            )
        errors, first = {}, 0
        for kind, size in self._sizes.items():
            errors[kind] = float(sum(self._graph.at(i).error(values) for i in range(first, first + size)))
            first += size
        return MotionSolution(
            world_from_bone=poses,
            residual_m=residual_m,
            residual_rad=residual_rad,
            weights=weights,
            world_from_cam=world_from_cam,
            iterations=count,
            errors=errors,
        )


def measurement_residuals(
    track: CameraTrack, world_from_cam: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """How far (N,) the measured poses lie from solved ones, metres and rad, and the weights they keep."""
    off = invert(track.map_from_cam) @ world_from_cam
    whitened = np.linalg.solve(np.linalg.cholesky(camera_covariance(track)), _pose_error(off)[..., None])
    distance_m, turn_rad = (np.linalg.norm(part, axis=1) for part in (off[:, :3, 3], so3_log(off[:, :3, :3])))
    return distance_m, turn_rad, _geman_mcclure_weight(np.linalg.norm(whitened[..., 0], axis=1))


def _merge_state_time(taken: dict[int, int], time_ns: int) -> int:
    """Time of the state off the ticks that is within `ON_TICK_TOLERANCE_NS`, or the given one, then remembered."""
    place = time_ns // ON_TICK_TOLERANCE_NS
    near = [taken[cell] for cell in (place - 1, place, place + 1) if cell in taken]
    found = next((time for time in near if abs(time - time_ns) <= ON_TICK_TOLERANCE_NS), time_ns)
    return taken.setdefault(found // ON_TICK_TOLERANCE_NS, found)


def camera_covariance(track: CameraTrack) -> FloatArray:
    """(N,6,6) of each measured pose in the camera's frame, rotation first, with the floors in place."""
    variances = np.empty((len(track.times_ns), 6))
    variances[:, :3] = np.maximum(track.sigma_rad, MIN_SIGMA_RAD)[:, None] ** 2
    variances[:, 3:] = np.maximum(track.sigma_map, MIN_SIGMA_M)[:, None] ** 2
    return np.asarray(variances[:, :, None] * np.eye(6))


def _measurement_noises(track: CameraTrack, joint_from_cam: FloatArray) -> list[Any]:
    """Noise of the bone's pose behind each measurement: the camera's, carried through the mount."""
    adjoint = gtsam.Pose3(joint_from_cam).AdjointMap()
    covariance = adjoint @ camera_covariance(track) @ adjoint.T
    return [gtsam.noiseModel.Gaussian.Covariance(each) for each in covariance]


def _pose_error(pose: FloatArray) -> FloatArray:
    """Rotation vector and translation (N,6) of small poses (N,4,4)."""
    return np.hstack([so3_log(pose[:, :3, :3]), pose[:, :3, 3]])


def _geman_mcclure_weight(distance: FloatArray) -> FloatArray:
    """Weight of a residual of that many sigmas."""
    squared = GEMAN_MCCLURE_C**2
    return np.asarray((squared / (squared + distance**2)) ** 2)


def _initial_states(
    poses: FloatArray, seconds: FloatArray, times: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Poses (N,4,4) and velocities (N,6) at `times` (N,) from poses (T,4,4) at `seconds` (T,)."""
    last = len(seconds) - 1
    if last == 0:
        return np.repeat(poses, len(times), axis=0), np.zeros((len(times), 6))
    first = np.clip(np.searchsorted(seconds, times, side="right") - 1, 0, last - 1)
    span = seconds[first + 1] - seconds[first]
    alpha = np.clip((times - seconds[first]) / span, 0.0, 1.0)
    step = invert(poses[first]) @ poses[first + 1]
    return interpolate_pose(poses[first], poses[first + 1], alpha), _pose_error(step) / span[:, None]


def joint_gaps(bones: Sequence[Bone], world_from_bone: FloatArray) -> dict[str, FloatArray]:
    """How far each bone's joint lies from where its parent has it, by role: (T,) metres."""
    out = {}
    for index, bone in enumerate(bones):
        if bone.parent >= 0:
            expected = world_from_bone[:, bone.parent] @ np.append(bone.offset_m, 1.0)
            out[bone.role] = np.linalg.norm(world_from_bone[:, index, :3, 3] - expected[:, :3], axis=1)
    return out


def hinge_deviations(
    skeleton: SkeletonModel, bones: Sequence[Bone], world_from_bone: FloatArray
) -> dict[str, FloatArray]:
    """How far the end of each hinged bone lies off its hinge's plane, by its role: (T,) metres."""
    out = {}
    for hinge in hinges(skeleton, tuple(bones)):
        axis = hinge.anchors_m[0] - hinge.anchors_m.mean(axis=0)
        upper = world_from_bone[:, hinge.upper]
        joint = np.einsum("tij,j->ti", upper[:, :3, :3], hinge.anchors_m.mean(axis=0)) + upper[:, :3, 3]
        along = np.einsum("tij,j->ti", upper[:, :3, :3], axis / np.linalg.norm(axis))
        end = world_from_bone[:, hinge.following, :3, 3]
        out[bones[hinge.following].role] = np.abs(((end - joint) * along).sum(axis=1))
    return out
