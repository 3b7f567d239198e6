"""The rotation of a camera through its video, as tracks of points show it without any map."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, set_array
from bodycap_batch.model.geometry import so3_exp, so3_log

MIN_ANGLE_RAD = float(np.deg2rad(45.0))
"""Minimum angle between two rotations that contradict each other. Origin: rooms repeat themselves at right
angles; half of one separates a place from the next one that looks alike."""
_MIN_SIGMAS = 5.0
"""Minimum angle between two rotations that contradict each other, in standard deviations of the chain.
Evidence: docs/decisions/tracks.md."""


@dataclass(frozen=True, slots=True)
class TurnError:
    """The difference between two turns of a camera.

    Attributes:
        angle_rad: The angle between them.
        sigma_rad: Its standard deviation.
    """

    angle_rad: float
    sigma_rad: float

    def is_wrong(self, min_angle_rad: float) -> bool:
        """Return True if the difference is larger than this angle, and more than its deviation explains."""
        return bool(self.angle_rad > max(min_angle_rad, _MIN_SIGMAS * self.sigma_rad))


@dataclass(frozen=True, slots=True, kw_only=True)
class RotationChain:
    """Rotations of a camera between successive frames.

    Attributes:
        frames: (K,) frame indices, increasing.
        turns: (K-1,3) rotation vectors (radians) from each of these frames to the next one, in camera
            coordinates; NaN where the tracks do not determine the rotation.
        sigma_rad: (K-1,) largest standard deviation of each rotation about any axis. It leaves out the part
            that grows with the angle.
        turn_sigma: Relative standard deviation of a turned angle, for example through the focal length.
    """

    frames: IntArray
    turns: FloatArray
    sigma_rad: FloatArray
    turn_sigma: float

    def __post_init__(self) -> None:
        set_array(self, "frames", (None,), np.int64)
        links = max(0, len(self.frames) - 1)
        set_array(self, "turns", (links, 3), finite=False)
        set_array(self, "sigma_rad", (links,), finite=False)

    def between(self, first: int, last: int) -> tuple[FloatArray, float] | None:
        """Return the rotation last_from_first (3,3) of two frames, and its standard deviation (radians).

        Inside a link, the camera is taken to turn evenly. The standard deviation is that of a turn that grows
        from zero.

        Returns:
            None if the tracks do not determine the rotation.
        """
        start = int(np.searchsorted(self.frames, first, side="right")) - 1
        stop = int(np.searchsorted(self.frames, last, side="left"))
        if start < 0 or stop >= len(self.frames):
            return None
        begin, end = self.frames[start:stop], self.frames[start + 1 : stop + 1]
        share = (np.minimum(end, last) - np.maximum(begin, first)) / (end - begin)
        angle = np.linalg.norm(self.turns[start:stop], axis=1)
        sigma = np.sum(self.sigma_rad[start:stop] + angle * share * (1.0 - share))
        sigma = float(np.hypot(sigma, self.turn_sigma * np.sum(angle * share)))
        if not np.isfinite(sigma):
            return None
        rotation = np.eye(3)
        for turn in so3_exp(self.turns[start:stop] * share[:, None]):
            rotation = turn @ rotation
        return rotation, sigma

    def compare(self, first: int, last: int, world_from_cam: FloatArray) -> TurnError | None:
        """Compare the rotations (2,3,3) of two frames with the chain; None if it does not know the turn."""
        found = self.between(first, last)
        if found is None:
            return None
        error = so3_log(world_from_cam[1].T @ world_from_cam[0] @ found[0].T)
        return TurnError(angle_rad=float(np.linalg.norm(error)), sigma_rad=found[1])

    def confirms(self, frames: IntArray, world_from_cam: FloatArray) -> bool | None:
        """Return whether the rotations (2,3,3) of two frames (2,) agree with the chain; None if unknown."""
        found = self.compare(int(frames[0]), int(frames[1]), world_from_cam)
        return None if found is None else not found.is_wrong(MIN_ANGLE_RAD)


def find_folded(chain: RotationChain | None, frames: IntArray, world_from_cam: FloatArray) -> BoolArray:
    """Find the poses whose rotation the video contradicts.

    A path can jump to a wrong place that looks like the right one. The path then turns by an angle by which
    the video does not turn. It is divided at such jumps. The longest part is right. A part before or after it
    is right, too, if the rotation of the video from one to the other agrees.

    Args:
        chain: The rotation of the camera; None if it is unknown. Nothing is found then.
        frames: (F,) frames with a pose, increasing.
        world_from_cam: (F,3,3) their rotations.

    Returns:
        (F,) True for each pose that is contradicted.
    """
    out = np.zeros(len(frames), dtype=bool)
    if chain is None or len(frames) < 2:
        return out

    def confirms(one: int, other: int) -> bool | None:
        pair = np.array([one, other])
        return chain.confirms(frames[pair], world_from_cam[pair])

    breaks = [index + 1 for index in range(len(frames) - 1) if confirms(index, index + 1) is False]
    parts = list(pairwise([0, *breaks, len(frames)]))
    longest = max(range(len(parts)), key=lambda part: parts[part][1] - parts[part][0])
    for others, step in ((parts[longest + 1 :], 1), (parts[:longest][::-1], -1)):
        kept = parts[longest]
        for part in others:
            ends = (kept[1] - 1, part[0]) if step > 0 else (part[1] - 1, kept[0])
            if confirms(*ends):
                kept = part
            else:
                out[slice(*part)] = True
    return out
