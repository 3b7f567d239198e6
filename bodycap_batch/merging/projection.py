"""Project the solved motion onto the rigid skeleton.

In the motion graph the joints have some slack, so bones can shift by millimetres. In a rigid motion only the
root shifts, and all other joints only rotate. The rigid motion has the rotations of the motion graph.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.model.camera_clock import CameraClock
from bodycap_batch.model.geometry import invert, poses_at, rotation_angle_rad
from bodycap_batch.model.merge_data import SolvedBody
from bodycap_batch.model.skeleton import Motion, forward_kinematics

_MAX_GAP_INTERVALS = 1.6
"""Maximum time between two camera poses for interpolation between them, in frame intervals.

Derivation: poses of neighbouring frames are one interval apart. If one frame between them is lost, they are
two intervals apart. The threshold is between the two values.
"""

_SNAP_NS = 1_000_000
"""Maximum time between a camera pose and a tick, nanoseconds, to use the pose without interpolation.

Evidence: none; the motion in 1 ms is below the noise.
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
        The rigid motion at the ticks of `body`, and its differences from the motion graph.
    """
    motion = rigid_motion(body)
    return Projection(motion=motion, gap=_gap(body, motion, _camera_poses(body, clocks, row_fraction or {})))


def rigid_motion(body: SolvedBody) -> Motion:
    """Return the rigid motion that has the joint rotations of the motion graph.

    Each solved joint has one centre in the rigid motion and one centre in the motion graph. At each tick, the
    position of the root minimises the sum of the squared distances between the two centres.

    Args:
        body: The solution of the motion graph.
    """
    skeleton, solved = body.skeleton, body.solved
    rotation = body.graph_world_from_joint[..., :3, :3]
    local = rotation.copy()
    parents = skeleton.parents[1:]
    local[:, 1:] = np.swapaxes(rotation[:, parents], -1, -2) @ rotation[:, 1:]
    centres = forward_kinematics(skeleton, np.zeros((len(local), 3)), local)[..., :3, 3]
    used = solved if solved.any() else np.ones(len(solved), dtype=bool)
    return Motion(
        skeleton=skeleton,
        fps=body.fps,
        start_ns=body.start_ns,
        root_in_world_m=(body.graph_world_from_joint[:, used][..., :3, 3] - centres[:, used]).mean(axis=1),
        local_rotation=local,
        observed=body.observed,
    )


class _CameraPoses(NamedTuple):
    """The poses of one camera's path in the world, at T ticks.

    Attributes:
        camera: Camera name.
        joint: Index of the joint at which the camera's bone starts.
        joint_from_cam: (4,4) mount of the camera.
        world_from_cam: (T,4,4) camera poses in the world, metres.
        found: (T,) True for the ticks with a camera pose.
    """

    camera: str
    joint: int
    joint_from_cam: FloatArray
    world_from_cam: FloatArray
    found: BoolArray


def _camera_poses(
    body: SolvedBody, clocks: Mapping[str, CameraClock], row_fraction: Mapping[str, FloatArray]
) -> Iterator[_CameraPoses]:
    """Yield the poses of each worn camera's path, interpolated at the ticks of the motion."""
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
            snap_ns=_SNAP_NS,
        )
        yield _CameraPoses(trajectory.camera, joint, mount.joint_from_cam, poses, found)


def _gap(body: SolvedBody, motion: Motion, cameras: Iterator[_CameraPoses]) -> dict[str, Any]:
    """Return the differences between the rigid motion and the solution of the graph (`Projection.gap`)."""
    exported = motion.world_from_joint()
    out: dict[str, Any] = {}
    if body.solved.any():
        graph, rigid = body.graph_world_from_joint[:, body.solved], exported[:, body.solved]
        out["joints"] = _pose_difference(graph, rigid)
    out["cameras"] = {
        each.camera: _pose_difference(
            each.world_from_cam[each.found], exported[each.found, each.joint] @ each.joint_from_cam
        )
        for each in cameras
        if each.found.any()
    }
    if body.standing is not None:
        held = body.standing[1:] & body.standing[:-1]
        out["feet"] = {
            body.skeleton.joints[joint]: _slide_speed(exported[:, joint, :3, 3], held[:, joint], body.fps)
            for joint in np.flatnonzero(held.any(axis=0)).tolist()
        }
    return out


def _slide_speed(centre: FloatArray, held: BoolArray, fps: float) -> dict[str, float]:
    """Return the percentiles of an ankle's speed while its foot stands.

    Args:
        centre: (T,3) centres of the ankle in the world, metres.
        held: (T-1,) True if the foot stands at a tick and at the next one.
        fps: Number of ticks per second.

    Returns:
        The median and the 95th percentile of the speed, metres per second.
    """
    speed = fps * np.linalg.norm(np.diff(centre, axis=0), axis=1)[held]
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
