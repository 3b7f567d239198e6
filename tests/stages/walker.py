"""A person who walks a curve and reaches out, made of sines, without any assumption of the solver."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from bodycap_batch.model.camera_clock import CameraClock
from bodycap_batch.model.geometry import Similarity, make_transform, so3_exp
from bodycap_batch.model.merge_data import MergeInputs
from bodycap_batch.model.nominal_mounts import nominal_mount
from bodycap_batch.model.scene import FrameStatus, Trajectory
from bodycap_batch.model.skeleton import Mount, SkeletonModel, forward_kinematics
from bodycap_batch.model.skeleton_presets import load_skeleton

ROLES = {"torso": "Spine1", "left_palm": "LeftHand", "right_palm": "RightHand"}
AXES = dict(zip("xyz", np.eye(3), strict=True))
FPS = 30.0
HEIGHT_M = 1.75
NOISE_M = 0.003
NOISE_RAD = float(np.radians(0.2))


@dataclass(frozen=True)
class Walk:
    """The true motion: joint poses as a function of time."""

    skeleton: SkeletonModel
    mounts: dict[str, Mount]

    def joints(self, seconds: np.ndarray) -> np.ndarray:
        """Return world_from_joint (T,J,4,4) at any times (T,)."""
        t, step = seconds, 2.0 * np.pi * 0.95 * seconds
        yaw = 0.9 * np.sin(0.5 * t)
        speed, heading = 1.1, yaw - 0.5 * np.pi
        fine = np.linspace(0.0, max(float(t.max()), 0.1), 4000)
        course = 0.9 * np.sin(0.5 * fine) - 0.5 * np.pi
        path = np.cumsum(np.stack([np.cos(course), np.sin(course)], axis=1), axis=0) * speed * fine[1]
        root = np.stack(
            [
                np.interp(t, fine, path[:, 0]),
                np.interp(t, fine, path[:, 1]),
                0.92 + 0.015 * np.cos(2.0 * step),
            ],
            axis=1,
        )
        reach = np.exp(-(((t - 1.8) / 0.4) ** 2))
        turns = {
            "Hips": [("z", heading + 0.5 * np.pi), ("z", 0.08 * np.sin(step))],
            "Spine1": [("z", -0.12 * np.sin(step)), ("x", 0.05 + 0.02 * np.sin(2.0 * step))],
            "LeftArm": [("x", -0.45 * np.sin(step) - 1.1 * reach), ("y", 1.35 - 0.2 * reach)],
            "RightArm": [("x", 0.5 * np.sin(step)), ("y", -1.4 + 0.05 * np.sin(step))],
            "LeftForeArm": [
                ("z", -0.35 - 0.2 * np.sin(step - 0.5) - 0.3 * reach),
                ("x", 0.15 * np.sin(0.7 * step)),
            ],
            "RightForeArm": [("z", 0.4 - 0.25 * np.sin(step - 0.5)), ("x", 0.1 * np.cos(0.8 * step))],
            "LeftHand": [("y", 0.12 * np.sin(1.3 * step))],
            "RightHand": [("y", 0.1 * np.cos(1.1 * step))],
        }
        local = np.tile(np.eye(3), (len(t), len(self.skeleton.joints), 1, 1))
        for role, rotations in turns.items():
            joint = self.skeleton.roles.index(role)
            for axis, angle in rotations:
                local[:, joint] = local[:, joint] @ so3_exp(
                    np.multiply.outer(np.broadcast_to(angle, t.shape), AXES[axis])
                )
        return forward_kinematics(self.skeleton, root, local)

    def camera(self, name: str, seconds: np.ndarray) -> np.ndarray:
        """Return world_from_cam (T,4,4) of a camera."""
        joint = self.skeleton.roles.index(self.mounts[name].role)
        return self.joints(seconds)[:, joint] @ self.mounts[name].joint_from_cam


def make_walk(rng: np.random.Generator, *, off_deg: float = 0.0, off_m: float = 0.0) -> Walk:
    """Return a walk with mounts that are off their nominal poses."""
    skeleton = load_skeleton("upper_body", HEIGHT_M)
    mounts = {}
    for name, role in ROLES.items():
        nominal = nominal_mount(name, role, skeleton)
        turn = Rotation.from_rotvec(np.radians(off_deg) * _unit(rng)).as_matrix()
        error = make_transform(turn, off_m * _unit(rng))
        mounts[name] = replace(nominal, joint_from_cam=nominal.joint_from_cam @ error)
    return Walk(skeleton, mounts)


def _unit(rng: np.random.Generator) -> np.ndarray:
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


def record(
    walk: Walk,
    name: str,
    rng: np.random.Generator,
    *,
    seconds: float = 3.0,
    gauge: Similarity | None = None,
    shift_s: float = 0.0,
    lost: tuple[float, float] | None = None,
) -> Trajectory:
    """Return the trajectory that registration would give for one camera.

    Args:
        walk: The true motion.
        name: Camera name.
        rng: Draws the noise.
        seconds: Length of the recording.
        gauge: map_from_world.
        shift_s: Common time minus the camera's own time.
        lost: First and last second without a pose.
    """
    times = np.arange(round(seconds * FPS)) / FPS
    poses = walk.camera(name, times + shift_s)
    noise = make_transform(
        Rotation.from_rotvec(rng.normal(scale=NOISE_RAD, size=(len(times), 3))).as_matrix(),
        rng.normal(scale=NOISE_M, size=(len(times), 3)),
    )
    gauge = gauge or Similarity(1.0, np.eye(3), np.zeros(3))
    poses = gauge.apply_to_poses(poses @ noise)
    seen = np.ones(len(times), dtype=bool) if lost is None else (times < lost[0]) | (times > lost[1])
    poses[~seen] = np.nan
    sigmas = np.repeat([NOISE_RAD, gauge.scale * NOISE_M], 3)
    covariance = np.tile(np.diag(sigmas**2), (len(times), 1, 1))
    covariance[~seen] = np.nan
    return Trajectory(
        camera=name,
        gauge="map-0",
        frame_numbers=np.arange(len(times)),
        times_ns=np.round(times * 1e9).astype(np.int64),
        gauge_from_cam=poses,
        covariance=covariance,
        status=tuple(FrameStatus.REGISTERED if each else FrameStatus.FEW_TRACKS for each in seen),
        inliers=np.where(seen, 60, 0),
        error_px=np.where(seen, 0.5, np.nan),
    )


def make_inputs(walk: Walk, trajectories: list[Trajectory], **changes: object) -> MergeInputs:
    """Return merge inputs with nominal mounts and the person's own skeleton."""
    values: dict[str, object] = {
        "trajectories": tuple(trajectories),
        "clocks": {each.camera: CameraClock(nominal_fps=FPS) for each in trajectories},
        "skeleton": walk.skeleton,
        "mounts": tuple(
            nominal_mount(each.camera, ROLES[each.camera], walk.skeleton)
            for each in trajectories
            if each.camera in ROLES
        ),
        "skeleton_is_measured": True,
        "height_m": HEIGHT_M,
    }
    return MergeInputs(**{**values, **changes})  # type: ignore[arg-type]
