"""Collect the observations of map points by a camera, one block of frames after another."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.rotation_path import PosePath, RotationPath
from bodycap_batch.model.scene import Map
from bodycap_batch.registration.poses.batched_pnp import Observations, RateErrors, make_observations
from bodycap_batch.registration.poses.static_points import static_points
from bodycap_batch.registration.tracking.klt import Tracks

_POINT_VARIANCE_RATIO = 6.0
"""Variance that the position error of a point adds to an observation, as a multiple of the variance of a
track. The value holds for a point that one keyframe sees. With more keyframes, the added variance is divided
by their number. Evidence: docs/decisions/registration.md."""
_TRANSIENT_WEIGHT = 0.01
"""Factor on the weight of the observations of points that are not static. Evidence:
docs/decisions/registration.md."""
BLOCK_FRAMES = 1200
"""Maximum number of frames in a block. Only the observations of one block are held in memory at a time. The
poses do not depend on this number. Evidence: docs/decisions/registration.md."""
_MIN_OBSERVED = 4
"""Minimum number of observations of a point for an estimate of its reliability. A point with fewer
observations is treated as fully reliable. Evidence: none."""


def point_weights(keyframe_count: IntArray) -> FloatArray:
    """Return the weights (N,) of observations, from the number of keyframes that see each observed point.

    More keyframes determine a point better. The weight approaches 1 as the number grows.

    Args:
        keyframe_count: (N,) number of keyframes that see each point.
    """
    return np.asarray(keyframe_count / (keyframe_count + _POINT_VARIANCE_RATIO))


@dataclass(slots=True)
class PointReliability:
    """Counts of each point's observations, from which the reliability of the point is computed.

    Attributes:
        observed: (P,) number of observations of each point by the camera, in frames with a pose.
        agreed: (P,) number of these observations that agree with the pose of their frame.
    """

    observed: IntArray
    agreed: IntArray

    @staticmethod
    def zero(count: int) -> PointReliability:
        """Return the reliability of `count` points, in which all numbers of observations are zero."""
        return PointReliability(np.zeros(count, np.int64), np.zeros(count, np.int64))

    def add(self, point: IntArray, has_pose: BoolArray, agrees: BoolArray) -> None:
        """Add observations to the counts. Observations in frames without a pose are ignored.

        Args:
            point: (M,) index of the observed point.
            has_pose: (M,) True if the frame of the observation has a pose.
            agrees: (M,) True if the observation agrees with that pose.
        """
        self.observed[:] += np.bincount(point[has_pose], minlength=len(self.observed))
        self.agreed[:] += np.bincount(point[has_pose & agrees], minlength=len(self.observed))

    def agreement(self, point: IntArray) -> FloatArray:
        """Return the fraction (M,) of each point's observations that agree with a pose.

        The fraction is 1 for a point with fewer than `_MIN_OBSERVED` observations.

        Args:
            point: (M,) index of the point for each requested fraction.
        """
        ratio = self.agreed / np.maximum(self.observed, 1)
        return np.asarray(np.where(self.observed < _MIN_OBSERVED, 1.0, ratio)[point])


@dataclass(slots=True)
class CameraObservations:
    """Provides the observations of a camera, one block of frames after another.

    If all frames fit into one block, the observations of this block are cached.

    Attributes:
        camera: The camera.
        tracks: Tracked observations in the frames of this camera, ordered by frame.
        scene_map: The map.
        rotation: The rotation of the camera from matches between adjacent frames; None if it is unknown. It
            is used where poses are missing.
        static: (P,) True if the point of the map is static; see `static_points`.
    """

    camera: CaptureCamera
    tracks: Tracks
    scene_map: Map
    rotation: RotationPath | None
    static: BoolArray = field(init=False)
    _only_block: FrameBlock | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        self.static = static_points(self.camera, self.scene_map)

    def blocks(self) -> Iterator[FrameBlock]:
        """Yield the observations of successive blocks of frames. If there is only one block, it is cached."""
        count = len(self.camera.times_ns)
        if count > BLOCK_FRAMES:
            for first in range(0, count, BLOCK_FRAMES):
                yield self._make_block(slice(first, min(first + BLOCK_FRAMES, count)))
            return
        if self._only_block is None:
            self._only_block = self._make_block(slice(0, count))
        yield self._only_block

    def _make_block(self, frames: slice) -> FrameBlock:
        """Collect the observations in some frames, ordered by frame."""
        scene_map, name = self.scene_map, self.camera.name
        tracks = self.tracks.in_frames(frames.start, frames.stop)
        tracked = scene_map.points_of(name, tracks.keyframe, tracks.feature)
        has_point = tracked >= 0
        own_frame = scene_map.keyframe_frame[scene_map.obs_keyframe]
        is_own = np.isin(scene_map.obs_keyframe, scene_map.keyframes_of(name))
        is_own &= (own_frame >= frames.start) & (own_frame < frames.stop)
        frame = np.concatenate([own_frame[is_own], tracks.frame[has_point]])
        point = np.concatenate([scene_map.obs_point[is_own], tracked[has_point]])
        px = np.concatenate([scene_map.obs_px[is_own], tracks.px[has_point].astype(np.float64)])
        order = np.argsort(frame, kind="stable")
        return FrameBlock(self, frames, frame[order], point[order], px[order])

    @property
    def lens(self) -> Camera:
        """The camera model of the map."""
        return self.scene_map.cameras[self.camera.name]

    @property
    def readout_s(self) -> float:
        """Readout time for which the map is corrected, seconds; 0 for a global shutter.

        The observations of a rolling shutter must be moved to the instant of the middle row.
        """
        return self.scene_map.readout_s.get(self.camera.name, 0.0)


@dataclass(slots=True)
class FrameBlock:
    """Observations of map points by a camera in a block of frames.

    They are the tracked observations and the observations of the keyframes.

    Attributes:
        source: The camera and the map.
        frames: Range of the frames in the block.
        frame: (M,) frame of each observation, increasing.
        point: (M,) index of the observed point.
        px: (M,2) observed pixel.
    """

    source: CameraObservations
    frames: slice
    frame: IntArray
    point: IntArray
    px: FloatArray
    _observations: Observations | None = field(default=None, init=False, repr=False)

    def observations(
        self,
        px: FloatArray | None,
        reliability: PointReliability | None,
        rates: RateErrors | None = None,
    ) -> Observations:
        """Return the weighted observations.

        Args:
            px: (M,2) corrected pixels, or None for the pixels of the block. The pixels of the block are
                undistorted once and cached.
            reliability: Reliability of the points according to an earlier solution; None if there is no
                earlier solution.
            rates: How the angular velocities move the corrected pixels; None if they are not corrected.
        """
        if px is not None:
            observations = replace(self._make_observations(px), rates=rates)
        elif self._observations is not None:
            observations = self._observations
        else:
            observations = self._observations = self._make_observations(self.px)
        if reliability is None:
            return observations
        weight = observations.weight * reliability.agreement(self.point) ** 2
        return replace(observations, weight=weight)

    def _make_observations(self, px: FloatArray) -> Observations:
        """Undistort pixels (M,2), and weight each observation by the certainty of its point."""
        scene_map = self.source.scene_map
        count = np.bincount(scene_map.obs_point, minlength=len(scene_map.points))[self.point]
        weight = point_weights(count) * np.where(self.static, 1.0, _TRANSIENT_WEIGHT)
        bounds = np.searchsorted(self.frame, np.arange(self.frames.start, self.frames.stop + 1))
        return make_observations(self.source.lens, bounds, scene_map.points[self.point], px, weight)

    @property
    def static(self) -> BoolArray:
        """(M,) True if the observed point is static."""
        return np.asarray(self.source.static[self.point])

    def px_at_mid_row(self, path: FloatArray) -> tuple[FloatArray, RateErrors]:
        """Return the pixels (M,2) moved to the instant of the middle row, and the errors of this movement.

        Args:
            path: (F,4,4) poses map_from_cam of all frames; NaN for a frame without a pose. Without poses,
                only the rotation between adjacent frames is corrected, if it is known.
        """
        source, lens, readout_s = self.source, self.source.lens, self.source.readout_s
        points = source.scene_map.points[self.point]
        poses = PosePath.create(path, source.camera.times_ns, source.rotation)
        fitted = poses.with_fitted_rates(lens, self.frame, points, self.px, readout_s)
        assert fitted.rate_sigma is not None
        # A wrong readout time turns the rays of the rows like a wrong angular velocity.
        off = source.scene_map.readout_sigma_s.get(source.camera.name, 0.0) / readout_s
        wrong = off * np.linalg.norm(fitted.rotation.rate, axis=1) / np.sqrt(3.0)
        leverage_s = fitted.rate_leverage_s(lens, self.frame, self.px, readout_s)
        errors = RateErrors(leverage_s, np.hypot(fitted.rate_sigma, wrong)[self.frame])
        return fitted.px_at_mid_row(lens, self.frame, points, self.px, readout_s), errors

    def count_by_frame(self, selected: BoolArray) -> IntArray:
        """Return the number (F,) of selected observations in each frame of the block.

        Args:
            selected: (M,) True for the observations to count.
        """
        return np.bincount(
            self.frame[selected] - self.frames.start, minlength=self.frames.stop - self.frames.start
        )
