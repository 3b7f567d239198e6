"""Simulated captures without pictures: the walker's camera paths with noise, gaps and gross errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.camera_clock import CameraClock
from bodycap_batch.model.geometry import Similarity, so3_exp
from bodycap_batch.model.merge_data import MergeInputs
from bodycap_batch.model.nominal_mounts import nominal_mount
from bodycap_batch.model.scene import FrameStatus, Trajectory
from bodycap_batch.model.skeleton import Mount
from bodycap_batch.synthetic.making import Subject, draw_subject, frame_times_ns
from bodycap_batch.synthetic.measured import disturb_poses
from bodycap_batch.synthetic.moving_body import MovingBody, camera_poses_at, joint_poses_at
from bodycap_batch.synthetic.options import SynthOptions
from bodycap_batch.synthetic.truth import common_ticks_ns, seconds_from_ns

GAUGE = "map-0"


@dataclass(frozen=True, kw_only=True)
class Posed:
    """A simulated capture.

    Attributes:
        inputs: Inputs of the merge, with nominal mounts and the body's own skeleton.
        gauges: map_from_world per gauge id.
        mounts: The true mounts.
        motion: The true motion.
        options: Options of the simulation.
    """

    inputs: MergeInputs
    gauges: Mapping[str, Similarity]
    mounts: tuple[Mount, ...]
    motion: MovingBody
    options: SynthOptions = field(repr=False)

    def by_mount(self, mounts: Sequence[Mount]) -> list[Trajectory]:
        """Return the trajectories of the mounts' cameras, in the order of the mounts."""
        found = {each.camera: each for each in self.inputs.trajectories}
        return [found[mount.camera] for mount in mounts]

    def world_from_joint(self) -> FloatArray:
        """Return the true poses (T,J,4,4) at the ticks of the merge."""
        return joint_poses_at(self.motion, seconds_from_ns(common_ticks_ns(self.options)))


def posed(
    options: SynthOptions,
    maps: Mapping[str, str] | None = None,
    move: Callable[[MovingBody], MovingBody] | None = None,
) -> Posed:
    """Simulate the output of registration.

    Args:
        options: Cameras, noise and gaps; the seed determines the mounts and the walk.
        maps: Gauge per camera; cameras without an entry share one gauge.
        move: Returns another motion of the same body; None for the walk itself.
    """
    subject = draw_subject(options)
    if move is not None:
        subject = replace(subject, motion=move(subject.motion))
    rng = np.random.default_rng([options.seed, 77])
    names = sorted({(maps or {}).get(camera, GAUGE) for camera in options.cameras})
    gauges = {name: _draw_gauge(rng) for name in names}
    trajectories = tuple(
        _trajectory(options, subject, mount, (name := (maps or {}).get(mount.camera, GAUGE), gauges[name]))
        for mount in subject.mounts
    )
    skeleton = subject.motion.skeleton
    inputs = MergeInputs(
        trajectories=trajectories,
        clocks={
            camera: CameraClock(
                nominal_fps=options.rate_fps(camera), offset_s=options.offsets_s.get(camera, 0.0)
            )
            for camera in options.cameras
        },
        skeleton=skeleton,
        mounts=tuple(nominal_mount(mount.camera, mount.role, skeleton) for mount in subject.mounts),
        skeleton_is_measured=True,
        height_m=options.subject_height_m,
    )
    return Posed(inputs=inputs, gauges=gauges, mounts=subject.mounts, motion=subject.motion, options=options)


def _draw_gauge(rng: np.random.Generator) -> Similarity:
    turn = so3_exp(rng.normal(size=3))
    return Similarity(float(np.exp(rng.uniform(-1.0, 1.0))), turn, rng.normal(size=3))


def _trajectory(
    options: SynthOptions, subject: Subject, mount: Mount, gauge: tuple[str, Similarity]
) -> Trajectory:
    name, map_from_world = gauge
    times_ns = frame_times_ns(options, mount.camera)
    true = camera_poses_at(
        subject.motion, mount, seconds_from_ns(times_ns) + options.offsets_s.get(mount.camera, 0.0)
    )
    seed = [options.cameras.index(mount.camera), *subject.seeds["poses"].generate_state(4).tolist()]
    seen, present = disturb_poses(true, options, np.random.default_rng(seed))
    hidden = ~present[:, None, None]
    sigmas = np.repeat(
        [np.radians(options.pose_sigma_deg), options.pose_sigma_m * map_from_world.scale], 3
    ).astype(np.float64)
    return Trajectory(
        camera=mount.camera,
        gauge=name,
        frame_numbers=np.arange(len(times_ns)),
        times_ns=times_ns,
        gauge_from_cam=np.where(hidden, np.nan, map_from_world.apply_to_poses(seen)),
        covariance=np.where(hidden, np.nan, np.diag(sigmas**2)),
        status=tuple(FrameStatus.REGISTERED if is_seen else FrameStatus.FEW_TRACKS for is_seen in present),
        inliers=np.where(present, 60, 0),
        error_px=np.where(present, 0.5, np.nan),
    )
