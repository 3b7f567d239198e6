"""What is printed: names that a terminal would execute, encodings without their characters, a full disk."""

from __future__ import annotations

import ast
import errno
import io
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

import bodycap_batch.cli.progress_display as shown
from bodycap_batch.cli import application, main, terminal
from bodycap_batch.cli.batch import _BatchReporter
from bodycap_batch.core.errors import BodycapError, JobError, StoreError
from bodycap_batch.core.printable import printable
from bodycap_batch.core.progress import Event
from bodycap_batch.pipeline.batch import BatchJob, Outcome, _outcome
from bodycap_batch.store import Store
from bodycap_batch.watch.job_status import JobStatusFile, append_log
from bodycap_batch.watch.spool import JobDir
from tests.pipeline.spools import SpoolFixture

ROOT = Path(__file__).parents[2]
COMMAND = (sys.executable, "-c", "from bodycap_batch.cli import main; main()")
BAD = "a\x1b[2J\nb\rc\x07d\u202ee\x9bf\u2028g"
"""A name that clears the screen, begins a line, goes back to its start, rings and turns the text around."""
SHOWN = r"a\x1b[2J\nb\rc\x07d\u202ee\x9bf\u2028g"
UNDECODABLE = "not\udcfftext"


def is_clean(text: str) -> bool:
    return all(line == printable(line) for line in text.split("\n"))


def run(*arguments: str | bytes, **options: Any) -> subprocess.CompletedProcess[bytes]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **options.pop("environment", {})}
    options.setdefault("stdout", subprocess.PIPE)
    return subprocess.run(
        [*COMMAND, *arguments], stderr=subprocess.PIPE, env=environment, check=False, **options
    )


def test_special_characters_are_escaped_and_others_are_not() -> None:
    assert printable(BAD) == SHOWN
    assert printable(UNDECODABLE) == r"not\udcfftext"
    plain = "Küche 厨房 \U0001f469\u200d\U0001f680 نص"
    assert printable(plain) == plain


def test_an_error_has_two_lines_whatever_it_names() -> None:
    error = JobError(f"no job named {BAD}", path=BAD, field=BAD, hint=f"rename {BAD}")
    assert len(str(error).split("\n")) == 2
    assert is_clean(str(error))
    assert error.one_line == printable(error.one_line)
    assert error.to_dict()["path"] == BAD, "for programs"


def test_no_name_in_the_spool_reaches_the_terminal_as_it_is(
    bench: SpoolFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    (bench.spool.inbox / BAD).mkdir()
    (bench.spool.inbox / f"{BAD}.txt").touch()
    (bench.spool.inbox / os.fsdecode(b"not\xfftext")).mkdir()
    for folder in (bench.spool.running, bench.spool.failed):
        job = JobDir(folder / f"{BAD}{folder.name}")
        job.path.mkdir()
        JobStatusFile(job).update(state="failed", stage=BAD, camera=BAD, error={"message": BAD, "hint": BAD})
    assert main(["status", str(bench.spool.root)]) == 0
    out = capfd.readouterr().out
    assert is_clean(out)
    assert r"not\udcfftext" in out
    rows = [line for line in out.split("\n") if SHOWN in line]
    assert len(rows) == 4
    for command in (
        ["retry", BAD],
        ["retry", f"{BAD}running"],
        ["cancel", f"{BAD}failed"],
        ["fly", BAD],
        [BAD],
    ):
        assert main([*command, str(bench.spool.root)]) == 2
        captured = capfd.readouterr()
        assert is_clean(captured.out + captured.err)
        assert SHOWN in captured.err or command[0] == "fly"


def test_names_in_the_log_of_a_job_are_escaped(tmp_path: Path) -> None:
    job = JobDir(tmp_path / "walk")
    job.path.mkdir()
    append_log(job, f"failed: {JobError('wrong', path=BAD, hint=BAD)}")
    text = job.log.read_text(encoding="utf-8")
    assert is_clean(text)
    assert len(text.splitlines()) == 2


def test_names_in_the_lines_of_a_watcher_are_escaped(
    bench: SpoolFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    (bench.spool.inbox / f"{BAD}.txt").touch()
    (bench.spool.inbox / BAD).mkdir()
    (bench.spool.inbox / BAD / "torso.mp4.part").touch()
    assert main(["watch", str(bench.spool.inbox), "--once", "--settle", "0"]) == 0
    err = capfd.readouterr().err
    assert is_clean(err)
    assert len([line for line in err.split("\n") if "stays in the inbox" in line]) == 2


def test_names_in_the_display_of_progress_are_escaped(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    events = [
        Event(kind="note", stage="", what=f"as {BAD} says [bold]"),
        Event(kind="started", stage="map", camera=BAD),
        Event(kind="progress", stage="map", camera=BAD, done=1, total=2, what=BAD),
        Event(kind="finished", stage="map", camera=BAD),
    ]
    with shown.ProgressLines() as lines:
        for event in events:
            lines(event)
    _BatchReporter(as_json=False).listener(Path(BAD))(events[1])
    error = JobError("wrong", path=BAD)
    error.add_note(f"note of {BAD!r}\nsecond line")
    _BatchReporter(as_json=False).report_outcome(
        Outcome(job=BatchJob(path=Path(BAD)), seconds=1.0, error=error)
    )
    assert is_clean(capfd.readouterr().err)
    stream = io.StringIO()
    monkeypatch.setattr(
        "rich.console.Console", lambda **_: Console(file=stream, width=400, color_system=None)
    )
    with shown.LiveProgress() as bars:
        for event in events:
            bars(event)
    text = stream.getvalue()
    assert f"as {SHOWN} says [bold]" in text
    assert "\x1b[2J" not in text
    assert "\u202e" not in text
    assert "\x07" not in text


def test_the_paths_of_the_garbage_are_escaped(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    store = Store(tmp_path)
    (tmp_path / "corrupt" / BAD).mkdir()
    assert store.root.is_dir()
    assert main(["gc", str(tmp_path)]) == 0
    out = capfd.readouterr().out
    assert is_clean(out)
    assert SHOWN in out


def test_a_bug_that_names_a_file_is_escaped(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError(BAD)

    monkeypatch.setattr(Path, "is_dir", fail)
    assert main(["status", "jobs"]) == 70
    assert is_clean(capfd.readouterr().err)


def test_only_one_module_of_the_commands_prints() -> None:
    writers = {"echo", "secho", "print", "write"}
    for path in sorted(Path(application.__file__).parent.glob("*.py")):
        if path.name == Path(terminal.__file__).name:
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call):
                continue
            name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            of_bars = isinstance(node.func, ast.Attribute) and "console" in ast.unparse(node.func)
            assert name not in writers or of_bars, (
                f"{path.name}:{node.lineno} prints without the terminal module"
            )


def test_an_output_encoding_without_the_characters_gets_escapes(tmp_path: Path) -> None:
    inbox = tmp_path / "inbox"
    (inbox / "Küche").mkdir(parents=True)
    plain_c = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    assert run("watch", "--help", environment=plain_c).returncode == 0
    done = run("status", str(tmp_path), environment=plain_c)
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.isascii()
    done = run("status", str(tmp_path), environment={"PYTHONIOENCODING": "latin-1"})
    assert "Küche".encode("latin-1") in done.stdout


@pytest.mark.parametrize("arguments", [["--version"], ["--help"], ["status", "."]])
def test_a_full_disk_under_the_output_is_a_disk_error(tmp_path: Path, arguments: list[str]) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("needs /dev/full")
    with open("/dev/full", "wb") as full:
        done = run(*arguments, cwd=tmp_path, stdout=full)
    assert done.returncode == 5, done.stderr
    assert done.stderr.startswith(b"error: standard output cannot be written: No space left on device\n")
    assert b"hint:" in done.stderr
    assert b"Traceback" not in done.stderr


def test_a_reader_that_ends_early_is_no_error(tmp_path: Path) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "wb") as closed:
        done = run("status", ".", cwd=tmp_path, stdout=closed)
    assert done.stderr == b""
    assert done.returncode in (0, 1)


def test_standard_error_on_a_full_disk_changes_no_exit_code(tmp_path: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("needs /dev/full")
    with open("/dev/full", "wb") as full:
        done = subprocess.run(
            [*COMMAND, "status", "missing"],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            stdout=full,
            stderr=full,
            check=False,
        )
    assert done.returncode == 2


@pytest.mark.parametrize("command", [["run", "walk"], ["status", "jobs"], ["watch"], ["check", "."], ["gc"]])
def test_a_deleted_working_folder_is_one_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], command: list[str]
) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    assert main(command) == 5
    err = capfd.readouterr().err
    assert err.startswith("error: the working folder no longer exists\n  hint: ")
    assert len(err.splitlines()) == 2
    assert main([*command[:1], "--help"]) == 0


@pytest.mark.parametrize("command", [["run", "{bad}"], ["run", "walk", "--out", "{bad}"], ["gc", "{bad}"]])
def test_a_path_that_is_not_utf8_is_refused_at_once(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], command: list[str]
) -> None:
    bad = os.fsdecode(os.fsencode(tmp_path) + b"/\xff")
    assert main([part.format(bad=bad) for part in command]) == 2
    err = capfd.readouterr().err
    assert r"\udcff is not UTF-8 text" in err
    assert "hint: rename" in err
    assert not list(tmp_path.iterdir())


def test_a_working_folder_or_store_that_is_not_utf8_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / os.fsdecode(b"\xff")
    folder.mkdir()
    monkeypatch.setenv("BODYCAP_STORE", str(folder))
    assert main(["gc"]) == 2
    monkeypatch.delenv("BODYCAP_STORE")
    monkeypatch.chdir(folder)
    assert main(["run", "walk"]) == 2
    assert capfd.readouterr().err.count(r"\udcff is not UTF-8 text") == 2


def test_a_name_that_is_not_utf8_inside_a_job_is_not_a_bug(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def encode(_: Path) -> bool:
        return bool(UNDECODABLE.encode())

    monkeypatch.setattr(Path, "is_dir", encode)
    assert main(["status", "jobs"]) == 2
    assert r"not\udcfftext is not UTF-8 text" in capfd.readouterr().err


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO])
def test_a_disk_that_fails_anywhere_is_exit_code_5(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], number: int
) -> None:
    def fail(path: Path) -> None:
        raise OSError(number, os.strerror(number), str(path))

    monkeypatch.setattr(Path, "is_dir", fail)
    assert main(["status", "jobs"]) == 5
    err = capfd.readouterr().err
    assert err.startswith(f"error: jobs: {os.strerror(number)}\n  hint: ")
    future = SimpleNamespace(exception=lambda: OSError(number, os.strerror(number)))
    found: Outcome = _outcome(BatchJob(path=Path("walk")), future, 1.0)  # type: ignore[arg-type]
    assert found.exit_code == 5


def test_json_is_ascii(capfd: pytest.CaptureFixture[str]) -> None:
    terminal.print_json({"name": BAD, "other": UNDECODABLE})
    out = capfd.readouterr().out
    assert is_clean(out)
    assert out.isascii()
    assert json.loads(out) == {"name": BAD, "other": UNDECODABLE}


def test_errors_of_the_output_are_store_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    class Full(io.StringIO):
        def flush(self) -> None:
            raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr(sys, "stdout", Full())
    with pytest.raises(StoreError, match="standard output"):
        terminal.print_line("text")
    assert issubclass(StoreError, BodycapError)
