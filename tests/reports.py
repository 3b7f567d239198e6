"""Results of a job for tests of the report: a walking body, three cameras and their map, without videos."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from bodycap_batch.core.context import StageContext
from bodycap_batch.export.export_inputs import ExportInputs
from bodycap_batch.export.metrics import collect_metrics
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.camera_clock import CameraClock
from bodycap_batch.model.geometry import Similarity, invert, transform_points
from bodycap_batch.model.merge_report import MergeReport
from bodycap_batch.model.scene import FrameStatus, KeyframeSelection, Map, Registration, Trajectory
from bodycap_batch.report import ReportInputs, write_report
from tests.bodies import CAMERAS, merged, reaching

LENS = Camera(model="PINHOLE", width_px=640, height_px=480, params=np.array([420.0, 420.0, 320.0, 240.0]))
GAUGE = "map-0"
WORLD = Similarity(1.0, np.eye(3), np.zeros(3))
_MAX_OBSERVATIONS = 40
"""Points that a frame observes at most."""


def report_inputs(frames: int = 60, points: int = 400, *, lost: slice = slice(20, 25)) -> ReportInputs:
    """Return the results of a job.

    The body walks all the time. Each registered frame observes up to 40 points of the map.

    Args:
        frames: Number of frames of each camera.
        points: Number of points of the map.
        lost: Frames of each camera without a pose.
    """
    result, clocks = merged(reaching(frames), world_from_map={GAUGE: WORLD}, projected=frames <= 120)
    rng = np.random.default_rng(5)
    low, high = (
        result.graph_world_from_joint[..., :3, 3].min((0, 1)),
        result.graph_world_from_joint[..., :3, 3].max((0, 1)),
    )
    cloud = rng.uniform(low - 2.0, high + 2.0, size=(points, 3))
    paths = tuple(_with_losses(path, lost) for path in result.trajectories)
    report = MergeReport.from_dict({**result.report.to_dict(), **_merge_report(paths)})
    variances = np.where(result.solved[:, None, None], np.diag([1e-4, 2e-4, 3e-4]), np.nan)
    covariance = np.tile(variances, (frames, 1, 1, 1))
    result = replace(result, trajectories=paths, report=report, joint_covariance_m2=covariance)
    registrations = tuple(_registered(path, cloud, rng) for path in paths)
    scene = _map(paths, cloud, rng)
    selections = tuple(_selection(path, rng) for path in paths)
    export = ExportInputs(
        out_dir=None,  # type: ignore[arg-type]
        maps=(scene,),
        trajectories=tuple(replace(path, gauge=GAUGE) for path in paths),
        clocks=clocks,
        selections=selections,
        merge=result,
        log={"reach": {"judged": True, "distances": 90, "within_reach": 1.0}},
    )
    motion = result.motion if frames <= 120 else None
    return ReportInputs(
        name="a walk <in> the lab",
        cameras=tuple(CAMERAS),
        maps=(scene,),
        registrations=registrations,
        clocks=clocks,
        selections=selections,
        merge=result,
        mounts=result.mounts,
        metrics=collect_metrics(export, motion, dict(result.projection_gap)),
    )


def clock() -> CameraClock:
    return CameraClock(nominal_fps=30.0)


def _with_losses(path: Trajectory, lost: slice) -> Trajectory:
    poses, status = path.gauge_from_cam.copy(), [FrameStatus.REGISTERED] * len(path.status)
    kept = np.ones(len(status), dtype=bool)
    kept[lost] = False
    rng = np.random.default_rng(len(path.camera))
    for index in np.flatnonzero(~np.isfinite(poses).all(axis=(1, 2)) & kept):
        poses[index] = poses[index - 1] if np.isfinite(poses[index - 1]).all() else np.eye(4)
    poses[~kept] = np.nan
    for index in np.flatnonzero(~kept):
        status[index] = FrameStatus.BLUR
    for index in np.flatnonzero(kept)[::10]:
        status[index] = FrameStatus.KEYFRAME
    return replace(
        path,
        gauge_from_cam=poses,
        covariance=np.where(kept[:, None, None], np.eye(6) * 1e-4, np.nan),
        status=tuple(status),
        inliers=np.where(kept, 80 + rng.integers(0, 40, len(kept)), 3),
        error_px=np.where(kept, rng.uniform(0.4, 0.6, len(kept)), np.nan),
    )


def _merge_report(paths: tuple[Trajectory, ...]) -> dict[str, object]:
    """Return merging's report on camera paths."""
    residual = {"p50": 0.001, "p95": 0.004}
    mount = {"sigma_deg": 3.0, "sigma_m": 0.01, "from_prior_deg": 8.0, "from_prior_m": 0.02, "roll_deg": 90.0}
    return {
        "scale": {
            "source": "height",
            "relative_sigma": 0.045,
            "sources": [{"name": "height", "relative_sigma": 0.045, "off": -0.012, "used": True}],
            "chi2": 0.0,
            "degrees_of_freedom": 0,
        },
        "mounts": {path.camera: {"role": CAMERAS[path.camera], **mount} for path in paths},
        "cameras": {
            path.camera: {
                "measurements": int(path.localised.sum()),
                "dropped_as_gross_errors": 0,
                "down_weighted": 1,
                "residual_m": residual,
                "residual_deg": {"p50": 0.1, "p95": 0.4},
                "longest_gap_s": 0.2,
            }
            for path in paths
        },
        "joint_gap_m": {"LeftHand": {"p50": 0.0002, "p95": 0.0006}},
        "hinge_off_plane_m": {"LeftForeArm": {"p50": 0.001, "p95": 0.0071}},
        "joined_cameras": {},
        "activity": {
            "name": "walk",
            "rules_active": {"Left palm below the shoulder": 0.125, "Right palm below the shoulder": 0.0},
            "rules_pressed_m": {"Left palm below the shoulder": {"p50": 0.011, "p95": 0.043}},
        },
    }


def _observe(pose: np.ndarray, cloud: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return up to 40 points in the image and their pixels."""
    x_in_cam = transform_points(invert(pose), cloud)
    px = LENS.project(x_in_cam)
    inside = np.flatnonzero((x_in_cam[:, 2] > 0.2) & (np.abs(px / [640, 480] - 0.5) < 0.5).all(axis=1))
    chosen = np.sort(rng.permutation(inside)[:_MAX_OBSERVATIONS])
    return chosen, px[chosen]


def _registered(path: Trajectory, cloud: np.ndarray, rng: np.random.Generator) -> Registration:
    """Return a registration; each track starts at a feature of the camera's first keyframe."""
    first = path.status.index(FrameStatus.KEYFRAME)
    rows = [
        (index, *_observe(path.gauge_from_cam[index], cloud, rng)) for index in np.flatnonzero(path.localised)
    ]
    counts = [len(points) for _, points, _ in rows]
    features = np.concatenate([points for _, points, _ in rows])
    return Registration(
        trajectory=replace(path, gauge=GAUGE),
        obs_frame=np.repeat([index for index, _, _ in rows], counts),
        obs_keyframe=np.full(len(features), first),
        obs_feature=features,
        obs_px=np.concatenate([px for _, _, px in rows]).astype(np.float32),
        wanted_keyframes=np.zeros(0, np.int64),
        tried_keyframes=np.zeros(0, np.int64),
    )


def _map(paths: tuple[Trajectory, ...], cloud: np.ndarray, rng: np.random.Generator) -> Map:
    """Return a map. A camera's first keyframe observes all points, so every track has a feature there."""
    names, frames, poses, keyframe, point, pixels = [], [], [], [], [], []
    for path in paths:
        keys = [index for index, status in enumerate(path.status) if status is FrameStatus.KEYFRAME]
        for order, index in enumerate(keys):
            chosen, px = _observe(path.gauge_from_cam[index], cloud, rng)
            if order == 0:
                chosen, px = np.arange(len(cloud)), np.zeros((len(cloud), 2))
                px[:] = np.nan_to_num(
                    LENS.project(transform_points(invert(path.gauge_from_cam[index]), cloud))
                )
            keyframe += [len(names)] * len(chosen)
            point.append(chosen)
            pixels.append(px)
            names.append(path.camera)
            frames.append(index)
            poses.append(path.gauge_from_cam[index])
    points = np.concatenate(point)
    return Map(
        gauge=GAUGE,
        cameras=dict.fromkeys(CAMERAS, LENS),
        keyframe_camera=tuple(names),
        keyframe_frame=np.array(frames),
        map_from_cam=np.stack(poses),
        points=cloud,
        colors=rng.integers(0, 256, size=cloud.shape).astype(np.uint8),
        point_error_px=np.full(len(cloud), 0.5),
        obs_keyframe=np.array(keyframe),
        obs_point=points,
        obs_feature=points,
        obs_px=np.concatenate(pixels),
    )


def _selection(path: Trajectory, rng: np.random.Generator) -> KeyframeSelection:
    keys = [index for index, status in enumerate(path.status) if status is FrameStatus.KEYFRAME]
    sharp = np.where(path.localised, 10.0, 3.0) + rng.uniform(0, 1, len(path.status))
    return KeyframeSelection(
        camera=path.camera,
        frames=np.array(keys),
        frame_count=len(path.status),
        sharpness=sharp,
        noise_px=0.4,
    )


def written(inputs: ReportInputs, folder: Path) -> str:
    """Write the page into a folder and return its text."""
    path = folder / "report.html"
    write_report(inputs, path, StageContext(work_dir=folder))
    return path.read_text(encoding="utf-8")
