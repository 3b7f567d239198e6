"""Collect the metrics of a job for ``metrics.json``.

The metrics contain no run times, dates and host names, so equal jobs give equal files.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.export.earth import earth_of_world
from bodycap_batch.export.export_inputs import ExportInputs
from bodycap_batch.export.far_points import is_far
from bodycap_batch.export.target_frames import (
    WORLD,
    main_target_name,
    maps_in_target_frames,
    trajectories_in_target_frames,
)
from bodycap_batch.formats.dataclass_files import json_value
from bodycap_batch.model.geometry import invert, rotation_angle_rad, transform_points
from bodycap_batch.model.path_uncertainty import path_uncertainty
from bodycap_batch.model.relative_pose import RelativePose
from bodycap_batch.model.rotation_path import PosePath
from bodycap_batch.model.scene import FrameStatus, Map, Trajectory
from bodycap_batch.model.skeleton import Motion

METRICS_SCHEMA = 1
"""Version of the layout of ``metrics.json``. Another number means that a key was removed, or that it has
another meaning. Keys can be added at any time."""


def collect_metrics(inputs: ExportInputs, motion: Motion | None, gap: Mapping[str, Any]) -> dict[str, Any]:
    """Return all metrics of a job as plain JSON values.

    Args:
        inputs: The results of the earlier stages.
        motion: The exported motion; None without a body.
        gap: Difference of the exported motion from the motion graph and from the cameras (`Projection.gap`).
    """
    paths = (*inputs.trajectories, *inputs.other_paths)
    errors = [observation_errors(scene, paths) for scene in inputs.maps]
    trajectories = trajectories_in_target_frames(inputs)
    cameras = {path.camera: _camera_metrics(inputs, path, errors) for path in trajectories}
    out: dict[str, Any] = {
        "schema_version": METRICS_SCHEMA,
        "frame": main_target_name(inputs),
        "metric": main_target_name(inputs) == WORLD,
        "partial": inputs.partial_reason is not None,
        "partial_reason": inputs.partial_reason,
        "cameras": cameras,
        "total": _total_metrics(inputs, cameras, errors),
        "models": [
            {
                "frame": exported.target,
                "scale": None if exported.target_from_map is None else exported.target_from_map.scale,
                "keyframes": dict(sorted(Counter(exported.scene.keyframe_camera).items())),
                **_map_counts(exported.scene, errors[_map_index(inputs.maps, exported.scene)]),
            }
            for exported in maps_in_target_frames(inputs)
        ],
        "mapping": dict(inputs.log),
        "clocks": {name: _clock_metrics(inputs, name) for name in inputs.clocks},
    }
    notes = {name: list(clock.notes) for name, clock in inputs.clocks.items() if clock.notes}
    if notes:
        out["clock_notes"] = notes
        contradicted = [name for name, clock in inputs.clocks.items() if clock.is_contradicted]
        out["contradicted_clocks"] = contradicted
    if inputs.inertial:
        out["telemetry"] = {name: item.figures() for name, item in inputs.inertial.items()}
    if (earth := earth_of_world(inputs)) is not None:
        out["earth"] = earth.figures()
    if inputs.relative_poses:
        out["relative_poses"] = [_relative_pose_metrics(inputs, item) for item in inputs.relative_poses]
    if inputs.merge is not None:
        out["merge"] = {
            **inputs.merge.report.to_dict(),
            "unused_cameras": dict(inputs.merge.unused_cameras),
        }
        if (skeleton := inputs.merge.skeleton).notes or skeleton.warnings:
            out["merge"]["skeleton"] = {"notes": skeleton.notes, "warnings": skeleton.warnings}
    if motion is not None:
        out["motion"] = _motion_metrics(motion, gap)
    return dict(json_value(out))


def _clock_metrics(inputs: ExportInputs, camera: str) -> dict[str, Any]:
    """Return the clock of one camera, relative to the reference camera."""
    clock = inputs.clocks[camera]
    reference = inputs.clocks.get(inputs.reference_camera)
    base_s = 0.0 if reference is None else reference.offset_s
    return {
        "offset_s": clock.offset_s - base_s if clock.is_known else None,
        "sigma_s": clock.sigma_s if clock.is_known else None,
        "drift_ppm": clock.drift_ppm,
        "drift_sigma_ppm": clock.drift_sigma_ppm,
        "source": clock.source,
    }


def _map_index(maps: Sequence[Map], scene: Map) -> int:
    """Return the index of a map in a sequence. Maps are compared by identity, not by content."""
    return next(index for index, item in enumerate(maps) if item is scene)


def observation_errors(scene: Map, trajectories: Sequence[Trajectory]) -> FloatArray:
    """Return the reprojection error (M,) of every observation of a map, pixels at the work size.

    The work size is the image size that all stages work at. The poses of a camera with rolling-shutter
    correction are given at the exposure of the middle image row. The observed pixels of such a camera are
    first moved to this exposure.

    Args:
        scene: The map.
        trajectories: The trajectories of the cameras. Only trajectories in the map's gauge are used. The
            rolling-shutter correction computes the motion of the keyframes from these trajectories.
    """
    paths = {path.camera: path for path in trajectories if path.gauge == scene.gauge}
    out = np.full(len(scene.obs_px), np.nan)
    order = np.argsort(scene.obs_keyframe, kind="stable")
    bounds = np.searchsorted(scene.obs_keyframe[order], np.arange(len(scene.keyframe_camera) + 1))
    for keyframe, camera in enumerate(scene.keyframe_camera):
        observations = order[bounds[keyframe] : bounds[keyframe + 1]]
        if len(observations) == 0:
            continue
        points = scene.points[scene.obs_point[observations]]
        intrinsics, px = scene.cameras[camera], scene.obs_px[observations]
        if camera in paths and camera in scene.readout_s:
            path, frame = paths[camera], np.full(len(observations), scene.keyframe_frame[keyframe])
            poses = PosePath.create(path.gauge_from_cam, path.times_ns)
            seen = intrinsics, frame, points, px, scene.readout_s[camera]
            px = poses.with_fitted_rates(*seen).px_at_mid_row(*seen)
        projected = intrinsics.project(transform_points(invert(scene.map_from_cam[keyframe]), points))
        out[observations] = np.linalg.norm(projected - px, axis=1)
    return out


def _map_counts(scene: Map, errors: FloatArray) -> dict[str, Any]:
    """Return the numbers of points and observations, and the mean reprojection error."""
    return {
        "points": len(scene.points),
        "far_points": int(is_far(scene).sum()),
        "measurements": len(scene.obs_px),
        "mean_reprojection_error_px": _finite_mean(errors),
    }


def _camera_metrics(
    inputs: ExportInputs, trajectory: Trajectory, errors: Sequence[FloatArray]
) -> dict[str, Any]:
    """Return the metrics of one camera.

    Args:
        inputs: The results of the earlier stages.
        trajectory: The trajectory of the camera.
        errors: For each map, the (M,) reprojection errors of its observations, pixels at the work size.
    """
    name = trajectory.camera
    registered = trajectory.registered
    own = [np.isin(scene.obs_keyframe, scene.keyframes_of(name)) for scene in inputs.maps]
    map_errors = np.concatenate([np.zeros(0), *(each[seen] for each, seen in zip(errors, own, strict=True))])
    selected = [len(item.frames) for item in inputs.selections if item.camera == name]
    return {
        "frame": trajectory.gauge,
        "frames": len(registered),
        "frames_registered": int(registered.sum()),
        "frames_in_other_maps": trajectory.status.count(FrameStatus.OTHER_MAP),
        "frames_rotation_only": trajectory.status.count(FrameStatus.ROTATION_ONLY),
        "coverage": float(registered.mean()) if len(registered) else 0.0,
        "seconds": _duration_s(trajectory),
        "status": dict(sorted(Counter(status.value for status in trajectory.status).items())),
        "keyframes_selected": sum(selected) if selected else None,
        "keyframes": sum(scene.keyframe_camera.count(name) for scene in inputs.maps),
        "points": sum(
            len(np.unique(scene.obs_point[seen])) for scene, seen in zip(inputs.maps, own, strict=True)
        ),
        "measurements": sum(int(seen.sum()) for seen in own),
        "mean_reprojection_error_px": _finite_mean(map_errors),
        "registration": _registration_metrics(trajectory),
        **path_uncertainty(trajectory),
    }


def _duration_s(trajectory: Trajectory) -> float:
    """Return the time that the frames of a camera cover, seconds: each frame lasts until the next one."""
    intervals_s = np.diff(trajectory.seconds)
    return float(intervals_s.sum() + np.median(intervals_s)) if len(intervals_s) else 0.0


def _registration_metrics(trajectory: Trajectory) -> dict[str, Any]:
    """Return the metrics of the observations from which registration computed one camera's poses."""
    localised = trajectory.localised & np.isfinite(trajectory.error_px)
    inliers = trajectory.inliers[localised]
    total = int(inliers.sum())
    error = float((trajectory.error_px[localised] * inliers).sum() / total) if total else None
    return {
        "measurements": total,
        "median_inliers": float(np.median(inliers)) if len(inliers) else None,
        "mean_reprojection_error_px": error,
    }


def _relative_pose_metrics(inputs: ExportInputs, item: RelativePose) -> dict[str, Any]:
    """Return the metrics of the relative pose of two cameras on the same segment.

    Lengths are in metres if the cameras' map has a transform to the world. Otherwise lengths are in the unit
    of the map's gauge.
    """
    gauge = {path.camera: path.gauge for path in inputs.trajectories}.get(item.cameras[0])
    candidates = (exported for exported in maps_in_target_frames(inputs) if exported.scene.gauge == gauge)
    exported = next(candidates, None)
    target_from_map = None if exported is None else exported.target_from_map
    scale = 1.0 if target_from_map is None else target_from_map.scale
    pose = item.first_from_second
    return {
        "cameras": list(item.cameras),
        "instants": item.instants,
        "rigid": item.is_rigid,
        "turn_deg": float(np.degrees(rotation_angle_rad(pose[:3, :3]))) if item.instants else None,
        "translation": scale * pose[:3, 3],
        "spread_deg": float(np.degrees(item.spread_rad)),
        "explained_deg": float(np.degrees(item.explained_rad)),
        "spread": scale * item.spread,
    }


def _total_metrics(
    inputs: ExportInputs, cameras: Mapping[str, Mapping[str, Any]], errors: Sequence[FloatArray]
) -> dict[str, Any]:
    """Return the metrics of all cameras together."""

    def total(key: str) -> int:
        return sum(int(camera[key] or 0) for camera in cameras.values())

    frames, registered = total("frames"), total("frames_registered")
    return {
        "cameras": len(cameras),
        "cameras_registered": sum(camera["frames_registered"] > 0 for camera in cameras.values()),
        "frames": frames,
        "frames_registered": registered,
        "frames_in_other_maps": total("frames_in_other_maps"),
        "frames_rotation_only": total("frames_rotation_only"),
        "coverage": registered / frames if frames else 0.0,
        "keyframes_selected": total("keyframes_selected"),
        "keyframes": total("keyframes"),
        "points": sum(len(scene.points) for scene in inputs.maps),
        "measurements": total("measurements"),
        "mean_reprojection_error_px": _finite_mean(np.concatenate([np.zeros(0), *errors])),
    }


def _motion_metrics(motion: Motion, gap: Mapping[str, Any]) -> dict[str, Any]:
    """Return the metrics of the exported motion: frame rate, length, observed joints, and the gap.

    The gap is described in `collect_metrics`.
    """
    ratio = motion.observed.mean(axis=0) if len(motion.observed) else np.zeros(len(motion.skeleton.joints))
    return {
        "fps": motion.fps,
        "frames": len(motion.root_in_world_m),
        "start_s": motion.start_ns / 1e9,
        "skeleton": motion.skeleton.name,
        "joints": {
            name: {
                "role": motion.skeleton.roles[index] or None,
                "observed": bool(ratio[index] > 0),
                "observed_share": float(ratio[index]),
            }
            for index, name in enumerate(motion.skeleton.joints)
        },
        "gap": dict(gap),
    }


def _finite_mean(values: FloatArray) -> float | None:
    """Return the mean of the finite values; None if there are no finite values."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else None
