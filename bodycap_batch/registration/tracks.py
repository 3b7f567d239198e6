"""Carry the map's points from keyframes into the frames between them, from both sides."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from bodycap_batch.arrays import IntArray
from bodycap_batch.capture import CaptureCamera
from bodycap_batch.context import StageContext
from bodycap_batch.scene import Map
from bodycap_batch.tracking import GreyImage, Pixels, pixel_scale, track_points

_MAX_TRACKS = 250
_CELLS = 8
_MAX_BUFFER = 90
"""Frames held in memory for the way back from a keyframe; bounds memory where keyframes are far apart."""
_MIN_TRACKS = 6


@dataclass(frozen=True, slots=True)
class Anchor:
    """The map points a keyframe observes.

    Attributes:
        feature: (N,) feature index in the keyframe.
        px: (N,2) float32 where it sees them.
    """

    feature: IntArray
    px: Pixels


@dataclass(frozen=True, slots=True)
class Tracks:
    """Observations of map points in frames, named by the keyframe feature they come from.

    Attributes:
        frame: (M,) frame index.
        keyframe: (M,) frame index of the keyframe.
        feature: (M,) feature index in the keyframe.
        px: (M,2) float32 pixel.
    """

    frame: IntArray
    keyframe: IntArray
    feature: IntArray
    px: Pixels

    @staticmethod
    def join(parts: list[Tracks]) -> Tracks:
        """Concatenate, ordered by frame, keyframe and feature."""
        if not parts:
            none = np.zeros(0, np.int64)
            return Tracks(none, none, none, np.zeros((0, 2), np.float32))
        frame = np.concatenate([part.frame for part in parts])
        keyframe = np.concatenate([part.keyframe for part in parts])
        feature = np.concatenate([part.feature for part in parts])
        px = np.concatenate([part.px for part in parts])
        order = np.lexsort((feature, keyframe, frame))
        return Tracks(frame[order], keyframe[order], feature[order], px[order])

    def select(self, mask: npt.NDArray[Any]) -> Tracks:
        """Keep the observations under a mask."""
        return Tracks(self.frame[mask], self.keyframe[mask], self.feature[mask], self.px[mask])


def anchors_of(scene_map: Map, camera: str) -> dict[int, Anchor]:
    """The best spread, longest seen map points of each of a camera's keyframes, by frame index."""
    seen = np.bincount(scene_map.obs_point, minlength=len(scene_map.points))
    lens = scene_map.cameras[camera]
    order = np.argsort(scene_map.obs_keyframe, kind="stable")
    bounds = np.searchsorted(scene_map.obs_keyframe[order], np.arange(len(scene_map.keyframe_camera) + 1))
    out = {}
    for keyframe in scene_map.keyframes_of(camera):
        mine = order[bounds[keyframe] : bounds[keyframe + 1]]
        px = scene_map.obs_px[mine]
        cell = np.clip((px / (lens.width_px, lens.height_px) * _CELLS).astype(int), 0, _CELLS - 1)
        picked = _spread(cell[:, 1] * _CELLS + cell[:, 0], seen[scene_map.obs_point[mine]])
        rows = np.sort(mine[picked])
        frame = int(scene_map.keyframe_frame[keyframe])
        out[frame] = Anchor(scene_map.obs_feature[rows], scene_map.obs_px[rows].astype(np.float32))
    return out


def _spread(cell: IntArray, value: IntArray) -> IntArray:
    """Rows of up to `_MAX_TRACKS` items, taken from the cells in turn, the most valuable first."""
    order = np.lexsort((-value, cell))
    sorted_cells = cell[order]
    first = np.searchsorted(sorted_cells, sorted_cells)
    rank = np.arange(len(order)) - first
    turn = np.lexsort((-value[order], rank))
    return np.asarray(order[turn[:_MAX_TRACKS]])


@dataclass(slots=True)
class _Active:
    """Tracks alive in the newest frame."""

    keyframe: int
    feature: IntArray
    px: Pixels

    def step(self, first: GreyImage, second: GreyImage) -> None:
        flow = track_points(first, second, self.px)
        self.feature, self.px = self.feature[flow.ok], flow.px[flow.ok]

    def observe(self, frame: int) -> Tracks:
        count = len(self.feature)
        return Tracks(
            np.full(count, frame, np.int64), np.full(count, self.keyframe, np.int64), self.feature, self.px
        )


def track_stretch(
    camera: CaptureCamera,
    anchors: Mapping[int, Anchor],
    start: int,
    stop: int,
    context: StageContext,
) -> Iterator[Tracks]:
    """Track from every keyframe in [start, stop) forward to the next one and back to the one before.

    Memory is bounded by `_MAX_BUFFER` frames. Yields the observations found, in no particular order.

    Args:
        camera: Video.
        anchors: Keyframes of the map by frame index.
        start: First frame; tracking forward begins at the first keyframe at or after it.
        stop: One past the last frame.
        context: Cancellation.
    """
    forward: _Active | None = None
    previous: GreyImage | None = None
    buffer: deque[tuple[int, GreyImage]] = deque(maxlen=_MAX_BUFFER)
    for index, grey in camera.grey_frames(start, stop):
        context.check_cancelled()
        if forward is not None and previous is not None:
            forward.step(previous, grey)
            if len(forward.feature) < _MIN_TRACKS:
                forward = None
            else:
                yield forward.observe(index)
        anchor = anchors.get(index)
        if anchor is not None:
            yield from _track_back(index, grey, anchor, buffer)
            buffer.clear()
            forward = _Active(index, anchor.feature, anchor.px)
        buffer.append((index, grey))
        previous = grey


def _track_back(
    keyframe: int, grey: GreyImage, anchor: Anchor, buffer: deque[tuple[int, GreyImage]]
) -> Iterator[Tracks]:
    active = _Active(keyframe, anchor.feature, anchor.px)
    later = grey
    for index, earlier in reversed(buffer):
        active.step(later, earlier)
        if len(active.feature) < _MIN_TRACKS:
            return
        yield active.observe(index)
        later = earlier


def track_scale(camera: CaptureCamera) -> float:
    """Factor on pixel thresholds for this camera."""
    return pixel_scale(camera.camera.width_px, camera.camera.height_px)
