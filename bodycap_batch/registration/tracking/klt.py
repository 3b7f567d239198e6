"""Track map points from keyframes forward and backward into the frames between them, with the KLT tracker."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.optical_flow import (
    GreyImage,
    ImageMotion,
    Pixels,
    detect_corners,
    estimate_coarse_motion,
    make_coarse_image,
    pixel_scale,
    track_points,
    unit_directions,
)
from bodycap_batch.model.scene import Map

_MAX_TRACKS = 250
"""Maximum number of map points tracked from a keyframe. Evidence: none."""
_GRID_CELLS = 8
"""Number of grid cells along each side of the image. The tracked points are spread over these cells.
Evidence: none."""
_MAX_BUFFERED_FRAMES = 90
"""Maximum number of frames held in memory for tracking backward from a keyframe. It bounds the memory if
keyframes are far apart."""
_MIN_TRACKS = 6
"""Minimum number of tracks from one keyframe. If fewer remain, none of them is continued, because they are
too few for a pose."""
_MAX_CLOSURE_PX = 2.0
"""Pixels at 640 px image width: maximum distance between a track that arrives at the next keyframe and the
keyframe's own observation of the same point. A track within this distance is treated as correct. Evidence:
none."""
_MIN_MOTION_POINTS = 48
"""Minimum number of tracked points for an estimate of the motion of the whole image. If fewer points are
tracked, corners are detected and used instead. Evidence: none."""
_CORNER_SPACING_PX = 12.0
"""Minimum distance between two detected corners, in pixels of the reduced image. Evidence: none."""


@dataclass(frozen=True, slots=True)
class KeyframePoints:
    """The map points that a keyframe observes.

    Attributes:
        feature: (N,) feature index in the keyframe.
        point: (N,) index of the map point.
        px: (N,2) float32 observed pixel.
    """

    feature: IntArray
    point: IntArray
    px: Pixels

    def select(self, mask: npt.NDArray[Any]) -> KeyframePoints:
        """Return the points that a mask selects."""
        return KeyframePoints(self.feature[mask], self.point[mask], self.px[mask])


@dataclass(frozen=True, slots=True)
class Tracks:
    """Tracked observations of map points.

    The map point is given by the keyframe feature that the track starts from.

    Attributes:
        frame: (M,) index of the observing frame.
        keyframe: (M,) frame index of the keyframe that the track starts from.
        feature: (M,) feature index in this keyframe.
        px: (M,2) float32 observed pixel.
    """

    frame: IntArray
    keyframe: IntArray
    feature: IntArray
    px: Pixels

    @staticmethod
    def join_and_clear(parts: list[Tracks]) -> Tracks:
        """Concatenate tracks, ordered by frame, keyframe and feature, and clear the list.

        The arrays are concatenated one field at a time, and the source arrays of this field are released. A
        long video would otherwise need too much memory. Evidence: docs/decisions/registration.md.
        """
        if not parts:
            none = np.zeros(0, np.int64)
            return Tracks(none, none, none, np.zeros((0, 2), np.float32))
        names = ("frame", "keyframe", "feature", "px")
        columns = [[getattr(part, name) for part in parts] for name in names]
        parts.clear()
        fields = []
        while columns:
            fields.append(np.concatenate(columns.pop(0)))
        frame, keyframe, feature, px = fields
        fields.clear()
        order = np.lexsort((feature, keyframe, frame))
        frame = frame[order]
        keyframe = keyframe[order]
        feature = feature[order]
        px = px[order]
        for field in (frame, keyframe, feature, px):
            field.flags.writeable = False  # a registration does not copy read-only arrays
        return Tracks(frame, keyframe, feature, px)

    def in_frames(self, first: int, stop: int) -> Tracks:
        """Return the observations in frames first <= frame < stop. The tracks must be ordered by frame."""
        low, high = np.searchsorted(self.frame, [first, stop]).tolist()
        return self.select(slice(low, high))

    def select(self, mask: npt.NDArray[Any] | slice) -> Tracks:
        """Return the observations that a mask or a slice selects."""
        return Tracks(self.frame[mask], self.keyframe[mask], self.feature[mask], self.px[mask])


def select_keyframe_points(scene_map: Map, camera: str) -> dict[int, KeyframePoints]:
    """Select map points of each keyframe of a camera, spread over the image.

    Points that many keyframes observe are preferred.

    Returns:
        Selected points of each keyframe, by frame index.
    """
    keyframe_count = np.bincount(scene_map.obs_point, minlength=len(scene_map.points))
    lens = scene_map.cameras[camera]
    order = np.argsort(scene_map.obs_keyframe, kind="stable")
    bounds = np.searchsorted(scene_map.obs_keyframe[order], np.arange(len(scene_map.keyframe_camera) + 1))
    out = {}
    for keyframe in scene_map.keyframes_of(camera):
        observed = order[bounds[keyframe] : bounds[keyframe + 1]]
        px = scene_map.obs_px[observed]
        cell = np.clip((px / (lens.width_px, lens.height_px) * _GRID_CELLS).astype(int), 0, _GRID_CELLS - 1)
        chosen = grid_sample(
            cell[:, 1] * _GRID_CELLS + cell[:, 0], keyframe_count[scene_map.obs_point[observed]], _MAX_TRACKS
        )
        rows = np.sort(observed[chosen])
        frame = int(scene_map.keyframe_frame[keyframe])
        out[frame] = KeyframePoints(
            scene_map.obs_feature[rows],
            scene_map.obs_point[rows],
            scene_map.obs_px[rows].astype(np.float32),
        )
    return out


def grid_sample(cell: IntArray, score: IntArray, count: int) -> IntArray:
    """Return the rows of up to `count` items, spread evenly over grid cells.

    Each round takes the item with the highest remaining score from every cell.

    Args:
        cell: (N,) index of each item's cell.
        score: (N,) score of each item.
        count: Maximum number of items to select.
    """
    order = np.lexsort((-score, cell))
    sorted_cells = cell[order]
    cell_start = np.searchsorted(sorted_cells, sorted_cells)
    rank = np.arange(len(order)) - cell_start
    by_rank = np.lexsort((-score[order], rank))
    return np.asarray(order[by_rank[:count]])


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredTurns:
    """Rotations between adjacent frames that a gyroscope measured.

    Attributes:
        lens: Intrinsics of the camera.
        step: (N-1,3,3) rotation later_from_earlier of each frame and the next frame.
        known: (N-1,) True if it was measured.
    """

    lens: Camera
    step: FloatArray
    known: BoolArray

    def motion(self, first: int, second: int) -> FloatArray | None:
        """Return the homography (3,3) of far points between two adjacent frames; None if it is unknown.

        It is in pixels of the full-size images with COLMAP's origin. The distortion of the lens is
        approximated.
        """
        import cv2

        if second != first + 1 or not self.known[first]:
            return None
        fractions = np.linspace(0.1, 0.9, _GRID_CELLS)
        grid = np.stack(np.meshgrid(fractions * self.lens.width_px, fractions * self.lens.height_px), axis=-1)
        px = grid.reshape(-1, 2)
        arrived = self.lens.project(unit_directions(self.lens.unproject(px)) @ self.step[first].T)
        seen = np.isfinite(arrived).all(axis=1)
        seen &= (np.abs(arrived - px) < max(self.lens.width_px, self.lens.height_px)).all(axis=1)
        if seen.sum() < _GRID_CELLS:
            return None
        homography, _ = cv2.findHomography(px[seen], arrived[seen])
        return None if homography is None else np.asarray(homography, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class _VideoFrame:
    """A video frame at full size for tracking and at reduced size for estimating image motion."""

    camera: CaptureCamera
    index: int
    grey: GreyImage
    coarse: GreyImage

    @property
    def scale(self) -> float:
        """Factor that converts pixel thresholds at 640 px image width to this image's size."""
        return pixel_scale(self.grey.shape[1], self.grey.shape[0])


@dataclass(slots=True)
class _ActiveTracks:
    """Tracks from one keyframe that have reached the newest frame.

    Attributes:
        keyframe: Frame index of the keyframe that the tracks start from.
        start: Points of this keyframe that were tracked at the start.
        rows: (N,) rows in `start` of the points that are still tracked, increasing.
        px: (N,2) current pixel of these points.
    """

    keyframe: int
    start: KeyframePoints
    rows: IntArray
    px: Pixels

    @staticmethod
    def start_at(keyframe: int, keyframe_points: KeyframePoints) -> _ActiveTracks:
        """Start tracks in a keyframe."""
        return _ActiveTracks(
            keyframe, keyframe_points, np.arange(len(keyframe_points.px)), keyframe_points.px
        )

    def advance(self, first: _VideoFrame, second: _VideoFrame, motion: ImageMotion | None) -> bool:
        """Follow the tracks from the first frame into the second; return False if too few remain."""
        # The check tracks each point back to the first frame, which is slow. It is only done if the image
        # motion is unknown or unreliable, because many tracks may then move to wrong points. A single wrong
        # track is rejected later, when the pose is estimated.
        with_check = motion is None or not motion.is_reliable
        tracked = track_points(first.grey, second.grey, self.px, motion, with_check=with_check)
        keep = tracked.ok & second.camera.is_unmasked(tracked.px, second.index)
        self.rows, self.px = self.rows[keep], tracked.px[keep]
        return len(self.rows) >= _MIN_TRACKS

    def observe(self, frame: int) -> Tracks:
        """Return the current pixels as observations in a frame."""
        return _make_tracks(frame, self.keyframe, self.start.feature[self.rows], self.px)


@dataclass(frozen=True, slots=True)
class _BufferedFrame:
    """A frame between two keyframes, held in memory for tracking backward.

    Attributes:
        frame: The frame.
        motion: Image motion from the next frame to this frame; None if it is unknown.
        rows: (N,) row indices, in the points of the start keyframe, of the forward tracks that reach this
            frame.
        px: (N,2) pixels of these tracks in this frame.
    """

    frame: _VideoFrame
    motion: ImageMotion | None
    rows: IntArray
    px: Pixels


def _make_tracks(frame: int, keyframe: int, feature: IntArray, px: Pixels) -> Tracks:
    """Return the observations of one frame, from tracks that start in one keyframe."""
    count = len(feature)
    return Tracks(np.full(count, frame, np.int64), np.full(count, keyframe, np.int64), feature, px)


def track_range(
    camera: CaptureCamera,
    points_by_keyframe: Mapping[int, KeyframePoints],
    start: int,
    stop: int,
    context: StageContext,
    turns: MeasuredTurns | None = None,
) -> Iterator[Tracks]:
    """Track from every keyframe in [start, stop) forward to the next and backward to the previous keyframe.

    At most `_MAX_BUFFERED_FRAMES` frames are held in memory, so backward tracks have at most this number of
    frames. The order of the yielded observations is not defined.

    Args:
        camera: The camera.
        points_by_keyframe: Map points of the keyframes, by frame index.
        start: First frame. Forward tracking starts at the first keyframe at or after this frame.
        stop: One past the last frame.
        context: Cancellation.
        turns: Rotations between frames that a gyroscope measured; None if there are none.
    """
    forward: _ActiveTracks | None = None
    previous: _VideoFrame | None = None
    buffered: deque[_BufferedFrame] = deque(maxlen=_MAX_BUFFERED_FRAMES)
    for index, grey in camera.grey_frames(start, stop):
        context.check_cancelled()
        frame = _VideoFrame(camera, index, grey, make_coarse_image(grey))
        if previous is not None:
            motion = _estimate_motion(previous, frame, forward, turns)
            buffered.append(_buffer(previous, motion, forward))
            if forward is not None and forward.advance(previous, frame, motion):
                yield forward.observe(index)
            else:
                forward = None
        keyframe_points = points_by_keyframe.get(index)
        if keyframe_points is not None:
            arrived = np.zeros(len(keyframe_points.px), dtype=bool)
            if forward is not None:
                arrived = yield from _close_tracks(forward, index, keyframe_points, buffered)
            yield from _track_back(frame, keyframe_points.select(~arrived), buffered)
            buffered.clear()
            forward = _ActiveTracks.start_at(index, keyframe_points)
        previous = frame


def _buffer(frame: _VideoFrame, motion: ImageMotion | None, active: _ActiveTracks | None) -> _BufferedFrame:
    """Return a frame with its forward tracks, for tracking backward from the next keyframe."""
    backward = None if motion is None else motion.inverse()
    if active is None:
        return _BufferedFrame(frame, backward, np.zeros(0, np.int64), np.zeros((0, 2), np.float32))
    return _BufferedFrame(frame, backward, active.rows, active.px)


def _close_tracks(
    active: _ActiveTracks, keyframe: int, keyframe_points: KeyframePoints, buffered: deque[_BufferedFrame]
) -> Generator[Tracks, None, BoolArray]:
    """Use forward tracks that arrive at the next keyframe as backward tracks of this keyframe.

    A forward track is used if it arrives near the keyframe's own observation of the same point. Its pixels
    are shifted by a constant offset, so that the track ends exactly at this observation. A separate backward
    track from the keyframe would follow the same path, and is not made.

    Args:
        active: Forward tracks that have reached the next keyframe.
        keyframe: Frame index of the next keyframe.
        keyframe_points: (N) points of the next keyframe.
        buffered: Frames before the next keyframe.

    Returns:
        Mask (N,) of the keyframe's points that need no tracking backward.
    """
    _, active_rows, point_rows = np.intersect1d(
        active.start.point[active.rows], keyframe_points.point, return_indices=True
    )
    offset = keyframe_points.px[point_rows] - active.px[active_rows]
    is_close = np.linalg.norm(offset, axis=1) < _MAX_CLOSURE_PX * buffered[-1].frame.scale
    active_rows, point_rows, offset = active_rows[is_close], point_rows[is_close], offset[is_close]
    for item in buffered:
        if len(active_rows) == 0 or len(item.rows) == 0:
            continue
        position = np.searchsorted(item.rows, active.rows[active_rows])
        yield _make_tracks(
            item.frame.index, keyframe, keyframe_points.feature[point_rows], item.px[position] + offset
        )
    arrived = np.zeros(len(keyframe_points.px), dtype=bool)
    arrived[point_rows] = True
    return arrived


def _estimate_motion(
    first: _VideoFrame,
    second: _VideoFrame,
    active: _ActiveTracks | None,
    turns: MeasuredTurns | None = None,
) -> ImageMotion | None:
    """Estimate the motion of the whole image from the active tracks.

    If too few tracks are active, corners are detected and used instead. The search starts from the rotation
    that a gyroscope measured, if there is one.
    """
    expected = None if turns is None else turns.motion(first.index, second.index)
    if active is not None and len(active.px) >= _MIN_MOTION_POINTS:
        points = active.px
    else:
        scale = first.grey.shape[1] / first.coarse.shape[1]
        points = detect_corners(first.coarse, _MIN_MOTION_POINTS, _CORNER_SPACING_PX) * np.float32(scale)
    return estimate_coarse_motion(first.coarse, second.coarse, points, first.grey.shape[1], expected)


def _track_back(
    frame: _VideoFrame, keyframe_points: KeyframePoints, buffered: deque[_BufferedFrame]
) -> Iterator[Tracks]:
    """Track points of a keyframe backward through the buffered frames."""
    active = _ActiveTracks.start_at(frame.index, keyframe_points)
    later = frame
    for item in reversed(buffered):
        if not active.advance(later, item.frame, item.motion):
            return
        yield active.observe(item.frame.index)
        later = item.frame


def camera_pixel_scale(camera: CaptureCamera) -> float:
    """Return the factor that converts pixel thresholds at 640 px width to a camera's image size."""
    return pixel_scale(camera.camera.width_px, camera.camera.height_px)
