"""Whole jobs on recordings that repeat a picture, and on captures in which no camera moves."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bodycap_batch.core.errors import EstimationError
from bodycap_batch.report.grades import Grade
from bodycap_batch.report.verdict import judge
from tests.altered import Recording, alter, frozen, on_a_tripod
from tests.evaluation import evaluate_trajectories
from tests.pipeline.hard_captures import MAX_ATE_M, render, rows_of, run

pytestmark = pytest.mark.slow

CAMERAS = ("torso", "left_palm")
SECONDS = 4.0
FROZEN_S = {
    "last second of a palm": {"left_palm": (3.0, SECONDS)},
    "middle of a palm": {"left_palm": (1.0, 2.0)},
    "all cameras from the middle on": dict.fromkeys(CAMERAS, (2.0, SECONDS)),
}
"""Intervals (s) in which a recording repeats a picture. Without the status FROZEN, all frames were localised,
and the largest error of a position was 0.95, 0.70 and 1.39 m (measured with a third camera)."""
MAX_ERROR_M = 0.10
"""The project's bound for a pose that is reported good."""


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render(
        tmp_path_factory.mktemp("walk"), seed=7, cameras=CAMERAS, seconds=SECONDS, width=320, height=240
    )


@pytest.mark.parametrize("case", FROZEN_S)
def test_frozen_frames_are_lost_and_all_others_are_right(
    case: str, walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spans = FROZEN_S[case]
    capture = alter(walk, tmp_path / "capture", {name: frozen(span) for name, span in spans.items()})
    assert run(capture) == 0
    said = capsys.readouterr().err
    assert all(
        f"{name}: the recording repeats one picture from {span[0]:.2f}" in said
        for name, span in spans.items()
    )
    for row in rows_of(capture):
        start, end = spans.get(row["camera"], (SECONDS, SECONDS))
        is_frozen = start <= float(row["time"]) < end
        assert (row["reason"] == "FROZEN") == is_frozen, row
    out = tmp_path / "out"
    paths = {name: out / "trajectories" / f"{name}.tum" for name in CAMERAS}
    report = evaluate_trajectories(paths, {name: capture / "gt" / f"{name}.tum" for name in CAMERAS})
    assert report.total.ate_m is not None
    assert report.total.ate_m.rmse < MAX_ATE_M
    assert report.total.ate_m.max < MAX_ERROR_M
    # The lost quarter or half of a camera is visible in the verdict.
    metrics = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
    assert judge(metrics, None).grade > Grade.GOOD


@pytest.mark.parametrize("recording", [frozen((0.0, SECONDS)), on_a_tripod(2.0)], ids=["frozen", "tripod"])
def test_a_capture_in_which_no_camera_moves_has_no_result(
    recording: Recording, walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capture = alter(walk, tmp_path / "capture", {"torso": recording})
    (capture / "left_palm.mp4").unlink()
    assert run(capture) == EstimationError.exit_code
    said = capsys.readouterr().err
    assert "no camera moves" in said
    assert "did the recordings freeze" in said
