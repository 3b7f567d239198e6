"""Cameras that one bone carries: where each sits beside the other, as all their frames together tell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray, set_array
from bodycap_batch.model.geometry import (
    invert,
    make_transform,
    poses_at,
    rotation_angle_rad,
    so3_exp,
    so3_log,
)
from bodycap_batch.model.scene import Trajectory

_MAX_ITERATIONS = 100
_CONVERGED_RAD = 1e-9
MIN_INSTANTS = 30
"""A second of frames in which both cameras have a pose of their own; fewer say too little of how they sit."""
_MAX_SPREAD_RATIO = 1.5
"""Spread of the relative turn over what the poses' own covariances explain (they hold the map's error too,
which both share). Four rendered rigs, one with a rolling shutter, in step: 0.3 to 0.8; 2 ms out of step 0.8
to 1.7; 5 ms, from where on solving them together does harm, 1.7 to 3.5; a frame 11 to 19."""
_MEDIAN_NORM_3D = 1.538
"""Median length of a vector of three standard normal variables."""
_SAME_INSTANT_RATIO = 0.25
"""Share of a frame's duration within which two time stamps of a synchronised rig mean one exposure: they are
rounded, and no other exposure lies between."""
_MAX_INTERPOLATION_FRAMES = 1.5
"""Frames so near are neighbours, between which a path is interpolated."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RelativePose:
    """Where one camera sits beside another.

    Attributes:
        cameras: Names of the first and the second.
        first_from_second: (4,4), translation in the unit of the gauge; NaN where no instant tells.
        instants: How many tell.
        spread_rad: Median angle of single instants from the mean.
        explained_rad: Median angle that the covariances of both paths' poses let expect.
        spread: Median distance of single instants' centres from the mean, in the gauge's unit.
    """

    cameras: tuple[str, str]
    first_from_second: FloatArray
    instants: int
    spread_rad: float
    explained_rad: float
    spread: float

    def __post_init__(self) -> None:
        set_array(self, "first_from_second", (4, 4), finite=False)

    @property
    def is_rigid(self) -> bool:
        """Whether enough instants agree that the two are held together and exposed in step."""
        return self.instants >= MIN_INSTANTS and self.spread_rad < _MAX_SPREAD_RATIO * self.explained_rad


@dataclass(frozen=True, slots=True, kw_only=True)
class RigPoses:
    """Where the other cameras of a rig sit beside one of them."""

    relative: tuple[RelativePose, ...]


def estimate_relative_pose(first: Trajectory, second: Trajectory, offset_ns: int) -> RelativePose:
    """Robust mean of the second camera's pose beside the first's over all frames where both have one.

    The second path is interpolated to the first one's instants.

    Args:
        first: One camera's path.
        second: The other's, in the same gauge; in another one no instant tells.
        offset_ns: What is added to the second's times to have them on the first's clock.

    Source: rotations by Hartley, Aftab, Trumpf, "L1 rotation averaging using the Weiszfeld algorithm",
        CVPR 2011; translations by their median along each axis.
    """
    names, samples = (first.camera, second.camera), np.zeros((0, 4, 4))
    if first.gauge == second.gauge and first.localised.any() and second.localised.any():
        times_ns, frame_ns = second.times_ns[second.localised], _frame_interval_ns(second.times_ns)
        poses, is_valid = poses_at(
            times_ns,
            second.gauge_from_cam[second.localised],
            first.times_ns[first.localised] - offset_ns,
            max_gap_ns=round(_MAX_INTERPOLATION_FRAMES * frame_ns),
            snap_ns=round(_SAME_INSTANT_RATIO * frame_ns),
        )
        samples = invert(first.gauge_from_cam[first.localised][is_valid]) @ poses[is_valid]
    if len(samples) == 0:
        return RelativePose(
            cameras=names,
            first_from_second=np.full((4, 4), np.nan),
            instants=0,
            spread_rad=np.nan,
            explained_rad=np.nan,
            spread=np.nan,
        )
    rotation, translation = mean_rotation(samples[:, :3, :3]), np.median(samples[:, :3, 3], axis=0)
    variance = sum(_rotation_variance(path) for path in (first, second))
    return RelativePose(
        cameras=names,
        first_from_second=make_transform(rotation, translation),
        instants=len(samples),
        spread_rad=float(np.median(rotation_angle_rad(rotation.T @ samples[:, :3, :3]))),
        explained_rad=_MEDIAN_NORM_3D * float(np.sqrt(variance)),
        spread=float(np.median(np.linalg.norm(samples[:, :3, 3] - translation, axis=1))),
    )


def _rotation_variance(path: Trajectory) -> float:
    """Usual variance of a pose's turn about one axis, rad²."""
    covariance = path.covariance[path.localised][:, :3, :3]
    return float(np.median(np.trace(covariance, axis1=1, axis2=2))) / 3.0


def mean_rotation(rotations: FloatArray) -> FloatArray:
    """Rotation (3,3) with the least sum of angles to rotations (N,3,3): nearly half of them may be wrong."""
    u, _, vt = np.linalg.svd(np.median(rotations, axis=0))
    mean = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    for _ in range(_MAX_ITERATIONS):
        rotvec = so3_log(mean.T @ rotations)
        weight = 1.0 / np.maximum(np.linalg.norm(rotvec, axis=1), _CONVERGED_RAD)
        step = weight @ rotvec / weight.sum()
        mean = mean @ so3_exp(step)
        if np.linalg.norm(step) < _CONVERGED_RAD:
            break
    return np.asarray(mean)


def match_instants(first_ns: IntArray, second_ns: IntArray) -> IntArray:
    """For each of the second's frames (N,) the first's frame at the same instant; -1 where there is none.

    Args:
        first_ns: (F,) increasing common times.
        second_ns: (N,) likewise.
    """
    if len(first_ns) < 2:
        return np.full(len(second_ns), -1, dtype=np.int64)
    after = np.clip(np.searchsorted(first_ns, second_ns), 1, len(first_ns) - 1)
    previous_is_nearer = second_ns - first_ns[after - 1] < first_ns[after] - second_ns
    frame = np.where(previous_is_nearer, after - 1, after)
    is_same = np.abs(first_ns[frame] - second_ns) < _SAME_INSTANT_RATIO * _frame_interval_ns(first_ns)
    return np.asarray(np.where(is_same, frame, -1), dtype=np.int64)


def _frame_interval_ns(times_ns: IntArray) -> float:
    """Usual time from one frame to the next."""
    return float(np.median(np.diff(times_ns))) if len(times_ns) > 1 else 0.0


def not_rigid_note(relative: RelativePose) -> str:
    """Why two cameras that the job says are a rig were not taken for one."""
    pair = " and ".join(relative.cameras)
    if relative.instants < MIN_INSTANTS:
        return (
            f"{pair}: {relative.instants} common frames in one map say too little of how they sit: each is on "
            "its own"
        )
    return (
        f"{pair}: their relative turn scatters by {np.degrees(relative.spread_rad):.2f} degrees where a rig's "
        f"would by {np.degrees(relative.explained_rad):.2f}: each is on its own. Check offset_s, and that one "
        "trigger exposes both"
    )
