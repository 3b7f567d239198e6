"""Whole jobs on captures with a fisheye, without a given lens, and with a camera that only rotates.

They are in a file of their own because the tests of a file run in one process, one after another.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.pipeline.hard_captures import (
    FISHEYE,
    MAX_ATE_M,
    MIN_COVERAGE,
    check_is_right,
    render,
    run,
    score,
)

pytestmark = pytest.mark.slow

TURN: dict[str, Any] = {"on_the_spot": True, "cameras": ("torso", "head"), "seconds": 5.0}


@pytest.fixture(scope="module")
def fisheye(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture with a fisheye, rendered once; each test works on a copy."""
    return render(tmp_path_factory.mktemp("fisheye"), **FISHEYE)


@pytest.mark.parametrize("case", ["fisheye", "on the spot"])
def test_a_hard_lens_or_turn_is_registered_and_right(case: str, fisheye: Path, tmp_path: Path) -> None:
    check_is_right(_copy(fisheye, tmp_path) if case == "fisheye" else render(tmp_path, **TURN))


def _copy(capture: Path, folder: Path) -> Path:
    return Path(shutil.copytree(capture, folder / capture.name))


@pytest.mark.parametrize("lens", ["usual", "fisheye"])
def test_a_lens_that_is_not_given_is_found(lens: str, fisheye: Path, tmp_path: Path) -> None:
    import pycolmap

    capture = _copy(fisheye, tmp_path) if lens == "fisheye" else render(tmp_path)
    true_focal_px = json.loads((capture / "calib.json").read_text())["params"][0]
    (capture / "calib.json").unlink()
    assert run(capture) == 0
    report = score(capture)
    assert report.total.coverage is not None
    assert report.total.ate_m is not None
    assert report.total.coverage >= MIN_COVERAGE
    assert report.total.ate_m.rmse < MAX_ATE_M
    model = pycolmap.Reconstruction(str(tmp_path / "out" / "colmap" / "0"))
    for camera in model.cameras.values():
        # The first guess is 9 % off for the usual lens, 50 % for the fisheye.
        assert camera.mean_focal_length() == pytest.approx(true_focal_px, rel=0.01)
        assert camera.mean_focal_length() != pytest.approx(true_focal_px, rel=1e-6)
