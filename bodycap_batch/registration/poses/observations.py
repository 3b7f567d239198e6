"""Collect the observations of map points by the cameras of a rig, block by block."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import invert
from bodycap_batch.model.rolling_shutter import image_velocity, px_at_mid_row
from bodycap_batch.model.scene import Map
from bodycap_batch.registration.poses.batched_pnp import Observations, make_observations, projection_jacobian
from bodycap_batch.registration.poses.static_points import static_points
from bodycap_batch.registration.tracking.klt import Tracks

_POINT_VARIANCE_RATIO = 6.0
"""Variance that the position error of a point adds to its observations, for a point seen by one keyframe,
relative to the variance of a track. It falls with the number of keyframes. Evidence:
docs/decisions/registration.md."""
_TRANSIENT_WEIGHT = 0.01
"""Weight factor of points that are not known to be static. Evidence: docs/decisions/registration.md."""
BLOCK_FRAMES = 1200
"""Frames whose observations are held at a time. It bounds the memory; the poses do not depend on it.
Evidence: docs/decisions/registration.md."""
_MIN_OBSERVED = 4
"""Observations of a point below which its reliability counts as full. Evidence: none."""


def point_weights(keyframe_count: IntArray) -> FloatArray:
    """Return the weights of observations of points that `keyframe_count` (N,) keyframes see, relative to 1.

    More keyframes determine a point better.
    """
    return np.asarray(keyframe_count / (keyframe_count + _POINT_VARIANCE_RATIO))


@dataclass(frozen=True, slots=True, kw_only=True)
class RigMember:
    """One camera of a rig.

    Attributes:
        camera: The camera.
        tracks: Observations in its frames, ordered by frame.
        cam_from_rig: (4,4) its pose in the rig; the poses of frames are those of the rig.
        rig_frame: (N,) frame of the rig at the instant of each frame of this camera; -1 if there is none.
    """

    camera: CaptureCamera
    tracks: Tracks
    cam_from_rig: FloatArray
    rig_frame: IntArray


@dataclass(slots=True)
class PointReliability:
    """How often each point was observed in frames with a pose, and how often it agreed with the pose.

    Attributes:
        observed: (C*P,) by camera and point.
        agreed: (C*P,) likewise.
    """

    observed: IntArray
    agreed: IntArray

    @staticmethod
    def zero(count: int) -> PointReliability:
        """Return empty counts for `count` points."""
        return PointReliability(np.zeros(count, np.int64), np.zeros(count, np.int64))

    def add(self, keys: IntArray, has_pose: BoolArray, agrees: BoolArray) -> None:
        """Count observations (M,) of points `keys`, in frames with a pose only."""
        self.observed[:] += np.bincount(keys[has_pose], minlength=len(self.observed))
        self.agreed[:] += np.bincount(keys[has_pose & agrees], minlength=len(self.observed))

    def agreement(self, keys: IntArray) -> FloatArray:
        """Return the ratio (M,) of a point's observations that agree; 1 for fewer than `_MIN_OBSERVED`."""
        ratio = self.agreed / np.maximum(self.observed, 1)
        return np.asarray(np.where(self.observed < _MIN_OBSERVED, 1.0, ratio)[keys])


@dataclass(slots=True)
class RigObservations:
    """The cameras of a rig and the map, with the observations of the last block if it is the only one.

    Attributes:
        members: The cameras. The frames of the first one are those of the rig.
        scene_map: The map.
        static: (C,P) static points, by camera.
    """

    members: Sequence[RigMember]
    scene_map: Map
    static: BoolArray
    _only_block: FrameBlock | None = field(default=None, init=False, repr=False)

    @staticmethod
    def create(members: Sequence[RigMember], scene_map: Map) -> RigObservations:
        """Find the static points of each camera."""
        static = np.array([static_points(member.camera, scene_map) for member in members])
        return RigObservations(members, scene_map, static)

    def blocks(self) -> Iterator[FrameBlock]:
        """Yield the observations of successive blocks of frames. A single block is cached."""
        count = len(self.members[0].camera.times_ns)
        if count > BLOCK_FRAMES:
            for first in range(0, count, BLOCK_FRAMES):
                yield self._make_block(slice(first, min(first + BLOCK_FRAMES, count)))
            return
        if self._only_block is None:
            self._only_block = self._make_block(slice(0, count))
        yield self._only_block

    def _make_block(self, frames: slice) -> FrameBlock:
        """Collect the observations of all cameras in some frames, ordered by frame."""
        parts = [_observations_of(member, self.scene_map, frames) for member in self.members]
        frame, point, px = (np.concatenate(each) for each in zip(*parts, strict=True))
        member = np.repeat(np.arange(len(self.members)), [len(part[0]) for part in parts])
        order = np.argsort(frame, kind="stable")
        return FrameBlock(self, frames, frame[order], point[order], px[order], member[order])

    @property
    def lenses(self) -> list[Camera]:
        """The camera models of the map, one for each member."""
        return [self.scene_map.cameras[member.camera.name] for member in self.members]

    @property
    def rolling(self) -> bool:
        """True if observations must be moved to the instant of the middle row."""
        return any(self.scene_map.readout_s.get(member.camera.name, 0.0) for member in self.members)


@dataclass(slots=True)
class FrameBlock:
    """Observations of the map by a rig in a block of frames: tracked points, and observations of keyframes.

    Attributes:
        rig: The rig.
        frames: The frames of the block.
        frame: (M,) frame index, increasing.
        point: (M,) point index.
        px: (M,2) pixel.
        member: (M,) index of the observing camera.
    """

    rig: RigObservations
    frames: slice
    frame: IntArray
    point: IntArray
    px: FloatArray
    member: IntArray
    _observations: Observations | None = field(default=None, init=False, repr=False)

    def observations(self, px: FloatArray | None, reliability: PointReliability | None) -> Observations:
        """Return the weighted observations, at pixels (M,2) if these differ from the block's own.

        Args:
            px: (M,2) corrected pixels, or None for the block's own; the latter are undistorted once and
                cached.
            reliability: Agreement of the points with the poses of an earlier solution, if there is one.
        """
        if px is not None:
            observations = self._make_observations(px)
        elif self._observations is not None:
            observations = self._observations
        else:
            observations = self._observations = self._make_observations(self.px)
        if reliability is None:
            return observations
        weight = observations.weight * reliability.agreement(self.point_keys) ** 2
        return replace(observations, weight=weight)

    def _make_observations(self, px: FloatArray) -> Observations:
        """Undistort pixels (M,2) and weight them by the certainty of their points."""
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
        """(M,) whether the observed point is static."""
        return np.asarray(self.rig.static[self.member, self.point])

    @property
    def point_keys(self) -> IntArray:
        """(M,) index by camera and point, as in `PointReliability`."""
        return self.member * len(self.rig.scene_map.points) + self.point

    def px_at_mid_row(self, path: FloatArray) -> FloatArray:
        """Return pixels (M,2) at the instant of the middle row, given the rig's poses of all frames."""
        out = self.px.copy()
        scene_map, times_ns = self.rig.scene_map, self.rig.members[0].camera.times_ns
        for number, (member, lens) in enumerate(zip(self.rig.members, self.rig.lenses, strict=True)):
            readout_s = scene_map.readout_s.get(member.camera.name, 0.0)
            if readout_s:
                rows = self.member == number
                own_poses, points = path @ invert(member.cam_from_rig), scene_map.points[self.point[rows]]
                velocity = image_velocity(lens, own_poses, times_ns, self.frame[rows], points)
                out[rows] = px_at_mid_row(lens, out[rows], velocity, readout_s)
        return out

    def count_by_frame(self, selected: BoolArray) -> IntArray:
        """Count the selected rows of each frame of the block."""
        return np.bincount(
            self.frame[selected] - self.frames.start, minlength=self.frames.stop - self.frames.start
        )


def _observations_of(
    member: RigMember, scene_map: Map, frames: slice
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return rig frames, points and pixels of the observations of one camera in a block of frames."""
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
