"""Measure how a camera turns from frame to frame through its video, from tracks of points."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import so3_log
from bodycap_batch.model.point_tracks import PointTracks
from bodycap_batch.model.rotation_chain import RotationChain
from bodycap_batch.tracks.moving_regions import camera_motion, ray_matches
from bodycap_batch.tracks.relative_motion import Motion

_STEPS = (6, 4, 2)
"""Lengths (frames) of a link, in the order in which they are tried. Between near frames, the pictures hardly
distinguish a turn from a step to the side, and a chain of many links adds up more errors. Even: each link is
measured a second time in two halves."""
_TURN_SIGMA = 0.05
"""Minimum relative standard deviation of a turned angle. Blur, and a rolling shutter on fast hands, make a
chain of a third of a second wrong by up to 37 % of the angle. Evidence: docs/decisions/tracks.md."""


def measure_rotation_chain(
    tracks: PointTracks, lens: Camera, lens_sigma: float, frames: IntArray
) -> RotationChain:
    """Measure the rotation of a camera through its video.

    Args:
        tracks: Tracks of the camera in the room.
        lens: Intrinsics of the camera.
        lens_sigma: Relative standard deviation of the focal length.
        frames: (N,) the frame of the tracks that each frame of the chain is.
    """

    def motion(one: int, other: int) -> Motion | None:
        _, start, end = tracks.between(int(frames[one]), int(frames[other]))
        return camera_motion(ray_matches(start, end, lens)[0])

    nodes, links = [0], list[tuple[FloatArray, float]]()
    while nodes[-1] < len(frames) - 1:
        end, link = min(nodes[-1] + _STEPS[-1], len(frames) - 1), (np.full(3, np.nan), np.nan)
        for longer in (nodes[-1] + step for step in _STEPS):
            found = _link(motion, nodes[-1], longer) if longer < len(frames) else None
            if found is not None:
                end, link = longer, found
                break
        links.append(link)
        nodes.append(end)
    return RotationChain(
        frames=np.array(nodes, dtype=np.int64),
        turns=np.array([turn for turn, _ in links]).reshape(-1, 3),
        sigma_rad=np.array([sigma for _, sigma in links]),
        turn_sigma=max(lens_sigma, _TURN_SIGMA),
    )


def _link(
    motion: Callable[[int, int], Motion | None], first: int, last: int
) -> tuple[FloatArray, float] | None:
    """Return the rotation vector from one frame to another, and its standard deviation (radians).

    The rotation is measured at once and in two halves. Their difference is an error that neither states: of
    tracks that drift, or of a wall with two solutions.
    """
    middle = (first + last) // 2
    whole, before, after = motion(first, last), motion(first, middle), motion(middle, last)
    if whole is None or before is None or after is None:
        return None
    loop = np.linalg.norm(so3_log(after.rotation @ before.rotation @ whole.rotation.T))
    return so3_log(whole.rotation), float(np.hypot(np.deg2rad(whole.sigma_deg), loop))
