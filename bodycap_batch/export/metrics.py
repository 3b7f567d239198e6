"""``metrics.json``: the figures of a job. No clocks, durations or host names: the same job, the same file."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.export.inputs import ExportInputs
from bodycap_batch.export.placed import WORLD, main_frame, place_maps, place_trajectories
from bodycap_batch.model.geometry import invert, rotation_angle_rad, transform_points
from bodycap_batch.model.relative_pose import RelativePose
from bodycap_batch.model.rolling_shutter import at_mid_row, image_velocity
from bodycap_batch.model.scene import Map, Trajectory
from bodycap_batch.model.skeleton import Motion


def collect_metrics(inputs: ExportInputs, motion: Motion | None, gap: Mapping[str, Any]) -> dict[str, Any]:
    """All figures as plain JSON values.

    Args:
        inputs: The results.
        motion: The motion as exported, or None.
        gap: How far it is from the graph and the cameras.
    """
    errors = [observation_errors(scene, inputs.trajectories) for scene in inputs.maps]
    trajectories = place_trajectories(inputs)
    cameras = {item.camera: _camera(inputs, item, errors) for item in trajectories}
    out: dict[str, Any] = {
        "frame": main_frame(inputs),
        "metric": main_frame(inputs) == WORLD,
        "partial": inputs.partial_reason is not None,
        "partial_reason": inputs.partial_reason,
        "cameras": cameras,
        "total": _total(inputs, cameras, errors),
        "models": [
            {
                "frame": placed.frame,
                "scale": None if placed.target_from_map is None else placed.target_from_map.scale,
                "keyframes": dict(sorted(Counter(placed.scene.keyframe_camera).items())),
                **_table(placed.scene, errors[_index(inputs.maps, placed.scene)]),
            }
            for placed in place_maps(inputs)
        ],
        "mapping": dict(inputs.log),
    }
    if inputs.relative_poses:
        out["relative_poses"] = [_relative(inputs, item) for item in inputs.relative_poses]
    if inputs.merge is not None:
        out["merge"] = {
            **inputs.merge.report.to_dict(),
            "unused_cameras": dict(inputs.merge.unused_cameras),
        }
    if motion is not None:
        out["motion"] = _motion(motion, gap)
    return dict(_plain(out))


def _index(maps: Sequence[Map], scene: Map) -> int:
    return next(index for index, item in enumerate(maps) if item is scene)


def observation_errors(scene: Map, trajectories: Sequence[Trajectory]) -> FloatArray:
    """Reprojection error (M,) of every observation, pixels at the work size.

    Pixels of a camera whose rolling shutter was taken out are moved to the instant its poses hold for.

    Args:
        scene: The map.
        trajectories: The frames' poses; those in the map's gauge tell how its keyframes move.
    """
    paths = {path.camera: path for path in trajectories if path.gauge == scene.gauge}
    out = np.full(len(scene.obs_px), np.nan)
    order = np.argsort(scene.obs_keyframe, kind="stable")
    bounds = np.searchsorted(scene.obs_keyframe[order], np.arange(len(scene.keyframe_camera) + 1))
    for keyframe, camera in enumerate(scene.keyframe_camera):
        mine = order[bounds[keyframe] : bounds[keyframe + 1]]
        if len(mine) == 0:
            continue
        points = scene.points[scene.obs_point[mine]]
        lens, px = scene.cameras[camera], scene.obs_px[mine]
        if camera in paths and camera in scene.readout_s:
            path, frame = paths[camera], np.full(len(mine), scene.keyframe_frame[keyframe])
            velocity = image_velocity(lens, path.gauge_from_cam, path.times_ns, frame, points)
            px = at_mid_row(lens, px, velocity, scene.readout_s[camera])
        projected = lens.project(transform_points(invert(scene.map_from_cam[keyframe]), points))
        out[mine] = np.linalg.norm(projected - px, axis=1)
    return out


def _table(scene: Map, errors: FloatArray) -> dict[str, Any]:
    """Points, measurements and their mean error of one map."""
    return {
        "points": len(scene.points),
        "measurements": len(scene.obs_px),
        "mean_reprojection_error_px": _mean(errors),
    }


def _camera(inputs: ExportInputs, trajectory: Trajectory, errors: Sequence[FloatArray]) -> dict[str, Any]:
    """One camera's line of the tables."""
    name = trajectory.camera
    kept = trajectory.localised
    mine = [
        (
            np.array([camera == name for camera in scene.keyframe_camera], dtype=bool)[scene.obs_keyframe],
            scene,
        )
        for scene in inputs.maps
    ]
    mapped = [np.concatenate([np.zeros(0), *(e[seen] for (seen, _), e in zip(mine, errors, strict=True))])]
    selected = [len(item.frames) for item in inputs.selections if item.camera == name]
    return {
        "frame": trajectory.gauge,
        "frames": len(kept),
        "frames_registered": int(kept.sum()),
        "coverage": float(kept.mean()) if len(kept) else 0.0,
        "status": dict(sorted(Counter(status.value for status in trajectory.status).items())),
        "keyframes_selected": sum(selected) if selected else None,
        "keyframes": sum(scene.keyframe_camera.count(name) for scene in inputs.maps),
        "points": sum(len(np.unique(scene.obs_point[seen])) for seen, scene in mine),
        "measurements": sum(int(seen.sum()) for seen, _ in mine),
        "mean_reprojection_error_px": _mean(mapped[0]),
        "registration": _registration(trajectory),
    }


def _registration(trajectory: Trajectory) -> dict[str, Any]:
    """Measurements behind the frames' poses."""
    kept = trajectory.localised & np.isfinite(trajectory.error_px)
    weights = trajectory.inliers[kept]
    total = int(weights.sum())
    error = float((trajectory.error_px[kept] * weights).sum() / total) if total else None
    return {
        "measurements": total,
        "median_inliers": float(np.median(weights)) if len(weights) else None,
        "mean_reprojection_error_px": error,
    }


def _relative(inputs: ExportInputs, item: RelativePose) -> dict[str, Any]:
    """Where one camera of a segment sits beside another: metres in the world, else the map's unit."""
    gauge = {path.camera: path.gauge for path in inputs.trajectories}.get(item.cameras[0])
    placed = next((each for each in place_maps(inputs) if each.scene.gauge == gauge), None)
    target_from_map = None if placed is None else placed.target_from_map
    scale = 1.0 if target_from_map is None else target_from_map.scale
    pose = item.first_from_second
    return {
        "cameras": list(item.cameras),
        "instants": item.instants,
        "rigid": item.rigid,
        "turn_deg": float(np.degrees(rotation_angle_rad(pose[:3, :3]))) if item.instants else None,
        "translation": scale * pose[:3, 3],
        "spread_deg": float(np.degrees(item.spread_rad)),
        "explained_deg": float(np.degrees(item.explained_rad)),
        "spread": scale * item.spread,
    }


def _total(
    inputs: ExportInputs, cameras: Mapping[str, Mapping[str, Any]], errors: Sequence[FloatArray]
) -> dict[str, Any]:
    """All cameras together."""

    def added(key: str) -> int:
        return sum(int(camera[key] or 0) for camera in cameras.values())

    frames, registered = added("frames"), added("frames_registered")
    return {
        "cameras": len(cameras),
        "cameras_registered": sum(camera["frames_registered"] > 0 for camera in cameras.values()),
        "frames": frames,
        "frames_registered": registered,
        "coverage": registered / frames if frames else 0.0,
        "keyframes_selected": added("keyframes_selected"),
        "keyframes": added("keyframes"),
        "points": sum(len(scene.points) for scene in inputs.maps),
        "measurements": added("measurements"),
        "mean_reprojection_error_px": _mean(np.concatenate([np.zeros(0), *errors])),
    }


def _motion(motion: Motion, gap: Mapping[str, Any]) -> dict[str, Any]:
    """The exported motion: rate, length, what was measured, and the gap."""
    share = motion.observed.mean(axis=0) if len(motion.observed) else np.zeros(len(motion.skeleton.joints))
    return {
        "fps": motion.fps,
        "frames": len(motion.root_in_world_m),
        "start_s": motion.start_ns / 1e9,
        "skeleton": motion.skeleton.name,
        "joints": {
            name: {
                "role": motion.skeleton.roles[index] or None,
                "observed": bool(share[index] > 0),
                "observed_share": float(share[index]),
            }
            for index, name in enumerate(motion.skeleton.joints)
        },
        "gap": dict(gap),
    }


def _mean(values: FloatArray) -> float | None:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else None


def _plain(value: Any) -> Any:
    """JSON values: numpy scalars and arrays unwrapped, NaN and infinity as null."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
