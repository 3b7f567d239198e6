"""All frames of a camera solved against the map, again with what the first solution taught."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.camera import Camera
from bodycap_batch.capture import CaptureCamera
from bodycap_batch.geometry import interpolate_pose, invert
from bodycap_batch.registration.batch import Views, inliers_of, lens_jacobian, make_views
from bodycap_batch.registration.confirmed import confirmed_points
from bodycap_batch.registration.jumps import lone_poses, pose_jumps
from bodycap_batch.registration.pose import MAP_VARIANCE_RATIO, FramePose, PoseLimits, solve_poses
from bodycap_batch.registration.tracks import Tracks
from bodycap_batch.rolling_shutter import at_mid_row, image_velocity
from bodycap_batch.scene import FrameStatus, Map

_POINT_VARIANCE = 6.0
"""Variance that a point seen by n keyframes adds to its projections, times n, in units of a track's own.
Without it and with 3, 6, 9: walk131 0.65, 0.59, 0.55, 0.55 cm; room131 3.1, 3.0, 2.9, 2.9; walk12 0.38 for
all; room12 0.55, 0.55, 0.56, 0.56."""
_UNCONFIRMED_WEIGHT = 0.01
"""Weight of points that nothing confirms. With 1, 0.1, 0.03, 0.01: room131 1.86, 1.39, 1.38, 1.36 cm; a
rendered capture with textured sleeves in view 1.00, 0.72, 0.61, 0.58 cm; room12 0.58, 0.60, 0.61, 0.61 cm."""
_LEAST_CONFIRMED = 6
"""Confirmed inliers without which a pose is that of the wearer's sleeve."""
_LONE_EVIDENCE = 4
"""A pose that no neighbouring frame confirms needs so many times the usual inliers."""
_MIN_JUDGED = 4
_AGAIN = 1
_AGAIN_ROLLING = 2
"""The velocity that moves pixels comes from the poses that the moved pixels give."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Member:
    """One of the cameras that see a frame together.

    Attributes:
        camera: Its video.
        tracks: Observations in its frames.
        cam_from_rig: (4,4) where it sits; frames' poses are those of the rig.
        rig_frame: (N,) frame of the rig at the instant of each of its own; -1 where there is none.
    """

    camera: CaptureCamera
    tracks: Tracks
    cam_from_rig: FloatArray
    rig_frame: IntArray


@dataclass(frozen=True, slots=True)
class _Seen:
    """Map points seen by a camera or a rig, by frame: tracked into it, and a keyframe's own observations.

    Attributes:
        frame: (M,) frame index, increasing.
        point: (M,) point index.
        px: (M,2) where.
        member: (M,) which camera saw it.
    """

    frame: IntArray
    point: IntArray
    px: FloatArray
    member: IntArray

    @staticmethod
    def by(members: Sequence[Member], scene_map: Map) -> _Seen:
        parts = [_seen_by(member, scene_map) for member in members]
        frame, point, px = (np.concatenate(each) for each in zip(*parts, strict=True))
        member = np.repeat(np.arange(len(members)), [len(part[0]) for part in parts])
        order = np.argsort(frame, kind="stable")
        order = order[frame[order] >= 0]
        return _Seen(frame[order], point[order], px[order], member[order])


def _seen_by(member: Member, scene_map: Map) -> tuple[IntArray, IntArray, FloatArray]:
    """Frames of the rig, points and pixels of what one camera sees."""
    tracks, name = member.tracks, member.camera.name
    point = scene_map.points_of(name, tracks.keyframe, tracks.feature)
    tracked = point >= 0
    mine = np.isin(scene_map.obs_keyframe, scene_map.keyframes_of(name))
    own_frame = scene_map.keyframe_frame[scene_map.obs_keyframe[mine]]
    return (
        member.rig_frame[np.concatenate([own_frame, tracks.frame[tracked]])],
        np.concatenate([scene_map.obs_point[mine], point[tracked]]),
        np.concatenate([scene_map.obs_px[mine], tracks.px[tracked].astype(np.float64)]),
    )


@dataclass(frozen=True, slots=True)
class _Rig:
    """Cameras with all that they see of the map.

    Attributes:
        members: The cameras; the first one's frames are the rig's.
        scene_map: The map.
        seen: What they see.
        points: (M,3) the points of it.
        bounds: (F+1,) its rows by frame.
    """

    members: Sequence[Member]
    scene_map: Map
    seen: _Seen
    points: FloatArray
    bounds: IntArray

    @staticmethod
    def of(members: Sequence[Member], scene_map: Map) -> _Rig:
        seen = _Seen.by(members, scene_map)
        bounds = np.searchsorted(seen.frame, np.arange(len(members[0].camera.times_ns) + 1))
        return _Rig(members, scene_map, seen, scene_map.points[seen.point], bounds)

    @property
    def lenses(self) -> list[Camera]:
        return [self.scene_map.cameras[member.camera.name] for member in self.members]

    def views(self, px: FloatArray, weight: FloatArray) -> Views:
        """What is seen, at pixels (M,2), with weights (M,)."""
        lenses = self.lenses
        if len(lenses) == 1:
            return make_views(lenses[0], self.bounds, self.points, px, weight)
        rays, px_from_ray = np.empty((len(px), 2)), np.empty((len(px), 2, 2))
        for number, lens in enumerate(lenses):
            mine = self.seen.member == number
            rays[mine] = lens.unproject(px[mine])
            px_from_ray[mine] = lens_jacobian(lens, rays[mine])
        return Views(
            bounds=self.bounds,
            points=self.points,
            rays=rays,
            px_from_ray=px_from_ray,
            weight=weight,
            member=self.seen.member,
            cam_from_rig=np.array([member.cam_from_rig for member in self.members]),
        )

    @property
    def rolling(self) -> bool:
        """Whether pixels have to be moved to the middle row's instant."""
        return any(self.scene_map.readout_s.get(member.camera.name, 0.0) for member in self.members)

    def at_mid_row(self, path: FloatArray) -> FloatArray:
        """Pixels (M,2) at the instant of the middle row, for the rig's poses (F,4,4)."""
        out = self.seen.px.copy()
        times_ns = self.members[0].camera.times_ns
        for number, (member, lens) in enumerate(zip(self.members, self.lenses, strict=True)):
            readout_s = self.scene_map.readout_s.get(member.camera.name, 0.0)
            if readout_s:
                mine = self.seen.member == number
                own = path @ invert(member.cam_from_rig)
                velocity = image_velocity(lens, own, times_ns, self.seen.frame[mine], self.points[mine])
                out[mine] = at_mid_row(lens, out[mine], velocity, readout_s)
        return out

    def confirmed(self) -> BoolArray:
        """(M,) whether something confirms the point that is seen."""
        by_member = np.array([confirmed_points(member.camera, self.scene_map) for member in self.members])
        return np.asarray(by_member[self.seen.member, self.seen.point])


def solve_frames(
    camera: CaptureCamera, scene_map: Map, tracks: Tracks, limits: PoseLimits
) -> list[FramePose]:
    """Solve every frame of a camera from the map points seen in it; see `solve_rig`."""
    count = len(camera.times_ns)
    alone = Member(camera=camera, tracks=tracks, cam_from_rig=np.eye(4), rig_frame=np.arange(count))
    rows = scene_map.keyframes_of(camera.name)
    start = _between(scene_map.keyframe_frame[rows], scene_map.map_from_cam[rows], count)
    return solve_rig([alone], scene_map, start, limits)


def solve_rig(
    members: Sequence[Member], scene_map: Map, start: FloatArray, limits: PoseLimits
) -> list[FramePose]:
    """Solve every frame of a rig from the map points that its cameras see at that instant.

    Points that move with the wearer, or were matched wrongly, lie off in most frames whatever the pose:
    once the poses stand, a point counts by the share of frames that agree with it, and all is solved
    again. Pixels of a rolling shutter are moved to the middle row's instant on the way.

    Args:
        members: Its cameras. The first one sits in the rig's origin and has its frames.
        scene_map: The map.
        start: (F,4,4) rig_from_map to start from; NaN where there is none.
        limits: What makes a pose acceptable.

    Returns:
        Poses of the first camera; `FrameStatus.RIG` where it saw too little for one of its own.
    """
    rig = _Rig.of(members, scene_map)
    seen, lenses, confirmed = rig.seen, rig.lenses, rig.confirmed()
    known = _point_weights(scene_map, seen.point, confirmed)
    views = rig.views(seen.px, known)
    poses = solve_poses(lenses, views, seen.px, start, limits)
    for _ in range(_AGAIN_ROLLING if rig.rolling else _AGAIN):
        path = matrices(poses)
        posed = np.asarray(np.isfinite(path).all(axis=(1, 2)))[seen.frame]
        judged = seen.point * len(members) + seen.member
        share = agreement(inliers_of(views, invert(path), limits.max_error_px), posed, judged)
        start = np.where(np.isfinite(path), invert(path), start)
        px, weight = seen.px, known * share**2
        if rig.rolling:
            px = rig.at_mid_row(path)
            views = rig.views(px, weight)
        else:
            views = replace(views, weight=weight)
        poses = solve_poses(lenses, views, px, start, limits)
    agrees = inliers_of(views, invert(matrices(poses)), limits.max_error_px)
    poses = _with_evidence(poses, _counts(rig, agrees & confirmed))
    own = _counts(rig, agrees & (seen.member == 0))
    return _without_doubtful(_named(poses, rig, own, limits), limits)


def _counts(rig: _Rig, which: BoolArray) -> IntArray:
    """(F,) how many of the rows under a mask each frame has."""
    return np.bincount(rig.seen.frame[which], minlength=len(rig.bounds) - 1)


def _named(poses: list[FramePose], rig: _Rig, own: IntArray, limits: PoseLimits) -> list[FramePose]:
    """Tell keyframes, and frames that the rig's other cameras carry; `own` counts the first one's inliers."""
    status = {}
    if len(rig.members) > 1:
        status = dict.fromkeys(np.flatnonzero(own < limits.min_inliers).tolist(), FrameStatus.RIG)
    rows = rig.scene_map.keyframes_of(rig.members[0].camera.name)
    status |= dict.fromkeys(rig.scene_map.keyframe_frame[rows].tolist(), FrameStatus.KEYFRAME)
    return [
        replace(pose, status=status.get(frame, pose.status))
        if pose.status is FrameStatus.REGISTERED
        else pose
        for frame, pose in enumerate(poses)
    ]


def _point_weights(scene_map: Map, point: IntArray, confirmed: BoolArray) -> FloatArray:
    """(M,) weights of views of points: where one stands is known the better the more keyframes see it."""
    seen = np.bincount(scene_map.obs_point, minlength=len(scene_map.points))[point]
    return np.asarray(seen / (seen + _POINT_VARIANCE) * np.where(confirmed, 1.0, _UNCONFIRMED_WEIGHT))


def agreement(agrees: BoolArray, posed: BoolArray, point: IntArray) -> FloatArray:
    """Share of a point's views that agree with the poses, for each view.

    Args:
        agrees: (M,) views that do.
        posed: (M,) views in frames that have a pose; the others do not count.
        point: (M,) the point of each.

    Returns:
        (M,) from 0 to 1; 1 where fewer than `_MIN_JUDGED` views tell.
    """
    total = np.bincount(point, weights=posed)
    share = np.bincount(point, weights=posed & agrees) / np.maximum(total, 1.0)
    return np.asarray(np.where(total < _MIN_JUDGED, 1.0, share)[point])


def matrices(poses: Sequence[FramePose]) -> FloatArray:
    """Poses gauge_from_cam (N,4,4), NaN where there is none."""
    none = np.full((4, 4), np.nan)
    found = [none if pose.gauge_from_cam is None else pose.gauge_from_cam for pose in poses]
    return np.array(found).reshape(-1, 4, 4)


def _between(keyframes: IntArray, map_from_cam: FloatArray, count: int) -> FloatArray:
    """Poses cam_from_map (count,4,4) interpolated between keyframes; the nearest one's outside them."""
    frames = np.arange(count)
    after = np.clip(np.searchsorted(keyframes, frames), 1, max(1, len(keyframes) - 1))
    after = np.minimum(after, len(keyframes) - 1)
    before = np.maximum(after - 1, 0)
    span = np.maximum(keyframes[after] - keyframes[before], 1)
    alpha = np.clip((frames - keyframes[before]) / span, 0.0, 1.0)
    return invert(interpolate_pose(map_from_cam[before], map_from_cam[after], alpha))


def _with_evidence(poses: list[FramePose], confirmed: IntArray) -> list[FramePose]:
    """Refuse the poses that hardly any confirmed point agrees with; `confirmed` counts them by frame."""
    posed = np.array([pose.gauge_from_cam is not None for pose in poses], dtype=bool)
    return _refused(poses, posed & (confirmed < _LEAST_CONFIRMED), FrameStatus.UNCONFIRMED)


def _without_doubtful(poses: list[FramePose], limits: PoseLimits) -> list[FramePose]:
    """Refuse the poses that jump away from both neighbours and back, and weak ones that stand alone."""
    centres = np.full((len(poses), 3), np.nan)
    sigma = np.full(len(poses), np.nan)
    for frame, pose in enumerate(poses):
        if pose.gauge_from_cam is not None and pose.covariance is not None:
            centres[frame] = pose.gauge_from_cam[:3, 3]
            # Neighbours share the map's error.
            sigma[frame] = np.sqrt(np.trace(pose.covariance[3:, 3:]) / MAP_VARIANCE_RATIO)
    out = _refused(poses, pose_jumps(centres, sigma), FrameStatus.POSE_JUMP)
    localised = np.array([pose.gauge_from_cam is not None for pose in out], dtype=bool)
    inliers = np.array([pose.inliers for pose in out], dtype=np.int64)
    lone = lone_poses(localised, inliers, _LONE_EVIDENCE * limits.min_inliers)
    return _refused(out, lone, FrameStatus.UNCONFIRMED)


def _refused(poses: list[FramePose], which: BoolArray, status: FrameStatus) -> list[FramePose]:
    return [
        FramePose(status=status, inliers=pose.inliers, error_px=pose.error_px) if which[frame] else pose
        for frame, pose in enumerate(poses)
    ]
