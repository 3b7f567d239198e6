"""Tracks of points that a simulated camera sees."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.point_tracks import PointTracks

BORDER_PX = 5
MIN_DEPTH_M = 0.3
NOISE_PX = 0.2


def project(lens: Camera, points: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the pixels (N,2) of points (N,3) in the camera frame, and which are in the picture (N,)."""
    px = lens.project(points)
    last = (lens.width_px - BORDER_PX, lens.height_px - BORDER_PX)
    return px, (points[:, 2] > MIN_DEPTH_M) & ((px > BORDER_PX) & (px < last)).all(axis=1)


def tracks_of_views(
    lens: Camera, views: Iterable[tuple[FloatArray, BoolArray]], rng: np.random.Generator
) -> PointTracks:
    """Return the tracks of points, with noise, from their pixels and visibility in each frame."""
    first, track, px = [0], [], []
    for found, seen in views:
        rows = np.flatnonzero(seen)
        track.append(rows)
        px.append(found[rows] + rng.normal(0, NOISE_PX, (len(rows), 2)))
        first.append(first[-1] + len(rows))
    return PointTracks(
        camera="head",
        width_px=lens.width_px,
        height_px=lens.height_px,
        first=np.array(first),
        track=np.concatenate(track),
        px=np.concatenate(px).astype(np.float32),
    )
