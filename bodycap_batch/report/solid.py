"""The three-dimensional part of the page: points, camera paths and the moving skeleton."""

from __future__ import annotations

from typing import Any

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.geometry import quat_xyzw_from_rotation
from bodycap_batch.model.merge_data import MergeResult
from bodycap_batch.report.inputs import ReportInputs
from bodycap_batch.report.packing import Shown, affordable, pack_bytes, pack_scaled, thinned
from bodycap_batch.report.placing import Placed, PlacedPath

MAX_POINTS = 50_000
"""More than a software renderer turns smoothly, and than an eye tells apart at the panel's size."""
_PATH_BUDGET = 1_300_000
_MOTION_BUDGET = 2_000_000
_POSE_BYTES = 16
_REACH = 4.0
"""Points further from the cameras than so many times the scene's half width are drawn by nobody."""


def solid_data(inputs: ReportInputs, placed: Placed, shown: Shown) -> dict[str, Any]:
    """All that the viewer draws, as JSON values.

    Args:
        inputs: The results.
        placed: Maps and paths in the frame that is drawn.
        shown: Told how much was thinned.
    """
    points, colours = _points(placed, shown)
    share = shown.of(_PATH_BUDGET) // max(1, len(placed.paths))
    return {
        "metric": placed.metric,
        "points": pack_scaled(points),
        "colours": pack_bytes(colours),
        "paths": [_path(path, share, shown) for path in placed.paths],
        "body": None if inputs.merge is None else _body(inputs.merge, shown),
        "view": _view(placed, inputs.merge, points),
    }


def _points(placed: Placed, shown: Shown) -> tuple[FloatArray, np.ndarray[Any, np.dtype[np.uint8]]]:
    clouds = [placed.drawn_from_map[scene.gauge].apply(scene.points) for scene in placed.maps]
    points = np.concatenate([np.zeros((0, 3)), *clouds])
    colours = np.concatenate([np.zeros((0, 3), np.uint8), *(scene.colors for scene in placed.maps)])
    keep = np.arange(len(points))
    if len(points):
        centre, radius = _extent(placed, points)
        keep = np.flatnonzero(np.abs(points - centre).max(axis=1) < _REACH * radius)
    # In random order: the viewer draws the first of them only while it moves on a slow machine.
    keep = np.random.default_rng(0).permutation(keep)[: shown.of(MAX_POINTS)]
    shown.note("points of the map", len(keep), len(points))
    return points[keep], np.asarray(colours[keep], dtype=np.uint8)


def _extent(placed: Placed, points: FloatArray) -> tuple[FloatArray, float]:
    """Middle of the cameras, and how far they and nine tenths of the points are from it."""
    centres = _centres(placed)
    middle = np.median(centres if len(centres) else points, axis=0)
    away = np.percentile(np.abs(points - middle).max(axis=1), 90)
    walked = np.abs(centres - middle).max(initial=0.0)
    return np.asarray(middle), float(max(away, walked, 1e-9))


def _centres(placed: Placed) -> FloatArray:
    centres = [path.poses[:, :3, 3] for path in placed.paths]
    joined = np.concatenate([np.zeros((0, 3)), *centres])
    return np.asarray(joined[np.isfinite(joined).all(axis=1)])


def _path(path: PlacedPath, budget: int, shown: Shown) -> dict[str, Any]:
    keep = thinned(len(path.poses), affordable(budget, _POSE_BYTES + 4))
    posed = np.asarray(np.isfinite(path.poses).all(axis=(1, 2)))
    shown.note("frames on the camera paths", int(posed[keep].sum()), int(posed.sum()))
    quats = np.full((len(path.poses), 4), np.nan)
    quats[posed] = quat_xyzw_from_rotation(path.poses[posed, :3, :3])
    return {
        "camera": path.camera,
        "time": pack_scaled(path.times_s[keep, None]),
        "centre": pack_scaled(path.poses[keep, :3, 3]),
        "quat": pack_scaled(quats[keep]),
        "keyframe": pack_bytes(path.keyframe[keep].astype(np.uint8)),
    }


def _body(merge: MergeResult, shown: Shown) -> dict[str, Any]:
    """Joint centres and bone ends over time."""
    skeleton = merge.skeleton
    times = merge.times_ns() * 1e-9
    ends = np.flatnonzero(np.isfinite(skeleton.end_offsets_m).all(axis=1))
    joints, extra = len(skeleton.joints), len(ends)
    sigma = joint_sigma_m(merge)
    columns = 3 * (joints + extra) + joints // 2 + (0 if sigma is None else joints)
    keep = thinned(len(times), affordable(shown.of(_MOTION_BUDGET), 2 * columns))
    shown.note("ticks of the motion", len(keep), len(times))
    poses = merge.motion.world_from_joint()[keep]
    tips = np.einsum("tnij,nj->tni", poses[:, ends][..., :3, :3], skeleton.end_offsets_m[ends])
    centres = np.concatenate([poses[:, :, :3, 3], tips + poses[:, ends][..., :3, 3]], axis=1)
    return {
        "joints": list(skeleton.joints),
        "parents": [*(int(parent) for parent in skeleton.parents), *(int(joint) for joint in ends)],
        "solved": [bool(each) for each in merge.solved],
        "fps": merge.fps,
        "time": [round(float(time), 6) for time in times[keep]],
        "centres": {**pack_scaled(centres.reshape(-1, 3)), "shape": list(centres.shape)},
        "observed": pack_bytes(merge.observed[keep].astype(np.uint8)),
        "sigma": None if sigma is None else pack_scaled(sigma[keep]),
    }


def joint_sigma_m(merge: MergeResult) -> FloatArray | None:
    """(T,J) sigma per axis of each joint, metres, NaN where unknown; None where the solver told none."""
    sigma = merge.joint_sigma_m()
    return sigma if np.isfinite(sigma).any() else None


def _view(placed: Placed, merge: MergeResult | None, points: FloatArray) -> dict[str, Any]:
    """Where to look from the start."""
    centres = _centres(placed)
    if merge is not None:
        centres = np.concatenate([centres, merge.motion.root_in_world_m])
    if len(centres) == 0:
        return {"centre": [0.0, 0.0, 0.0], "radius": 1.0}
    low, high = np.percentile(centres, [2, 98], axis=0)
    middle = 0.5 * (low + high)
    room = np.percentile(np.linalg.norm(points - middle, axis=1), 75) if len(points) else 0.0
    walked = 0.6 * float(np.linalg.norm(high - low))
    radius = max(walked, 0.55 * float(room), 1.2 if placed.metric else 1e-6)
    return {"centre": [round(float(value), 4) for value in middle], "radius": round(radius, 6)}
