"""The progress of a job on a terminal: one line for the job, the current tasks, and no broken words."""

from __future__ import annotations

import contextlib
import fcntl
import io
import os
import pty
import struct
import subprocess
import sys
import termios
from itertools import pairwise
from pathlib import Path

import pytest
from rich.console import Console

from bodycap_batch.cli import progress_display, terminal
from bodycap_batch.cli.job_progress import READING_VIDEOS, JobProgress
from bodycap_batch.core.progress import Event, Kind
from bodycap_batch.tasks.order import STAGE_ORDER

ROOT = Path(__file__).parents[2]
CAMERAS = ("torso", "left_palm", "right_palm")
WIDTH = 80


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def event(kind: Kind, stage: str, camera: str = "", done: int = 0, total: int = 0, what: str = "") -> Event:
    return Event(kind=kind, stage=stage, camera=camera, done=done, total=total, what=what)


def run_of(stages: tuple[str, ...] = STAGE_ORDER) -> list[Event]:
    """The events of a job with three cameras, two of which run at the same time."""
    events = [event("progress", READING_VIDEOS, done=done, total=30, what="MB") for done in (0, 15, 30)]
    for stage in stages:
        for camera in CAMERAS if stage in ("keyframes", "registration") else ("",):
            events.append(event("started", stage, camera))
            events += [event("progress", stage, camera, done, 360, "frames") for done in range(0, 361, 40)]
            events.append(event("finished", stage, camera))
    return events


def test_the_progress_of_a_job_grows_from_nothing_to_all_of_it() -> None:
    job, seen = JobProgress(), []
    job.expect_cameras(len(CAMERAS))
    for each in run_of():
        job.update(each)
        seen.append(job.fraction)
    assert seen == sorted(seen)
    assert seen[0] == 0.0
    assert seen[-1] == pytest.approx(1.0)
    # A step of a task is at most a part of a stage, and the map, the longest stage, is a third of a job.
    assert max(after - before for before, after in pairwise(seen)) < 0.34


def test_an_unfinished_camera_is_missing_in_the_progress() -> None:
    fractions = []
    for count in (1, 3):
        job = JobProgress()
        job.expect_cameras(count)
        job.update(event("finished", "check"))
        job.update(event("finished", "keyframes", "torso"))
        fractions.append(job.fraction)
    job = JobProgress()
    job.update(event("finished", "check"))
    assert fractions[1] - job.fraction == pytest.approx((fractions[0] - job.fraction) / 3)


def test_the_time_left_follows_from_the_time_that_was_needed() -> None:
    clock = Clock()
    job = JobProgress(clock)
    job.update(event("started", "check"))
    assert job.left_s() is None
    start = job.fraction
    clock.now = 100.0
    job.update(event("finished", "map"))
    assert job.left_s() == pytest.approx(100.0 * (1.0 - job.fraction) / (job.fraction - start))
    expected = 100.0 * (1.0 - job.fraction) / (job.fraction - start)
    clock.now = 120.0
    assert job.left_s() == pytest.approx(expected - 20.0)
    clock.now = 100.0 + expected  # a step without progress takes longer than everything was expected to
    assert job.left_s() is None
    clock.now = 400.0
    job.update(event("finished", "registration"))
    assert job.left_s() == pytest.approx(400.0 * (1.0 - job.fraction) / (job.fraction - start))


def test_reused_stages_do_not_count_as_fast() -> None:
    clock = Clock()
    job = JobProgress(clock)
    for stage in ("check", "keyframes", "map"):
        job.update(event("reused", stage))
    done = job.fraction
    job.update(event("started", "registration"))
    clock.now = 30.0
    job.update(event("finished", "registration"))
    assert job.left_s() == pytest.approx(30.0 * (1.0 - job.fraction) / (job.fraction - done))


def test_a_command_with_one_stage_is_one_job_and_rendering_comes_before_the_job() -> None:
    job = JobProgress()
    job.update(event("progress", "synth", done=270, total=1080, what="torso"))
    assert job.fraction == pytest.approx(0.25)
    job.update(event("started", "check"))
    assert job.fraction < 0.05


def shown(events: list[Event], monkeypatch: pytest.MonkeyPatch, error: Exception | None = None) -> str:
    """What the display leaves on a screen of 80 columns after these events."""
    stream = io.StringIO()
    monkeypatch.setattr(
        "rich.console.Console", lambda **_: Console(file=stream, width=WIDTH, color_system=None)
    )
    try:
        with progress_display.LiveProgress() as display:
            display.expect_cameras(len(CAMERAS))
            for each in events:
                display(each)
            if error is not None:
                raise error
    except RuntimeError:
        pass
    return stream.getvalue()


def test_a_finished_job_leaves_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    (line,) = shown(run_of(), monkeypatch).splitlines()
    assert " 100 %  done in " in line


def test_the_current_tasks_stand_below_the_line_of_the_job(monkeypatch: pytest.MonkeyPatch) -> None:
    running = [
        *(each for each in run_of() if each.stage in (READING_VIDEOS, "check")),
        event("started", "keyframes", "torso"),
        event("progress", "keyframes", "torso", 90, 360, "frames " * 20),
        event("started", "keyframes", "left_palm"),
        event("note", "clocks", what="note: " + "the cameras recorded at the same time " * 4),
    ]
    lines = shown(running, monkeypatch, RuntimeError()).splitlines()
    assert max(map(len, lines)) <= WIDTH
    *note, job, torso, palm = [line.rstrip() for line in lines]
    assert all(
        word in ("note:", "the", "cameras", "recorded", "at", "same", "time")
        for line in note
        for word in line.split()
    )
    assert job.endswith("stopped")
    assert torso.startswith("  keyframes torso: 90 of 360 frames frames")
    assert palm == "  keyframes left_palm"
    assert READING_VIDEOS not in "".join(lines)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (None, "time left: not known"),
        (4.0, "a few seconds left"),
        (34.0, "about 30 s left"),
        (57.0, "about 1 min left"),
        (260.0, "about 4 min left"),
        (3900.0, "about 1 h 05 min left"),
    ],
)
def test_the_time_left_is_rounded(seconds: float | None, text: str) -> None:
    assert progress_display._left_text(seconds) == text


def test_texts_break_between_words_on_a_terminal_only(monkeypatch: pytest.MonkeyPatch) -> None:
    text = "  poor: Metric scale: sizes are known to about ± 11 cm of body height, and /a/path" + "/long" * 20

    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setenv("COLUMNS", str(WIDTH))
    for stream in (Terminal(), io.StringIO()):
        monkeypatch.setattr(sys, "stdout", stream)
        terminal.print_text(text)
        lines = stream.getvalue().splitlines()
        assert " ".join(" ".join(lines).split()) == text.strip()
        assert (len(lines) > 1) == stream.isatty()
        if stream.isatty():
            assert [line for line in lines if len(line) > WIDTH] == [f"    /a/path{'/long' * 20}"]
            assert all(line.startswith("    ") for line in lines[1:])


def test_an_error_on_a_terminal_of_80_columns_breaks_between_words(tmp_path: Path) -> None:
    screen, device = pty.openpty()
    fcntl.ioctl(device, termios.TIOCSWINSZ, struct.pack("HHHH", 24, WIDTH, 0, 0))
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "TERM": "xterm"}
    command = (sys.executable, "-c", "from bodycap_batch.cli import main; raise SystemExit(main())")
    with subprocess.Popen(
        [*command, "run", "walk", "--force", "--from", "map"],
        cwd=tmp_path,
        env={name: value for name, value in environment.items() if name not in ("COLUMNS", "LINES")},
        stdin=device,
        stdout=device,
        stderr=device,
    ) as child:
        os.close(device)
        output = b""
        with contextlib.suppress(OSError):  # the child has closed the terminal
            while part := os.read(screen, 4096):
                output += part
    os.close(screen)
    assert child.returncode == 2
    lines = output.decode().replace("\r", "").splitlines()
    assert max(map(len, lines)) <= WIDTH
    assert "--force repeats all stages, --from repeats only some stages" in " ".join(" ".join(lines).split())
