"""From the graph's bones, whose joints have slack, to a rigid skeleton that still meets the cameras.

The exported motion moves by rotations and the root's travel alone. Both start from the graph's and are
corrected by a short least-squares solve: meet the measured cameras, stay close to the graph, and let the
correction change slowly over time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.merging.projection.solver import (
    CameraTarget,
    ProjectionProblem,
    RigidMotion,
    StandingJoint,
    solve_rigid_motion,
)
from bodycap_batch.model.geometry import invert, poses_at, rotation_angle_rad
from bodycap_batch.model.merge_data import CameraClock, SolvedBody, standing_sigma_m
from bodycap_batch.model.skeleton import Motion, SkeletonModel, forward_kinematics

_MAX_GAP_INTERVALS = 1.6
"""A measured pose is interpolated between neighbouring frames, never across a lost one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Projection:
    """A motion of the rigid skeleton, and how far it is from what it stands for.

    Attributes:
        motion: The rigid motion.
        gap: JSON values: graph joints against its joints, the merge's camera paths (measured, or solved with
            the body: `MergeOptions.camera_paths`) against its cameras, how fast standing feet slide.
    """

    motion: Motion
    gap: Mapping[str, Any]


def project_motion(
    body: SolvedBody,
    clocks: Mapping[str, CameraClock],
    row_fraction: Mapping[str, FloatArray] | None = None,
) -> Projection:
    """Project the solution of the factor graph onto its own rigid skeleton.

    Args:
        body: The solved bones.
        clocks: By camera name.
        row_fraction: By camera, (N,) mean row behind each pose over the image height (rolling shutter).

    Returns:
        The motion on the body's timeline. Joints the graph did not solve keep their local rotations.
    """
    cameras = _camera_targets(body, clocks, row_fraction or {})
    solved = np.flatnonzero(body.solved)
    start = _initial_motion(body.skeleton, body.graph_world_from_joint, body.solved)
    problem = ProjectionProblem(
        fps=body.fps,
        skeleton=body.skeleton,
        solved=solved,
        world_from_joint=body.graph_world_from_joint,
        cameras=cameras,
        planted=_standing_joints(body),
    )
    result = solve_rigid_motion(problem, start)
    motion = Motion(
        skeleton=body.skeleton,
        fps=body.fps,
        start_ns=body.start_ns,
        root_in_world_m=result.root,
        local_rotation=result.local,
        observed=body.observed,
    )
    return Projection(motion=motion, gap=_gap(body, motion, cameras))


def _standing_joints(body: SolvedBody) -> tuple[StandingJoint, ...]:
    """The ankles whose feet stand now and then."""
    if body.standing is None:
        return ()
    held = body.standing[1:] & body.standing[:-1]
    sigma_m = standing_sigma_m(body.fps)
    return tuple(
        StandingJoint(joint=int(joint), held=held[:, joint], sigma_m=sigma_m)
        for joint in np.flatnonzero(held.any(axis=0))
    )


def _initial_motion(skeleton: SkeletonModel, world_from_joint: FloatArray, solved: BoolArray) -> RigidMotion:
    """The graph's rotations, and the root where the solved joints fit best."""
    rotation = world_from_joint[..., :3, :3]
    local = rotation.copy()
    for joint in range(1, len(skeleton.joints)):
        local[:, joint] = np.swapaxes(rotation[:, skeleton.parents[joint]], -1, -2) @ rotation[:, joint]
    placed = forward_kinematics(skeleton, np.zeros((len(local), 3)), local)[..., :3, 3]
    trusted = solved if solved.any() else np.ones(len(solved), dtype=bool)
    root = (world_from_joint[:, trusted][..., :3, 3] - placed[:, trusted]).mean(axis=1)
    return RigidMotion(root=root, local=local)


def _camera_targets(
    body: SolvedBody, clocks: Mapping[str, CameraClock], row_fraction: Mapping[str, FloatArray]
) -> tuple[CameraTarget, ...]:
    """Each camera's measured poses at the ticks of the motion."""
    out = []
    mounts = {mount.camera: mount for mount in body.mounts}
    for trajectory in body.trajectories:
        kept = np.flatnonzero(trajectory.localised)
        mount = mounts.get(trajectory.camera)
        joint = None if mount is None else body.skeleton.index_of_role(mount.role)
        if mount is None or joint is None or not len(kept):
            continue
        rows = row_fraction.get(trajectory.camera)
        times = clocks[trajectory.camera].common_times_ns(
            trajectory.times_ns[kept], None if rows is None else rows[kept]
        )
        order = np.argsort(times, kind="stable")
        interval = np.median(np.diff(trajectory.times_ns)) if len(trajectory.times_ns) > 1 else 0.0
        poses, found = poses_at(
            times[order],
            trajectory.gauge_from_cam[kept[order]],
            body.times_ns(),
            max_gap_ns=round(_MAX_GAP_INTERVALS * float(interval)),
            snap_ns=1_000_000,
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


def _gap(body: SolvedBody, motion: Motion, cameras: tuple[CameraTarget, ...]) -> dict[str, Any]:
    """How far the exported motion is from the graph and from the cameras."""
    exported = motion.world_from_joint()
    out: dict[str, Any] = {}
    if body.solved.any():
        graph, rigid = body.graph_world_from_joint[:, body.solved], exported[:, body.solved]
        out["joints"] = _pose_difference(graph, rigid)
    out["cameras"] = {
        tracked.camera: _pose_difference(
            tracked.world_from_cam[tracked.found],
            exported[tracked.found, tracked.joint] @ tracked.joint_from_cam,
        )
        for tracked in cameras
        if tracked.found.any()
    }
    if body.standing is not None:
        out["feet"] = {
            body.skeleton.joints[planted.joint]: _slide_speed(
                exported[:, planted.joint, :3, 3], planted, body.fps
            )
            for planted in _standing_joints(body)
        }
    return out


def _slide_speed(centre: FloatArray, planted: StandingJoint, fps: float) -> dict[str, float]:
    """How fast an ankle (T,3) slides while its foot stands."""
    speed = fps * np.linalg.norm(np.diff(centre, axis=0), axis=1)[planted.held]
    return {f"slide_p{q}_m_per_s": float(np.percentile(speed, q)) for q in (50, 95)}


def _pose_difference(first: FloatArray, second: FloatArray) -> dict[str, float]:
    """Median and 95th percentile of distance and angle between poses (...,4,4)."""
    difference = invert(first) @ second
    distance = np.linalg.norm(difference[..., :3, 3], axis=-1)
    angle = np.rad2deg(rotation_angle_rad(difference[..., :3, :3]))
    return {
        "p50_m": float(np.percentile(distance, 50)),
        "p95_m": float(np.percentile(distance, 95)),
        "p50_deg": float(np.percentile(angle, 50)),
        "p95_deg": float(np.percentile(angle, 95)),
    }
