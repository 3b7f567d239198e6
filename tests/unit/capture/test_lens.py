"""Work size and calibration."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bodycap_batch.capture import open_camera, open_capture
from bodycap_batch.capture.initial_intrinsics import work_size
from bodycap_batch.config.calibration import Calibration, read_calibration
from bodycap_batch.config.job import load_job
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.model.camera import Camera, with_two_focal_lengths
from tests.videos import textured_frame, write_video


def lens_of(path: Path, work_px: int = 960, **camera: object) -> Camera:
    config = CameraConfig(name="torso", video=(path,), **camera)
    return open_camera(CaptureConfig(cameras=(config,), work_px=work_px), config).camera


@pytest.fixture(scope="module")
def wide(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_video(tmp_path_factory.mktemp("wide") / "a.mp4", [textured_frame(0, 640, 360)] * 2)


def pinhole(width: int, height: int, origin: str = "colmap") -> Calibration:
    return Calibration(
        model="PINHOLE", params=(400.0, 410.0, 330.0, 170.0), width=width, height=height, pixel_origin=origin
    )


def test_frames_are_never_enlarged() -> None:
    assert work_size((640, 480), 960) == (640, 480)
    assert work_size((1920, 1080), 960) == (960, 540)
    assert work_size((1080, 1920), 960) == (540, 960)


@pytest.mark.parametrize(
    ("stored", "aspect", "rotation", "worked"),
    [
        ((480, 360), Fraction(4, 3), 0, (480, 270)),
        ((360, 288), Fraction(16, 15), 0, (360, 270)),
        ((480, 360), Fraction(4, 3), 90, (270, 480)),
        ((240, 480), Fraction(1, 2), 0, (120, 480)),
        ((480, 360), Fraction(1000, 1001), 0, (480, 360)),
        ((480, 360), Fraction(9, 1), 0, (480, 360)),
    ],
)
def test_pixels_that_are_not_square_are_worked_on_as_square_ones(
    tmp_path: Path, stored: tuple[int, int], aspect: Fraction, rotation: int, worked: tuple[int, int]
) -> None:
    frames = [textured_frame(0, *stored)] * 2
    path = write_video(tmp_path / "a.mp4", frames, pixel_aspect=aspect, rotation=rotation)
    config = CameraConfig(name="torso", video=(path,))
    camera = open_camera(CaptureConfig(cameras=(config,), work_px=960), config)
    assert (camera.camera.width_px, camera.camera.height_px) == worked
    (image,) = [image for _, image in camera.grey_frames(0, 1)]
    assert image.shape == worked[::-1]


@pytest.mark.parametrize("size", [(480, 360), (640, 360)])
def test_stored_and_shown_pixels_may_both_be_calibrated(tmp_path: Path, size: tuple[int, int]) -> None:
    """480 columns shown as 640: a lens in either's pixels sees the same picture."""
    frames = [textured_frame(0, 480, 360)] * 2
    path = write_video(tmp_path / "a.mp4", frames, pixel_aspect=Fraction(4, 3))
    share = size[0] / 640
    calibration = Calibration(
        model="PINHOLE", params=(400.0 * share, 400.0, 320.0 * share, 180.0), width=size[0], height=360
    )
    lens = lens_of(path, calibration=calibration)
    assert (lens.width_px, lens.height_px) == (480, 270)
    assert np.allclose(lens.params, [300.0, 300.0, 240.0, 135.0])


def test_intrinsics_scale_with_the_pixel_origin(wide: Path) -> None:
    full = lens_of(wide, calibration=pinhole(640, 360))
    half = lens_of(wide, work_px=320, calibration=pinhole(640, 360))
    assert (half.width_px, half.height_px) == (320, 180)
    points = np.random.default_rng(0).uniform((-1, -1, 2), (1, 1, 5), (20, 3))
    # In COLMAP's origin a pixel (x, y) at one size is (x/2, y/2) at half of it: exact.
    assert np.allclose(half.project(points), full.project(points) / 2, atol=1e-9)


def test_the_opencv_origin_is_converted_before_scaling(wide: Path) -> None:
    colmap = lens_of(wide, work_px=320, calibration=pinhole(640, 360))
    opencv = lens_of(wide, work_px=320, calibration=pinhole(640, 360, "opencv"))
    # Half a pixel at the calibrated size is a quarter at half the size.
    assert np.allclose(opencv.params - colmap.params, [0, 0, 0.25, 0.25])


def test_another_size_of_the_same_aspect_is_scaled(wide: Path) -> None:
    lens = lens_of(wide, calibration=pinhole(1280, 720))
    assert lens.params.tolist() == [200.0, 205.0, 165.0, 85.0]


@pytest.mark.parametrize(("size", "hint"), [((640, 480), "video mode"), ((360, 640), "rotated")])
def test_another_aspect_is_refused(wide: Path, size: tuple[int, int], hint: str) -> None:
    with pytest.raises(CaptureError, match="aspect ratios differ") as caught:
        lens_of(wide, calibration=pinhole(*size))
    assert hint in str(caught.value.hint)
    assert caught.value.path == str(wide)
    assert caught.value.exit_code == 3


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_PINHOLE", (400.0, 320.0, 180.0)),
        ("SIMPLE_RADIAL", (400.0, 320.0, 180.0, -0.1)),
        ("RADIAL", (400.0, 320.0, 180.0, -0.1, 0.03)),
        ("SIMPLE_RADIAL_FISHEYE", (400.0, 320.0, 180.0, -0.1)),
        ("RADIAL_FISHEYE", (400.0, 320.0, 180.0, -0.1, 0.03)),
    ],
)
def test_one_focal_length_becomes_two_without_a_change(model: str, params: tuple[float, ...]) -> None:
    lens = Camera(model=model, width_px=640, height_px=360, params=params)  # type: ignore[arg-type]
    twin = with_two_focal_lengths(lens)
    points = np.random.default_rng(1).uniform((-1, -1, 2), (1, 1, 5), (20, 3))
    assert np.allclose(twin.project(points), lens.project(points), atol=1e-9)


def test_a_rounded_side_keeps_every_point_in_place(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mp4", [textured_frame(0, 640, 362)] * 2)
    calibration = Calibration(
        model="SIMPLE_RADIAL", params=(400.0, 320.0, 181.0, -0.1), width=640, height=362
    )
    full, small = lens_of(path, calibration=calibration), lens_of(path, work_px=250, calibration=calibration)
    assert (small.width_px, small.height_px) == (250, 141)
    points = np.random.default_rng(2).uniform((-1, -1, 2), (1, 1, 5), (20, 3))
    assert np.allclose(small.project(points), full.project(points) * (250 / 640, 141 / 362), atol=1e-9)


def test_auto_is_a_guess_to_refine(wide: Path) -> None:
    lens = lens_of(wide, calibration="auto")
    assert lens.refine
    assert lens.principal_point_px == (320.0, 180.0)
    given_view = lens_of(wide, calibration="auto", fov_deg=90.0)
    assert given_view.focal_px == pytest.approx(320.0)


def calib(tmp_path: Path, data: object) -> Path:
    path = tmp_path / "calib.json"
    path.write_text(data if isinstance(data, str) else json.dumps(data))
    return path


LENS = {"model": "PINHOLE", "params": [420, 420, 320, 240], "width": 640, "height": 480}


def test_one_calibration_for_all_and_one_for_each(tmp_path: Path) -> None:
    one = read_calibration(calib(tmp_path, {**LENS, "offsets_s": {"head": 0.5}, "fps": 30}), "head")
    assert (one.calibration.params, one.offset_s) == ((420, 420, 320, 240), 0.5)
    other = {**LENS, "params": [500, 500, 320, 240], "offset_s": -0.2, "rolling_shutter_s": 0.02}
    each = read_calibration(calib(tmp_path, {"cameras": {"torso": LENS, "head": other}}), "head")
    assert (each.calibration.params[0], each.offset_s, each.rolling_shutter_s) == (500, -0.2, 0.02)
    with pytest.raises(CaptureError, match="'hed'") as caught:
        read_calibration(tmp_path / "calib.json", "hed")
    assert "'head'" in str(caught.value.hint)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"params": [420, 420, 320]}, None),
        ({"params": [0, 420, 320, 240]}, "params.0"),
        ({"model": "PINHOL"}, "model"),
        ({"width": 0}, "width"),
        ({"width": None}, "width"),
        ({"params": "420"}, "params"),
        ({"offsets_s": {"torso": "soon"}}, "offsets_s"),
        ({"rolling_shutter_s": True}, "rolling_shutter_s"),
        ({"pixel_origin": "somewhere"}, "pixel_origin"),
    ],
)
def test_wrong_calibrations_name_the_field(
    tmp_path: Path, change: dict[str, object], field: str | None
) -> None:
    path = calib(tmp_path, {**LENS, **change})
    with pytest.raises(CaptureError) as caught:
        read_calibration(path, "torso")
    assert caught.value.path == str(path)
    assert caught.value.field == field
    assert caught.value.hint


def test_a_broken_file_names_the_line(tmp_path: Path) -> None:
    with pytest.raises(CaptureError) as caught:
        read_calibration(calib(tmp_path, '{"model": "PINHOLE",\n "params": [1 2]}'), "torso")
    assert caught.value.line == 2


json_values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.sampled_from([*LENS, "cameras", "torso", "offsets_s"]), inner)
    ),
    max_leaves=8,
)


@given(json_values.map(json.dumps) | st.text(max_size=30) | st.just("[" * 100_000))
def test_any_calibration_file_gives_a_lens_or_a_typed_error(
    tmp_path_factory: pytest.TempPathFactory, text: str
) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzz.json"
    path.write_text(text, encoding="utf-8", errors="surrogatepass")
    try:
        entry = read_calibration(path, "torso")
    except CaptureError:
        return
    assert entry.calibration.camera().focal_px > 0


@pytest.mark.data
def test_the_real_capture_has_opencv_pixels_and_unix_times(data_root: Path) -> None:
    camera = open_capture(load_job(data_root / "tum_fr1_xyz").capture).cameras[0]
    assert len(camera.frame_numbers) == 798
    assert camera.camera.principal_point_px == (319.1, 255.8)
    assert camera.times_ns[0] == 1305031102175304000
    assert not camera.camera.refine


@pytest.fixture(scope="module")
def camcorder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """1440 stored columns that are shown as 1920."""
    return write_video(
        tmp_path_factory.mktemp("hdv") / "a.mp4",
        [textured_frame(0, 1440, 1080)] * 2,
        pixel_aspect=Fraction(4, 3),
    )


@pytest.mark.parametrize(
    ("camera", "ratio"),
    [
        ({}, 1.0),
        ({"fov_deg": 80.0}, 1.0),
        ({"calibration": "GoPro HERO11 Black / Wide"}, 1.0),
        # A mode that stretches the picture to 16:9, in square pixels.
        ({"calibration": "Hawkeye Firefly X Lite / 150"}, 1335.68 / 1000.54),
        # A profile of stored pixels, 2880x2160, which are shown as 3840x2160.
        ({"calibration": "SJCAM c100+ / 2880x2160"}, 1955.88 * 4 / 3 / 2605.22),
        ({"calibration": {**LENS, "params": [1050, 1400, 720, 540], "width": 1440, "height": 1080}}, 1.0),
        ({"calibration": {**LENS, "params": [1400, 1400, 960, 540], "width": 1920, "height": 1080}}, 1.0),
    ],
)
def test_pixels_that_are_not_square_are_in_the_lens(
    camcorder: Path, camera: dict[str, object], ratio: float
) -> None:
    lens = lens_of(camcorder, **camera)
    assert (lens.width_px, lens.height_px) == (960, 540)
    # The shapes of profiles are rounded to even numbers; focal lengths within 3 % are taken as equal.
    assert lens.focal_ratio == pytest.approx(ratio, rel=0.03 if abs(ratio - 1.0) < 0.03 else 0.002)
    if "SJCAM" in str(camera):
        assert lens.focal_px == pytest.approx(2605.22 / 4, rel=0.03)


def test_a_mask_may_have_the_shape_of_the_stored_picture(camcorder: Path, tmp_path: Path) -> None:
    mask = np.zeros((540, 720), np.uint8)
    mask[:, :360] = 255
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    config = CameraConfig(name="torso", video=(camcorder,), mask=tmp_path / "mask.png")
    found = open_camera(CaptureConfig(cameras=(config,)), config).mask
    assert found is not None
    assert found.shape == (540, 960)
    assert found[:, :479].all()
    assert not found[:, 481:].any()
