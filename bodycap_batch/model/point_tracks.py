"""Tracks of points through the frames of one camera's video."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.core.arrays import BoolArray, IntArray, set_array
from bodycap_batch.model.optical_flow import Pixels

STORED_STEP = 2
"""Every how many frames the points of the tracks are stored and used to check paths. Evidence:
docs/decisions/report.md."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PointTracks:
    """Points that optical flow follows from frame to frame.

    A track begins in a cell of the picture that has none, and ends where the point is lost. Its positions
    depend on the pixels of the video only.

    Attributes:
        camera: Camera name.
        width_px: Width of the picture, pixels.
        height_px: Height of the picture, pixels.
        first: (N+1,) index of the first observation of each frame; the last entry is M.
        track: (M,) number of the track of each observation. In each frame, the numbers increase.
        px: (M,2) float32 positions, px, with COLMAP's origin. They are not corrected for a rolling shutter.
    """

    camera: str
    width_px: int
    height_px: int
    first: IntArray
    track: IntArray
    px: Pixels

    def __post_init__(self) -> None:
        set_array(self, "first", (None,), np.int64)
        set_array(self, "track", (None,), np.int64)
        set_array(self, "px", (len(self.track), 2), np.float32)
        if len(self.first) == 0 or self.first[-1] != len(self.track) or (np.diff(self.first) < 0).any():
            raise ValueError("first: the observations of the frames must follow each other")

    @property
    def frame_count(self) -> int:
        """Number N of frames."""
        return len(self.first) - 1

    def at(self, frame: int) -> tuple[IntArray, Pixels]:
        """Return the track numbers (K,) and the positions (K,2) of the points in a frame."""
        own = slice(int(self.first[frame]), int(self.first[frame + 1]))
        return self.track[own], self.px[own]

    def between(self, one: int, other: int) -> tuple[IntArray, Pixels, Pixels]:
        """Return the numbers (K,) of the tracks that two frames have, and their positions (K,2) in both."""
        tracks, px = self.at(one)
        other_tracks, other_px = self.at(other)
        common, rows, other_rows = np.intersect1d(
            tracks, other_tracks, assume_unique=True, return_indices=True
        )
        return common, px[rows], other_px[other_rows]

    def chosen(self, frames: IntArray, step: int) -> PointTracks:
        """Return the tracks of some frames, by their order, with the points of every `step`-th of them."""
        empty = np.zeros(0, dtype=np.int64)
        rows = [
            np.arange(self.first[frame], self.first[frame + 1]) if number % step == 0 else empty
            for number, frame in enumerate(frames.tolist())
        ]
        first = np.cumsum([0, *map(len, rows)])
        kept = np.concatenate([empty, *rows])
        return replace(self, first=first, track=self.track[kept], px=self.px[kept])

    def outside(self, regions: BoolArray) -> PointTracks:
        """Return the tracks without the observations in some regions.

        Args:
            regions: (R,C) or (N,R,C) mask of cells that divide every picture, or the picture of each frame,
                evenly, True for each cell to leave out.
        """
        shape = np.array([regions.shape[-1], regions.shape[-2]])
        cell = (self.px / np.array([self.width_px, self.height_px]) * shape).astype(np.int64)
        cell = np.clip(cell, 0, shape - 1)
        frame = np.repeat(np.arange(self.frame_count), np.diff(self.first))
        keep = ~np.broadcast_to(regions, (self.frame_count, *regions.shape[-2:]))[
            frame, cell[:, 1], cell[:, 0]
        ]
        before = np.concatenate([[0], np.cumsum(keep)])
        return replace(self, first=before[self.first], track=self.track[keep], px=self.px[keep])
