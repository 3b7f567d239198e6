"""The ticks from which mounts and scale are learnt: where cameras were measured together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.merging.cameras.track import (
    MAX_SAMPLE_GAP_NS,
    MIN_SIGMA_M,
    MIN_SIGMA_RAD,
    CameraTrack,
    pick_evenly,
)
from bodycap_batch.merging.graph.factors import MountPoints
from bodycap_batch.merging.graph.posture import Posture, find_posture

MAP_ERROR_M = 0.005
MAP_ERROR_RAD = float(np.radians(0.25))
MAP_ERROR_DURATION_S = 1.0
"""Maps bend: camera paths are off by about this much for about this long, all poses of a stretch together.
What repeats must not count as often as it was sampled, or the mounts follow the map (one by 10 cm). Maps that
have settled lie 3 to 6 mm off; at twice these values joints' sigmas were larger, no palm was better."""
T_POSE_SAMPLES = 8
MIN_SAMPLES = 10
"""Samples each camera gets where it was measured so often, however seldom all were measured together."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationSamples:
    """Camera poses at the ticks the calibration uses.

    Attributes:
        times_ns: (K,) common clock.
        cameras: Names, in the order of the other fields.
        bones: Index of each camera's bone.
        map_from_cam: (C,K,4,4).
        valid: (C,K) where a camera was measured.
        sigma_rad: (C,) rotation sigma of each camera's measurements.
        sigma_map: (C,) centre sigma, map units.
        repeats: How many samples share one error of the map, 1 or more.
        white_share: Of the measurements' variance, what is not the map's error.
        posture: What is known of the body at the ticks.
    """

    times_ns: IntArray
    cameras: tuple[str, ...]
    bones: tuple[int, ...]
    map_from_cam: FloatArray
    valid: BoolArray
    sigma_rad: FloatArray
    sigma_map: FloatArray
    repeats: float
    white_share: float
    posture: Posture

    def points(self, scale: float) -> list[MountPoints]:
        """The points that stand for each camera's mount at a scale."""
        return [
            MountPoints(float(r), float(scale * m))
            for r, m in zip(self.sigma_rad, self.sigma_map, strict=True)
        ]


def take_samples(
    tracks: Sequence[CameraTrack],
    provisional: float,
    count: int,
    up: FloatArray | None = None,
    t_pose_ns: tuple[int, int] | None = None,
) -> CalibrationSamples:
    """Pick up to `count` times, evenly among those where most cameras were measured together.

    Args:
        tracks: Cleaned tracks, the trunk's first.
        provisional: Metres per map unit.
        count: Most times to take.
        up: (3,) the vertical in the map where it is known.
        t_pose_ns: From when to when a T-pose stands; a few more times are taken in it.

    Raises:
        EstimationError: Two cameras were hardly ever measured together.
    """
    times_ns = _sample_times(tracks, count, t_pose_ns)
    looks = [track.poses_at(times_ns, max_gap_ns=MAX_SAMPLE_GAP_NS) for track in tracks]
    seconds = 1e-9 * float(times_ns[-1] - times_ns[0])
    repeats = max(1.0, MAP_ERROR_DURATION_S * len(times_ns) / max(seconds, 1e-3))
    white_rad = np.array([max(float(np.median(track.sigma_rad)), MIN_SIGMA_RAD) for track in tracks])
    white_map = np.array(
        [max(float(np.median(track.sigma_map)), MIN_SIGMA_M / provisional) for track in tracks]
    )
    # The map is off by the same for all cameras of a segment: together they count as one.
    bones = np.array([track.bone for track in tracks])
    alike = (bones[:, None] == bones).sum(axis=1)
    sigma_map = np.sqrt(white_map**2 + alike * repeats * (MAP_ERROR_M / provisional) ** 2)
    return CalibrationSamples(
        times_ns=times_ns,
        cameras=tuple(track.camera for track in tracks),
        bones=tuple(track.bone for track in tracks),
        map_from_cam=np.array([poses for poses, _ in looks]),
        valid=np.array([valid for _, valid in looks]),
        sigma_rad=np.sqrt(white_rad**2 + alike * repeats * MAP_ERROR_RAD**2),
        sigma_map=sigma_map,
        repeats=repeats,
        white_share=float(((white_map / sigma_map) ** 2).mean()),
        posture=find_posture(tracks[0].scaled(provisional), times_ns, up, t_pose_ns),
    )


def _sample_times(tracks: Sequence[CameraTrack], count: int, t_pose_ns: tuple[int, int] | None) -> IntArray:
    """Times of the first camera; of a camera that is seldom seen with it, its own beside a third one."""
    times_ns = tracks[0].times_ns
    looks = np.array([track.poses_at(times_ns, max_gap_ns=MAX_SAMPLE_GAP_NS)[1] for track in tracks])
    together = looks.sum(axis=0)
    full = np.flatnonzero(together == together.max())
    shared = np.flatnonzero(together >= min(2, len(tracks)))
    pick = pick_evenly(full if len(full) >= count else shared, count)
    if t_pose_ns is not None:
        inside = np.flatnonzero((times_ns >= t_pose_ns[0]) & (times_ns <= t_pose_ns[1]) & (together >= 2))
        pick = np.union1d(pick, pick_evenly(inside, T_POSE_SAMPLES))
    further: list[IntArray] = []
    for track, seen in zip(tracks, looks, strict=True):
        if seen[pick].sum() < min(MIN_SAMPLES, count):
            beside = np.flatnonzero(seen & (together >= 2))
            pick = np.union1d(pick, pick_evenly(beside, MIN_SAMPLES))
            if len(beside) < MIN_SAMPLES:
                further.append(_own_times(track, tracks))
    enough = len(shared) + sum(len(own) for own in further)
    if len(tracks) > 1 and enough < MIN_SAMPLES:
        raise EstimationError(
            f"camera {tracks[0].camera!r} was localised together with another camera in only "
            f"{len(shared)} frames, and no two others were more often",
            hint=f"{MIN_SAMPLES} are needed to find how the cameras sit on the body; see frames.csv",
        )
    return np.unique(np.concatenate([times_ns[pick], *further]))


def _own_times(track: CameraTrack, tracks: Sequence[CameraTrack]) -> IntArray:
    """A few of a camera's own times at which another one was measured too."""
    beside = [
        other.poses_at(track.times_ns, max_gap_ns=MAX_SAMPLE_GAP_NS)[1]
        for other in tracks
        if other is not track
    ]
    return track.times_ns[pick_evenly(np.flatnonzero(np.any(beside, axis=0)), MIN_SAMPLES)]
