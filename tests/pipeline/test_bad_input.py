"""Bad input: each case gives its typed error and exit code, names the file, and says what to do."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from bodycap_batch.check import check_path, require_ready
from bodycap_batch.cli import main
from bodycap_batch.config.job import load_job
from bodycap_batch.core.errors import BodycapError
from tests.broken import CASES, FRAMES, MIRRORED, Case, black, edit, overwrite
from tests.videos import textured_frame, write_video


@pytest.fixture
def capture(sound_folder: Path, tmp_path: Path) -> Path:
    """A sound job of two cameras; each test then breaks one thing."""
    return Path(shutil.copytree(sound_folder, tmp_path / "walk"))


def test_there_are_enough_of_them() -> None:
    assert len(CASES) >= 40
    assert len({case.name for case in CASES}) == len(CASES)


def test_the_sound_job_is_ready(capture: Path) -> None:
    assert check_path(capture / "job.yaml").ready


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_bad_input(capture: Path, case: Case) -> None:
    case.break_it(capture)
    report = check_path(capture / "job.yaml")
    error = report.errors[0]
    assert report.exit_code == error.exit_code == case.code
    assert case.message in error.message
    assert Path(str(error.path)).name == case.file
    assert error.hint
    assert len(error.message) < 500
    if case.code != 5:  # the disk is looked at when a stage starts, not before
        with pytest.raises(BodycapError):
            require_ready(load_job(capture / "job.yaml"))


def damaged_in_the_middle(root: Path) -> None:
    overwrite(root / "torso.mp4", 0.5, 0.6)


def shorter(root: Path) -> None:
    write_video(root / "head.mp4", MIRRORED[:20])


def upside_down(root: Path) -> None:
    write_video(root / "head.mp4", MIRRORED, rotation=180)


def variable_rate(root: Path) -> None:
    write_video(root / "head.mp4", MIRRORED, pts=[10 * i + (i % 3) * 4 for i in range(40)])


def dropped(root: Path) -> None:
    write_video(root / "head.mp4", MIRRORED, pts=[10 * (i + 15 * (i > 20)) for i in range(40)])


def frozen(root: Path) -> None:
    write_video(root / "head.mp4", [MIRRORED[0]] * 40)


def no_contrast(root: Path) -> None:
    write_video(root / "head.mp4", [textured_frame(i) // 12 + 90 for i in range(40)])


def partly_black(root: Path) -> None:
    write_video(root / "head.mp4", [*MIRRORED[:12], *[MIRRORED[0] * 0] * 28])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (damaged_in_the_middle, "of 40 frames are damaged in the video"),
        (shorter, "all cameras recorded at the same time for 0.6 s"),
        (upside_down, "ready to run"),
        (variable_rate, "variable rate"),
        (dropped, "dropped 15 frames"),
        (frozen, "the picture does not change"),
        (no_contrast, "hardly any contrast"),
        (partly_black, "inspected pictures are black"),
        (edit("capture:", "skeleton: none\ncapture:"), "ready to run"),
        (lambda root: (root / "calib.json").unlink() or edit("calib.json", "auto")(root), "not calibrated"),
    ],
)  # fmt: skip
def test_what_makes_a_job_hard_is_said_and_does_not_stop_it(
    capture: Path, change: Callable[[Path], None], said: str
) -> None:
    change(capture)
    report = check_path(capture / "job.yaml")
    assert report.ready, report.lines()
    assert said in "\n".join(report.lines())


def test_a_missing_chapter_is_no_matter_where_the_times_are_stated(capture: Path) -> None:
    (capture / "torso.mp4").unlink()
    for name in ("GX010042.MP4", "GX030042.MP4"):
        write_video(capture / "card" / name, FRAMES[:20])
    times = "\n".join(str((index + 100 * (index > 19)) / 30) for index in range(40))
    (capture / "times.txt").write_text(times)
    edit("video: torso.mp4", "video: card, timestamps: times.txt")(capture)
    assert check_path(capture / "job.yaml").ready


@pytest.mark.parametrize(
    ("break_it", "code", "message"),
    [
        (black, 3, "torso.mp4: camera torso shows only black pictures"),
        (edit("capture:", "hight_m: 1\ncapture:"), 2, "job.yaml:1: hight_m: unknown key"),
    ],
)
def test_a_refused_run_leaves_earlier_results(
    capture: Path,
    break_it: Callable[[Path], None],
    code: int,
    message: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(capture)
    results = {"motion.bvh": b"earlier", "trajectories/torso.tum": b"0 0 0 0 0 0 0 1\n"}
    for name, data in results.items():
        (capture / "results" / name).parent.mkdir(parents=True, exist_ok=True)
        (capture / "results" / name).write_bytes(data)
    break_it(capture)
    assert main(["run", "job.yaml", "--out", "results"]) == code
    told = capsys.readouterr().err
    assert message in told
    assert "hint: " in told
    assert {name: (capture / "results" / name).read_bytes() for name in results} == results
    assert main(["check", "job.yaml"]) == code
