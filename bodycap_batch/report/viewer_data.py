"""Make the data of the 3D viewer: points, camera paths and the moving skeleton."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import FloatArray, evenly_spaced
from bodycap_batch.model.geometry import quat_xyzw_from_rotation
from bodycap_batch.model.merge_data import MergeResult
from bodycap_batch.model.skeleton import SkeletonModel
from bodycap_batch.report.drawn_scene import DrawnPath, DrawnScene
from bodycap_batch.report.packing import PageBudget, affordable_count, pack_bytes, pack_scaled
from bodycap_batch.report.report_inputs import ReportInputs

MAX_POINTS = 50_000
"""Maximum number of drawn map points.

With more points, a software renderer could not rotate the view smoothly. A user could not distinguish more
points either.
"""
_PATH_BUDGET = 1_300_000
"""Maximum number of base64 characters of all camera paths together. Evidence: none."""
_MOTION_BUDGET = 2_000_000
"""Maximum number of base64 characters of the body's motion. Evidence: none."""
_POSE_BYTES = 16
"""Number of bytes of one pose of a path: 16 bits for each number of position, quaternion and time."""
_MAX_DISTANCE = 4.0
"""Maximum distance of a drawn point from the scene's centre, as a multiple of the scene's half width.

The distance is measured along each axis. Evidence: none.
"""


def make_viewer_data(inputs: ReportInputs, scene: DrawnScene, budget: PageBudget) -> dict[str, Any]:
    """Return everything that the viewer draws, as JSON values.

    Args:
        inputs: The results of the job.
        scene: Maps and camera paths in the drawn frame of reference.
        budget: The budget of the page. It records how many items of each kind are shown.
    """
    points, colours = _select_points(scene, budget)
    path_budget = budget.scaled(_PATH_BUDGET) // max(1, len(scene.paths))
    return {
        "metric": scene.is_metric,
        "points": pack_scaled(points),
        "colours": pack_bytes(colours),
        "paths": [_pack_path(path, path_budget, budget) for path in scene.paths],
        "body": None if inputs.merge is None else _pack_body(inputs.merge, budget),
        "view": _initial_view(scene, inputs.merge, points),
    }


def _select_points(scene: DrawnScene, budget: PageBudget) -> tuple[FloatArray, npt.NDArray[np.uint8]]:
    """Select the map points to draw, in random order.

    Returns:
        The positions (P,3) in the drawn frame of reference, and the RGB colours (P,3).
    """
    clouds = [scene.drawn_from_map[one_map.gauge].apply(one_map.points) for one_map in scene.maps]
    points = np.concatenate([np.zeros((0, 3)), *clouds])
    colours = np.concatenate([np.zeros((0, 3), np.uint8), *(one_map.colors for one_map in scene.maps)])
    selected = np.arange(len(points))
    if len(points):
        centre, radius = _extent(scene, points)
        selected = np.flatnonzero(np.abs(points - centre).max(axis=1) < _MAX_DISTANCE * radius)
    # On a slow computer the viewer draws only the first points while the view moves. Because of the random
    # order, the first points form a thinner cloud of the same shape.
    selected = np.random.default_rng(0).permutation(selected)[: budget.scaled(MAX_POINTS)]
    budget.record("points of the map", len(selected), len(points))
    return points[selected], np.asarray(colours[selected], dtype=np.uint8)


def _extent(scene: DrawnScene, points: FloatArray) -> tuple[FloatArray, float]:
    """Return the scene's centre (3,) and the scene's half width.

    The centre is the median camera position. If there are no cameras, it is the median point. A cube around
    the centre with this half width contains all cameras and 90 % of the points.
    """
    centres = _camera_centres(scene)
    middle = np.median(centres if len(centres) else points, axis=0)
    point_distance = np.percentile(np.abs(points - middle).max(axis=1), 90)
    camera_distance = np.abs(centres - middle).max(initial=0.0)
    return np.asarray(middle), float(max(point_distance, camera_distance, 1e-9))


def _camera_centres(scene: DrawnScene) -> FloatArray:
    """Return the camera centres (N,3) of all registered frames, in the drawn frame of reference."""
    centres = np.concatenate([np.zeros((0, 3)), *(path.poses[:, :3, 3] for path in scene.paths)])
    return np.asarray(centres[np.isfinite(centres).all(axis=1)])


def _pack_path(path: DrawnPath, characters: int, budget: PageBudget) -> dict[str, Any]:
    kept = evenly_spaced(len(path.poses), affordable_count(characters, _POSE_BYTES + 4))
    localised = np.asarray(np.isfinite(path.poses).all(axis=(1, 2)))
    budget.record("frames on the camera paths", int(localised[kept].sum()), int(localised.sum()))
    quats = np.full((len(path.poses), 4), np.nan)
    quats[localised] = quat_xyzw_from_rotation(path.poses[localised, :3, :3])
    return {
        "camera": path.camera,
        "time": pack_scaled(path.times_s[kept, None]),
        "centre": pack_scaled(path.poses[kept, :3, 3]),
        "quat": pack_scaled(quats[kept]),
        "keyframe": pack_bytes(path.keyframe[kept].astype(np.uint8)),
    }


def _pack_body(merge: MergeResult, budget: PageBudget) -> dict[str, Any]:
    """Return the centres of joints and the tips of end joints over time, with the skeleton's structure."""
    skeleton = merge.skeleton
    times = merge.times_ns() * 1e-9
    end_joints = np.flatnonzero(np.isfinite(skeleton.end_offsets_m).all(axis=1))
    joint_count = len(skeleton.joints)
    sigma = known_joint_sigma_m(merge)
    columns = 3 * (joint_count + len(end_joints)) + joint_count // 2 + (0 if sigma is None else joint_count)
    kept = evenly_spaced(len(times), affordable_count(budget.scaled(_MOTION_BUDGET), 2 * columns))
    budget.record("ticks of the motion", len(kept), len(times))
    poses = merge.motion.world_from_joint()[kept]
    end_poses = poses[:, end_joints]
    tip_offsets = np.einsum("tnij,nj->tni", end_poses[..., :3, :3], skeleton.end_offsets_m[end_joints])
    centres = np.concatenate([poses[:, :, :3, 3], tip_offsets + end_poses[..., :3, 3]], axis=1)
    return {
        "joints": list(skeleton.joints),
        "parents": [*(int(parent) for parent in skeleton.parents), *(int(joint) for joint in end_joints)],
        "solved": [bool(solved) for solved in merge.solved],
        "fps": merge.fps,
        "across": _across(skeleton),
        "time": [round(float(time), 6) for time in times[kept]],
        "centres": {**pack_scaled(centres.reshape(-1, 3)), "shape": list(centres.shape)},
        "observed": pack_bytes(merge.observed[kept].astype(np.uint8)),
        "sigma": None if sigma is None else pack_scaled(sigma[kept]),
    }


def _across(skeleton: SkeletonModel) -> list[int] | None:
    """Return a joint of the left side and the same joint of the right side; None without such a pair."""
    for part in ("UpLeg", "Arm", "Shoulder"):
        pair = [skeleton.index_of_role(f"{side}{part}") for side in ("Left", "Right")]
        if pair[0] is not None and pair[1] is not None:
            return [pair[0], pair[1]]
    return None


def known_joint_sigma_m(merge: MergeResult) -> FloatArray | None:
    """Return the sigma (T,J) of each joint's position per axis, metres.

    An unknown sigma is NaN. The result is None if every sigma is unknown.
    """
    sigma = merge.joint_sigma_m()
    return sigma if np.isfinite(sigma).any() else None


def _initial_view(scene: DrawnScene, merge: MergeResult | None, points: FloatArray) -> dict[str, Any]:
    """Return the centre and the radius of the region that the viewer shows when the page opens."""
    centres = _camera_centres(scene)
    if merge is not None:
        centres = np.concatenate([centres, merge.motion.root_in_world_m])
    if len(centres) == 0:
        return {"centre": [0.0, 0.0, 0.0], "radius": 1.0}
    low, high = np.percentile(centres, [2, 98], axis=0)
    middle = 0.5 * (low + high)
    room_radius = np.percentile(np.linalg.norm(points - middle, axis=1), 75) if len(points) else 0.0
    path_radius = 0.6 * float(np.linalg.norm(high - low))
    radius = max(path_radius, 0.55 * float(room_radius), 1.2 if scene.is_metric else 1e-6)
    return {"centre": [round(float(value), 4) for value in middle], "radius": round(radius, 6)}
