"""Project the solved motion onto a rigid skeleton.

In the motion graph the joints have some slack, so bones can shift by millimetres. In a rigid motion only the
root shifts, and all other joints only rotate. This module estimates a rigid motion that is close to the
camera poses and to the motion graph. It also requires that the difference between the rigid motion and the
motion graph changes slowly over time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.projection.rigid_motion_solver import (
    CameraTarget,
    ProjectionProblem,
    RigidMotion,
    StandingJoint,
    solve_rigid_motion,
)
from bodycap_batch.model.camera_clock import CameraClock
from bodycap_batch.model.geometry import invert, poses_at, rotation_angle_rad
from bodycap_batch.model.merge_data import ON_TICK_TOLERANCE_NS, SolvedBody, standing_sigma_m
from bodycap_batch.model.skeleton import Motion, forward_kinematics, local_rotations

_MAX_GAP_INTERVALS = 1.6
"""Maximum time between two camera poses for interpolation between them, in frame intervals.

Derivation: poses of neighbouring frames are one interval apart. If one frame between them is lost, they are
two intervals apart. The threshold is between the two values.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Projection:
    """The motion of the rigid skeleton, and its differences from the solution of the motion graph.

    Attributes:
        motion: The rigid motion.
        gap: Differences between the rigid motion and the solution of the motion graph, as plain JSON values.
            ``joints``: difference between the poses of the solved joints. ``cameras``: by camera, difference
            between the camera poses on the rigid skeleton and the poses of the camera's path (see
            `MergeOptions.camera_paths`). ``feet``: by ankle joint, sliding speed in the rigid motion while
            the foot stands.
    """

    motion: Motion
    gap: Mapping[str, Any]


def project_motion(
    body: SolvedBody,
    clocks: Mapping[str, CameraClock],
    row_fraction: Mapping[str, FloatArray] | None = None,
) -> Projection:
    """Project the solution of the motion graph onto its rigid skeleton.

    Args:
        body: The solution of the motion graph.
        clocks: By camera, its clock.
        row_fraction: By camera, (N,) mean image row of the observations of each of the N frames, as a
            fraction of the image height. With a rolling shutter, the time of a pose depends on this row.

    Returns:
        The rigid motion at the ticks of `body`, and its differences from the motion graph. Joints that the
        graph did not solve keep their local rotations.
    """
    problem = projection_problem(body, clocks, row_fraction)
    result = solve_rigid_motion(problem, initial_motion(body))
    motion = Motion(
        skeleton=body.skeleton,
        fps=body.fps,
        start_ns=body.start_ns,
        root_in_world_m=result.root,
        local_rotation=result.local,
        observed=body.observed,
    )
    return Projection(motion=motion, gap=_gap(body, motion, problem))


def projection_problem(
    body: SolvedBody,
    clocks: Mapping[str, CameraClock],
    row_fraction: Mapping[str, FloatArray] | None = None,
) -> ProjectionProblem:
    """Return the least-squares problem that `project_motion` solves.

    Args:
        body: The solution of the motion graph.
        clocks: By camera, its clock.
        row_fraction: By camera, (N,) mean image row of the observations of each of the N frames, as a
            fraction of the image height.

    Returns:
        The terms of the problem.
    """
    return ProjectionProblem(
        fps=body.fps,
        skeleton=body.skeleton,
        solved=np.flatnonzero(body.solved),
        world_from_joint=body.graph_world_from_joint,
        cameras=_camera_targets(body, clocks, row_fraction or {}),
        standing=_standing_joints(body),
    )


def initial_motion(body: SolvedBody) -> RigidMotion:
    """Return the rigid motion that has the joint rotations of the motion graph.

    Each solved joint has one centre in the rigid motion and one centre in the motion graph. At each tick, the
    position of the root minimises the sum of the squared distances between the two centres.

    Args:
        body: The solution of the motion graph.

    Returns:
        The initial motion of the least-squares problem.
    """
    skeleton, solved = body.skeleton, body.solved
    local = local_rotations(skeleton, body.graph_world_from_joint[..., :3, :3])
    centres = forward_kinematics(skeleton, np.zeros((len(local), 3)), local)[..., :3, 3]
    used = solved if solved.any() else np.ones(len(solved), dtype=bool)
    root = (body.graph_world_from_joint[:, used][..., :3, 3] - centres[:, used]).mean(axis=1)
    return RigidMotion(root=root, local=local)


def _standing_joints(body: SolvedBody) -> tuple[StandingJoint, ...]:
    """Return the ankles of all feet that stand on the floor at two or more successive ticks."""
    if body.standing is None:
        return ()
    held = body.standing[1:] & body.standing[:-1]
    sigma_m = standing_sigma_m(body.fps)
    return tuple(
        StandingJoint(joint=int(joint), held=held[:, joint], sigma_m=sigma_m)
        for joint in np.flatnonzero(held.any(axis=0))
    )


def _camera_targets(
    body: SolvedBody, clocks: Mapping[str, CameraClock], row_fraction: Mapping[str, FloatArray]
) -> tuple[CameraTarget, ...]:
    """Return the poses of each camera's path in the world, interpolated at the ticks of the motion."""
    out = []
    mounts = {mount.camera: mount for mount in body.mounts}
    for trajectory in body.trajectories:
        localised = np.flatnonzero(trajectory.localised)
        mount = mounts.get(trajectory.camera)
        joint = None if mount is None else body.skeleton.index_of_role(mount.role)
        if mount is None or joint is None or not len(localised):
            continue
        rows = row_fraction.get(trajectory.camera)
        times = clocks[trajectory.camera].common_times_ns(
            trajectory.times_ns[localised], None if rows is None else rows[localised]
        )
        order = np.argsort(times, kind="stable")
        own_poses = trajectory.gauge_from_cam[localised[order]]
        if mount.slip is not None:
            own_poses = mount.slip.as_before(own_poses, times[order])
        interval = np.median(np.diff(trajectory.times_ns)) if len(trajectory.times_ns) > 1 else 0.0
        poses, found = poses_at(
            times[order],
            own_poses,
            body.times_ns(),
            max_gap_ns=round(_MAX_GAP_INTERVALS * float(interval)),
            snap_ns=ON_TICK_TOLERANCE_NS,
        )
        out.append(
            CameraTarget(
                camera=trajectory.camera,
                joint=joint,
                joint_from_cam=mount.joint_from_cam,
                world_from_cam=poses,
                found=found,
            )
        )
    return tuple(out)


def _gap(body: SolvedBody, motion: Motion, problem: ProjectionProblem) -> dict[str, Any]:
    """Return the differences between the rigid motion and the solution of the graph (`Projection.gap`)."""
    exported = motion.world_from_joint()
    out: dict[str, Any] = {}
    if body.solved.any():
        graph, rigid = body.graph_world_from_joint[:, body.solved], exported[:, body.solved]
        out["joints"] = _pose_difference(graph, rigid)
    out["cameras"] = {
        target.camera: _pose_difference(
            target.world_from_cam[target.found],
            exported[target.found, target.joint] @ target.joint_from_cam,
        )
        for target in problem.cameras
        if target.found.any()
    }
    if body.standing is not None:
        out["feet"] = {
            body.skeleton.joints[standing.joint]: _slide_speed(
                exported[:, standing.joint, :3, 3], standing, body.fps
            )
            for standing in problem.standing
        }
    return out


def _slide_speed(centre: FloatArray, standing: StandingJoint, fps: float) -> dict[str, float]:
    """Return the percentiles of an ankle's speed while its foot stands.

    Args:
        centre: (T,3) centres of the ankle in the world, metres.
        standing: The ticks at which the foot stands.
        fps: Number of ticks per second.

    Returns:
        The median and the 95th percentile of the speed, metres per second.
    """
    speed = fps * np.linalg.norm(np.diff(centre, axis=0), axis=1)[standing.held]
    return {f"slide_p{q}_m_per_s": float(np.percentile(speed, q)) for q in (50, 95)}


def _pose_difference(first: FloatArray, second: FloatArray) -> dict[str, float]:
    """Return the median and the 95th percentile of the distances and angles between two sets of poses.

    Args:
        first: (...,4,4) poses.
        second: (...,4,4) poses, one for each pose of `first`.

    Returns:
        Percentiles of the distance in metres and of the angle in degrees.
    """
    difference = invert(first) @ second
    distance = np.linalg.norm(difference[..., :3, 3], axis=-1)
    angle = np.rad2deg(rotation_angle_rad(difference[..., :3, :3]))
    return {
        "p50_m": float(np.percentile(distance, 50)),
        "p95_m": float(np.percentile(distance, 95)),
        "p50_deg": float(np.percentile(angle, 50)),
        "p95_deg": float(np.percentile(angle, 95)),
    }
