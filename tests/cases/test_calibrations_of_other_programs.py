"""A small file of each program that people calibrate with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.config.calibration import read_calibration
from bodycap_batch.core.errors import CaptureError

pytestmark = pytest.mark.data

CENTRED = (420.0, 420.0, 320.0, 240.0)
READ = {
    "bom.json": ("PINHOLE", CENTRED),
    "cameras.txt": ("OPENCV", (*CENTRED, 0.01, -0.002, 0.0, 0.0)),
    "camchain.yaml": ("OPENCV_FISHEYE", (*CENTRED, 0.01, -0.002, 0.0, 0.0)),
    "cv.yml": ("OPENCV", (*CENTRED, 0.01, -0.002, 0.0, 0.0)),
    "camera_array.toml": ("OPENCV", (*CENTRED, 0.01, -0.002, 0.0, 0.0)),
    # Its principal point is at 320, 240 with OpenCV's pixel origin.
    "lens.json": ("OPENCV_FISHEYE", (420.0, 420.0, 320.5, 240.5, 0.01, 0.0, 0.0, 0.0)),
}


@pytest.fixture
def folder(data_root: Path) -> Path:
    found = data_root.parent / "cases" / "foreign_calibrations"
    if not found.is_dir():
        pytest.skip(f"no such case: {found}")
    return found


@pytest.mark.parametrize("name", READ)
def test_the_file_is_read(folder: Path, name: str) -> None:
    lens = read_calibration(folder / name, "torso").calibration.camera()
    model, params = READ[name]
    assert (lens.model, lens.width_px, lens.height_px) == (model, 640, 480)
    np.testing.assert_allclose(lens.params, params)


def test_another_format_is_refused_by_name(folder: Path) -> None:
    with pytest.raises(CaptureError, match="OpenImuCameraCalibrator") as caught:
        read_calibration(folder / "openicc.json", "torso")
    assert "write the calibration like this" in str(caught.value.hint)


def test_five_coefficients_get_the_name_of_their_model(folder: Path) -> None:
    with pytest.raises(CaptureError, match="FULL_OPENCV"):
        read_calibration(folder / "five.json", "torso")
