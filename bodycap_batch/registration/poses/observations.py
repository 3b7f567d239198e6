"""Collect the observations of map points by the cameras of a rig, one block of frames after another."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import invert
from bodycap_batch.model.reprojection_derivatives import projection_jacobian
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


@dataclass(frozen=True, slots=True, kw_only=True)
class RigMember:
    """One camera of a rig.

    Attributes:
        camera: The camera.
        tracks: Tracked observations in the frames of this camera, ordered by frame.
        cam_from_rig: (4,4) pose of the camera in the rig. The estimated poses of frames are poses of the rig.
        rig_frame: (N,) index of the rig's frame at the instant of each frame of this camera; -1 if the rig
            has no frame at this instant.
        rotation: The rotation of the camera from matches between adjacent frames; None if it is unknown.
            It is used where poses are missing.
    """

    camera: CaptureCamera
    tracks: Tracks
    cam_from_rig: FloatArray
    rig_frame: IntArray
    rotation: RotationPath | None = None


@dataclass(slots=True)
class PointReliability:
    """Counts of each point's observations, from which the reliability of the point is computed.

    C is the number of cameras, P the number of points.

    Attributes:
        observed: (C*P,) number of observations of each point by each camera, in frames with a pose.
        agreed: (C*P,) number of these observations that agree with the pose of their frame.
    """

    observed: IntArray
    agreed: IntArray

    @staticmethod
    def zero(count: int) -> PointReliability:
        """Return a reliability with `count` entries, in which all numbers of observations are zero."""
        return PointReliability(np.zeros(count, np.int64), np.zeros(count, np.int64))

    def add(self, keys: IntArray, has_pose: BoolArray, agrees: BoolArray) -> None:
        """Add observations to the counts. Observations in frames without a pose are ignored.

        Args:
            keys: (M,) combined index of camera and point for each observation.
            has_pose: (M,) True if the frame of the observation has a pose.
            agrees: (M,) True if the observation agrees with that pose.
        """
        self.observed[:] += np.bincount(keys[has_pose], minlength=len(self.observed))
        self.agreed[:] += np.bincount(keys[has_pose & agrees], minlength=len(self.observed))

    def agreement(self, keys: IntArray) -> FloatArray:
        """Return the fraction (M,) of each point's observations that agree with a pose.

        The fraction is 1 for a point with fewer than `_MIN_OBSERVED` observations.

        Args:
            keys: (M,) combined index of camera and point for each requested fraction.
        """
        ratio = self.agreed / np.maximum(self.observed, 1)
        return np.asarray(np.where(self.observed < _MIN_OBSERVED, 1.0, ratio)[keys])


@dataclass(slots=True)
class RigObservations:
    """Provides the observations of a rig's cameras, one block of frames after another.

    If all frames fit into one block, the observations of this block are cached.

    C is the number of cameras, P the number of points.

    Attributes:
        members: The cameras of the rig. The frames of the first camera are the frames of the rig.
        scene_map: The map.
        static: (C,P) True if the point is static for the camera; see `static_points`.
    """

    members: Sequence[RigMember]
    scene_map: Map
    static: BoolArray
    _only_block: FrameBlock | None = field(default=None, init=False, repr=False)

    @staticmethod
    def create(members: Sequence[RigMember], scene_map: Map) -> RigObservations:
        """Return the cameras and the map with the static points of each camera."""
        static = np.array([static_points(member.camera, scene_map) for member in members])
        return RigObservations(members, scene_map, static)

    def blocks(self) -> Iterator[FrameBlock]:
        """Yield the observations of successive blocks of frames. If there is only one block, it is cached."""
        count = len(self.members[0].camera.times_ns)
        if count > BLOCK_FRAMES:
            for first in range(0, count, BLOCK_FRAMES):
                yield self._make_block(slice(first, min(first + BLOCK_FRAMES, count)))
            return
        if self._only_block is None:
            self._only_block = self._make_block(slice(0, count))
        yield self._only_block

    def _make_block(self, frames: slice) -> FrameBlock:
        """Collect the observations of all cameras in the rig's frames `frames`, ordered by frame."""
        parts = [_observations_of(member, self.scene_map, frames) for member in self.members]
        frame, point, px = (np.concatenate(each) for each in zip(*parts, strict=True))
        member = np.repeat(np.arange(len(self.members)), [len(part[0]) for part in parts])
        order = np.argsort(frame, kind="stable")
        return FrameBlock(self, frames, frame[order], point[order], px[order], member[order])

    @property
    def lenses(self) -> list[Camera]:
        """The camera models of the map, one for each camera of the rig."""
        return [self.scene_map.cameras[member.camera.name] for member in self.members]

    @property
    def rolling(self) -> bool:
        """True if at least one camera has a rolling shutter.

        The observations of such a camera must be moved to the instant of the middle row.
        """
        return any(self.scene_map.readout_s.get(member.camera.name, 0.0) for member in self.members)


@dataclass(slots=True)
class FrameBlock:
    """Observations of map points by the cameras of a rig in a block of frames.

    They are the tracked observations and the observations of the keyframes.

    Attributes:
        rig: The cameras of the rig and the map.
        frames: Range of the rig's frames in the block.
        frame: (M,) index of the rig's frame of each observation, increasing.
        point: (M,) index of the observed point.
        px: (M,2) observed pixel.
        member: (M,) index of the observing camera.
    """

    rig: RigObservations
    frames: slice
    frame: IntArray
    point: IntArray
    px: FloatArray
    member: IntArray
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
        weight = observations.weight * reliability.agreement(self.point_keys) ** 2
        return replace(observations, weight=weight)

    def _make_observations(self, px: FloatArray) -> Observations:
        """Undistort pixels (M,2), and weight each observation by the certainty of its point."""
        scene_map, lenses = self.rig.scene_map, self.rig.lenses
        count = np.bincount(scene_map.obs_point, minlength=len(scene_map.points))[self.point]
        weight = point_weights(count) * np.where(self.static, 1.0, _TRANSIENT_WEIGHT)
        bounds = np.searchsorted(self.frame, np.arange(self.frames.start, self.frames.stop + 1))
        points = scene_map.points[self.point]
        if len(lenses) == 1:
            return make_observations(lenses[0], bounds, points, px, weight)
        rays, px_from_ray = np.empty((len(px), 2)), np.empty((len(px), 2, 2))
        for number, lens in enumerate(lenses):
            rows = self.member == number
            rays[rows] = lens.unproject(px[rows])
            px_from_ray[rows] = projection_jacobian(lens, rays[rows])
        return Observations(
            bounds=bounds,
            points=points,
            rays=rays,
            px_from_ray=px_from_ray,
            weight=weight,
            member=self.member,
            cam_from_rig=np.array([member.cam_from_rig for member in self.rig.members]),
        )

    @property
    def static(self) -> BoolArray:
        """(M,) True if the observed point is static for the observing camera."""
        return np.asarray(self.rig.static[self.member, self.point])

    @property
    def point_keys(self) -> IntArray:
        """(M,) combined index of camera and point for each observation, as used in `PointReliability`."""
        return self.member * len(self.rig.scene_map.points) + self.point

    def px_at_mid_row(self, path: FloatArray) -> tuple[FloatArray, RateErrors]:
        """Return the pixels (M,2) moved to the instant of the middle row, and the errors of this movement.

        Args:
            path: (F,4,4) poses map_from_rig of all frames; NaN for a frame without a pose. Without poses,
                only the rotation between adjacent frames is corrected, if it is known.
        """
        out = self.px.copy()
        leverage_s, sigma = np.zeros(len(out)), np.zeros(len(out))
        scene_map, times_ns = self.rig.scene_map, self.rig.members[0].camera.times_ns
        for number, (member, lens) in enumerate(zip(self.rig.members, self.rig.lenses, strict=True)):
            name = member.camera.name
            readout_s = scene_map.readout_s.get(name, 0.0)
            if readout_s:
                rows = self.member == number
                frame, points, px = self.frame[rows], scene_map.points[self.point[rows]], self.px[rows]
                poses = PosePath.create(path @ invert(member.cam_from_rig), times_ns, member.rotation)
                fitted = poses.with_fitted_rates(lens, frame, points, px, readout_s)
                assert fitted.rate_sigma is not None
                # A wrong readout time turns the rays of the rows like a wrong angular velocity.
                off = scene_map.readout_sigma_s.get(name, 0.0) / readout_s
                wrong = off * np.linalg.norm(fitted.rotation.rate, axis=1) / np.sqrt(3.0)
                leverage_s[rows] = fitted.rate_leverage_s(lens, frame, px, readout_s)
                sigma[rows] = np.hypot(fitted.rate_sigma, wrong)[frame]
                out[rows] = fitted.px_at_mid_row(lens, frame, points, px, readout_s)
        return out, RateErrors(leverage_s, sigma)

    def count_by_frame(self, selected: BoolArray) -> IntArray:
        """Return the number (F,) of selected observations in each frame of the block.

        Args:
            selected: (M,) True for the observations to count.
        """
        return np.bincount(
            self.frame[selected] - self.frames.start, minlength=self.frames.stop - self.frames.start
        )


def _observations_of(
    member: RigMember, scene_map: Map, frames: slice
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return the observations of one camera in a block of the rig's frames.

    Returns:
        Index of the rig's frame (M,), point index (M,) and pixel (M,2) of each observation.
    """
    name = member.camera.name
    inside = np.flatnonzero((member.rig_frame >= frames.start) & (member.rig_frame < frames.stop))
    first, stop = (int(inside[0]), int(inside[-1]) + 1) if len(inside) else (0, 0)
    tracks = member.tracks.in_frames(first, stop)
    point = scene_map.points_of(name, tracks.keyframe, tracks.feature)
    has_point = point >= 0
    own_frame = scene_map.keyframe_frame[scene_map.obs_keyframe]
    is_own = np.isin(scene_map.obs_keyframe, scene_map.keyframes_of(name))
    is_own &= (own_frame >= first) & (own_frame < stop)
    frame = member.rig_frame[np.concatenate([own_frame[is_own], tracks.frame[has_point]])]
    in_rig = frame >= 0
    return (
        frame[in_rig],
        np.concatenate([scene_map.obs_point[is_own], point[has_point]])[in_rig],
        np.concatenate([scene_map.obs_px[is_own], tracks.px[has_point].astype(np.float64)])[in_rig],
    )
