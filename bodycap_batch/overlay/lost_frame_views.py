"""Predict what each lost frame sees: a part of the map, the wearer, or neither."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray, set_array
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.camera_clock import CameraClock
from bodycap_batch.model.geometry import invert, poses_at, transform_points
from bodycap_batch.model.merge_data import MergeResult
from bodycap_batch.model.scene import Map, Trajectory
from bodycap_batch.model.wearer_view import WearerView
from bodycap_batch.overlay.lens_field import field_margin, max_field_angle_rad
from bodycap_batch.overlay.wearer_prediction import predict_wearer_view

_MIN_POINTS = 30
"""Minimum number of visible map points in a frame that sees a part of the map. Evidence: none."""
_MIN_PICTURE_SHARE = 0.1
"""Minimum share of a picture's cells in which a frame that sees a part of the map has a map point. Evidence:
none."""
_CELLS = (10, 8)
"""Number of columns and rows of the cells of a picture."""
_MIN_BODY_SHARE = 0.4
"""Minimum share of the body in the picture of a frame that sees the wearer. Evidence: none."""
_MAX_GAP_NS = 1_000_000_000
"""Maximum time, nanoseconds, between two localised frames between which a pose is interpolated. It is used
without a body. Evidence: none."""
_MAX_SIGMA_M = 0.1
"""Maximum sigma, metres per axis, of a joint on the solved body whose camera gets a predicted pose. Evidence:
docs/decisions/report.md."""
_MAX_POINTS = 4000
"""Maximum number of map points that are projected. A larger map is thinned, and each point counts more."""


class LostView(StrEnum):
    """What a lost frame sees, according to its predicted pose.

    MAP: A part of the map, in front of the wearer.
    WEARER: Mostly the wearer's body, and hardly anything of the map.
    NOTHING: Neither a part of the map nor much of the wearer.
    UNKNOWN: The pose cannot be predicted, or the prediction is too uncertain.
    """

    MAP = "MAP"
    WEARER = "WEARER"
    NOTHING = "NOTHING"
    UNKNOWN = "UNKNOWN"


@dataclass(frozen=True, slots=True, kw_only=True)
class LostFrameViews:
    """What the lost frames of one camera see.

    Attributes:
        camera: Camera name.
        frame: (L,) index of each lost frame, increasing.
        view: (L,) what each frame sees.
        points: (L,) number of map points that should be visible; 0 if the pose is unknown.
        body_share: (L,) share of the wearer's body in the picture, 0 to 1; NaN if it is unknown.
    """

    camera: str
    frame: IntArray
    view: tuple[LostView, ...]
    points: IntArray
    body_share: FloatArray

    def __post_init__(self) -> None:
        count = len(self.view)
        set_array(self, "frame", (count,), np.int64)
        set_array(self, "points", (count,), np.int64)
        set_array(self, "body_share", (count,), finite=False)

    def by_frame(self) -> dict[int, LostView]:
        """Return what each lost frame sees, by frame index."""
        return dict(zip(self.frame.tolist(), self.view, strict=True))


def predict_lost_views(
    trajectories: Sequence[Trajectory],
    maps: Sequence[Map],
    clocks: Mapping[str, CameraClock],
    merge: MergeResult | None,
) -> dict[str, LostFrameViews]:
    """Predict what the lost frames of each camera see.

    With a body, the pose of a lost frame is that of the camera on the solved body. Without a body, it is
    interpolated between the localised frames before and after it. Frames whose poses merging removed are
    lost.

    Args:
        trajectories: The trajectory of each camera, in the gauge of the camera's map.
        maps: The maps.
        clocks: The clock of each camera, by camera name.
        merge: The solved body; None without a body.

    Returns:
        What the lost frames see, by camera name.
    """
    scenes = {scene.gauge: scene for scene in maps}
    merged = {} if merge is None else {path.camera: path for path in merge.trajectories}
    out = {}
    for path in trajectories:
        lost = np.flatnonzero(~merged.get(path.camera, path).localised)
        scene = scenes.get(path.gauge)
        if scene is None or path.camera not in scene.cameras:
            out[path.camera] = _unknown(path.camera, lost)
            continue
        lens = scene.cameras[path.camera]
        if merge is not None and path.camera in merged:
            common_ns = clocks[path.camera].common_times_ns(path.times_ns[lost])
            nothing = np.full((len(lost), 4, 4), np.nan)
            body = predict_wearer_view(merge, path.camera, lens, common_ns, nothing)
            points = [merge.world_from_map[key].apply(scenes[key].points) for key in merge.world_from_map]
            poses = body.world_from_cam.copy()
            poses[~(_sigma_m(merge, path.camera, common_ns) <= _MAX_SIGMA_M)] = np.nan
            out[path.camera] = _views(path.camera, lost, poses, np.concatenate(points), lens, body)
            continue
        found = np.flatnonzero(path.localised)
        poses, inside = poses_at(
            path.times_ns[found], path.gauge_from_cam[found], path.times_ns[lost], max_gap_ns=_MAX_GAP_NS
        )
        poses[~inside] = np.nan
        out[path.camera] = _views(path.camera, lost, poses, scene.points, lens, None)
    return out


def _sigma_m(merge: MergeResult, camera: str, common_ns: IntArray) -> FloatArray:
    """Return the sigma (L,) of the joint that carries a camera, metres per axis; NaN if it is unknown.

    Args:
        merge: The solved body.
        camera: Camera name.
        common_ns: (L,) common times, nanoseconds. The sigma is that of the nearest tick before.
    """
    role = next(mount.role for mount in merge.mounts if mount.camera == camera)
    ticks_ns = merge.times_ns()
    tick = np.clip(np.searchsorted(ticks_ns, common_ns, side="right") - 1, 0, len(ticks_ns) - 1)
    return np.asarray(merge.joint_sigma_m()[tick, merge.skeleton.index_of_role(role)])


def _views(
    camera: str,
    lost: IntArray,
    poses: FloatArray,
    points: FloatArray,
    lens: Camera,
    body: WearerView | None,
) -> LostFrameViews:
    """Return what the lost frames of one camera see.

    Args:
        camera: Camera name.
        lost: (L,) indices of the lost frames.
        poses: (L,4,4) predicted poses, from the camera to the frame of reference of the points; NaN if
            unknown.
        points: (P,3) points of the maps.
        lens: Intrinsics of the camera.
        body: The wearer's body in the lost frames; None if it is unknown.
    """
    every = max(1, -(-len(points) // _MAX_POINTS))
    max_angle_rad = max_field_angle_rad(lens)
    counts, views = np.zeros(len(lost), np.int64), []
    share = np.full(len(lost), np.nan) if body is None else body.share()
    for index, pose in enumerate(poses):
        if not np.isfinite(pose).all():
            views.append(LostView.UNKNOWN)
            continue
        x_in_cam = transform_points(invert(pose), points[::every])
        px = _visible_px(x_in_cam, lens, max_angle_rad, body, index)
        counts[index] = every * len(px)
        cells = (px / (lens.width_px, lens.height_px) * _CELLS).astype(np.int64)
        filled = len(np.unique(cells, axis=0)) / (_CELLS[0] * _CELLS[1])
        if counts[index] >= _MIN_POINTS and filled >= _MIN_PICTURE_SHARE:
            views.append(LostView.MAP)
        else:
            views.append(LostView.WEARER if share[index] >= _MIN_BODY_SHARE else LostView.NOTHING)
    return LostFrameViews(camera=camera, frame=lost, view=tuple(views), points=counts, body_share=share)


def _visible_px(
    x_in_cam: FloatArray, lens: Camera, max_angle_rad: float, body: WearerView | None, index: int
) -> FloatArray:
    """Return the pixels (V,2) of the points (P,3) that are in the picture and not behind the body."""
    inside = field_margin(x_in_cam, max_angle_rad, 0.0) > 0.0
    px = lens.project(x_in_cam[inside])
    shown = ((px >= 0.0) & (px < (lens.width_px, lens.height_px))).all(axis=1)
    px, points = px[shown], x_in_cam[inside][shown]
    if body is None or len(px) == 0:
        return px
    depth = body.depth_along_ray(points[:, :2] / points[:, 2:], np.full(len(points), index))
    return np.asarray(px[depth > np.linalg.norm(points, axis=1)])


def _unknown(camera: str, lost: IntArray) -> LostFrameViews:
    """Return the views of lost frames whose poses are unknown."""
    return LostFrameViews(
        camera=camera,
        frame=lost,
        view=(LostView.UNKNOWN,) * len(lost),
        points=np.zeros(len(lost), np.int64),
        body_share=np.full(len(lost), np.nan),
    )
