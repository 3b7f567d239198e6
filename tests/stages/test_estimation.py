"""Keyframes, map and registration on a rendered capture with exact poses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.capture import open_capture
from bodycap_batch.config import KeyframeOptions, MapOptions, RegistrationOptions
from bodycap_batch.config.job import load_job
from bodycap_batch.core.errors import CaptureError, EstimationError
from bodycap_batch.keyframes import select_keyframes
from bodycap_batch.mapping import build_map, extend_map
from bodycap_batch.model.geometry import Similarity, align_points, rotation_angle_rad, so3_exp
from bodycap_batch.model.scene import FrameStatus, Map
from bodycap_batch.registration import register_frames
from tests.rooms import look, make_transform, write_capture
from tests.stages.conftest import DARK, FRAMES, Estimated, context

# With a focal length of 210 px at about 3 m, one pixel is 14 mm. A pose of 100 points at 0.6 px has an error
# of about 3 mm, with tracking drift. Three times that bounds the RMS; no error can be below a tenth of it.
MAX_ATE_M, MIN_ATE_M = 0.012, 0.0003


def _errors(estimated: Estimated) -> tuple[np.ndarray, Similarity]:
    """Return the position errors in metres, with all cameras under one similarity."""
    mine, theirs = [], []
    for item in estimated.registrations:
        known = item.trajectory.localised
        mine.append(item.trajectory.gauge_from_cam[known][:, :3, 3])
        theirs.append(estimated.truth[item.trajectory.camera][known][:, :3, 3])
    world_from_map = align_points(np.concatenate(mine), np.concatenate(theirs))
    error = np.linalg.norm(world_from_map.apply(np.concatenate(mine)) - np.concatenate(theirs), axis=1)
    return error, world_from_map


def test_every_lit_frame_is_localised_to_a_centimetre(estimated: Estimated) -> None:
    error, world_from_map = _errors(estimated)
    assert MIN_ATE_M < np.sqrt((error**2).mean()) < MAX_ATE_M
    for item in estimated.registrations:
        dark = (
            np.isin(np.arange(FRAMES), DARK)
            if item.trajectory.camera == "left_palm"
            else np.zeros(FRAMES, bool)
        )
        assert item.trajectory.localised[~dark].all()
        assert not item.trajectory.localised[dark].any()
        known = item.trajectory.localised
        poses = world_from_map.apply_to_poses(item.trajectory.gauge_from_cam[known])
        truth = estimated.truth[item.trajectory.camera][known]
        turn = poses[:, :3, :3] @ np.swapaxes(truth[:, :3, :3], 1, 2)
        # A common rotation comes from the alignment: millimetres over a path of a metre.
        u, _, vt = np.linalg.svd(turn.mean(axis=0))
        own = rotation_angle_rad(turn @ (u @ vt).T)
        assert np.degrees(np.median(own)) < 0.2
        assert np.degrees(own.max()) < 1.0


def test_dark_frames_give_a_reason_and_request_keyframes(estimated: Estimated) -> None:
    palm = next(item for item in estimated.registrations if item.trajectory.camera == "left_palm")
    reasons = {palm.trajectory.status[frame] for frame in DARK}
    assert reasons <= {FrameStatus.FEW_TRACKS, FrameStatus.BLUR, FrameStatus.FEW_INLIERS}
    assert np.isnan(palm.trajectory.gauge_from_cam[DARK.start : DARK.stop]).all()
    offered = set(palm.wanted_keyframes) | set(palm.tried_keyframes)
    assert offered & set(DARK)


def test_a_new_gauge_is_followed_without_a_step_at_keyframes(estimated: Estimated, tmp_path: Path) -> None:
    """The map is rotated, moved and scaled between two rounds, as by a refinement."""
    world = Similarity(3.7, so3_exp([0.4, 1.0, -0.3]), np.array([5.0, -2.0, 0.7]))
    moved = tuple(_transformed(item, world) for item in estimated.result.maps)
    for camera, selection, before in zip(
        estimated.capture.cameras, estimated.selections, estimated.registrations, strict=True
    ):
        after = register_frames(
            camera, moved, selection, RegistrationOptions(), context(tmp_path), previous=before
        )
        assert after.trajectory.gauge == "moved"
        assert after.trajectory.status == before.trajectory.status
        known = before.trajectory.localised
        expected = world.apply_to_poses(before.trajectory.gauge_from_cam[known])
        got = after.trajectory.gauge_from_cam[known]
        sigma = np.sqrt(np.trace(before.trajectory.covariance[known][:, 3:, 3:], axis1=1, axis2=2))
        change = np.linalg.norm(got[:, :3, 3] - expected[:, :3, 3], axis=1) / 3.7
        # The observations are the same. Only RANSAC's samples may differ, by a part of the pose's noise.
        assert np.median(change / sigma) < 0.1
        assert (change / sigma).max() < 2.0
        scaled = after.trajectory.covariance[known][:, 3:, 3:] / 3.7**2
        ratio = np.trace(scaled, axis1=1, axis2=2) / sigma**2
        assert np.abs(np.log(ratio)).max() < np.log(1.5)
    steps = np.diff(got[:, :3, 3], axis=0)
    jump = np.linalg.norm(np.diff(steps, axis=0), axis=1) / 3.7
    consecutive = np.diff(np.flatnonzero(known)) == 1
    # The second difference of the true path is below 4.6 m/s² · (1/30 s)² = 5 mm; noise triples it at most.
    assert jump[consecutive[1:] & consecutive[:-1]].max() * _errors(estimated)[1].scale < 0.03


def _transformed(scene_map: Map, world: Similarity) -> Map:
    unit = np.repeat([1.0, world.scale], 3)
    return replace(
        scene_map,
        gauge="moved",
        points=world.apply(scene_map.points),
        map_from_cam=world.apply_to_poses(scene_map.map_from_cam),
        keyframe_covariance=scene_map.keyframe_covariance * np.outer(unit, unit),
    )


def test_unchanged_intervals_are_not_tracked_again(estimated: Estimated, tmp_path: Path) -> None:
    camera, selection, before = (
        estimated.capture.cameras[0],
        estimated.selections[0],
        estimated.registrations[0],
    )
    decoded: list[str] = []
    watching = replace(context(tmp_path), progress=lambda _done, _total, what: decoded.append(what))
    register_frames(
        camera, estimated.result.maps, selection, RegistrationOptions(), watching, previous=before
    )
    assert "frames tracked" not in decoded


def test_an_extended_map_keeps_its_keyframes(estimated: Estimated, tmp_path: Path) -> None:
    known = set(estimated.selections[0].frames)
    extra = [frame for frame in (11, 25, 47) if frame not in known]
    name = estimated.capture.cameras[0].name
    grown = extend_map(
        estimated.capture, estimated.result, {name: np.array(extra)}, MapOptions(), context(tmp_path)
    )
    before, after = estimated.result.maps[0], grown.maps[0]
    assert after.gauge != before.gauge
    keyframes = list(zip(after.keyframe_camera, after.keyframe_frame, strict=True))
    assert {(name, frame) for frame in extra} <= set(keyframes)
    rows = [keyframes.index(key) for key in zip(before.keyframe_camera, before.keyframe_frame, strict=True)]
    mine, theirs = after.map_from_cam[rows][:, :3, 3], before.map_from_cam[:, :3, 3]
    change = np.linalg.norm(align_points(mine, theirs).apply(mine) - theirs, axis=1)
    assert change.max() < 0.02 * np.ptp(theirs, axis=0).max()


def test_the_same_capture_gives_the_same_map(estimated: Estimated, tmp_path: Path) -> None:
    again = build_map(estimated.capture, estimated.selections, MapOptions(), context(tmp_path))
    first, second = estimated.result.maps[0], again.maps[0]
    assert first.gauge == second.gauge
    for field in ("points", "map_from_cam", "colors", "obs_px", "obs_point", "point_error_px"):
        assert np.array_equal(getattr(first, field), getattr(second, field))


def test_points_have_the_grey_of_the_walls(estimated: Estimated) -> None:
    colors = estimated.result.maps[0].colors.astype(int)
    # The room is grey; H.264 chroma may shift a channel by a few levels.
    assert np.abs(colors - colors.mean(axis=1, keepdims=True)).max() < 12
    assert np.ptp(colors) > 80


def test_turning_on_the_spot_needs_few_keyframes(tmp_path: Path) -> None:
    count = 40
    turning = {"torso": np.array([make_transform(look(0.012 * k), [0, 0, 0]) for k in range(count)])}
    moving = {"torso": np.array([make_transform(look(0.0), [0, 0.03 * k - 0.6, 0]) for k in range(count)])}
    chosen = {}
    for name, paths in (("turning", turning), ("moving", moving)):
        capture = write_capture(tmp_path / name, paths)
        options = KeyframeOptions(max_gap_s=10.0, min_survival=0.05, parallax_px=8.0)
        chosen[name] = len(select_keyframes(capture.cameras[0], options, context(tmp_path)).frames)
    assert chosen["turning"] == 2  # the first and the last frame
    assert chosen["moving"] >= 3


def test_motion_decides_on_keyframes_not_the_number_of_frames(tmp_path: Path) -> None:
    counts = []
    for fps in (30, 60):
        metres = np.arange(fps) * 1.2 / fps
        paths = {"torso": np.array([make_transform(look(0.0), [0, at - 0.6, 0]) for at in metres])}
        capture = write_capture(tmp_path / str(fps), paths, fps=fps)
        options = KeyframeOptions(max_gap_s=10.0, min_survival=0.05, parallax_px=3.0, window=1)
        counts.append(len(select_keyframes(capture.cameras[0], options, context(tmp_path)).frames))
    assert counts[0] >= 5
    # At 30 fps a keyframe can be up to one frame late: here one in five.
    assert counts[0] <= counts[1] <= 1.5 * counts[0]


def test_a_budget_keeps_the_keyframes_that_show_most(tmp_path: Path) -> None:
    # At rest, then fast: only the second half shows anything new.
    metres = np.concatenate([np.zeros(20), np.linspace(0.0, 1.2, 20)])
    paths = {"torso": np.array([make_transform(look(0.0), [0, at - 0.6, 0]) for at in metres])}
    camera = write_capture(tmp_path, paths).cameras[0]
    free = select_keyframes(camera, KeyframeOptions(max_gap_s=0.15), context(tmp_path)).frames
    options = KeyframeOptions(max_gap_s=0.15, max_per_min=60.0 * 6 / (39 / 30))
    held = select_keyframes(camera, options, context(tmp_path)).frames
    assert len(free) > 8
    assert len(held) == 6
    assert set(held) <= set(free)
    assert {held[0], held[-1]} == {0, 39}
    assert (held >= 20).sum() >= 4


def test_keyframes_avoid_blurred_frames(tmp_path: Path) -> None:
    import cv2

    from tests.rooms import LENS, Camera, Room
    from tests.videos import write_video

    room = Room.make(1)
    camera = Camera(model="PINHOLE", width_px=320, height_px=240, params=np.array(LENS["params"]))
    views = [room.view(camera, make_transform(look(0.0), [0, 0.03 * k - 0.6, 0])) for k in range(36)]
    blurred = [index for index in range(36) if index % 2]
    for index in blurred:
        views[index] = cv2.GaussianBlur(views[index], (0, 0), 1.6)
    write_video(tmp_path / "cap" / "torso.mp4", views)
    capture = open_capture(load_job(tmp_path / "cap").capture)
    frames = select_keyframes(capture.cameras[0], KeyframeOptions(max_gap_s=0.15), context(tmp_path)).frames
    inner = frames[1:-1]
    assert len(inner) >= 3
    assert (inner % 2 == 0).mean() > 0.8


def test_no_keyframe_is_a_repetition_of_a_picture(tmp_path: Path) -> None:
    from tests.videos import write_video

    # The recording is frozen in frames 11 to 25, and from frame 34 on.
    shown = [10 if 10 <= k < 26 else min(k, 33) for k in range(45)]
    poses = np.array([make_transform(look(0.0), [0, 0.03 * k - 0.6, 0]) for k in shown])
    capture = write_capture(tmp_path, {"torso": poses})
    video = capture.cameras[0].chapters[0]
    views = [image for _, image in capture.cameras[0].read(np.arange(45))]
    write_video(video, [views[k] for k in shown])
    (camera,) = open_capture(load_job(tmp_path).capture).cameras
    selection = select_keyframes(camera, KeyframeOptions(max_gap_s=0.15), context(tmp_path))
    assert np.flatnonzero(selection.frozen).tolist() == [*range(11, 26), *range(34, 45)]
    assert not selection.frozen[selection.frames].any()
    assert {0, 10, 33} <= set(selection.frames.tolist())
    assert (selection.frames > 25).any()


def test_cameras_that_stand_still_are_refused(estimated: Estimated, tmp_path: Path) -> None:
    still = [replace(selection, motion_px=0.2) for selection in estimated.selections]
    with pytest.raises(EstimationError, match="no camera moves") as caught:
        build_map(estimated.capture, still, MapOptions(), context(tmp_path))
    assert caught.value.hint
    assert all(selection.motion_px > 20.0 for selection in estimated.selections)


def test_no_texture_is_refused_with_numbers(tmp_path: Path) -> None:
    poses = np.array([make_transform(look(0.0), [0.02 * k, 0, 0]) for k in range(12)])
    capture = write_capture(tmp_path / "cap", {"torso": poses}, black={"torso": range(12)})
    selection = select_keyframes(capture.cameras[0], KeyframeOptions(max_gap_s=0.1), context(tmp_path))
    with pytest.raises(EstimationError, match=r"0 of \d+ keyframes"):
        build_map(capture, [selection], MapOptions(), context(tmp_path / "map"))


def test_a_camera_without_frames_is_refused(estimated: Estimated, tmp_path: Path) -> None:
    empty = replace(
        estimated.capture.cameras[0], frame_numbers=np.zeros(0, np.int64), times_ns=np.zeros(0, np.int64)
    )
    with pytest.raises(CaptureError, match="no frames"):
        select_keyframes(empty, KeyframeOptions(), context(tmp_path))


def test_a_camera_outside_every_map_has_no_map(estimated: Estimated, tmp_path: Path) -> None:
    stranger = replace(estimated.capture.cameras[0], name="head")
    selection = replace(estimated.selections[0], camera="head")
    got = register_frames(
        stranger, estimated.result.maps, selection, RegistrationOptions(), context(tmp_path)
    )
    assert set(got.trajectory.status) == {FrameStatus.NO_MAP}
    assert len(got.wanted_keyframes) == 0
