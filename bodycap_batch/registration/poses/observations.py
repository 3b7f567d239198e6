"""What cameras see of the map, a stretch of frames at a time."""

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
"""Variance that a point seen by n keyframes adds to its projections, times n, in units of a track's own.
Without it and with 3, 6, 9: walk131 0.65, 0.59, 0.55, 0.55 cm; room131 3.1, 3.0, 2.9, 2.9; walk12 0.38 for
all; room12 0.55, 0.55, 0.56, 0.56."""
_TRANSIENT_WEIGHT = 0.01
"""Weight of points that nothing confirms. With 1, 0.1, 0.03, 0.01: room131 1.86, 1.39, 1.38, 1.36 cm; a
rendered capture with textured sleeves in view 1.00, 0.72, 0.61, 0.58 cm; room12 0.58, 0.60, 0.61, 0.61 cm."""
BLOCK_FRAMES = 1200
"""Frames whose views are held at a time. Solving 144 s of one camera took 792 MB with all of them held, and
takes 484; the poses are the same."""
_MIN_OBSERVED = 4


def point_weights(keyframe_count: IntArray) -> FloatArray:
    """X"""
    return np.asarray(keyframe_count / (keyframe_count + _POINT_VARIANCE_RATIO))


@dataclass(frozen=True, slots=True, kw_only=True)
class RigMember:
    """One of the cameras that see a frame together.

    Attributes:
        camera: Its video.
        tracks: Observations in its frames, ordered by frame.
        cam_from_rig: (4,4) where it sits; frames' poses are those of the rig.
        rig_frame: (N,) frame of the rig at the instant of each of its own; -1 where there is none.
    """

    camera: CaptureCamera
    tracks: Tracks
    cam_from_rig: FloatArray
    rig_frame: IntArray


@dataclass(frozen=True, slots=True)
class PointReliability:
    """How often points were seen in frames with a pose, and how often they agreed with it.

    Attributes:
        seen: (C*P,) by camera and point.
        agreed: (C*P,) likewise.
    """

    observed: IntArray
    agreed: IntArray

    @staticmethod
    def zero(count: int) -> PointReliability:
        """No votes on so many points."""
        return PointReliability(np.zeros(count, np.int64), np.zeros(count, np.int64))

    def add(self, keys: IntArray, has_pose: BoolArray, agrees: BoolArray) -> None:
        """Count views (M,) of points `keys`, those alone whose frames are posed."""
        self.observed[:] += np.bincount(keys[has_pose], minlength=len(self.observed))
        self.agreed[:] += np.bincount(keys[has_pose & agrees], minlength=len(self.observed))

    def agreement(self, keys: IntArray) -> FloatArray:
        """Share (M,) of a point's views that agree; 1 where fewer than `_MIN_OBSERVED` tell."""
        ratio = self.agreed / np.maximum(self.observed, 1)
        return np.asarray(np.where(self.observed < _MIN_OBSERVED, 1.0, ratio)[keys])


@dataclass(slots=True)
class RigObservations:
    """Cameras and the map.

    Attributes:
        members: The cameras; the first one's frames are the rig's.
        scene_map: The map.
        confirmed: (C,P) points that something confirms, by camera.
        kept: The only stretch, once it is known.
    """

    members: Sequence[RigMember]
    scene_map: Map
    static: BoolArray
    _only_block: FrameBlock | None = field(default=None, init=False, repr=False)

    @staticmethod
    def create(members: Sequence[RigMember], scene_map: Map) -> RigObservations:
        """Cameras with what confirms the map's points to each."""
        static = np.array([static_points(member.camera, scene_map) for member in members])
        return RigObservations(members, scene_map, static)

    def blocks(self) -> Iterator[FrameBlock]:
        """What is seen, some frames at a time; a single stretch is kept for the next time."""
        count = len(self.members[0].camera.times_ns)
        if count > BLOCK_FRAMES:
            for first in range(0, count, BLOCK_FRAMES):
                yield self._make_block(slice(first, min(first + BLOCK_FRAMES, count)))
            return
        if self._only_block is None:
            self._only_block = self._make_block(slice(0, count))
        yield self._only_block

    def _make_block(self, frames: slice) -> FrameBlock:
        parts = [_observations_of(member, self.scene_map, frames) for member in self.members]
        frame, point, px = (np.concatenate(each) for each in zip(*parts, strict=True))
        member = np.repeat(np.arange(len(self.members)), [len(part[0]) for part in parts])
        order = np.argsort(frame, kind="stable")
        return FrameBlock(self, frames, frame[order], point[order], px[order], member[order])

    @property
    def lenses(self) -> list[Camera]:
        """Their lenses, as the map has them."""
        return [self.scene_map.cameras[member.camera.name] for member in self.members]

    @property
    def rolling(self) -> bool:
        """Whether pixels have to be moved to the middle row's instant."""
        return any(self.scene_map.readout_s.get(member.camera.name, 0.0) for member in self.members)


@dataclass(slots=True)
class FrameBlock:
    """What a rig sees of the map in a stretch of frames: tracked points, and keyframes' own observations.

    Attributes:
        rig: The rig.
        frames: Which frames.
        frame: (M,) frame index, increasing.
        point: (M,) point index.
        px: (M,2) where.
        member: (M,) which camera saw it.
        made: Its views, once they are made.
    """

    rig: RigObservations
    frames: slice
    frame: IntArray
    point: IntArray
    px: FloatArray
    member: IntArray
    _observations: Observations | None = field(default=None, init=False, repr=False)

    def observations(self, px: FloatArray | None, reliability: PointReliability | None) -> Observations:
        """What is seen, at pixels (M,2) where these are not its own; `reliability` tell how far points agree."""
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
        scene_map, lenses = self.rig.scene_map, self.rig.lenses
        # Where a point stands is known the better the more keyframes see it.
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
        """(M,) whether something confirms the point that is seen."""
        return np.asarray(self.rig.static[self.member, self.point])

    @property
    def point_keys(self) -> IntArray:
        """(M,) camera and point, as votes number them."""
        return self.member * len(self.rig.scene_map.points) + self.point

    def px_at_mid_row(self, path: FloatArray) -> FloatArray:
        """Pixels (M,2) at the instant of the middle row, for the rig's poses of all frames."""
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
        """How many of the rows under a mask each frame of the stretch has."""
        return np.bincount(
            self.frame[selected] - self.frames.start, minlength=self.frames.stop - self.frames.start
        )


def _observations_of(
    member: RigMember, scene_map: Map, frames: slice
) -> tuple[IntArray, IntArray, FloatArray]:
    """Frames of the rig, points and pixels of what one camera sees in a stretch."""
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
