"""The command line: messages, exit codes, progress, signals."""

from __future__ import annotations

import errno
import json
import os
import pty
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import typer
import yaml

import bodycap_batch
from bodycap_batch.cli import main
from bodycap_batch.cli.application import COMMAND_GROUPS, app
from bodycap_batch.formats.frame_table import COLUMNS
from bodycap_batch.runner import Children
from bodycap_batch.tasks.stages import STAGES
from tests.pipeline.fake_bodycap import run_here
from tests.pipeline.fake_stages import ORDERS, give_orders
from tests.processes import gone
from tests.results import results_of

ROOT = Path(__file__).parents[2]
BODYCAP = (sys.executable, str(Path(__file__).with_name("fake_bodycap.py")))


class Bench:
    """A folder with two videos in which `bodycap` runs."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.capture = folder / "my walk"
        self.capture.mkdir()
        for name in ("torso", "left_palm"):
            (self.capture / f"{name}.mp4").write_text(f"frames of {name}")
        self.environment = {**os.environ, "PYTHONPATH": str(ROOT), ORDERS: str(folder / "orders.json")}
        self.environment.pop("BODYCAP_STORE", None)
        self.order()

    def order(self, **orders: Any) -> None:
        give_orders(self.folder, **orders)

    def start(self, *arguments: str, **options: Any) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [*BODYCAP, *arguments],
            cwd=self.folder,
            env=self.environment,
            text=True,
            **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options},
        )

    def run(self, *arguments: str) -> tuple[int, str, str]:
        return run_here(self.folder, self.environment, *arguments)

    def wait_until_started(self) -> int:
        end = time.monotonic() + 30
        while not (self.folder / "started").exists() or not (self.folder / "started").read_text():
            assert time.monotonic() < end
            time.sleep(0.02)
        return int((self.folder / "started").read_text())


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


def test_a_video_that_is_not_used_is_a_note_of_the_run_and_of_the_batch(bench: Bench) -> None:
    (bench.capture / "board.mp4").write_text("a calibration board")
    (bench.capture / "job.yaml").write_text("capture: {cameras: [{name: torso, video: torso.mp4}]}\n")
    for command in (["run", "--until", "check"], ["batch"]):
        code, _, err = bench.run(*command, "my walk")
        assert code == 0, err
        assert "board.mp4 is not used: the name is not a known place on the body" in err
    job = yaml.safe_load((bench.folder / "out" / "my_walk" / "job.yaml").read_text())
    assert [camera["name"] for camera in job["capture"]["cameras"]] == ["torso", "left_palm"]
    assert job["capture"]["cameras_only"] is True


def test_a_folder_runs_without_a_job_and_the_last_line_names_the_results(bench: Bench) -> None:
    process = bench.start("run", "my walk")
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    results = bench.folder / "out" / "my_walk"
    assert out.splitlines()[-1] == f"results: {results}"
    assert (results / "metrics.json").is_file()
    assert (bench.folder / "out" / ".store" / "artefacts").is_dir()
    for line in ("keyframes torso: done", "map: started", "note: a note"):
        assert line in err


def test_the_second_run_has_nothing_to_do(bench: Bench) -> None:
    bench.run("run", "my walk")
    code, out, _ = bench.run("run", "my walk")
    assert code == 0
    assert "nothing to do, because all 15 stages were already done" in out


def test_a_child_starts_ahead_if_there_are_no_results(bench: Bench) -> None:
    with mock.patch.object(Children, "start_ahead", autospec=True) as start_ahead:
        assert bench.run("run", "my walk")[0] == 0
        assert [call.args[1] for call in start_ahead.call_args_list] == [STAGES["check"].modules]
        assert bench.run("run", "my walk")[0] == 0
        assert start_ahead.call_count == 1, "all stages may be stored"


def test_results_elsewhere_have_their_store_beside_them(bench: Bench) -> None:
    code, out, _ = bench.run("run", "my walk", "--out", "elsewhere", "--skeleton", "none")
    assert code == 0
    assert out.splitlines()[-1] == f"results: {bench.folder / 'elsewhere'}"
    assert (bench.folder / ".store" / "artefacts").is_dir()
    assert not (bench.folder / "elsewhere" / ".store").exists()
    assert not (bench.folder / "out").exists()


def test_the_store_can_be_named_by_option_or_variable(bench: Bench) -> None:
    assert bench.run("run", "my walk", "--store", "kept")[0] == 0
    bench.environment["BODYCAP_STORE"] = str(bench.folder / "kept")
    assert "nothing to do" in bench.run("run", "my walk", "--out", "elsewhere")[1]


def test_a_run_until_registration_names_that_stage(bench: Bench) -> None:
    bench.order(localised=[40], lost={"torso": 3})
    code, out, _ = bench.run("run", "my walk", "--until", "registration")
    assert (code, out) == (
        0,
        "my_walk: stopped after the stage registration, as requested; run the job again without --until to "
        "compute the other stages\n",
    )


@pytest.mark.slow
def test_stages_are_repeated_skipped_explained_and_removed(bench: Bench) -> None:
    code, out, _ = bench.run("run", "my walk", "--until", "keyframes")
    assert code == 0
    assert out.startswith("my_walk: stopped after the stage keyframes, as requested; run the job again")
    code, out, _ = bench.run("why", "my walk")
    assert code == 0
    lines = [" ".join(line.split()) for line in out.splitlines()]
    assert "map would run: this stage has not been computed before" in lines
    assert "merge would run: after map" in lines
    bench.run("run", "my walk")
    assert bench.run("why", "my walk")[1].splitlines()[-1] == "nothing to do"
    _, _, err = bench.run("run", "my walk", "--from", "merge")
    assert "registration torso: already done" in err
    assert "merge: done" in err
    assert "check: done" in bench.run("run", "my walk", "--force")[2]
    code, _, err = bench.run("run", "my walk", "--force", "--from", "merge")
    assert code == 2
    assert "use only one of the two options" in err
    bench.run("run", "my walk", "--skeleton", "none")
    code, out, _ = bench.run("gc")
    assert code == 0
    assert "would remove" in out
    assert "(use --delete to remove these artefacts)" in out
    assert out.replace("would remove", "removed").partition(" (")[0] in bench.run("gc", "--delete")[1]
    assert json.loads(bench.run("gc", "--json")[1])["artefacts"] == []


def test_json_progress_has_json_on_every_line(bench: Bench) -> None:
    code, out, err = bench.run("run", "my walk", "--json-progress")
    assert code == 0, err
    events = [json.loads(line) for line in out.splitlines()]
    assert {event["stage"] for event in events[:-1]} >= {"keyframes", "map", "merge", "export"}
    assert events[-1]["kind"] == "done"
    assert events[-1]["out_dir"] == str(bench.folder / "out" / "my_walk")


def test_json_progress_includes_a_failure(bench: Bench) -> None:
    bench.order(fail="map")
    code, out, err = bench.run("run", "my walk", "--json-progress")
    last = json.loads(out.splitlines()[-1])
    assert code == last["exit_code"] == 4
    assert (last["kind"], last["type"]) == ("error", "EstimationError")
    assert "map does not work out" in last["message"]
    assert "map does not work out" in err


def test_a_terminal_gets_one_line_for_the_job(bench: Bench) -> None:
    ours, theirs = pty.openpty()
    bench.environment |= {"TERM": "xterm", "COLUMNS": "120"}
    with bench.start("run", "my walk", stderr=theirs) as process:
        os.close(theirs)
        text = b""
        while True:
            try:
                data = os.read(ours, 1 << 16)
            except OSError:
                break
            if not data:
                break
            text += data
        assert process.wait(60) == 0
    assert b"\x1b[" in text
    assert "━" in text.decode()
    assert b"100 %" in text
    assert b"done in " in text


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_stops_the_children_and_the_next_run_continues(
    bench: Bench, number: signal.Signals, code: int
) -> None:
    bench.order(hang="map")
    process = bench.start("run", "my walk")
    child = bench.wait_until_started()
    process.send_signal(number)
    _, err = process.communicate(timeout=30)
    assert process.returncode == code
    assert "stopped" in err
    assert "Traceback" not in err
    assert gone(child)
    assert not (bench.folder / "out" / "my_walk" / "metrics.json").exists()
    bench.order()
    again, _, err = bench.run("run", "my walk")
    assert again == 0, err
    assert "keyframes torso: already done" in err


@pytest.mark.slow
def test_kill_9_at_any_stage_loses_only_that_stage(bench: Bench) -> None:
    reference = Bench(_made(bench.folder / "reference"))
    reference.run("run", "my walk")
    expected = results_of(reference.folder / "out" / "my_walk")
    for stage in ("keyframes", "export"):
        (bench.folder / "started").unlink(missing_ok=True)
        bench.order(hang=stage)
        process = bench.start("run", "my walk", stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        child = bench.wait_until_started()
        process.kill()
        process.wait()
        os.kill(child, signal.SIGKILL)
    bench.order()
    code, _, err = bench.run("run", "my walk")
    assert code == 0, err
    for done in ("check", "map", "merge"):
        assert f"{done}: already done" in err
    assert results_of(bench.folder / "out" / "my_walk") == expected


def test_two_runs_of_a_job_at_the_same_time_give_its_results(bench: Bench) -> None:
    both = [bench.start("run", "my walk") for _ in range(2)]
    ends = [process.communicate(timeout=90) for process in both]
    assert [process.returncode for process in both] == [0, 0], ends
    results = results_of(bench.folder / "out" / "my_walk")
    assert "nothing to do" in bench.run("run", "my walk")[1]
    assert results_of(bench.folder / "out" / "my_walk") == results
    assert not any(name.endswith(".part") for name in results)
    assert list((bench.folder / "out" / ".store" / "tmp").iterdir()) == []
    assert list((bench.folder / "out" / ".store" / "corrupt").iterdir()) == []


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder


_ON_A_SMALL_DISK = """
import sys
from pathlib import Path
from tests.pipeline.test_cli import Bench
from tests.results import results_of
bench = Bench(Path(sys.argv[1]))
out = bench.folder / "out" / "my_walk"
assert bench.run("run", "my walk")[0] == 0
before = results_of(out)
bench.order(fill="map")
(bench.capture / "torso.mp4").write_text("other frames")
code, _, err = bench.run("run", "my walk")
assert code == 5, err
assert "space" in err and "--store" in err and "Traceback" not in err, err
assert results_of(out) == before
bench.order()
code, _, err = bench.run("run", "my walk")
assert code == 0 and "keyframes torso: already done" in err, err
assert results_of(out) != before
"""


@pytest.mark.slow
def test_a_disk_that_fills_up_leaves_earlier_results_intact(tmp_path: Path) -> None:
    mount = ["unshare", "--mount", "--propagation", "private", "sh", "-c"]
    if subprocess.run([*mount, "mount -t tmpfs none /mnt"], capture_output=True, check=False).returncode:
        pytest.skip("needs the right to mount a tmpfs in a mount namespace of its own (root)")
    command = 'mount -t tmpfs -o size=128m none "$1" && exec "$2" -c "$3" "$1"'
    done = subprocess.run(
        [*mount, command, "sh", str(tmp_path), sys.executable, _ON_A_SMALL_DISK],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_insufficient_data_is_exit_code_4_with_partial_results(bench: Bench) -> None:
    bench.order(fail="merge")
    code, _, err = bench.run("run", "my walk")
    assert code == 4
    assert "merge does not work out" in err
    assert "hint: film more" in err
    assert (bench.folder / "out" / "my_walk" / "partial" / "metrics.json").is_file()


def test_a_bug_is_exit_code_70_with_a_traceback(bench: Bench) -> None:
    (bench.folder / "orders.json").write_text("no JSON")
    code, _, err = bench.run("run", "my walk")
    assert code == 70
    assert "Traceback" in err
    assert "please report" in err


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["run"], 2, "Missing argument"),
        (["fly"], 2, "No such command"),
        (["run", "nothing.yaml"], 2, "nothing.yaml"),
        (["run", "{folder}", "--height", "17.5"], 2, "height"),
        (["run", "{folder}", "--skeleton", "centaur"], 2, "centaur"),
        (["run", "{folder}", "--threads", "0"], 2, "threads"),
        (["run", "{empty}"], 3, "no video"),
        (["check", "{empty}"], 3, "no video"),
        (["synth", "{empty}/new", "--set", "fog=1"], 2, "fog"),
        (["synth", "{empty}/new", "--set", "nois=1"], 2, "did you mean 'noise'?"),
        (["synth", "{empty}/new", "--cameras", "torso,elbow_x"], 2, "'elbow_x' is not the name of a place"),
        (["synth", "{empty}/new", "--set", "exposure_s=1"], 2, "`bodycap synth --help`"),
        (["synth", "{empty}/new", "--seconds", "0"], 2, "should be greater than 0"),
        (["synth", "{empty}/new", "--set", "noise"], 2, "KEY=VALUE"),
        (["synth", "{empty}/new", "--size", "big"], 2, "640x480"),
        (["evaluate", "{folder}", "{empty}"], 2, "compared"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_wrong_arguments_are_named(
    bench: Bench, capfd: pytest.CaptureFixture[str], arguments: list[str], code: int, words: str
) -> None:
    (bench.folder / "empty").mkdir()
    places = {"folder": str(bench.capture), "empty": str(bench.folder / "empty")}
    assert main([part.format(**places) for part in arguments]) == code
    captured = capfd.readouterr()
    assert words in captured.err + captured.out
    assert "Traceback" not in captured.err


def test_an_unwritable_results_folder_is_named(bench: Bench) -> None:
    (bench.folder / "out").write_text("a file")
    code, _, err = bench.run("run", "my walk")
    assert code == 5
    assert str(bench.folder / "out") in err
    assert "hint:" in err


def test_the_help_lists_every_command_once_in_its_group(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["--help"]) == 0
    text = capfd.readouterr().out
    assert [line for line in text.splitlines() if len(line) > 80] == []
    listed = text.partition("Record and solve:")[2]
    assert "..." not in listed
    words = [line.split()[0] for line in listed.splitlines() if line.startswith("  ") and line[2] != " "]
    assert sorted(words) == sorted(typer.main.get_command(app).commands)  # type: ignore[attr-defined]
    titles = [line.rstrip(":") for line in listed.splitlines() if line and not line.startswith(" ")]
    assert titles == list(COMMAND_GROUPS)[1:]


def test_a_disk_that_does_not_answer_is_not_a_bug(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def stale(path: Path) -> Path:
        raise OSError(errno.ESTALE, os.strerror(errno.ESTALE), str(path))

    monkeypatch.setattr(Path, "resolve", stale)
    assert main(["check", "walk"]) == 5
    output = capfd.readouterr().err
    assert "error: walk: Stale file handle" in output
    assert "mounted" in output
    assert "bug" not in output


def test_the_version_is_printed(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capfd.readouterr().out.strip() == f"bodycap {bodycap_batch.__version__}"


@pytest.mark.parametrize("command", ["run", "check", "evaluate", "synth"])
def test_every_command_has_help_with_an_example(command: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert main([command, "--help"]) == 0
    text = capfd.readouterr().out
    assert f"  bodycap {command} " in text
    assert "[default" not in text.split("Options:")[0]


def _write_tum(path: Path, centres: np.ndarray) -> None:
    rows = [f"{0.1 * i} {x} {y} {z} 0 0 0 1" for i, (x, y, z) in enumerate(centres)]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(rows) + "\n")


def test_evaluate_aligns_all_cameras_together_and_counts_lost_frames(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(3)
    for name in ("torso", "left_palm"):
        centres = rng.normal(size=(50, 3))
        _write_tum(tmp_path / "gt" / f"{name}.tum", centres)
        _write_tum(tmp_path / "mine" / "trajectories" / f"{name}.tum", 2.0 * centres + 1.0)
    rows = [
        f"{name},{i},{0.1 * i},{0.1 * i},{'REGISTERED,' if i < 50 else 'LOST,BLUR'},0,,,"
        for name in ("torso", "left_palm")
        for i in range(100)
    ]
    table = "\n".join(["# a comment", ",".join(COLUMNS), *rows]) + "\n"
    (tmp_path / "mine" / "frames.csv").write_text(table)
    assert main(["evaluate", str(tmp_path / "mine"), str(tmp_path), "--json"]) == 0
    report = json.loads(capfd.readouterr().out)["trajectories"]
    assert report["scale"] == pytest.approx(0.5, abs=1e-9)
    assert report["total"]["ate_m"]["rmse"] == pytest.approx(0.0, abs=1e-9)
    assert report["total"]["coverage"] == 0.5
    assert main(["evaluate", str(tmp_path / "mine"), str(tmp_path), "--reference", "torso"]) == 0
    text = capfd.readouterr().out
    assert "left_palm from torso: 50 frames" in text
    assert "50.0 %" in text
