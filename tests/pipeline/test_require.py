"""`--require` and the field `require`: exit code 6 for results that are written but not good enough."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bodycap_batch.config.requirement import Requirement
from bodycap_batch.core.errors import RequirementUnmet, StoreError, error_from_dict, worst_exit_code
from bodycap_batch.pipeline.requirement import unmet_requirement
from bodycap_batch.report.loss_causes import LossCause, LostSpan
from bodycap_batch.report.summary import summarise
from bodycap_batch.report.verdict import judge
from tests.pipeline.spools import SpoolFixture
from tests.pipeline.test_cli import Bench
from tests.unit.report.test_summary import metrics

FAIR = metrics(scale=0.05)


@pytest.fixture
def films(tmp_path: Path) -> Bench:
    bench = Bench(tmp_path)
    bench.order(metrics=FAIR)
    return bench


def test_results_that_are_not_good_enough_are_written_and_exit_with_6(films: Bench) -> None:
    results = films.folder / "out" / "my_walk"
    code, out, err = films.run("run", "my walk", "--require", "good,0.9")
    assert code == 6
    assert out.splitlines()[-1] == f"results: {results}"
    assert (results / "run.json").is_file()
    assert (
        "the result is usable with care with 100.0 % of the recording, but good with 90.0 % is required"
        in err
    )
    assert "The cause: Metric scale (sizes are known to about" in err
    for enough in ("usable,0.9", "usable", "poor, 1"):
        assert films.run("run", "my walk", "--require", enough)[0] == 0
    assert films.run("run", "my walk")[0] == 0, "the requirement of a command line holds for one run"


def test_programs_get_the_verdict_and_then_the_error(films: Bench) -> None:
    code, out, _ = films.run("run", "my walk", "--require", "good", "--json-progress")
    done, error = (json.loads(line) for line in out.splitlines()[-2:])
    assert code == error["exit_code"] == 6
    assert (done["kind"], done["verdict"]["grade"]) == ("done", "usable with care")
    assert (error["kind"], error["type"]) == ("error", "RequirementUnmet")
    assert type(error_from_dict(error)) is RequirementUnmet


def test_a_batch_exits_with_6_and_names_the_job(films: Bench) -> None:
    code, out, _ = films.run("batch", "my walk", "--require", "good")
    assert code == 6
    assert "not as required (6)" in out.splitlines()[-2]
    code, out, _ = films.run("batch", "my walk", "--require", "good", "--json")
    job = json.loads(out.splitlines()[-1])
    assert (code, job["exit_code"], job["verdict"]["grade"]) == (6, 6, "usable with care")
    assert job["out_dir"] is not None


def test_the_job_file_can_require_and_the_command_line_replaces_it(films: Bench) -> None:
    job = films.folder / "my walk" / "job.yaml"
    job.write_text("require: good,0.9\n")
    assert films.run("run", "my walk")[0] == 6
    assert films.run("run", "my walk", "--require", "usable")[0] == 0
    job.write_text("require: excellent\n")
    code, _, err = films.run("run", "my walk")
    assert code == 2
    assert "job.yaml:1" in err
    assert "'excellent' is not a grade" in err


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("excellent", "'excellent' is not a grade"),
        ("", "'' is not a grade"),
        ("good,90", "'90' is not a share between 0 and 1"),
        ("good,nan", "'nan' is not a share"),
        ("good,much", "'much' is not a share"),
    ],
)
@pytest.mark.parametrize("command", ["run", "batch", "watch"])
def test_a_requirement_that_cannot_be_understood_is_refused(
    films: Bench, command: str, text: str, says: str
) -> None:
    place = ["inbox"] if command == "watch" else ["my walk"]
    code, _, err = films.run(command, *place, "--require", text)
    assert code == 2
    assert f"--require: {says}" in err
    assert "for example good,0.9" in err
    assert not (films.folder / "out" / "my_walk" / "metrics.json").exists()


@pytest.mark.parametrize(
    ("job", "required", "code"),
    [("", "good", 6), ("require: usable\n", "good", 0), ("require: good\n", None, 6), ("", None, 0)],
)
def test_a_watched_job_that_is_not_good_enough_fails_with_its_results(
    bench: SpoolFixture, job: str, required: str | None, code: int
) -> None:
    bench.order(metrics=FAIR)
    bench.drop("walk", f"name: walk\n{job}")
    assert bench.run_once(require=required) == code
    status = bench.status("walk")
    assert (status["state"], status["exit_code"]) == ("failed" if code else "done", code)
    assert status["verdict"]["grade"] == "usable with care"
    assert (bench.job("walk").result / "metrics.json").is_file()


def test_the_camera_that_is_missing_is_the_cause() -> None:
    values = metrics()
    values["cameras"]["left_palm"] = {**values["cameras"]["torso"], "frames_registered": 4}  # type: ignore[index]
    summary = summarise(values)
    assert unmet_requirement("good,0.7", summary, Path("out")) is None
    assert unmet_requirement(None, summary, Path("out")) is None
    unmet = unmet_requirement("good,0.9", summary, Path("out"))
    assert unmet is not None
    assert "good with 70.0 % of the recording, but good with 90.0 % is required" in unmet.message
    assert unmet.message.endswith("The cause: left_palm has 40.0 % of its frames")
    spans = [
        LostSpan(camera="left_palm", from_s=at, to_s=at + frames, frames=frames, cause=cause)
        for at, frames, cause in ((0.0, 2, LossCause.BLUR), (3.0, 4, LossCause.PLAIN))
    ]
    unmet = unmet_requirement(
        "good,0.9", summarise(values, judge(values, None, spans).to_dict()), Path("out")
    )
    assert unmet is not None
    assert unmet.message.endswith("left_palm has 40.0 % of its frames: plain surfaces")


def test_a_joint_that_was_rarely_measured_is_the_cause() -> None:
    values = metrics()
    values["motion"] = {
        "fps": 30.0,
        "frames": 300,
        "joints": {
            "Spine1": {"role": "Spine1", "observed": True, "observed_share": 1.0},
            "LeftHand": {"role": "LeftHand", "observed": True, "observed_share": 0.5},
            "Hips": {"role": "Hips", "observed": False, "observed_share": 0.0},
        },
    }
    unmet = unmet_requirement("good,0.9", summarise(values), Path("out"))
    assert unmet is not None
    assert "75.0 % of the recording" in unmet.message
    assert unmet.message.endswith("LeftHand was measured in 50.0 % of the motion")


def test_any_failure_outranks_an_unmet_requirement() -> None:
    assert worst_exit_code([]) == 0
    assert worst_exit_code([0, 6, 0]) == 6
    assert worst_exit_code([6, StoreError.exit_code, 0]) == 5
    assert worst_exit_code([2, 6]) == 2
    assert worst_exit_code([6, 70]) == 70


def test_a_requirement_without_a_share_is_about_the_grade_alone() -> None:
    assert Requirement.from_text("usable") == Requirement(grade="usable", coverage=0.0)
    assert Requirement.from_text(" good , 0.9 ") == Requirement(grade="good", coverage=0.9)
