"""Show the progress of a job: live on a terminal, as lines in a log, or as JSON for other programs."""

from __future__ import annotations

import datetime as dt
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from bodycap_batch.cli.job_progress import READING_VIDEOS, JobProgress
from bodycap_batch.cli.signals import event_on_signal
from bodycap_batch.cli.terminal import print_json, print_timed_message
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.percent import format_percent
from bodycap_batch.core.printable import printable
from bodycap_batch.core.progress import Event, StepProgress

if TYPE_CHECKING:
    from rich.console import RenderableType

_LINE_PERIOD_S = 5.0
"""Maximum time (seconds) between two progress lines of a stage. Evidence: none."""
_LINE_PAUSE_S = 1.0
"""Minimum time (seconds) between two progress lines of a stage. Evidence: none."""
_LINE_PROGRESS = 0.1
"""A stage prints its next progress line before `_LINE_PERIOD_S` if it has advanced at least by this fraction
since the last line. Unit: 1 (the whole stage). Evidence: none."""
_BAR_WIDTH = 30
"""Width of the bar of a job, characters."""

_SCHEMA = 1
"""Number of the form of the JSON lines. It changes if a field changes its meaning or is removed."""


def print_event(values: Mapping[str, Any]) -> None:
    """Print one JSON line for other programs: the number of its form, the time (UTC), and the values."""
    time_text = dt.datetime.now(dt.UTC).isoformat(timespec="milliseconds")
    print_json({"schema": _SCHEMA, "time": time_text, **values})


class ProgressDisplay:
    """A display that shows the events of a job, which come from several threads; a context manager."""

    def __init__(self) -> None:
        self._lock = threading.Lock()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the display."""

    def expect_cameras(self, count: int) -> None:
        """Tell the display how many cameras the job has."""

    def __call__(self, event: Event) -> None:
        """Show one event."""
        raise NotImplementedError


def make_progress_display(*, as_json: bool) -> ProgressDisplay:
    """Return a display: JSON lines if `as_json` is True, else a live one on a terminal, else plain lines."""
    if as_json:
        return JsonLines()
    return LiveProgress() if sys.stderr.isatty() else ProgressLines()


@contextmanager
def command_context(stage: str, *, as_json: bool, threads: int = 1) -> Iterator[StageContext]:
    """Yield the context of a command that runs one stage in this process, and shows its progress."""
    with (
        event_on_signal() as stop,
        make_progress_display(as_json=as_json) as display,
        tempfile.TemporaryDirectory() as work,
    ):

        def report(done: int, total: int, what: str) -> None:
            display(Event(kind="progress", stage=stage, done=done, total=total, what=what))

        progress = StepProgress(report)
        yield StageContext(work_dir=Path(work), threads=threads, progress=progress, cancelled=stop.is_set)
        progress.complete()


class JsonLines(ProgressDisplay):
    """Prints each event as one line with a JSON object on standard output."""

    def __call__(self, event: Event) -> None:
        """Print one event."""
        with self._lock:
            print_event(event.to_dict())


class ProgressLines(ProgressDisplay):
    """Prints plain lines on standard error: every few seconds, or after every tenth of a stage."""

    def __init__(self) -> None:
        super().__init__()
        self._pace: dict[str, _LinePacer] = {}

    def __call__(self, event: Event) -> None:
        """Print one event. Progress is printed only if a new progress line of the stage is due."""
        with self._lock:
            if event.kind == "progress":
                pace = self._pace.setdefault(f"{event.label} {event.what}", _LinePacer())
                if (text := pace.line(event)) is not None:
                    print_timed_message(text)
            else:
                print_timed_message(text_from_event(event))


class _LinePacer:
    """Decides when a stage prints its next progress line, and measures the speed of the stage."""

    def __init__(self) -> None:
        self._first: tuple[float, int] | None = None
        self._written, self._share = time.monotonic(), 0.0

    def line(self, event: Event) -> str | None:
        """Return the line to print for an event; None if no line is due yet."""
        now, progress = time.monotonic(), event.done / event.total if event.total else 0.0
        self._first = self._first or (now, event.done)
        waited = now - self._written
        if waited < _LINE_PERIOD_S and not (
            waited >= _LINE_PAUSE_S and progress - self._share >= _LINE_PROGRESS
        ):
            return None
        self._written, self._share = now, progress
        seconds, done = now - self._first[0], event.done - self._first[1]
        rate = done / seconds if seconds > 0 and done > 0 else None
        of_all = f" of {event.total} {event.what} ({format_percent(progress)})"
        text = f"{event.label}: {event.done}{of_all if event.total else f' {event.what}'}"
        if rate is not None:
            text += f", {rate:.3g}/s"
            if event.done < event.total:
                text += f", {_duration_text((event.total - event.done) / rate)} left"
        return text


class LiveProgress(ProgressDisplay):
    """Shows on a terminal one line for the job, with the time left, and the current tasks beneath it."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.live import Live

        super().__init__()
        self._job, self._start = JobProgress(), time.monotonic()
        self._tasks: dict[str, str] = {}
        self._last_line = ""
        self._console = Console(stderr=True)
        self._live = Live(get_renderable=self._render, console=self._console, refresh_per_second=4)

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the display and restore the terminal. The line of the whole job stays."""
        with self._lock:
            if kind is None:
                self._tasks.clear()
                self._last_line = f"done in {_duration_text(time.monotonic() - self._start)}"
            else:
                self._last_line = "stopped"
        self._live.stop()

    def expect_cameras(self, count: int) -> None:
        """Tell the display how many cameras the job has."""
        self._job.expect_cameras(count)

    def __call__(self, event: Event) -> None:
        """Show an event. A task disappears when it has finished."""
        if event.kind == "note":
            # Without the lock: the console waits for the thread that draws, which waits for the lock.
            self._console.print(printable(event.what), highlight=False, markup=False)
            return
        with self._lock:
            self._job.update(event)
            if event.kind in ("finished", "reused"):
                self._tasks.pop(event.label, None)
                return
            if event.kind == "started":
                self._tasks.pop(READING_VIDEOS, None)  # it has no event at its end
            self._tasks[event.label] = printable(_task_text(event))

    def _render(self) -> RenderableType:
        from rich.console import Group
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        with self._lock:
            is_done = self._last_line.startswith("done")
            fraction = 1.0 if is_done else self._job.fraction
            words = self._last_line or _left_text(self._job.left_s())
            tasks = list(self._tasks.values())
        line = Table.grid(padding=(0, 2, 0, 0))
        line.add_row(
            ProgressBar(total=1.0, completed=fraction, width=_BAR_WIDTH),
            Text(f"{format_percent(fraction):>5}"),
            Text(words),
        )
        texts = [Text(f"  {task}", style="dim", no_wrap=True, overflow="ellipsis") for task in tasks]
        return Group(line, *texts)


def _task_text(event: Event) -> str:
    if event.kind == "progress":
        count = f" {event.done} of {event.total}" if event.total else ""
        return f"{event.label}:{count} {event.what}".rstrip()
    return event.label if event.kind == "started" else f"{event.label}: {event.kind}"


def _left_text(seconds: float | None) -> str:
    """Return a text for the estimated time to the end of a job; None means that it is unknown."""
    if seconds is None:
        return "time left: not known"
    if seconds < 10:
        return "a few seconds left"
    if seconds < 55:
        return f"about {10 * round(seconds / 10)} s left"
    minutes = round(seconds / 60)
    hours, rest = divmod(minutes, 60)
    return f"about {hours} h {rest:02d} min left" if hours else f"about {minutes} min left"


def text_from_event(event: Event) -> str:
    """Return the text that describes an event to the user."""
    if event.kind == "note":
        return event.what
    words = {
        "started": "started",
        "reused": "already done, taken from the store",
        "finished": f"done in {_duration_text(event.seconds)}",
        "failed": "failed",
        "stopped": "stopped",
    }
    return f"{event.label}: {words[event.kind]}"


def _duration_text(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s"
