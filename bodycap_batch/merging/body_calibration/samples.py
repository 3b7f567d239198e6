"""Select the times at which the body calibration samples the camera paths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, evenly_spaced
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.merging.body.bones import Bone, kinematic_chain
from bodycap_batch.merging.cameras.track import MAX_SAMPLE_GAP_NS, MIN_SIGMA_M, MIN_SIGMA_RAD, CameraTrack
from bodycap_batch.merging.graph.factors import MountPoints
from bodycap_batch.merging.graph.posture import Posture, find_posture
from bodycap_batch.model.skeleton import Mount, SkeletonModel

MAP_ERROR_M = 0.005
"""Sigma of the positional error of a map along a camera path, metres.

A map bends: all poses of an interval have the same error. Correlated errors must not count as often as they
are sampled, or the mounts follow the map. Evidence: docs/decisions/body_calibration.md.
"""
MAP_ERROR_RAD = float(np.radians(0.25))
"""Sigma of the rotational error of a map along a camera path, radians.

Evidence: docs/decisions/body_calibration.md.
"""
MAP_ERROR_DURATION_S = 1.0
"""Time over which the error of a map is nearly constant, seconds.

Evidence: docs/decisions/body_calibration.md.
"""
T_POSE_SAMPLES = 8
"""Additional samples in a T-pose. Evidence: none."""
MIN_SAMPLES = 10
"""Samples that each camera gets, if it was measured so often with another one. Evidence: none."""
MIN_COMMON_FRAMES = 15
"""Frames in which a camera has to be measured together with the reference camera before the two are
calibrated alone: half a second at 30 fps. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PostureHints:
    """Facts on the posture that are known before the calibration.

    Attributes:
        vertical: (3,) the vertical in the map; None if unknown.
        t_pose_ns: First and last common time of a T-pose; None without one.
    """

    vertical: FloatArray | None = None
    t_pose_ns: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationSamples:
    """Camera poses at the ticks that the calibration uses.

    Attributes:
        times_ns: (K,) common time.
        cameras: Names, in the order of the other fields.
        bones: Index of each camera's bone.
        map_from_cam: (C,K,4,4) poses.
        valid: (C,K) True if the camera was measured.
        sigma_rad: (C,) rotation sigma of each camera's poses, per axis.
        sigma_map: (C,) centre sigma of each camera's poses, per axis, map units.
        correlated_samples: Number of samples that share one error of the map, at least 1.
        white_noise_share: Part of the measurements' variance that is independent noise, 0 to 1. The rest is
            error of the map.
        posture: What is known of the body at the ticks.
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
        """Return the points that stand for each camera's mount, at a scale in metres per map unit."""
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
    """Select up to `count` times, evenly spaced among those at which most cameras were measured together.

    Args:
        tracks: Cleaned tracks, that of the reference camera first.
        provisional: Approximate scale, metres per map unit.
        count: Maximum number of times, without those added for a T-pose or a rarely measured camera.
        vertical: (3,) the vertical in the map; None if unknown.
        t_pose_ns: First and last common time of a T-pose, in which a few more samples are taken.

    Raises:
        EstimationError: Too few samples show two cameras at the same time.
    """
    times_ns = _sample_times(tracks, count, t_pose_ns)
    sampled = [track.poses_at(times_ns, max_gap_ns=MAX_SAMPLE_GAP_NS) for track in tracks]
    seconds = 1e-9 * float(times_ns[-1] - times_ns[0])
    correlated = max(1.0, MAP_ERROR_DURATION_S * len(times_ns) / max(seconds, 1e-3))
    white_rad = np.array([max(float(np.median(track.sigma_rad)), MIN_SIGMA_RAD) for track in tracks])
    white_map = np.array(
        [max(float(np.median(track.sigma_map)), MIN_SIGMA_M / provisional) for track in tracks]
    )
    # All cameras of a segment see the same error of the map, so together they count as one.
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


@dataclass(frozen=True, slots=True)
class CameraSubset:
    """Some of the cameras, sampled for a calibration of their own.

    Attributes:
        bones: The bones between these cameras.
        samples: Their poses at the sampled ticks.
    """

    bones: tuple[Bone, ...]
    samples: CalibrationSamples


def sample_subset(
    skeleton: SkeletonModel,
    mounts: Mapping[str, Mount],
    tracks: Sequence[CameraTrack],
    provisional: float,
    count: int,
    hints: PostureHints,
) -> CameraSubset:
    """Sample some of the cameras for a calibration of their own.

    Args:
        skeleton: The body.
        mounts: By camera, its mount prior.
        tracks: Cleaned tracks of these cameras, that of the reference camera first.
        provisional: Approximate scale, metres per map unit.
        count: Maximum number of samples.
        hints: What is known of the posture.
    """
    roles = [mounts[track.camera].role for track in tracks]
    bones = kinematic_chain(skeleton, roles)
    index = {bone.role: number for number, bone in enumerate(bones)}
    own = [replace(track, bone=index[role]) for track, role in zip(tracks, roles, strict=True)]
    return CameraSubset(bones, take_samples(own, provisional, count, hints.vertical, hints.t_pose_ns))


def count_common_frames(reference: CameraTrack, track: CameraTrack) -> int:
    """Count the frames of the reference camera at which the other camera was measured, too."""
    return int(track.poses_at(reference.times_ns, max_gap_ns=MAX_SAMPLE_GAP_NS)[1].sum())


def _sample_times(tracks: Sequence[CameraTrack], count: int, t_pose_ns: tuple[int, int] | None) -> IntArray:
    """Select times of the reference camera, and own times of cameras that are rarely measured with it."""
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
            f"{len(shared)} frames, and no two others were more often",
            hint=f"{MIN_SAMPLES} are needed to find how the cameras sit on the body; see frames.csv",
        )
    return np.unique(np.concatenate([times_ns[picked], *further]))


def _own_times(track: CameraTrack, tracks: Sequence[CameraTrack]) -> IntArray:
    """Select a few of a camera's own times at which another camera was measured, too."""
    common = [
        other.poses_at(track.times_ns, max_gap_ns=MAX_SAMPLE_GAP_NS)[1]
        for other in tracks
        if other is not track
    ]
    return track.times_ns[_evenly(np.flatnonzero(np.any(common, axis=0)), MIN_SAMPLES)]


def _evenly(frames: IntArray, count: int) -> IntArray:
    """Select up to `count` of the frames (N,), evenly spaced."""
    return frames[evenly_spaced(len(frames), count)]
