"""Metric scale from a marker board: detection in images, fit, refusal of unusable views."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from bodycap_batch.calibration.board_detection import CalibrationBoard
from bodycap_batch.calibration.board_views import find_board_views
from bodycap_batch.capture import open_capture
from bodycap_batch.config.job import load_job
from bodycap_batch.config.options import MarkerBoard, MergeOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.merging.body_calibration.marker_board import LocatedBoard, locate_board
from bodycap_batch.merging.body_calibration.scale import ScaleSource
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.camera_clock import CameraClock
from bodycap_batch.model.geometry import Similarity, invert, make_transform, so3_exp, transform_points
from bodycap_batch.model.merge_data import BoardView, MergeInputs
from bodycap_batch.model.nominal_mounts import nominal_mount
from bodycap_batch.model.scene import FrameStatus, Trajectory
from bodycap_batch.model.skeleton_presets import load_skeleton
from tests.rooms import LENS, look
from tests.videos import write_video

FLAT = MarkerBoard(square_m=0.06, columns=7, rows=5)
LARGE = FLAT.model_copy(update={"square_m": 0.12})
CHESSBOARD = MarkerBoard(kind="chessboard", square_m=0.06, columns=7, rows=5)
GAUGE = Similarity(0.4, so3_exp([0.7, -1.1, 0.4]), np.array([1.0, 2.0, -0.5]))
WORLD_FROM_BOARD = make_transform(look(0.1) @ so3_exp([0.2, 0.1, 0.3]), [1.6, 0.3, 0.2])
CAMERA = Camera(model="PINHOLE", width_px=320, height_px=240, params=np.array(LENS["params"]))


def _board(
    inputs: MergeInputs, options: MergeOptions, main_from_gauge: dict[str, Similarity] | None = None
) -> LocatedBoard:
    in_one_map = {each.gauge: Similarity(1.0, np.eye(3), np.zeros(3)) for each in inputs.trajectories}
    board = locate_board(
        inputs.trajectories, inputs.board_views, options.marker_board, main_from_gauge or in_one_map
    )
    assert board is not None
    return board


def _scale(*arguments: Any) -> ScaleSource:
    return _board(*arguments).scale


def _path(count: int, centre_noise_m: float = 0.0, half_way_m: float = 0.7) -> np.ndarray:
    """Return world_from_cam (N,4,4) of a person who walks past the board and looks at it."""
    rng = np.random.default_rng(3)
    across = np.linspace(-half_way_m, half_way_m, count)
    centres = np.stack([0.3 + 0.2 * across, across, 0.1 * np.sin(5.0 * across)], axis=1)
    yaw = np.arctan2(0.3 - centres[:, 1], 1.6 - centres[:, 0])
    centres += rng.normal(scale=centre_noise_m, size=centres.shape) if centre_noise_m else 0.0
    return np.array([make_transform(look(y), c) for y, c in zip(yaw, centres, strict=True)])


def _inputs(world_from_cam: np.ndarray, views: tuple[BoardView, ...] = ()) -> MergeInputs:
    count = len(world_from_cam)
    skeleton = load_skeleton("upper_body", 1.75)
    path = Trajectory(
        camera="torso",
        gauge="map-0",
        frame_numbers=np.arange(count),
        times_ns=np.round(np.arange(count) * 3e8).astype(np.int64),
        gauge_from_cam=GAUGE.apply_to_poses(world_from_cam),
        covariance=np.tile(1e-6 * np.eye(6), (count, 1, 1)),
        status=(FrameStatus.KEYFRAME,) * count,
        inliers=np.full(count, 60),
        error_px=np.full(count, 0.5),
    )
    return MergeInputs(
        trajectories=(path,),
        clocks={"torso": CameraClock(nominal_fps=30.0)},
        skeleton=skeleton,
        mounts=(nominal_mount("torso", "Spine1", skeleton),),
        board_views=views,
    )


def _views(
    world_from_cam: np.ndarray, rng: np.random.Generator, noise_px: float = 0.3
) -> tuple[BoardView, ...]:
    """Return what a detector gives: corners with noise, and a pose of the board from each view alone."""
    x, y = np.meshgrid(np.arange(7), np.arange(5))
    board = 0.06 * np.stack([x.ravel(), y.ravel(), np.zeros(35)], axis=1)
    out = []
    for frame, pose in enumerate(world_from_cam):
        seen = invert(pose) @ WORLD_FROM_BOARD
        x_in_cam = transform_points(seen, board)
        rays = x_in_cam[:, :2] / x_in_cam[:, 2:] + rng.normal(scale=noise_px / 210.0, size=(35, 2))
        off = make_transform(so3_exp(rng.normal(scale=0.1, size=3)), rng.normal(scale=0.02, size=3))
        out.append(
            BoardView(camera="torso", frame=frame, board_m=board, rays=rays, cam_from_board=seen @ off)
        )
    return tuple(out)


def test_the_board_gives_the_scale_and_its_uncertainty():
    for seed in range(5):
        rng = np.random.default_rng(seed)
        exact = _path(12)
        bent = exact.copy()
        bent[:, :3, 3] += rng.normal(scale=0.004, size=(12, 3))
        source = _scale(_inputs(bent, _views(exact, rng)), MergeOptions(marker_board=FLAT))
        # Four millimetres on a way of 1.4 m, twelve times: half a per cent, five times that for five draws.
        assert abs(np.log(source.scale * GAUGE.scale)) < min(3.0 * source.sigma_log, 0.025)
        assert 0.003 <= source.sigma_log < 0.02


@pytest.mark.parametrize("half_way_m", [0.25, 0.5])
def test_the_sigma_of_a_short_view_covers_the_error_of_the_map(half_way_m):
    off = []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        exact = _path(15, half_way_m=half_way_m)
        bent = exact.copy()
        # Errors of 5 mm that last for half a second, five keyframes.
        bent[:, :3, 3] += 0.005 * gaussian_filter1d(rng.normal(scale=4.2, size=(75, 3)), 5, axis=0)[30:-30]
        inputs = _inputs(bent, _views(exact, rng))
        path = replace(inputs.trajectories[0], times_ns=np.arange(15) * 100_000_000)
        source = _scale(replace(inputs, trajectories=(path,)), MergeOptions(marker_board=FLAT))
        off.append(np.log(source.scale * GAUGE.scale) / source.sigma_log)
    # The root mean square of sixteen is known to 18 %.
    assert 0.6 < float(np.sqrt(np.mean(np.square(off)))) < 1.5


def test_views_that_start_at_the_other_end_and_a_wrong_view_do_no_harm():
    rng = np.random.default_rng(0)
    exact = _path(12)
    views = list(_views(exact, rng, noise_px=0.1))
    middle = np.array([0.18, 0.12, 0.0])
    about = make_transform(np.diag([-1.0, -1.0, 1.0]), 2.0 * middle)
    for one in (1, 4, 5):
        views[one] = replace(
            views[one], rays=views[one].rays[::-1].copy(), cam_from_board=views[one].cam_from_board @ about
        )
    views[7] = replace(views[7], rays=views[7].rays + 0.15)
    source = _scale(_inputs(exact, tuple(views)), MergeOptions(marker_board=CHESSBOARD))
    assert source.scale * GAUGE.scale == pytest.approx(1.0, abs=0.01)


def test_a_board_in_another_map_uses_the_units_of_that_map():
    views = _views(_path(12), np.random.default_rng(0))
    inputs, asked = _inputs(_path(12), views), MergeOptions(marker_board=FLAT)
    half = Similarity(0.5, np.eye(3), np.zeros(3))
    alone, placed = _scale(inputs, asked), _scale(inputs, asked, {"map-0": half})
    assert placed.scale == pytest.approx(2.0 * alone.scale)
    with pytest.raises(EstimationError, match="0 keyframes"):
        _scale(inputs, asked, {"map-1": half})


def test_numbered_corners_are_not_rotated_to_fit_a_wrong_view():
    views = list(_views(_path(12), np.random.default_rng(0), noise_px=0.1))
    inputs, asked = _inputs(_path(12), tuple(views)), MergeOptions(marker_board=FLAT)
    right = _scale(inputs, asked)
    about = make_transform(np.diag([-1.0, -1.0, 1.0]), [0.36, 0.24, 0.0])
    for one in (1, 4, 5):
        views[one] = replace(views[one], cam_from_board=views[one].cam_from_board @ about)
    source = _scale(replace(inputs, board_views=tuple(views)), asked)
    # If they were rotated, their corners would be outliers, and the fit would use the other nine views.
    assert source.scale == pytest.approx(right.scale, rel=1e-6)


def test_views_in_the_main_map_come_before_those_in_an_aligned_one():
    rng = np.random.default_rng(0)
    views = _views(_path(12), rng)
    inputs = _inputs(_path(12))
    palm = replace(inputs.trajectories[0], camera="left_palm", gauge="map-1")
    few = tuple(view for view in views if view.frame % 3 == 0)
    # The scale of the aligned map is 20 % too large; it has three times as many views.
    places = {
        "map-0": Similarity(1.0, np.eye(3), np.zeros(3)),
        "map-1": Similarity(1.2, np.eye(3), np.zeros(3)),
    }
    both = replace(
        inputs,
        clocks=inputs.clocks | {"left_palm": inputs.clocks["torso"]},
        mounts=(*inputs.mounts, replace(inputs.mounts[0], camera="left_palm")),
        trajectories=(*inputs.trajectories, palm),
        board_views=(*few, *(replace(view, camera="left_palm") for view in views)),
    )
    asked = MergeOptions(marker_board=FLAT)
    assert _scale(both, asked, places).scale * GAUGE.scale == pytest.approx(1.0, abs=0.02)
    fewer = replace(both, board_views=both.board_views[2:])
    assert _scale(fewer, asked, places).scale * GAUGE.scale == pytest.approx(1.0 / 1.2, abs=0.02)


def test_a_board_without_enough_views_is_refused():
    rng = np.random.default_rng(0)
    asked = MergeOptions(marker_board=FLAT)
    assert locate_board(_inputs(_path(4)).trajectories, (), None, {}) is None
    with pytest.raises(EstimationError, match="found in only 2 keyframes"):
        _scale(_inputs(_path(2), _views(_path(2), rng)), asked)
    still = np.repeat(_path(1), 6, axis=0)
    still[:, :3, 3] += rng.normal(scale=1e-3, size=(6, 3))
    with pytest.raises(EstimationError, match="from nearly the same place"):
        _scale(_inputs(still, _views(still, rng)), asked)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory) -> tuple[Path, np.ndarray]:
    """Write a clip of the ChArUco board on a grey wall; return its folder and the camera poses."""
    folder, poses = tmp_path_factory.mktemp("filmed"), _path(8)
    texels = 24
    picture = cv2.copyMakeBorder(
        CalibrationBoard(kind="charuco", columns=7, rows=5).picture(texels),
        *[texels] * 4,
        cv2.BORDER_CONSTANT,
        value=235,
    )
    # Texel centres to metres on the board, whose origin is the outer corner of its first square.
    metres = LARGE.square_m / texels
    texel = np.array(
        [[metres, 0.0, metres * (0.5 - texels)], [0.0, metres, metres * (0.5 - texels)], [0, 0, 1]]
    )
    lens = np.array([[840.0, 0.0, 639.5], [0.0, 840.0, 479.5], [0.0, 0.0, 1.0]])
    frames = []
    for pose in poses:
        seen = (invert(pose) @ WORLD_FROM_BOARD @ make_transform(np.eye(3), [-0.42, -0.3, 0.0]))[:3]
        fine = cv2.warpPerspective(
            picture,
            lens @ seen[:, [0, 1, 3]] @ texel,
            (1280, 960),
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=110,
        )
        frames.append(cv2.resize(fine, (320, 240), interpolation=cv2.INTER_AREA))
    write_video(folder / "torso.mp4", frames, fps=30)
    lens_file = str(LENS).replace("'", '"').replace("}", ', "pixel_origin": "COLMAP"}')
    (folder / "calib.json").write_text(lens_file, encoding="utf-8")
    return folder, poses


def test_a_filmed_board_is_found_and_measured(filmed, tmp_path):
    folder, poses = filmed
    capture = open_capture(load_job(folder).capture)
    every = {"torso": np.arange(len(poses))}
    context = StageContext(work_dir=tmp_path)
    views = find_board_views(capture, every, {"torso": CAMERA}, LARGE, context)
    assert len(views) >= 6
    source = _scale(_inputs(poses, views), MergeOptions(marker_board=LARGE))
    # A tenth of a pixel on a board of 130 px, eight times.
    assert source.scale * GAUGE.scale == pytest.approx(1.0, abs=0.01)
    other = LARGE.model_copy(update={"dictionary": "6X6_50"})
    assert find_board_views(capture, every, {"torso": CAMERA}, other, context) == ()


def test_a_lying_or_hanging_board_gives_the_vertical():
    views = _views(_path(12), np.random.default_rng(0))
    board = _board(_inputs(_path(12), views), MergeOptions(marker_board=FLAT))
    assert board.verticals(None) == ()
    edges = GAUGE.rotation @ WORLD_FROM_BOARD[:3, :3]
    (lying,) = board.verticals("lying")
    # The normal points towards the cameras, whatever its sign from the detector.
    towards = GAUGE.rotation @ (_path(12)[:, :3, 3].mean(axis=0) - WORLD_FROM_BOARD[:3, 3])
    assert lying.up @ towards > 0.0
    # 0.1 px of noise in a dozen views of 24 corners: a small part of a degree.
    assert abs(lying.up @ edges[:, 2]) > np.cos(np.radians(0.5))
    hanging = [say.up for say in board.verticals("hanging")]
    assert len(hanging) == 4
    for edge in (edges[:, 0], -edges[:, 0], edges[:, 1], -edges[:, 1]):
        assert max(up @ edge for up in hanging) > np.cos(np.radians(0.5))
    turned = Similarity(0.5, so3_exp([0.0, 0.0, 1.0]), np.zeros(3))
    (placed,) = _board(
        _inputs(_path(12), views), MergeOptions(marker_board=FLAT), {"map-0": turned}
    ).verticals("lying")
    assert np.allclose(placed.up, turned.rotation @ lying.up)
