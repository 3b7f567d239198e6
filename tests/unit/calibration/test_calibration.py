"""Calibration from clips of boards: boards drawn with known intrinsics must give these intrinsics."""

import json
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from bodycap_batch import cli
from bodycap_batch.calibration import (
    CalibrationBoard,
    calibrate_clip,
    find_board,
    write_calibration,
    write_preview,
)
from bodycap_batch.calibration.board_detection import BoardCorners
from bodycap_batch.calibration.board_search import _charuco_boards
from bodycap_batch.calibration.clip_calibration import (
    _focal_lengths_of_halves,
    _require_known_focal_length,
    corner_coverage,
    select_diverse_views,
)
from bodycap_batch.calibration.intrinsics_fit import fit_intrinsics
from bodycap_batch.calibration.printed_board import PRINTED_BOARD
from bodycap_batch.capture import open_camera
from bodycap_batch.config.calibration import read_calibration
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import CaptureError, EstimationError, JobError
from bodycap_batch.model.camera import CV2_PIXEL_OFFSET_PX
from bodycap_batch.model.geometry import so3_exp
from tests.boards import (
    FISHEYE_LENS,
    PINHOLE_LENS,
    SQUARE_TEXELS,
    board_clip,
    chessboard_picture,
    with_margin,
)
from tests.videos import write_video

CHARUCO = CalibrationBoard(kind="charuco", columns=9, rows=6)
CHESSBOARD = CalibrationBoard(kind="chessboard", columns=9, rows=6)


def _clip(folder, lens, board, views=16):
    """Write a clip of five pictures a second; each shows the board at another position."""
    plain = board.kind == "chessboard"
    picture = chessboard_picture(9, 6) if plain else board.picture(SQUARE_TEXELS)
    images = board_clip(lens, with_margin(picture), views, np.random.default_rng(1), whole=plain)
    return write_video(folder / f"{board.kind}.mp4", images, fps=5)


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return _clip(tmp_path_factory.mktemp("boards"), PINHOLE_LENS, CHARUCO)


@pytest.fixture(scope="module")
def result(clip):
    return calibrate_clip(clip, CHARUCO, "auto", StageContext(work_dir=clip.parent))


def _close(result, lens):
    focal, centre = np.array(result.fit.params[:2]), np.array(result.fit.params[2:4])
    assert np.abs(focal / lens.params[:2] - 1).max() < 0.005
    # 600 corners with errors of 0.1 px. Tilt and centre are correlated, which costs a factor of 100.
    assert np.abs(centre - lens.params[2:4]).max() < 1.0
    rays = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 7), np.linspace(-0.35, 0.35, 5)), axis=-1).reshape(
        -1, 2
    )
    points = np.column_stack([rays, np.ones(len(rays))])
    found = type(lens)(
        model=result.fit.model, width_px=640, height_px=480, params=np.array(result.fit.params)
    )
    # All parameters together: at most half a pixel anywhere in the picture.
    assert np.abs(found.project(points) - lens.project(points)).max() < 0.5


def test_a_charuco_clip_gives_the_true_intrinsics(result):
    assert result.fit.model == "OPENCV"
    assert result.found >= 15
    assert result.coverage > 0.8
    _close(result, PINHOLE_LENS)
    # Noise of two grey levels and H.264 move a corner by hundredths of a pixel.
    assert 0.01 < result.fit.rms_px < 0.2
    assert not result.notes


def test_the_stated_sigma_agrees_with_the_error(result):
    errors = np.abs(np.array(result.fit.params[:2]) - PINHOLE_LENS.params[:2])
    sigmas = np.array(result.fit.focal_sigma_px)
    assert (sigmas > 0).all()
    assert (sigmas < 0.005 * 430).all()
    # Corner errors are not fully independent, hence four sigma and not three.
    assert (errors < 4 * sigmas).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lens", "board"), [(PINHOLE_LENS, CHESSBOARD), (FISHEYE_LENS, CHARUCO), (FISHEYE_LENS, CHESSBOARD)]
)
def test_other_boards_and_camera_models(tmp_path, lens, board):
    clip = _clip(tmp_path, lens, board, views=30)
    found = calibrate_clip(clip, board, "auto", StageContext(work_dir=tmp_path))
    assert found.fit.model == lens.model
    _close(found, lens)


def test_a_job_reads_the_written_file(result, clip, tmp_path):
    write_calibration(result, tmp_path / "calib.json", None)
    entry = read_calibration(tmp_path / "calib.json", "torso")
    assert entry.calibration.camera().params.tolist() == result.fit.params
    config = CameraConfig(name="torso", video=(clip,), calibration=entry.calibration)
    camera = open_camera(CaptureConfig(cameras=(config,)), config)
    assert camera.calibrated
    assert camera.camera.params.tolist() == result.fit.params
    report = json.loads((tmp_path / "calib.json").read_text())["calibrated_with"]
    assert report["rms_px"] == pytest.approx(result.fit.rms_px, abs=1e-4)
    assert len(report["view_rms_px"]) == report["views"]
    one, other = report["focal_of_halves_px"]
    assert abs(one / other - 1) < 0.005


def test_cameras_are_added_to_one_file(result, tmp_path):
    path = tmp_path / "calib.json"
    for camera in ("torso", "left_palm", "torso"):
        write_calibration(result, path, camera)
    assert sorted(json.loads(path.read_text())["cameras"]) == ["left_palm", "torso"]
    assert read_calibration(path, "left_palm").calibration.params == tuple(result.fit.params)
    write_calibration(result, path, None)
    with pytest.raises(JobError, match="one calibration for all"):
        write_calibration(result, path, "torso")


def test_the_preview_is_undistorted(result, tmp_path):
    write_preview(result, tmp_path / "calib.png")
    with av.open(str(tmp_path / "calib.png")) as picture:
        image = next(picture.decode(video=0)).to_ndarray(format="gray")
    assert image.shape == (480, 1280)
    # After undistortion the corners of a row are on a straight line; before, they are not.
    bends = []
    for half in (image[:, :640], image[:, 640:]):
        view = CHARUCO.find(np.ascontiguousarray(half))
        rows = [view.px[view.board_m[:, 1] == y] for y in np.unique(view.board_m[:, 1])]
        rows = [row - row.mean(axis=0) for row in rows if len(row) >= 6]
        bends.append(max(np.linalg.svd(row, compute_uv=False)[1] for row in rows))
    assert bends[1] < 0.5 < bends[0]


def test_a_clip_without_the_board_is_refused_with_numbers(tmp_path):
    clip = _clip(tmp_path, PINHOLE_LENS, CHARUCO, views=4)
    with pytest.raises(
        CaptureError, match=r"found in 0 of 4 inspected pictures, but 8 pictures with the board are needed"
    ) as refused:
        calibrate_clip(clip, CHESSBOARD, "auto", StageContext(work_dir=tmp_path))
    assert "the clip shows a ChArUco board of 9x6 squares" in refused.value.message
    assert "--charuco 9x6 --dictionary 4X4_50" in refused.value.hint


def test_the_command_writes_calibration_and_preview(clip, tmp_path, capsys):
    out = tmp_path / "lens.json"
    assert cli.main(["calibrate", str(clip), "--charuco", "9x6", "--lens", "opencv", "--out", str(out)]) == 0
    output = capsys.readouterr().out
    assert "found in 16 of 16 pictures" in output
    assert "reprojection error" in output
    assert read_calibration(out, "any").calibration.model == "OPENCV"
    assert (tmp_path / "lens.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--charuco", "9x6", "--chessboard", "9x6"], "only one board can be used"),
        (["--charuco", "nine"], "is not the size of a board"),
        (["--charuco", "2x2"], "too small"),
        (["--charuco", "9x6", "--dictionary", "9X9"], "no family of markers"),
        (["--charuco", "9x6", "--marker", "1.5"], "cannot be 1.5 times as wide as a square"),
    ],
)
def test_wrong_options_are_refused(clip, tmp_path, capsys, words, message):
    assert cli.main(["calibrate", str(clip), *words, "--out", str(tmp_path / "calib.json")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "calib.json").exists()


def _exact_views(lens, rng, count, noise_px=0.0, tilt=0.5):
    x, y = np.meshgrid(np.arange(9.0), np.arange(6.0))
    board = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    views = []
    for _ in range(count):
        turn = so3_exp(rng.uniform(-tilt, tilt, 3))
        centre = np.append(rng.uniform(-2, 2, 2), rng.uniform(9, 13))
        px = lens.project((board - [4.0, 2.5, 0.0]) @ turn.T + centre) - CV2_PIXEL_OFFSET_PX
        views.append(BoardCorners(board_m=board, px=px + rng.normal(0, noise_px, px.shape)))
    return views


@pytest.mark.parametrize("lens", [PINHOLE_LENS, FISHEYE_LENS])
def test_exact_corners_give_the_exact_lens_and_pixel_origin(lens):
    fit = fit_intrinsics(lens.model, _exact_views(lens, np.random.default_rng(0), 12), (640, 480))
    # The pinhole solver takes corners in single precision, which is 3e-5 px.
    assert np.abs(np.array(fit.params[:4]) - lens.params[:4]).max() < 0.01
    assert fit.rms_px < 1e-3


def test_an_outlier_view_is_removed():
    rng = np.random.default_rng(0)
    views = _exact_views(PINHOLE_LENS, rng, 12, noise_px=0.05)
    views[5] = BoardCorners(board_m=views[5].board_m, px=views[5].px + rng.normal(0, 4.0, views[5].px.shape))
    fit = fit_intrinsics("OPENCV", views, (640, 480))
    assert fit.kept == tuple(index for index in range(12) if index != 5)
    assert fit.rms_px < 0.1


def test_diverse_views_are_selected():
    rng = np.random.default_rng(0)
    near = _exact_views(PINHOLE_LENS, np.random.default_rng(1), 1)
    same = [
        BoardCorners(board_m=near[0].board_m, px=near[0].px + rng.normal(0, 0.1, (54, 2))) for _ in range(30)
    ]
    others = _exact_views(PINHOLE_LENS, rng, 5)
    chosen = select_diverse_views(same + others, (640, 480), 6)
    assert set(range(30, 35)) <= set(chosen)


def test_coverage_counts_cells():
    assert corner_coverage([np.array([[0.0, 0.0], [1.0, 1.0]])], (640, 480)) == 1 / 48
    assert corner_coverage([np.array([[-0.5, -0.5], [639.5, 479.5]])], (640, 480)) == 2 / 48


def test_boards_printed_white_on_black_are_found():
    board = CalibrationBoard(kind="charuco", columns=7, rows=5)
    picture = with_margin(board.picture(SQUARE_TEXELS))
    frames = board_clip(PINHOLE_LENS, picture, 18, np.random.default_rng(5), whole=False)
    upright = [board.find(frame) for frame in frames]
    inverted = [board.find(255 - frame) for frame in frames]
    both = [(one, other) for one, other in zip(upright, inverted, strict=True) if one is not None]
    assert len(both) >= 10
    assert sum(other is not None for _, other in both) >= 0.9 * len(both)
    # The corners are the same.
    for one, other in both:
        if other is not None and len(one.px) == len(other.px):
            np.testing.assert_allclose(other.px, one.px, atol=0.2)


def test_no_board_is_found_in_noise_of_either_polarity():
    board = CalibrationBoard(kind="charuco", columns=7, rows=5)
    noise = np.random.default_rng(1).integers(0, 255, (240, 320)).astype(np.uint8)
    assert board.find(noise) is None
    assert board.find(255 - noise) is None


def test_the_board_of_a_clip_is_found_without_naming_it(clip):
    board = find_board(clip, StageContext(work_dir=clip.parent))
    assert (board.kind, board.columns, board.rows) == ("charuco", 9, 6)


@pytest.fixture(scope="module")
def unusual(tmp_path_factory):
    """A chessboard of a size that no list of usual boards has."""
    images = board_clip(
        PINHOLE_LENS, with_margin(chessboard_picture(11, 7)), 9, np.random.default_rng(1), whole=True
    )
    return write_video(tmp_path_factory.mktemp("unusual") / "board.mp4", images, fps=5)


@pytest.mark.parametrize("stated", ["10x7", "7x5"])
def test_a_wrongly_counted_board_is_refused_with_the_size_that_fits(unusual, tmp_path, capsys, stated):
    """10x7 is never found; parts of 7x5 corners are, each at another place of the board."""
    out = tmp_path / "calib.json"
    code = cli.main(["calibrate", str(unusual), "--chessboard", stated, "--out", str(out)])
    assert code in (3, 4)
    error = " ".join(capsys.readouterr().err.split())
    assert (
        "the clip shows a chessboard of 11x7 inner corners, which a lens fits with an error of 0.0" in error
    )
    assert "--chessboard 11x7" in error
    assert not out.exists()


def test_the_size_of_a_chessboard_is_measured(unusual):
    found = find_board(unusual, StageContext(work_dir=unusual.parent))
    assert (found.kind, found.columns, found.rows) == ("chessboard", 11, 7)


@pytest.mark.parametrize(
    ("columns", "rows", "legacy", "lens"),
    [(8, 6, True, PINHOLE_LENS), (5, 7, False, FISHEYE_LENS), (12, 9, False, PINHOLE_LENS)],
)
def test_the_size_of_a_charuco_board_is_measured(columns, rows, legacy, lens):
    board = CalibrationBoard(kind="charuco", columns=columns, rows=rows, dictionary="5X5_100", legacy=legacy)
    picture = with_margin(board.picture(SQUARE_TEXELS))
    (found,) = _charuco_boards(board_clip(lens, picture, 5, np.random.default_rng(3), whole=False))
    assert found.is_like(board)
    assert found.legacy == legacy


def test_a_bent_board_is_refused_with_its_error(tmp_path, capsys):
    picture = with_margin(chessboard_picture(9, 6))
    y, x = np.indices(picture.shape, dtype=np.float32)
    # The corners are up to a sixth of a square beside their places.
    bent = cv2.remap(picture, x + 8 * np.sin(y / 60), y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    images = board_clip(PINHOLE_LENS, bent, 9, np.random.default_rng(1), whole=True)
    clip = write_video(tmp_path / "bent.mp4", images, fps=5)
    assert cli.main(["calibrate", str(clip), "--chessboard", "9x6"]) == 4
    error = " ".join(capsys.readouterr().err.split())
    assert "no lens fits the 9 views of the chessboard of 9x6 inner corners (the best has a reproj" in error
    assert "the clip shows" not in error
    assert not (tmp_path / "calib.json").exists()


@pytest.mark.parametrize(("tilt", "is_known"), [(0.5, True), (0.03, False)])
def test_views_that_do_not_determine_the_focal_length_are_refused(tilt, is_known):
    views = _exact_views(PINHOLE_LENS, np.random.default_rng(0), 16, noise_px=0.2, tilt=tilt)
    fit = fit_intrinsics("OPENCV", views, (640, 480))
    halves = _focal_lengths_of_halves("OPENCV", views, (640, 480))
    if is_known:
        _require_known_focal_length(fit, halves, Path("a.mp4"))
        # 16 views with errors of 0.2 px: a third of a percent.
        assert abs(halves[0] / halves[1] - 1) < 0.02
    else:
        with pytest.raises(EstimationError, match="do not determine the focal length") as caught:
            _require_known_focal_length(fit, halves, Path("a.mp4"))
        assert "tilt the board" in caught.value.hint


def test_a_clip_without_a_board_is_refused(tmp_path):
    grey = np.full((20, 240, 320), 110, dtype=np.uint8)
    with pytest.raises(CaptureError, match="no calibration board") as caught:
        find_board(write_video(tmp_path / "wall.mp4", grey, fps=5), StageContext(work_dir=tmp_path))
    assert "--print" in caught.value.hint


def test_the_printed_board_is_the_one_that_is_found(tmp_path):
    """The page is drawn again from its rectangles; every corner must be where its squares meet."""
    assert cli.main(["calibrate", "--print", str(tmp_path / "board.pdf")]) == 0
    text = (tmp_path / "board.pdf").read_text("ascii")
    assert text.startswith("%PDF-1.4")
    start = int(text.rpartition("startxref\n")[2].split()[0])
    assert text[start:].startswith("xref")
    page = np.full((595, 842), 255, dtype=np.uint8)  # A4 across, one pixel for a PDF unit
    boxes = [line.split()[:4] for line in text.splitlines() if line.endswith(" re f")]
    for x, y, width, height in np.array(boxes, dtype=float):
        rows = slice(round(595 - y - height), round(595 - y))
        page[rows, round(x) : round(x + width)] = 0
    found = PRINTED_BOARD.find(page)
    assert found is not None
    assert len(found.px) == 24, "7 x 5 squares have 6 x 4 inner corners"
    side = np.linalg.norm(found.px[1] - found.px[0]) * 25.4 / 72
    assert abs(side - 36.0) < 0.5  # a pixel of the page is 0.35 mm
