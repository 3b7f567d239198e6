"""Select the times at which the body calibration samples the camera paths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, evenly_spaced
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.merging.cameras.track import MAX_SAMPLE_GAP_NS, MIN_SIGMA_M, MIN_SIGMA_RAD, CameraTrack
from bodycap_batch.merging.graph.factors import MountPoints
from bodycap_batch.merging.graph.posture import Posture, find_posture

MAP_ERROR_M = 0.005
"""Sigma of the positional error of a map along a camera path, metres.

A map is slightly bent, so all poses in a short interval of time have nearly the same error. The graph
therefore reduces the weight of the poses. With full weights, the bends of the map would distort the mounts.
Evidence: docs/decisions/body_calibration.md.
"""
MAP_ERROR_RAD = float(np.radians(0.25))
"""Sigma of the rotational error of a map along a camera path, radians.

Evidence: docs/decisions/body_calibration.md.
"""
MAP_ERROR_DURATION_S = 1.0
"""Duration over which the error of a map is nearly constant, seconds.

Evidence: docs/decisions/body_calibration.md.
"""
T_POSE_SAMPLES = 8
"""Maximum number of additional sampled times in a T-pose. Evidence: none."""
MIN_SAMPLES = 10
"""Desired number of samples per camera at which this camera and at least one other camera were measured.

If a camera has fewer such frames, it gets fewer samples. If all cameras together have fewer such frames, the
calibration fails. Evidence: none.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class PostureHints:
    """Facts about the posture that are known before the calibration.

    Attributes:
        vertical: (3,) the vertical in the gauge of the tracks; None if unknown.
        t_pose_ns: First and last common time of a T-pose; None if there is no T-pose.
    """

    vertical: FloatArray | None = None
    t_pose_ns: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationSamples:
    """Camera poses at the ticks that the calibration uses.

    Attributes:
        times_ns: (K,) common time of each tick.
        cameras: Names of the C cameras, in the order of the other fields.
        bones: Index of the bone of each camera.
        map_from_cam: (C,K,4,4) camera poses in the gauge of the tracks.
        valid: (C,K) True if the camera was measured at the tick.
        sigma_rad: (C,) rotation sigma of each camera's poses, radians per axis.
        sigma_map: (C,) centre sigma of each camera's poses, map units per axis.
        correlated_samples: Number of samples that share one error of the map, at least 1.
        white_noise_share: Fraction of the variance of the camera centres that is independent noise, 0 to 1.
            The fraction is a mean over the cameras. The rest of the variance is error of the map.
        posture: Facts about the posture at the ticks.
    """

    times_ns: IntArray
    cameras: tuple[str, ...]
    bones: tuple[int, ...]
    map_from_cam: FloatArray
    valid: BoolArray
    sigma_rad: FloatArray
    sigma_map: FloatArray
    correlated_samples: float
    white_noise_share: float
    posture: Posture

    def mount_points(self, scale: float) -> list[MountPoints]:
        """Return the points that represent each camera's mount, for a scale in metres per map unit."""
        return [
            MountPoints(float(r), float(scale * m))
            for r, m in zip(self.sigma_rad, self.sigma_map, strict=True)
        ]


def take_samples(
    tracks: Sequence[CameraTrack],
    provisional: float,
    count: int,
    vertical: FloatArray | None = None,
    t_pose_ns: tuple[int, int] | None = None,
) -> CalibrationSamples:
    """Sample the camera poses at times at which many cameras were measured together.

    The times are frame times of the reference camera at which as many cameras as possible were measured. If
    there are too few such frames, all frames with at least two measured cameras are used. The samples are
    evenly spaced among these frames.

    Args:
        tracks: Cleaned tracks. The track of the reference camera is the first.
        provisional: Approximate scale, metres per map unit.
        count: Maximum number of times. Times for a T-pose or for a rarely measured camera are added to these.
        vertical: (3,) the vertical in the gauge of the tracks; None if unknown.
        t_pose_ns: First and last common time of a T-pose, which gets additional samples; None if there is no
            T-pose.

    Returns:
        The sampled camera poses.

    Raises:
        EstimationError: Two cameras were measured together at too few times.
    """
    times_ns = _sample_times(tracks, count, t_pose_ns)
    sampled = [track.poses_at(times_ns, max_gap_ns=MAX_SAMPLE_GAP_NS) for track in tracks]
    seconds = 1e-9 * float(times_ns[-1] - times_ns[0])
    correlated = max(1.0, MAP_ERROR_DURATION_S * len(times_ns) / max(seconds, 1e-3))
    white_rad = np.array([max(float(np.median(track.sigma_rad)), MIN_SIGMA_RAD) for track in tracks])
    white_map = np.array(
        [max(float(np.median(track.sigma_map)), MIN_SIGMA_M / provisional) for track in tracks]
    )
    # The poses of all cameras on one bone have the same error of the map. Together they count as one camera.
    bones = np.array([track.bone for track in tracks])
    same_bone = (bones[:, None] == bones).sum(axis=1)
    sigma_map = np.sqrt(white_map**2 + same_bone * correlated * (MAP_ERROR_M / provisional) ** 2)
    return CalibrationSamples(
        times_ns=times_ns,
        cameras=tuple(track.camera for track in tracks),
        bones=tuple(track.bone for track in tracks),
        map_from_cam=np.array([poses for poses, _ in sampled]),
        valid=np.array([valid for _, valid in sampled]),
        sigma_rad=np.sqrt(white_rad**2 + same_bone * correlated * MAP_ERROR_RAD**2),
        sigma_map=sigma_map,
        correlated_samples=correlated,
        white_noise_share=float(((white_map / sigma_map) ** 2).mean()),
        posture=find_posture(tracks[0].scaled(provisional), times_ns, vertical, t_pose_ns),
    )


def _sample_times(tracks: Sequence[CameraTrack], count: int, t_pose_ns: tuple[int, int] | None) -> IntArray:
    """Select frame times of the reference camera.

    For a camera that was rarely measured together with the reference camera, some frame times of that camera
    are added.
    """
    times_ns = tracks[0].times_ns
    measured = np.array([track.poses_at(times_ns, max_gap_ns=MAX_SAMPLE_GAP_NS)[1] for track in tracks])
    cameras = measured.sum(axis=0)
    complete = np.flatnonzero(cameras == cameras.max())
    shared = np.flatnonzero(cameras >= min(2, len(tracks)))
    picked = _evenly(complete if len(complete) >= count else shared, count)
    if t_pose_ns is not None:
        inside = np.flatnonzero((times_ns >= t_pose_ns[0]) & (times_ns <= t_pose_ns[1]) & (cameras >= 2))
        picked = np.union1d(picked, _evenly(inside, T_POSE_SAMPLES))
    further: list[IntArray] = []
    for track, valid in zip(tracks, measured, strict=True):
        if valid[picked].sum() < min(MIN_SAMPLES, count):
            common = np.flatnonzero(valid & (cameras >= 2))
            picked = np.union1d(picked, _evenly(common, MIN_SAMPLES))
            if len(common) < MIN_SAMPLES:
                further.append(_own_times(track, tracks))
    usable = len(shared) + sum(len(own) for own in further)
    if len(tracks) > 1 and usable < MIN_SAMPLES:
        raise EstimationError(
            f"camera {tracks[0].camera!r} was localised together with another camera in only "
            f"{len(shared)} frames, and no two other cameras have enough common frames",
            hint=f"record a longer walk in which the cameras see the same places; {MIN_SAMPLES} common "
            "frames are needed to find the poses of the cameras on the body (frames.csv lists why frames "
            "were lost)",
        )
    return np.unique(np.concatenate([times_ns[picked], *further]))


def _own_times(track: CameraTrack, tracks: Sequence[CameraTrack]) -> IntArray:
    """Select at most `MIN_SAMPLES` frame times of a camera at which another camera was measured too."""
    common = [
        other.poses_at(track.times_ns, max_gap_ns=MAX_SAMPLE_GAP_NS)[1]
        for other in tracks
        if other is not track
    ]
    return track.times_ns[_evenly(np.flatnonzero(np.any(common, axis=0)), MIN_SAMPLES)]


def _evenly(frames: IntArray, count: int) -> IntArray:
    """Select at most `count` of the frames (N,), evenly spaced."""
    return frames[evenly_spaced(len(frames), count)]
