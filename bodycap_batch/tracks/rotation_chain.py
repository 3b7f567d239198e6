"""Measure how a camera turns from frame to frame through its video, from tracks of points."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import IntArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import so3_log
from bodycap_batch.model.point_tracks import PointTracks
from bodycap_batch.model.rotation_chain import RotationChain
from bodycap_batch.tracks.moving_regions import ray_matches
from bodycap_batch.tracks.relative_motion import Motion, measure_rotation

_STEPS = (5, 3, 2, 1)
"""Lengths (frames) of a link, in the order in which they are tried. Between near frames, the pictures hardly
distinguish a turn from a step to the side, and a chain of many links adds up more errors."""


_TURN_SIGMA = 0.05
"""Minimum relative standard deviation of a turned angle. Blur, and a rolling shutter on fast hands, make a
chain of a third of a second wrong by up to 37 % of the angle. Evidence: docs/decisions/tracks.md."""


def measure_rotation_chain(
    tracks: PointTracks, lens: Camera, lens_sigma: float, frames: IntArray, stops: IntArray
) -> RotationChain:
    """Measure the rotation of a camera through its video.

    Args:
        tracks: Tracks of the camera in the room.
        lens: Intrinsics of the camera.
        lens_sigma: Relative standard deviation of the focal length.
        frames: (N,) the frame of the tracks that each frame of the chain is.
        stops: Frames of the chain at which a link ends in any case.
    """

    def motion(one: int, other: int) -> Motion | None:
        _, start, end = tracks.between(int(frames[one]), int(frames[other]))
        return measure_rotation(ray_matches(start, end, lens)[0])

    nodes, turns, sigmas = [0], [], []
    for stop in sorted({*stops.tolist(), len(frames) - 1} - {0}):
        while nodes[-1] < stop:
            ends = dict.fromkeys(min(nodes[-1] + step, stop) for step in _STEPS)
            tried = ((end, motion(nodes[-1], end)) for end in ends)
            end, found = next((pair for pair in tried if pair[1] is not None), (nodes[-1] + 1, None))
            turns.append(np.full(3, np.nan) if found is None else so3_log(found.rotation))
            sigmas.append(np.nan if found is None else np.deg2rad(found.sigma_deg))
            nodes.append(end)
    return RotationChain(
        frames=np.array(nodes, dtype=np.int64),
        turns=np.array(turns).reshape(-1, 3),
        sigma_rad=np.array(sigmas),
        turn_sigma=max(lens_sigma, _TURN_SIGMA),
    )
