"""Measured camera paths on the common clock, cleaned of gross errors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.geometry import Similarity, interpolate_pose
from bodycap_batch.model.merge_data import MergeInputs
from bodycap_batch.model.scene import Trajectory
from bodycap_batch.model.skeleton import Mount
from bodycap_batch.model.skeleton_presets import NAMED_SIGMA_RAD, NOMINAL_SIGMA_M

OUTLIER_HALF_WINDOW = 6
OUTLIER_LIMIT_M = 0.12
"""A quadratic over ±6 frames at 30 fps follows a swinging hand to a few cm; wrong poses are off by more."""

MIN_SIGMA_M = 0.004
MIN_SIGMA_RAD = float(np.radians(0.4))
"""Floors of a pose's sigma: PnP's covariance knows image noise, not the map's error or a strap's give."""

_UNCALIBRATED_SIGMA_RAD, _UNCALIBRATED_SIGMA_M = 0.98 * NAMED_SIGMA_RAD, 0.98 * NOMINAL_SIGMA_M
"""A mount known less well than both was not calibrated: its name alone promises as much. (The wearer's habits
alone turn a calibrated palm's by up to that.)"""


MAX_SAMPLE_GAP_NS = 100_000_000
"""Longest hole between two frames that is interpolated for a sample."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraTrack:
    """The localised frames of one camera.

    Attributes:
        camera: Camera name.
        bone: Index of the bone that carries it.
        frames: (N,) indices into the trajectory.
        times_ns: (N,) common clock, increasing.
        map_from_cam: (N,4,4) poses in the map's gauge.
        sigma_rad: (N,) rotation sigma per axis.
        sigma_map: (N,) centre sigma per axis, map units.
    """

    camera: str
    bone: int
    frames: IntArray
    times_ns: IntArray
    map_from_cam: FloatArray
    sigma_rad: FloatArray
    sigma_map: FloatArray

    def keep(self, mask: BoolArray) -> CameraTrack:
        """Keep the frames where `mask` (N,) is True."""
        return replace(
            self,
            frames=self.frames[mask],
            times_ns=self.times_ns[mask],
            map_from_cam=self.map_from_cam[mask],
            sigma_rad=self.sigma_rad[mask],
            sigma_map=self.sigma_map[mask],
        )

    def scaled(self, scale: float) -> CameraTrack:
        """The same path with that many units in each of its own."""
        poses = self.map_from_cam.copy()
        poses[:, :3, 3] *= scale
        return replace(self, map_from_cam=poses, sigma_map=scale * self.sigma_map)

    def poses_at(self, times_ns: IntArray, *, max_gap_ns: int) -> tuple[FloatArray, BoolArray]:
        """Interpolate between neighbouring frames.

        Args:
            times_ns: (T,) wanted times.
            max_gap_ns: Largest time between the two frames around a wanted time.

        Returns:
            Poses (T,4,4), nearest-frame ones where there is nothing to interpolate, and (T,) whether it was.
        """
        last = len(self.times_ns) - 1
        after = np.clip(np.searchsorted(self.times_ns, times_ns, side="left"), 0, last)
        before = np.where(self.times_ns[after] == times_ns, after, np.maximum(after - 1, 0))
        span = np.maximum(self.times_ns[after] - self.times_ns[before], 1)
        alpha = np.clip((times_ns - self.times_ns[before]) / span, 0.0, 1.0)
        poses = interpolate_pose(self.map_from_cam[before], self.map_from_cam[after], alpha)
        inside = (times_ns >= self.times_ns[0]) & (times_ns <= self.times_ns[-1])
        return poses, inside & (self.times_ns[after] - self.times_ns[before] <= max_gap_ns)


def make_track(inputs: MergeInputs, trajectory: Trajectory, bone: int) -> CameraTrack:
    """Take the localised frames of a trajectory onto the common clock."""
    frames = np.flatnonzero(trajectory.localised)
    rows = inputs.row_fraction.get(trajectory.camera)
    times_ns = inputs.clocks[trajectory.camera].common_times_ns(
        trajectory.times_ns[frames], None if rows is None else rows[frames]
    )
    order = np.argsort(times_ns, kind="stable")
    variances = np.diagonal(trajectory.covariance[frames], axis1=1, axis2=2)[order]
    return CameraTrack(
        camera=trajectory.camera,
        bone=bone,
        frames=frames[order].astype(np.int64),
        times_ns=times_ns[order],
        map_from_cam=trajectory.gauge_from_cam[frames][order],
        sigma_rad=np.sqrt(variances[:, :3].mean(axis=1)),
        sigma_map=np.sqrt(variances[:, 3:].mean(axis=1)),
    )


def transform_track(track: CameraTrack, target_from_map: Similarity) -> CameraTrack:
    """The track in another map's gauge, or in metres."""
    return replace(
        track,
        map_from_cam=target_from_map.apply_to_poses(track.map_from_cam),
        sigma_map=target_from_map.scale * track.sigma_map,
    )


def transform_trajectory(trajectory: Trajectory, target_from_map: Similarity, gauge: str) -> Trajectory:
    """The trajectory in another frame of that name."""
    unit = np.repeat([1.0, target_from_map.scale], 3)
    return replace(
        trajectory,
        gauge=gauge,
        gauge_from_cam=target_from_map.apply_to_poses(trajectory.gauge_from_cam),
        covariance=trajectory.covariance * np.outer(unit, unit),
    )


def remove_outliers(track: CameraTrack, scale: float, fps: float) -> tuple[CameraTrack, int]:
    """Drop frames whose centre jumps off a robust quadratic through its neighbours.

    Args:
        track: The measured path.
        scale: Metres per map unit (a provisional one will do).
        fps: Nominal rate of the camera.

    Returns:
        The cleaned track and how many frames were dropped.
    """
    count = len(track.times_ns)
    steps = np.array([step for step in range(-OUTLIER_HALF_WINDOW, OUTLIER_HALF_WINDOW + 1) if step])
    index = np.arange(count)[:, None] + steps
    valid = (index >= 0) & (index < count)
    index = np.clip(index, 0, count - 1)
    time = (track.times_ns[index] - track.times_ns[:, None]) * (1e-9 * fps)
    valid &= np.abs(time) <= OUTLIER_HALF_WINDOW + 0.5
    centre = scale * (track.map_from_cam[index, :3, 3] - track.map_from_cam[:, None, :3, 3])
    predicted = _robust_quadratic(time / OUTLIER_HALF_WINDOW, centre, valid)
    # Extrapolation at the end of a stretch cannot tell a turn of the path from an error.
    inner = ((time < 0) & valid).sum(axis=1).clip(max=2) + ((time > 0) & valid).sum(axis=1).clip(max=2) == 4
    bad = (np.linalg.norm(predicted, axis=1) > OUTLIER_LIMIT_M) & inner & (valid.sum(axis=1) >= 6)
    bad = _runs_with_jumps(bad, scale * track.map_from_cam[:, :3, 3])
    return track.keep(~bad), int(bad.sum())


def _runs_with_jumps(bad: BoolArray, centre_m: FloatArray) -> BoolArray:
    """Those stretches of bad frames (N,) that jump: a thrown arm leaves any quadratic, but smoothly."""
    jump = np.zeros(len(bad), dtype=bool)
    jump[1:-1] = np.linalg.norm(np.diff(centre_m, n=2, axis=0), axis=1) > OUTLIER_LIMIT_M
    edges = np.flatnonzero(np.diff(np.concatenate([[0], bad.astype(np.int8), [0]])))
    out = np.zeros(len(bad), dtype=bool)
    for first, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        out[first:end] = jump[max(first - 1, 0) : end + 1].any()
    return out


def _robust_quadratic(time: FloatArray, centre: FloatArray, valid: BoolArray) -> FloatArray:
    """Value at time 0 (N,3) of quadratics through (N,W) times and (N,W,3) centres, Cauchy-weighted."""
    basis = np.stack([np.ones_like(time), time, time**2], axis=-1)
    weight = valid.astype(np.float64)
    for _ in range(8):
        weighted = basis * weight[..., None]
        normal = np.einsum("nwi,nwj->nij", weighted, basis) + 1e-9 * np.eye(3)
        coefficients = np.linalg.solve(normal, np.einsum("nwi,nwk->nik", weighted, centre))
        residual = np.linalg.norm(centre - basis @ coefficients, axis=-1)
        weight = valid / (1.0 + (residual / (0.25 * OUTLIER_LIMIT_M)) ** 2)
    return np.asarray(coefficients[:, 0])


def is_uncalibrated(mount: Mount) -> bool:
    """Whether a solved mount is known no better than its name promises."""
    return mount.sigma_rad >= _UNCALIBRATED_SIGMA_RAD and mount.sigma_m >= _UNCALIBRATED_SIGMA_M


def inflate_sigmas(track: CameraTrack, mount: Mount) -> CameraTrack:
    """The track (metres) at the uncertainty of its mount, where the motion told next to nothing of it.

    A camera never seen together with others keeps the mount its name promises: 9° and 2.9 cm an axis.
    At its poses' own millimetres it would bend the body to that guess.
    """
    if not is_uncalibrated(mount):
        return track
    return replace(
        track,
        sigma_rad=np.hypot(track.sigma_rad, mount.sigma_rad),
        sigma_map=np.hypot(track.sigma_map, mount.sigma_m),
    )


def pick_evenly(pool: IntArray, count: int) -> IntArray:
    """Up to `count` of the pool, evenly; none of an empty one."""
    if not len(pool):
        return pool
    return np.asarray(pool[np.unique(np.linspace(0, len(pool) - 1, count).round().astype(np.int64))])
