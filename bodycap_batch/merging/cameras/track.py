"""The camera paths that merging uses: localised frames on the common clock, without gross errors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.geometry import Similarity, interpolate_pose
from bodycap_batch.model.merge_data import MergeInputs
from bodycap_batch.model.nominal_mounts import NOMINAL_ERROR_RAD, NOMINAL_SIGMA_M
from bodycap_batch.model.scene import Trajectory
from bodycap_batch.model.skeleton import Mount

MIN_SIGMA_M, MIN_SIGMA_RAD = 0.004, float(np.radians(0.4))
"""Minimum sigmas of a measured pose per axis (metres, radians). The covariance of a pose contains the errors
of the picture and of the map, but not the movement of the strap. Evidence: none."""

_UNCALIBRATED_SIGMA_RAD, _UNCALIBRATED_SIGMA_M = 0.98 * NOMINAL_ERROR_RAD, 0.98 * NOMINAL_SIGMA_M
"""Minimum sigmas (radians, metres per axis) of a mount that is treated as uncalibrated. The values are
slightly below the sigmas of the mount prior. A mount is treated as uncalibrated only if both of its sigmas
reach these values. The rotation sigma alone is no sufficient test, because the systematic bias of the posture
may cause an equally large rotation sigma on a calibrated palm."""


MAX_SAMPLE_GAP_NS = 100_000_000
"""Maximum time (nanoseconds) between two frames for the interpolation of a pose. The calibration and the
checks do not use poses between frames that are further apart. The value is three frame intervals at 30 fps.
Evidence: none."""
MAX_COARSE_GAP_NS = 200_000_000
"""Maximum time (nanoseconds) between two frames for the interpolation of a pose, if less accuracy is enough.
Initial values and the search for a T-pose need less accuracy than the calibration. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraTrack:
    """The localised frames of one camera.

    Attributes:
        camera: Name of the camera.
        bone: Index of the bone that the camera is mounted on.
        frames: (N,) indices of the frames in the trajectory.
        times_ns: (N,) times on the common clock, increasing.
        map_from_cam: (N,4,4) poses of the camera in the map's gauge.
        sigma_rad: (N,) sigma of the rotation per axis, radians.
        sigma_map: (N,) sigma of the centre per axis, map units.
    """

    camera: str
    bone: int
    frames: IntArray
    times_ns: IntArray
    map_from_cam: FloatArray
    sigma_rad: FloatArray
    sigma_map: FloatArray

    def keep(self, mask: BoolArray) -> CameraTrack:
        """Return the track with the frames where `mask` (N,) is True."""
        return replace(
            self,
            frames=self.frames[mask],
            times_ns=self.times_ns[mask],
            map_from_cam=self.map_from_cam[mask],
            sigma_rad=self.sigma_rad[mask],
            sigma_map=self.sigma_map[mask],
        )

    def scaled(self, scale: float) -> CameraTrack:
        """Return the track in another unit of length.

        Args:
            scale: Number of new units per present unit.
        """
        poses = self.map_from_cam.copy()
        poses[:, :3, 3] *= scale
        return replace(self, map_from_cam=poses, sigma_map=scale * self.sigma_map)

    def poses_at(self, times_ns: IntArray, *, max_gap_ns: int) -> tuple[FloatArray, BoolArray]:
        """Interpolate the poses between neighbouring frames.

        `bodycap_batch.model.geometry.poses_at` returns the identity at times without a pose. This method
        returns a pose at every time. At the time of a frame, it returns exactly the pose of that frame.

        Args:
            times_ns: (T,) requested times on the common clock.
            max_gap_ns: Maximum time between the two frames around a requested time for a valid pose.

        Returns:
            Poses (T,4,4), and (T,) whether each pose is valid. A pose is valid if its time is inside the
            track, and if the two frames around it are at most `max_gap_ns` apart. An invalid pose inside the
            track is interpolated too. A pose outside the track equals the pose of the first or the last
            frame.
        """
        last = len(self.times_ns) - 1
        after = np.clip(np.searchsorted(self.times_ns, times_ns, side="left"), 0, last)
        before = np.where(self.times_ns[after] == times_ns, after, np.maximum(after - 1, 0))
        span = np.maximum(self.times_ns[after] - self.times_ns[before], 1)
        alpha = np.clip((times_ns - self.times_ns[before]) / span, 0.0, 1.0)
        poses = interpolate_pose(self.map_from_cam[before], self.map_from_cam[after], alpha)
        inside = (times_ns >= self.times_ns[0]) & (times_ns <= self.times_ns[-1])
        return poses, inside & (self.times_ns[after] - self.times_ns[before] <= max_gap_ns)


def nearest_times(sorted_ns: IntArray, times_ns: IntArray) -> IntArray:
    """Return the nearest of the sorted times (N,) for each of `times_ns` (T,)."""
    after = np.clip(np.searchsorted(sorted_ns, times_ns), 0, len(sorted_ns) - 1)
    before = np.maximum(after - 1, 0)
    closer = np.abs(sorted_ns[before] - times_ns) <= np.abs(sorted_ns[after] - times_ns)
    return np.asarray(np.where(closer, sorted_ns[before], sorted_ns[after]))


def make_track(inputs: MergeInputs, trajectory: Trajectory, bone: int) -> CameraTrack:
    """Return the localised frames of a trajectory on the common clock.

    Args:
        inputs: The inputs of the merge stage. Only the clocks and the image rows of the poses are used.
        trajectory: Trajectory of one camera.
        bone: Index of the bone that the camera is mounted on.
    """
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
    """Return the track in another frame of reference, such as the gauge of another map."""
    return replace(
        track,
        map_from_cam=target_from_map.apply_to_poses(track.map_from_cam),
        sigma_map=target_from_map.scale * track.sigma_map,
    )


def transform_trajectory(trajectory: Trajectory, target_from_map: Similarity, gauge: str) -> Trajectory:
    """Return the trajectory in another frame of reference.

    Args:
        trajectory: Trajectory with poses and covariances in its own gauge.
        target_from_map: Similarity from the trajectory's gauge to the new frame of reference.
        gauge: Name of the new frame of reference.
    """
    unit = np.repeat([1.0, target_from_map.scale], 3)
    return replace(
        trajectory,
        gauge=gauge,
        gauge_from_cam=target_from_map.apply_to_poses(trajectory.gauge_from_cam),
        covariance=trajectory.covariance * np.outer(unit, unit),
    )


def is_uncalibrated(mount: Mount) -> bool:
    """Return True if a mount is nearly as uncertain as the prior that follows from the camera's name."""
    return mount.sigma_rad >= _UNCALIBRATED_SIGMA_RAD and mount.sigma_m >= _UNCALIBRATED_SIGMA_M


def inflate_sigmas(track: CameraTrack, mount: Mount) -> CameraTrack:
    """Add the uncertainty of an uncalibrated mount to the sigmas of its track.

    A camera that is never localised together with other cameras keeps the mount prior that follows from its
    name. The sigmas of this prior are 9° and 2.9 cm per axis. The position sigmas of the camera's poses are
    only millimetres. With such small sigmas, the track would distort the body to fit the inaccurate mount.

    Args:
        track: Track of the camera, poses in metres.
        mount: The solved mount of the camera.
    """
    if not is_uncalibrated(mount):
        return track
    return replace(
        track,
        sigma_rad=np.hypot(track.sigma_rad, mount.sigma_rad),
        sigma_map=np.hypot(track.sigma_map, mount.sigma_m),
    )
