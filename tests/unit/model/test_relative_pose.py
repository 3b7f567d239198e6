"""Cameras held together by hardware: where they sit, and frames that one of them carries for another."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.config import RegistrationOptions
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.core.context import StageContext
from bodycap_batch.formats.dataclass_files import read_dataclass, write_dataclass
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.camera_clock import ClockRelation
from bodycap_batch.model.geometry import invert, make_transform, rotation_angle_rad, so3_exp
from bodycap_batch.model.map_diagnostics import MapDiagnostics
from bodycap_batch.model.relative_pose import RigPoses, estimate_relative_pose, match_instants, mean_rotation
from bodycap_batch.model.scene import FrameStatus, KeyframeSelection, Map, Registration, Trajectory
from bodycap_batch.registration import RegisteredCamera, register_in_rig
from bodycap_batch.registration.poses.batched_pnp import Observations, linearise, make_observations
from bodycap_batch.tasks import recover
from bodycap_batch.tasks.camera_group import CameraGroupTask
from bodycap_batch.tasks.inputs import ArtefactRef, CaptureRef
from bodycap_batch.tasks.registered_cameras import RIG_POSES
from bodycap_batch.tasks.registration import save_registration
from bodycap_batch.tasks.stage import read_summary

LENS = Camera(model="PINHOLE", width_px=640, height_px=480, params=np.array([420.0, 420.0, 320.0, 240.0]))
COUNT = 61
KEYFRAMES = np.array([0, 20, 40, 60])
FRAME_NS = 33_333_333
BLIND = range(24, 37)
FIRST_FROM_SECOND = make_transform(so3_exp([0.1, np.radians(50.0), -0.05]), [0.12, 0.02, -0.05])
NOISE_PX = 0.3


def _path() -> np.ndarray:
    """map_from_cam (F,4,4) of a body that walks, turns and sways."""
    t = np.arange(COUNT) / 30.0
    turns = so3_exp(np.stack([0.1 * np.sin(4 * t), 0.5 * t, 0.1 * np.cos(5 * t)], axis=1))
    return make_transform(turns, np.stack([0.5 * t, 0.05 * np.sin(6 * t), 0.3 * t], axis=1))


def _paths() -> dict[str, np.ndarray]:
    return {"torso": _path(), "torso_2": _path() @ FIRST_FROM_SECOND}


def _camera(name: str) -> CaptureCamera:
    return CaptureCamera(
        name=name,
        chapters=(),
        camera=LENS,
        calibrated=True,
        frame_numbers=np.arange(COUNT),
        times_ns=np.arange(COUNT) * FRAME_NS,
        nominal_fps=30.0,
        rolling_shutter_s=0.0,
    )


def _seen(
    path: np.ndarray, points: np.ndarray, rng: np.random.Generator
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Which points each frame sees, and where."""
    out = []
    for pose in path:
        x_in_cam = points @ invert(pose)[:3, :3].T + invert(pose)[:3, 3]
        px = LENS.project(x_in_cam)
        inside = (x_in_cam[:, 2] > 0.5) & ((px > 0) & (px < (640, 480))).all(axis=1)
        rows = np.flatnonzero(inside)
        out.append((rows, px[rows] + rng.normal(0.0, NOISE_PX, (len(rows), 2))))
    return out


def _registration(name: str, path: np.ndarray, seen: list[tuple[np.ndarray, np.ndarray]]) -> Registration:
    """Own poses a little off, none in `BLIND` of the first camera; all its views as tracks."""
    rng = np.random.default_rng(3)
    lost = np.array([name == "torso" and frame in BLIND for frame in range(COUNT)])
    noisy = path @ make_transform(so3_exp(rng.normal(0, 1e-3, (COUNT, 3))), rng.normal(0, 4e-3, (COUNT, 3)))
    poses = np.where(lost[:, None, None], np.nan, noisy)
    status = [FrameStatus.FEW_TRACKS if each else FrameStatus.REGISTERED for each in lost]
    parts = [
        (np.full(len(rows), frame), np.full(len(rows), KEYFRAMES[min(frame // 20, 2)]), rows, px)
        for frame, (rows, px) in enumerate(seen)
        if not lost[frame] and frame not in KEYFRAMES
    ]
    frame, keyframe, feature, px = (np.concatenate(each) for each in zip(*parts, strict=True))
    return Registration(
        trajectory=Trajectory(
            camera=name,
            gauge="map-0",
            frame_numbers=np.arange(COUNT),
            times_ns=np.arange(COUNT) * FRAME_NS,
            gauge_from_cam=poses,
            covariance=np.where(lost[:, None, None], np.nan, 1e-5 * np.eye(6)),
            status=tuple(status),
            inliers=np.zeros(COUNT, np.int64),
            error_px=np.zeros(COUNT),
        ),
        obs_frame=frame,
        obs_keyframe=keyframe,
        obs_feature=feature,
        obs_px=px.astype(np.float32),
        wanted_keyframes=np.zeros(0, np.int64),
        tried_keyframes=np.zeros(0, np.int64),
    )


def _rig() -> tuple[Map, list[RegisteredCamera]]:
    """Two cameras in a cloud of points; a point's feature number is its own in every keyframe."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-5, -3, -5), (5, 3, 7), (1500, 3))
    rows, cameras, observed = [], [], []
    for name, path in _paths().items():
        seen = _seen(path, points, rng)
        cameras.append(RegisteredCamera(camera=_camera(name), registration=_registration(name, path, seen)))
        for frame in KEYFRAMES.tolist():
            rows.append((name, frame, path[frame]))
            # A keyframe knows all points by their number, so that every view is a track of it.
            observed.append(seen[frame])
    counts = [len(each[0]) for each in observed]
    scene_map = Map(
        gauge="map-0",
        cameras={"torso": LENS, "torso_2": LENS},
        keyframe_camera=tuple(name for name, _, _ in rows),
        keyframe_frame=np.array([frame for _, frame, _ in rows]),
        map_from_cam=np.array([pose for _, _, pose in rows]),
        points=points,
        colors=np.zeros((len(points), 3), np.uint8),
        point_error_px=np.zeros(len(points)),
        obs_keyframe=np.repeat(np.arange(len(rows)), counts),
        obs_point=np.concatenate([each[0] for each in observed]),
        obs_feature=np.concatenate([each[0] for each in observed]),
        obs_px=np.concatenate([each[1] for each in observed]),
    )
    return scene_map, cameras


def _solved(scene_map: Map, own: RegisteredCamera, other: RegisteredCamera) -> Registration:
    selection = KeyframeSelection(
        camera=own.camera.name, frames=KEYFRAMES, frame_count=COUNT, sharpness=np.ones(COUNT), noise_px=0.2
    )
    return register_in_rig(own, [other], [scene_map], selection, RegistrationOptions())[0]


def test_a_camera_that_sees_nothing_is_carried_and_says_so() -> None:
    scene_map, (first, second) = _rig()
    found = _solved(scene_map, first, second).trajectory
    assert {found.status[frame] for frame in BLIND} == {FrameStatus.RIG}
    assert {found.status[frame] for frame in KEYFRAMES} == {FrameStatus.KEYFRAME}
    assert all(status.localised for status in found.status)
    error_m = np.linalg.norm(found.gauge_from_cam[:, :3, 3] - _path()[:, :3, 3], axis=1)
    # Carried ones have the error of the mean place beside the other, 4 mm · √2 · √3/√48 = 1.4 mm, and of its
    # pose: 0.3 px at 420 px and 5 m over the root of some 200 points, a few times that: below a millimetre.
    assert error_m[BLIND.start : BLIND.stop].max() < 0.006
    assert np.sqrt((error_m**2).mean()) < 0.004


def test_a_keyframe_with_few_observations_is_supported_by_the_rig() -> None:
    scene_map, (first, second) = _rig()
    kept = (scene_map.obs_keyframe != 1) | (np.cumsum(scene_map.obs_keyframe == 1) <= 5)
    poor = replace(
        scene_map,
        **{
            name: getattr(scene_map, name)[kept]
            for name in ("obs_keyframe", "obs_point", "obs_feature", "obs_px")
        },
    )
    found = _solved(poor, first, second).trajectory
    assert found.status[KEYFRAMES[1]] is FrameStatus.RIG


def test_relative_poses_of_the_rig_survive_recovery(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene_map, cameras = _rig()
    folders = [tmp_path / each.camera.name for each in cameras]
    for folder, each in zip(folders, cameras, strict=True):
        folder.mkdir()
        save_registration(each.registration, each.camera, folder, rolling=True)
    selection = KeyframeSelection(
        camera="torso", frames=KEYFRAMES, frame_count=COUNT, sharpness=np.ones(COUNT), noise_px=0.2
    )
    relative = estimate_relative_pose(*(each.registration.trajectory for each in cameras), 0)
    write_dataclass(RigPoses(relative=(relative,)), folders[0], RIG_POSES)
    capture = SimpleNamespace(cameras=tuple(each.camera for each in cameras))
    monkeypatch.setattr(recover, "load_capture", lambda *_, **__: capture)
    stored_map = SimpleNamespace(maps=(scene_map,), diagnostics=MapDiagnostics())
    monkeypatch.setattr(recover, "load_map", lambda _: stored_map)
    monkeypatch.setattr(recover, "load_keyframes", lambda _: selection)
    monkeypatch.setattr(
        "bodycap_batch.registration.recovery.recover.find_lost_poses", lambda found, *_: found
    )
    out = tmp_path / "out"
    out.mkdir()
    stored = {path.name: ArtefactRef(path=path, digest="") for path in folders}
    config = CaptureConfig(cameras=(CameraConfig(name="torso", video=(Path("torso.mp4"),)),))
    task = CameraGroupTask(
        options=RegistrationOptions(),
        cameras=tuple(stored),
        capture=CaptureRef(config=config, digests={}),
        keyframes=stored,
        map=ArtefactRef(path=tmp_path, digest=""),
        registrations=stored,
        offsets_s={},
    )
    recover.run_recover(task, StageContext(work_dir=tmp_path, threads=1), out)
    (kept,) = read_dataclass(RigPoses, out, RIG_POSES).relative
    assert kept.cameras == relative.cameras
    assert read_summary(out) == read_summary(folders[0])


def test_both_cameras_of_a_rig_get_poses_that_fit_together() -> None:
    scene_map, (first, second) = _rig()
    one = _solved(scene_map, first, second).trajectory.gauge_from_cam
    two = _solved(scene_map, second, first).trajectory.gauge_from_cam
    apart = invert(one) @ two
    off_m = np.linalg.norm(apart[:, :3, 3] - apart[0, :3, 3], axis=1)
    # A weak frame that is smoothed in one camera and not in the other moves by less than its sigma, 1 mm.
    assert np.median(off_m) < 2e-5
    assert off_m.max() < 1e-3
    assert np.linalg.norm(apart[0, :3, 3] - FIRST_FROM_SECOND[:3, 3]) < 0.005


def test_cameras_out_of_step_are_left_as_they_are() -> None:
    scene_map, (first, second) = _rig()
    late = replace(second, camera=replace(second.camera, clock=ClockRelation(offset_s=0.2)))
    assert _solved(scene_map, first, late) is first.registration


def test_the_mean_relative_pose_is_robust_and_reports_its_spread() -> None:
    _, (first, second) = _rig()
    poses = second.registration.trajectory.gauge_from_cam.copy()
    poses[::4, :3, 3] += 1.0
    poses[::4, :3, :3] = poses[::4, :3, :3] @ so3_exp([0.0, 0.5, 0.0])
    path = replace(second.registration.trajectory, gauge_from_cam=poses)
    found = estimate_relative_pose(first.registration.trajectory, path, 0)
    assert found.instants == COUNT - len(BLIND)
    off = found.first_from_second[:3, :3].T @ FIRST_FROM_SECOND[:3, :3]
    assert rotation_angle_rad(off) < 2e-3
    np.testing.assert_allclose(found.first_from_second[:3, 3], FIRST_FROM_SECOND[:3, 3], atol=0.006)
    # Both poses' 1 mrad and 4 mm an axis: medians of three axes √2 · 1.54 times that.
    assert 1e-3 < found.spread_rad < 5e-3
    assert 4e-3 < found.spread < 2e-2
    # Covariances of 1e-5 rad² an axis are stated for both.
    np.testing.assert_allclose(found.explained_rad, 1.538 * np.sqrt(2e-5), rtol=1e-9)


def test_in_another_map_no_instant_tells() -> None:
    _, (first, second) = _rig()
    found = estimate_relative_pose(
        first.registration.trajectory, replace(second.registration.trajectory, gauge="map-1"), 0
    )
    assert found.instants == 0
    assert np.isnan(found.spread)


def test_the_mean_rotation_of_equal_ones_is_theirs() -> None:
    turn = so3_exp([0.3, -2.0, 1.0])
    np.testing.assert_allclose(mean_rotation(np.tile(turn, (5, 1, 1))), turn, atol=1e-9)


@pytest.mark.parametrize(
    ("shift_ns", "expected"), [(0, 0), (4_000_000, 0), (12_000_000, -1), (33_333_333, 1)]
)
def test_time_stamps_of_one_exposure_may_be_rounded(shift_ns: int, expected: int) -> None:
    times_ns = np.arange(10) * FRAME_NS
    frame = match_instants(times_ns, times_ns[:5] + shift_ns)
    assert frame.tolist() == [each + expected if expected >= 0 else -1 for each in range(5)]


def test_the_derivative_is_that_of_the_rig_s_motion() -> None:
    rng = np.random.default_rng(5)
    points, px = rng.uniform((-1, -1, 3), (1, 1, 5), (8, 3)), rng.uniform(0, 480, (8, 2))
    alone = make_observations(LENS, np.array([0, 8]), points, px)
    places = np.array([np.eye(4), FIRST_FROM_SECOND])
    rig = Observations(
        bounds=alone.bounds, points=points, rays=alone.rays, px_from_ray=alone.px_from_ray,
        weight=alone.weight, member=np.array([0, 1] * 4), cam_from_rig=places,
    )  # fmt: skip
    pose, rows = make_transform(so3_exp([0.1, 0.2, 0.0]), [0.1, 0.0, 0.2]), np.arange(8)
    _, jacobian, _ = linearise(rig, rows, np.tile(pose, (8, 1, 1)))
    for axis in range(6):
        step = np.zeros(6)
        step[axis] = 1e-6
        ahead, behind = (
            linearise(
                rig, rows, np.tile(make_transform(so3_exp(s * step[:3]), s * step[3:]) @ pose, (8, 1, 1))
            )[0]
            for s in (1.0, -1.0)
        )
        np.testing.assert_allclose(jacobian[:, axis], (ahead - behind) / 2e-6, rtol=1e-4, atol=1e-2)
