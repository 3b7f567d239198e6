"""Whole jobs on rendered captures that are hard in one way each, scored against the exact truth."""

from __future__ import annotations

import csv
import json
import os
from pathlib import Path
from typing import Any

import pytest

from bodycap_batch.cli import main
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.evaluate import TrajectoryReport, evaluate_trajectories
from bodycap_batch.synthetic import SynthOptions, synthesise
from tests.altered import AS_A_PHONE, alter, covered, slower, zoomed

pytestmark = pytest.mark.slow

SMALL: dict[str, Any] = {"seconds": 4.0, "width": 480, "height": 360, "seed": 5}
FISHEYE = {"lens": "OPENCV_FISHEYE", "lens_params": (225.0, 225.0, 241.5, 178.5, 0.03, -0.01, 0.004, -0.001)}
PRESSED_S = (1.5, 2.7)
CASES: dict[str, dict[str, Any]] = {
    # Drawn many times over for each frame: shorter, and two cameras.
    "blurred": {"exposure_s": 0.008, "cameras": ("torso", "left_palm"), "seconds": 3.0},
    "rolling": {"rolling_shutter_s": 0.02, "cameras": ("torso", "left_palm"), "seconds": 3.0},
    # With the forearms held up, palms see the ceiling alone; chest and head see the arms before the room.
    "arms in view": {"cameras": ("torso", "head"), "body_in_view": True, "arms_ahead": 1.0},
    "fisheye": FISHEYE,
    "on the spot": {"on_the_spot": True, "cameras": ("torso", "head"), "seconds": 5.0},
}
# What the project asks for on these: 95 % of the frames, 2 cm. A pixel is 1 cm at the 3 m of this room: half
# a millimetre would mean that truth leaked.
MIN_COVERAGE, MAX_ATE_M, MIN_ATE_M = 0.95, 0.02, 0.0005


def _render(folder: Path, **values: Any) -> Path:
    context = StageContext(work_dir=folder, threads=os.cpu_count() or 1)
    synthesise(SynthOptions(**{**SMALL, **values}), folder / "capture", context)
    return folder / "capture"


def _run(capture: Path) -> int:
    """Map and paths alone, without their video."""
    cameras = [{"name": path.stem, "video": path.name} for path in sorted(capture.glob("*.mp4"))]
    job = {"capture": {"cameras": cameras}, "skeleton": "none", "export": {"preview": False}}
    if (capture / "calib.json").exists():
        job["capture"]["calibration"] = "calib.json"
    (capture / "job.json").write_text(json.dumps(job))
    return int(main(["run", str(capture / "job.json"), "--out", str(capture.parent / "out")]))


def _score(capture: Path) -> TrajectoryReport:
    """All frames of all cameras under one similarity."""
    rows = _rows(capture)
    frames = {name: sum(row["camera"] == name for row in rows) for name in {row["camera"] for row in rows}}
    paths = {path.stem: path for path in (capture.parent / "out" / "trajectories").glob("*.tum")}
    assert set(paths) == set(frames)
    truth = {name: capture / "gt" / f"{name}.tum" for name in frames}
    return evaluate_trajectories(paths, truth, frames=frames)


def _rows(capture: Path) -> list[dict[str, str]]:
    with (capture.parent / "out" / "frames.csv").open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(line for line in stream if not line.startswith("#")))


@pytest.mark.parametrize("case", CASES)
def test_a_hard_capture_is_registered_and_right(case: str, tmp_path: Path) -> None:
    capture = _render(tmp_path, **CASES[case])
    assert _run(capture) == 0
    report = _score(capture)
    assert report.total.coverage is not None
    assert report.total.ate_m is not None
    assert report.total.coverage >= MIN_COVERAGE
    assert MIN_ATE_M < report.total.ate_m.rmse < MAX_ATE_M


COVERED_S = {"torso": (0.0, 0.6), "left_palm": (1.5, 2.3)}
RECORDED = {
    "phones": dict.fromkeys(COVERED_S, AS_A_PHONE),
    "covered": {name: covered(span) for name, span in COVERED_S.items()},
    "rates": {"left_palm": slower(2, (240, 180))},
    "zoomed": {"left_palm": zoomed(0.75)},
}


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _render(tmp_path_factory.mktemp("walk"), seed=7, cameras=tuple(COVERED_S))


@pytest.mark.parametrize("how", RECORDED)
def test_what_cameras_in_the_field_record_is_registered_and_right(
    how: str, walk: Path, tmp_path: Path
) -> None:
    capture = alter(walk, tmp_path / "capture", RECORDED[how])
    assert _run(capture) == 0
    report, rows = _score(capture), _rows(capture)
    hidden = [row for row in rows if how == "covered" and _in(float(row["time"]), COVERED_S[row["camera"]])]
    assert len(hidden) == (42 if how == "covered" else 0)
    assert not any(row["status"] in ("REGISTERED", "KEYFRAME") for row in hidden)
    assert report.total.registered >= MIN_COVERAGE * (len(rows) - len(hidden))
    assert report.total.ate_m is not None
    assert MIN_ATE_M < report.total.ate_m.rmse < MAX_ATE_M


def _in(time_s: float, span_s: tuple[float, float]) -> bool:
    return span_s[0] <= time_s < span_s[1]


def test_a_palm_at_the_chest_is_refused_and_comes_back(tmp_path: Path) -> None:
    capture = _render(tmp_path, seed=2, body_in_view=True, pressed_s={"left_palm": PRESSED_S})
    assert _run(capture) == 0
    report = _score(capture)
    palm = [row for row in _rows(capture) if row["camera"] == "left_palm"]
    for row in palm:
        if PRESSED_S[0] <= float(row["time"]) <= PRESSED_S[1]:
            # Nothing but the wearer's chest is seen.
            assert row["status"] != "REGISTERED", row
            assert row["status"]
    # The hand leaves within half a second; from then on at most five frames are lost.
    after = [row for row in palm if float(row["time"]) > PRESSED_S[1] + 0.5]
    assert sum(row["status"] != "REGISTERED" for row in after) <= 5
    # None registered wrongly: 10 cm is the project's bound for a pose that is reported good.
    assert report.total.ate_m is not None
    assert report.total.ate_m.max < 0.10
    assert report.total.ate_m.rmse < MAX_ATE_M


def test_a_room_of_repeated_posters_is_right_or_refused(tmp_path: Path) -> None:
    capture = _render(tmp_path, seed=3, furnished=False, repeated_posters=True)
    code = _run(capture)
    if code == 0:
        report = _score(capture)
        assert report.total.ate_m is not None
        assert report.total.ate_m.rmse < MAX_ATE_M
    else:
        assert code == EstimationError.exit_code


@pytest.mark.parametrize("lens", [{}, FISHEYE], ids=["usual", "fisheye"])
def test_a_lens_that_is_not_given_is_found(lens: dict[str, Any], tmp_path: Path) -> None:
    import pycolmap

    capture = _render(tmp_path, **lens)
    true_focal_px = json.loads((capture / "calib.json").read_text())["params"][0]
    (capture / "calib.json").unlink()
    assert _run(capture) == 0
    report = _score(capture)
    assert report.total.coverage is not None
    assert report.total.ate_m is not None
    assert report.total.coverage >= MIN_COVERAGE
    assert report.total.ate_m.rmse < MAX_ATE_M
    model = pycolmap.Reconstruction(str(tmp_path / "out" / "colmap" / "0"))
    for camera in model.cameras.values():
        # The first guess is 9 % off for the usual lens, 50 % for the fisheye.
        assert camera.mean_focal_length() == pytest.approx(true_focal_px, rel=0.01)
        assert camera.mean_focal_length() != pytest.approx(true_focal_px, rel=1e-6)
