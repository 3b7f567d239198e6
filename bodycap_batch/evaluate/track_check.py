"""Compare the poses of a camera with the tracks of its video: the check of a run by itself.

It is the check of `right_frames` with points of tracks instead of fresh features. Tracks cost little, because
the selection of keyframes follows them anyway. They show no place again that was lost from view, so only
frames near each other are compared.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.evaluate.fresh_features import FrameFeatures, features_at
from bodycap_batch.evaluate.right_frames import (
    Pictures,
    RightFrames,
    find_right_frames,
)
from bodycap_batch.evaluate.two_view import Outcome
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.optical_flow import pixel_scale
from bodycap_batch.model.point_tracks import STORED_STEP, PointTracks
from bodycap_batch.model.rotation_chain import RotationChain

_GAPS = {STORED_STEP: STORED_STEP, 3 * STORED_STEP: STORED_STEP, 8 * STORED_STEP: 2 * STORED_STEP}
"""Distances in frames of the linked frames, and every how many frames a link starts."""
_ERROR_PX = 0.5
"""Standard deviation of a point, px of an image with a long side of 640 px. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackedVideo:
    """What the check needs of the video of a camera with N frames.

    Attributes:
        tracks: Points of the room in every `STORED_STEP`-th frame.
        lens: Intrinsics of the camera.
        times_s: (N,) times of the frames.
        readout_s: Time from the exposure of the first row to that of the last row; 0 for a global shutter.
        rotation_chain: How the camera turns; None if it is unknown.
    """

    tracks: PointTracks
    lens: Camera
    times_s: FloatArray
    readout_s: float = 0.0
    rotation_chain: RotationChain | None = None


def check_with_tracks(
    video: TrackedVideo, world_from_cam: FloatArray, progress: Callable[[int, int], None] | None = None
) -> RightFrames:
    """Return which poses the tracks confirm, and which they contradict. Every `STORED_STEP`-th is compared.

    Args:
        video: The tracks of the video.
        world_from_cam: (N,4,4) poses; NaN for a frame without one.
        progress: Receives the number of finished frames and of all frames.
    """
    tracks = video.tracks
    lens = video.lens.scaled(tracks.width_px, tracks.height_px)
    pictures = Pictures(
        [_features(tracks, lens, frame) for frame in range(tracks.frame_count)],
        video.times_s,
        video.readout_s,
        video.rotation_chain,
        rotations=world_from_cam[:, :3, :3],
        match=_common_tracks,
    )
    return find_right_frames(pictures, world_from_cam, progress, _GAPS)


def count_frames(found: RightFrames) -> dict[str, Any]:
    """Return the numbers of compared and of contradicted frames, and where those are, as JSON values."""
    wrong = [frame for frame, outcome in enumerate(found.outcome) if outcome is Outcome.WRONG]
    return {
        "compared": found.count(Outcome.RIGHT) + len(wrong),
        "contradicted": len(wrong),
        "contradicted_frames": [min(wrong), max(wrong)] if wrong else [],
    }


def _features(tracks: PointTracks, lens: Camera, frame: int) -> FrameFeatures | None:
    """Return the points of a frame; None for a frame whose points are not stored."""
    numbers, position = tracks.at(frame)
    if len(numbers) == 0:
        return None
    error_rad = _ERROR_PX * pixel_scale(lens.width_px, lens.height_px) / lens.focal_px
    return features_at(lens, position.astype(np.float64), numbers, np.full(len(numbers), error_rad))


def _common_tracks(first: FrameFeatures, second: FrameFeatures) -> IntArray:
    _, rows, other_rows = np.intersect1d(
        first.descriptors, second.descriptors, assume_unique=True, return_indices=True
    )
    return np.column_stack([rows, other_rows])
