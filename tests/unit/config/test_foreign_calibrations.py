"""Calibrations of other programs: each projects points as its own formulas or OpenCV do."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from bodycap_batch.cli import main
from bodycap_batch.config.calibration import Calibration, read_calibration
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.model.camera import CV2_PIXEL_OFFSET_PX
from tests.videos import textured_frame, write_video

POINTS = np.random.default_rng(0).uniform((-0.8, -0.6, 1), (0.8, 0.6, 2), (40, 3))
MATRIX = np.array([[420.0, 0.0, 319.0], [0.0, 421.0, 238.0], [0.0, 0.0, 1.0]])
FLAT = MATRIX.ravel().tolist()
SIZE = {"image_width": 640, "image_height": 480}


def saved(folder: Path, content: object, name: str = "lens.txt") -> Path:
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


def read(folder: Path, content: object, camera: str = "torso") -> Calibration:
    return read_calibration(saved(folder, content), camera).calibration


def opencv_pixels(terms: list[float], *, fisheye: bool = False) -> np.ndarray[Any, Any]:
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    zero = np.zeros(3)
    px, _ = (
        project(POINTS[:, None], zero, zero, MATRIX, np.array(terms))
        if fisheye
        else project(POINTS, zero, zero, MATRIX, np.array(terms))
    )
    return np.asarray(px).reshape(-1, 2)


def matrix_in_yaml(name: str, rows: int, data: list[float], tag: str = "!!opencv-matrix") -> str:
    values = ", ".join(f"{value!r}" for value in data)
    return f"{name}: {tag}\n   rows: {rows}\n   cols: {len(data) // rows}\n   dt: d\n   data: [ {values} ]\n"


def opencv_yaml(terms: list[float], extra: str = "") -> str:
    return (
        "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\n"
        + matrix_in_yaml("camera_matrix", 3, FLAT)
        + matrix_in_yaml("distortion_coefficients", 1, terms)
        + extra
    )


def opencv_xml(terms: list[float]) -> str:
    def matrix(name: str, rows: int, data: list[float]) -> str:
        values = " ".join(map(repr, data))
        return (
            f'<{name} type_id="opencv-matrix"><rows>{rows}</rows><dt>d</dt><data>\n {values}</data></{name}>'
        )

    return (
        '<?xml version="1.0"?>\n<opencv_storage>\n<image_Width>640</image_Width>'
        "<image_Height>480</image_Height>"
        + matrix("Camera_Matrix", 3, FLAT)
        + matrix("Distortion_Coefficients", 5, terms)
        + "<Avg_Reprojection_Error>2.1e-01</Avg_Reprojection_Error></opencv_storage>"
    )


def ros_yaml(model: str, terms: list[float]) -> str:
    return (
        "image_width: 640\nimage_height: 480\ncamera_name: head\n"
        + matrix_in_yaml("camera_matrix", 3, FLAT, "")
        + f"distortion_model: {model}\n"
        + matrix_in_yaml("distortion_coefficients", 1, terms, "")
        + matrix_in_yaml("rectification_matrix", 3, [1.0, 0, 0, 0, 1, 0, 0, 0, 1], "")
        + matrix_in_yaml("projection_matrix", 3, [9.0, 0, 9, 0, 0, 9, 9, 0, 0, 0, 1, 0], "")
    )


FOUR, FIVE = [-0.1, 0.02, 0.001, -0.002], [-0.1, 0.02, 0.001, -0.002, 0.03]
EIGHT, FISHEYE = [0.2, 0.02, 0.001, -0.002, 0.001, 0.3, 0.01, 0.002], [0.03, -0.01, 0.002, -0.001]


@pytest.mark.parametrize(
    ("content", "model", "terms"),
    [
        (opencv_yaml(FOUR), "OPENCV", FOUR),
        (opencv_yaml(FIVE), "FULL_OPENCV", FIVE),
        (opencv_yaml([*FOUR, 0.0]), "OPENCV", FOUR),
        (opencv_yaml([0.0] * 5), "PINHOLE", [0.0] * 5),
        (opencv_xml(FIVE), "FULL_OPENCV", FIVE),
        (ros_yaml("plumb_bob", FIVE), "FULL_OPENCV", FIVE),
        (ros_yaml("rational_polynomial", EIGHT), "FULL_OPENCV", EIGHT),
        ({"K": MATRIX.tolist(), "dist": [FIVE], "img_size": [640, 480]}, "FULL_OPENCV", FIVE),
        ({"cameraMatrix": FLAT, "distCoeffs": FOUR, "resolution": "640 480"}, "OPENCV", FOUR),
        (opencv_yaml(FISHEYE, "fisheye_model: 1\n"), "OPENCV_FISHEYE", FISHEYE),
        (ros_yaml("equidistant", FISHEYE), "OPENCV_FISHEYE", FISHEYE),
        (
            "header: {frame_id: x}\nheight: 480\nwidth: 640\ndistortion_model: equidistant\n"
            f"d: {FISHEYE}\nk: {FLAT}\n",
            "OPENCV_FISHEYE",
            FISHEYE,
        ),
        (
            f"[cam_1]\ncam_id = 1\nerror = 0.3\nsize = [640, 480]\nmatrix = {MATRIX.tolist()}\n"
            f"distortions = {FISHEYE}\nfisheye = true\n",
            "OPENCV_FISHEYE",
            FISHEYE,
        ),
    ],
)
def test_lenses_of_opencv_project_as_opencv_does(
    tmp_path: Path, content: object, model: str, terms: list[float]
) -> None:
    found = read(tmp_path, content)
    assert (found.model, found.width, found.height) == (model, 640, 480)
    expected = opencv_pixels(terms, fisheye=model == "OPENCV_FISHEYE") + CV2_PIXEL_OFFSET_PX
    np.testing.assert_allclose(found.camera().project(POINTS), expected, atol=1e-6)


def kalibr(projection: str, distortion: str, intrinsics: list[float], terms: list[float]) -> str:
    return (
        f"cam0:\n  camera_model: {projection}\n  distortion_coeffs: {terms}\n"
        f"  distortion_model: {distortion}\n  intrinsics: {intrinsics}\n  resolution: [640, 480]\n"
        "  rostopic: /cam0/image_raw\n"
    )


def pixels(plane: Any) -> np.ndarray[Any, Any]:
    return np.asarray(plane) * [420.0, 421.0] + [319.5, 238.5]


def test_lenses_of_kalibr_project_as_its_formulas_do(tmp_path: Path) -> None:
    x, y, z = POINTS.T
    radius, distance = np.hypot(x, y) / z, np.linalg.norm(POINTS, axis=1)
    plain = [420.0, 421.0, 319.0, 238.0]
    fov = np.arctan(2 * radius * np.tan(0.45)) / 0.9 / radius
    enhanced = 0.6 * np.sqrt(1.1 * (x**2 + y**2) + z**2) + 0.4 * z
    unified = z + 0.9 * distance
    for content, plane in (
        (kalibr("pinhole", "fov", plain, [0.9]), np.stack([x / z * fov, y / z * fov], axis=1)),
        (kalibr("eucm", "none", [0.6, 1.1, *plain], []), np.stack([x, y], axis=1) / enhanced[:, None]),
        (kalibr("omni", "radtan", [0.9, *plain], [0.0] * 4), np.stack([x, y], axis=1) / unified[:, None]),
    ):
        lens = read(tmp_path, content).camera()
        np.testing.assert_allclose(lens.project(POINTS), pixels(plane), atol=1e-6)
        np.testing.assert_allclose(
            lens.unproject(lens.project(POINTS)), POINTS[:, :2] / z[:, None], atol=1e-6
        )
    assert read(tmp_path, kalibr("pinhole", "radtan", plain, FOUR)).model == "OPENCV"
    assert read(tmp_path, kalibr("pinhole", "equidistant", plain, FISHEYE)).model == "OPENCV_FISHEYE"


def test_cameras_of_colmap_are_taken_as_they_are(tmp_path: Path) -> None:
    head = "# Camera list with one line of data per camera:\n"
    one = read(tmp_path, f"{head}3 OPENCV 640 480 420 421 320 240 -0.1 0.02 1e-3 0\n")
    assert (one.model, one.pixel_origin) == ("OPENCV", "colmap")
    assert one.params == (420, 421, 320, 240, -0.1, 0.02, 0.001, 0)
    bare = read(tmp_path, f"{head}1 FISHEYE 640 480 420 421 320 240\n")
    assert (bare.model, bare.params[4:]) == ("OPENCV_FISHEYE", (0, 0, 0, 0))


GYROFLOW = {
    "name": "x", "camera_brand": "GoPro", "camera_model": "HERO11 Black", "lens_model": "Wide",
    "calib_dimension": {"w": 640, "h": 480}, "orig_dimension": {"w": 640, "h": 480},
    "fisheye_params": {
        "RMS_error": 0.4, "camera_matrix": MATRIX.tolist(), "distortion_coeffs": FISHEYE,
    },
}  # fmt: skip


def test_profiles_of_gyroflow_are_fisheye_lenses(tmp_path: Path) -> None:
    found = read(tmp_path, GYROFLOW)
    np.testing.assert_allclose(
        found.camera().project(POINTS), opencv_pixels(FISHEYE, fisheye=True) + 0.5, atol=1e-6
    )
    made = found.calibrated_with
    assert made is not None
    assert (made.rms_px, made.camera, made.lens_mode) == (0.4, "GoPro HERO11 Black", "Wide")
    # Gyroflow stretched pictures of 1280 pixels to 640 before it calibrated.
    stretched = read(tmp_path, {**GYROFLOW, "input_horizontal_stretch": 0.5})
    assert (stretched.width, stretched.height) == (1280, 480)
    x, y = opencv_pixels(FISHEYE, fisheye=True).T + 0.5
    np.testing.assert_allclose(stretched.camera().project(POINTS), np.stack([2 * x, y], 1), atol=1e-6)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (kalibr("ds", "none", [0.1, 0.5, 420, 420, 320, 240], []), ("Kalibr", "'ds'", "pinhole-equi")),
        (kalibr("omni", "radtan", [0.9, 420, 420, 320, 240], FOUR), ("Kalibr", "omni", "eucm-none")),
        (
            {**SIZE, "intrinsic_type": "FISHEYE", "intrinsics": {"focal_length": 420.0}},
            ("OpenImuCameraCalibrator", '"model": "PINHOLE"'),
        ),
        ({"fl_x": 420, "fl_y": 420, "cx": 320, "cy": 240, "w": 640, "h": 480}, ("nerfstudio",)),
        ({**GYROFLOW, "digital_lens": "gopro_superview"}, ("Gyroflow", "goprosuperview")),
        ({"K": FLAT, "D": [*EIGHT, 0.1, 0, 0, 0], **SIZE}, ("OpenCV", "thin-prism")),
        ({"K": FLAT, "D": FOUR}, ("size of the pictures", "image_width")),
        ({"K": [420, 9, 319, 0, 420, 239, 0, 0, 1], "D": [], **SIZE}, ("not perpendicular",)),
        ({"K": [420, "x", 319, 0, 420, 239, 0, 0, 1], "D": [], **SIZE}, ("could not convert",)),
        ({"K": FLAT, "D": [], "image_width": 1e999, "image_height": 480}, ("infinity",)),
        ({"v2 x": {"projection_type": "brown", "width": 640}}, ("OpenSfM", '"model": "PINHOLE"')),
        ("<calibration><projection>frame</projection></calibration>", ("Agisoft Metashape",)),
        ("<!DOCTYPE x [<!ENTITY a 'b'>]><opencv_storage>&a;</opencv_storage>", ("document type",)),
        ("a: !!python/object/apply:os.system ['true']\n", ("could not determine a constructor",)),
        ("[" * 100_000, ("nested deeper",)),
        ("hello", ("contains no calibration", '"model": "PINHOLE"')),
        ("", ("contains no calibration",)),
    ],
)
def test_what_cannot_be_expressed_is_refused_by_name_with_advice(
    tmp_path: Path, content: object, words: tuple[str, ...]
) -> None:
    with pytest.raises(CaptureError) as caught:
        read(tmp_path, content)
    assert caught.value.path == str(tmp_path / "lens.txt")
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("data", "word"),
    [
        (b"PK\x03\x04x", "NumPy"), (b"\x80\x04x", "pickle"), (b"MATLAB 5.0 MAT-file\0\1", "MATLAB"),
        (b"\x01\0\0\0\0\0\0\0\x01", "cameras.txt"),
    ],
)  # fmt: skip
def test_binary_files_are_refused_by_name(tmp_path: Path, data: bytes, word: str) -> None:
    path = tmp_path / "lens.bin"
    path.write_bytes(data)
    with pytest.raises(CaptureError, match="binary format") as caught:
        read_calibration(path, "torso")
    assert word in str(caught.value)


def test_several_cameras_are_taken_by_name_or_the_names_are_shown(tmp_path: Path) -> None:
    plain = [420.0, 421.0, 319.0, 238.0]
    first = kalibr("pinhole", "radtan", plain, FOUR)
    bad = kalibr("ds", "none", [0.1, 0.5, *plain], [])
    both = first.replace("cam0", "torso", 1) + bad.replace("cam0", "head", 1)
    assert read(tmp_path, both).model == "OPENCV"
    with pytest.raises(CaptureError, match="'ds'"):
        read(tmp_path, both, "head")
    with pytest.raises(CaptureError, match="'left_palm'") as caught:
        read(tmp_path, both, "left_palm")
    assert "torso, head" in str(caught.value.hint)
    assert read(tmp_path, first, "left_palm").model == "OPENCV"
    of_torso = {"torso": {"K": FLAT, "D": [], **SIZE}}
    assert read(tmp_path, of_torso).model == "PINHOLE"
    with pytest.raises(CaptureError, match="'left_palm'"):
        read(tmp_path, of_torso, "left_palm")
    grouped = {name: {"K": FLAT, "D": [], **SIZE} for name in ("torso", "head")}
    assert read(tmp_path, {"cameras": grouped}, "head").model == "PINHOLE"
    with pytest.raises(CaptureError) as caught:
        read(tmp_path, "1 PINHOLE 640 480 420 420 320 240\n2 PINHOLE 640 480 430 430 320 240\n")
    assert "the cameras in the file are 1, 2" in str(caught.value.hint)


def test_five_coefficients_are_told_to_be_full_opencv(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="but 9 are given") as caught:
        read(
            tmp_path, {"model": "OPENCV", "params": [420, 420, 320, 240, *FIVE], "width": 640, "height": 480}
        )
    assert "FULL_OPENCV" in caught.value.message
    assert '"FULL_OPENCV", "params": [fx, fy, cx, cy, k1, k2, p1, p2, k3, k4' in str(caught.value.hint)


def test_an_error_that_no_calibration_has_is_refused(tmp_path: Path) -> None:
    lens = {"model": "PINHOLE", "params": [420, 420, 320, 240], "width": 640, "height": 480}
    made = {"rms_px": 107.2, "board": "x", "views": 8, "notes": ["look"]}
    with pytest.raises(CaptureError, match=r"107\.2 px; at most 1\.0 px") as caught:
        read(tmp_path, {**lens, "calibrated_with": made})
    assert caught.value.field == "calibrated_with.rms_px"
    found = read(tmp_path, {**lens, "calibrated_with": {**made, "rms_px": 0.2}})
    assert found.calibrated_with is not None
    assert found.calibrated_with.notes == ("look",)
    assert read(tmp_path, {**lens, "calibrated_with": "some program"}).calibrated_with is None


def test_a_job_uses_the_file_of_another_program(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_video(tmp_path / "torso.mp4", [textured_frame(n % 40, 640, 480) for n in range(75)])
    saved(tmp_path, opencv_yaml(FIVE), "cv.yml")
    saved(
        tmp_path, "capture: {calibration: cv.yml, cameras: [{name: torso, video: torso.mp4}]}\n", "job.yaml"
    )
    assert main(["check", str(tmp_path)]) == 0
    output = capsys.readouterr().out
    assert "the camera is calibrated: FULL_OPENCV, focal length 420 px" in " ".join(output.split())
    assert "FULL_OPENCV in cv.yml" in output
