"""A moving body with cameras, as the result of merging: joints with slack, camera poses with noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.projection.project import Projection, project_motion
from bodycap_batch.model.camera_clock import CameraClock
from bodycap_batch.model.geometry import Similarity, make_transform, so3_exp
from bodycap_batch.model.merge_data import MergeResult, SolvedBody
from bodycap_batch.model.merge_report import MergeReport
from bodycap_batch.model.nominal_mounts import nominal_mount
from bodycap_batch.model.scene import FrameStatus, Trajectory
from bodycap_batch.model.skeleton import Motion, Mount, SkeletonModel
from bodycap_batch.model.skeleton_presets import load_skeleton

CAMERAS = {"torso": "Spine1", "left_palm": "LeftHand", "right_palm": "RightHand"}
ARMS = ("Spine1", "LeftArm", "LeftForeArm", "LeftHand", "RightArm", "RightForeArm", "RightHand")

BVH_PAIR = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT LeftArm
  {
    OFFSET 20 0 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 30 0 0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.0333333
1 100 2 0 0 0 90 0 0
1 100 2 0 0 90 0 0 0
"""
"""The smallest BVH file with all elements of the format: two joints, two frames."""


def reaching(ticks: int = 60, skeleton: SkeletonModel | None = None, fps: float = 30.0) -> Motion:
    """Return the motion of a body that walks forward (−Y), turns and swings its arms, with still legs."""
    body = skeleton or load_skeleton("upper_body", 1.75)
    time = np.arange(ticks) / fps
    local = np.tile(np.eye(3), (ticks, len(body.joints), 1, 1))

    def turn(role: str, *vector: FloatArray) -> None:
        joint = body.index_of_role(role)
        assert joint is not None
        local[:, joint] = so3_exp(np.stack(np.broadcast_arrays(*vector), axis=1))

    turn("Hips", 0 * time, 0 * time, 0.4 * time)
    turn("Spine1", 0.1 * np.sin(3 * time), 0 * time, 0.2 * np.sin(2 * time))
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        turn(f"{side}Arm", 0.5 * np.sin(3 * time), sign * (1.1 + 0.1 * np.sin(time)), 0.2 * np.sin(4 * time))
        turn(f"{side}ForeArm", 0 * time, 0 * time, -sign * (0.6 + 0.3 * np.sin(3 * time)))
        turn(f"{side}Hand", 0.2 * np.sin(5 * time), 0 * time, 0 * time)
    return Motion(
        skeleton=body,
        fps=fps,
        start_ns=5_000_000_000,
        root_in_world_m=np.stack([0 * time, -1.1 * time, 0.93 + 0.02 * np.sin(9 * time)], axis=1),
        local_rotation=local,
        observed=np.zeros((ticks, len(body.joints)), dtype=bool),
    )


def trajectory_of(
    motion: Motion, mount: Mount, rng: np.random.Generator, *, noise_m: float, lost: slice, offset_ns: int
) -> Trajectory:
    """Return the measured path of a camera with lost frames, and noise of `noise_m` and of 0.3° per 5 mm."""
    joint = motion.skeleton.index_of_role(mount.role)
    poses = motion.world_from_joint()[:, joint] @ mount.joint_from_cam
    count = len(poses)
    turn = so3_exp(rng.normal(scale=np.deg2rad(0.3) * noise_m / 0.005, size=(count, 3)))
    poses = poses @ make_transform(turn, rng.normal(scale=noise_m, size=(count, 3)))
    status = [FrameStatus.REGISTERED] * count
    status[lost] = [FrameStatus.BLUR] * len(status[lost])
    kept = np.array([item.localised for item in status])
    return Trajectory(
        camera=mount.camera,
        gauge="world",
        frame_numbers=np.arange(count),
        times_ns=motion.times_ns() - offset_ns,
        gauge_from_cam=np.where(kept[:, None, None], poses, np.nan),
        covariance=np.where(kept[:, None, None], np.eye(6) * 1e-4, np.nan),
        status=tuple(status),
        inliers=np.where(kept, 80, 3),
        error_px=np.where(kept, 0.5, np.nan),
    )


def merged(
    motion: Motion,
    *,
    slack_m: float = 0.004,
    slack_rad: float = 0.01,
    noise_m: float = 0.003,
    offset_s: float = 0.0,
    world_from_map: dict[str, Similarity] | None = None,
    projected: bool = True,
) -> tuple[MergeResult, dict[str, CameraClock]]:
    """Return the merge result for a motion, with slack in its joints, and the clocks of the cameras.

    Without `projected` its rigid motion is the given one, which spares a long motion the solve.
    """
    rng = np.random.default_rng(8)
    body = motion.skeleton
    solved = np.array([role in ARMS for role in body.roles])
    graph = motion.world_from_joint()
    shape = graph.shape[:2]
    loose = make_transform(
        so3_exp(rng.normal(scale=slack_rad, size=(*shape, 3))), rng.normal(scale=slack_m, size=(*shape, 3))
    )
    graph = np.where(solved[:, None, None], graph @ loose, graph)
    mounts = tuple(nominal_mount(camera, role, body) for camera, role in CAMERAS.items())
    paths = tuple(
        trajectory_of(
            motion, mount, rng, noise_m=noise_m, lost=slice(20, 25), offset_ns=round(offset_s * 1e9)
        )
        for mount in mounts
    )
    observed = np.array([role in CAMERAS.values() for role in body.roles])
    solution = SolvedBody(
        skeleton=body,
        fps=motion.fps,
        start_ns=motion.start_ns,
        graph_world_from_joint=graph,
        solved=solved,
        observed=np.tile(observed, (shape[0], 1)),
        trajectories=paths,
        mounts=mounts,
    )
    clocks = {camera: CameraClock(nominal_fps=30.0, offset_s=offset_s) for camera in CAMERAS}
    projection = (
        project_motion(solution, clocks)
        if projected
        else Projection(motion=replace(motion, observed=solution.observed), gap={})
    )
    result = MergeResult(
        skeleton=solution.skeleton,
        fps=solution.fps,
        start_ns=solution.start_ns,
        graph_world_from_joint=solution.graph_world_from_joint,
        solved=solution.solved,
        observed=solution.observed,
        trajectories=solution.trajectories,
        mounts=solution.mounts,
        motion=projection.motion,
        projection_gap=projection.gap,
        world_from_map=world_from_map or {},
        unused_cameras={},
        report=MergeReport.from_dict({"scale": {"source": "height"}}),
    )
    return result, clocks
