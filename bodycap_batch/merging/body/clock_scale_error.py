"""The error of the metric scale that uncertain clocks cause."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from bodycap_batch.merging.body.bones import Bone
from bodycap_batch.merging.body.provisional_scale import distance_constraint, kinematic_neighbours
from bodycap_batch.merging.cameras.track import CameraTrack
from bodycap_batch.model.camera_clock import ESTIMATED_SOURCES, CameraClock
from bodycap_batch.model.skeleton import Mount


def scale_sigma_from_clocks(
    bones: Sequence[Bone],
    tracks: Sequence[CameraTrack],
    mounts: Mapping[str, Mount],
    clocks: Mapping[str, CameraClock],
) -> float:
    """Return the sigma of the logarithm of the metric scale that the sigmas of the clocks cause.

    A wrong clock changes the distances between the cameras of neighbouring bones. The scale is inversely
    proportional to these distances. A stated clock is used as it is stated. The change is computed for a
    shift of each clock by one sigma, to earlier and to later times.

    Args:
        bones: The graph's bones.
        tracks: Tracks of all cameras, in the gauge of one map.
        mounts: Mount of each camera, by camera name.
        clocks: Clock of each camera, by camera name.
    """
    variance = 0.0
    for camera, clock in clocks.items():
        if clock.source not in ESTIMATED_SOURCES or not clock.sigma_s:
            continue
        logs = [
            _log_distance(bones, _with_shift(tracks, camera, side * clock.sigma_s), mounts)
            for side in (-1.0, 0.0, 1.0)
        ]
        variance += max(abs(logs[0] - logs[1]), abs(logs[2] - logs[1])) ** 2
    return float(np.sqrt(variance))


def _with_shift(tracks: Sequence[CameraTrack], camera: str, shift_s: float) -> list[CameraTrack]:
    shift_ns = round(1e9 * shift_s)
    return [
        replace(track, times_ns=track.times_ns + shift_ns) if track.camera == camera else track
        for track in tracks
    ]


def _log_distance(bones: Sequence[Bone], tracks: Sequence[CameraTrack], mounts: Mapping[str, Mount]) -> float:
    """Return the mean logarithm of the typical distances between cameras of neighbouring bones."""
    links = [
        distance_constraint(bones, first, second, mounts)
        for first, second in kinematic_neighbours(bones, tracks)
    ]
    scales = [link.typical_scale() for link in links if link is not None]
    return float(np.mean(np.log(scales))) if scales else 0.0
