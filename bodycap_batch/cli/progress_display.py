"""Show the progress of a job: as bars on a terminal, as lines in a log, or as JSON for other programs."""

from __future__ import annotations

import datetime as dt
import sys
import threading
import time
from collections.abc import Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol, Self

from bodycap_batch.cli.terminal import print_json, print_timed_message
from bodycap_batch.core.percent import format_percent
from bodycap_batch.core.printable import printable
from bodycap_batch.core.progress import Event

if TYPE_CHECKING:
    from rich.progress import Progress, Task, TaskID

_LINE_PERIOD_S = 5.0
"""Maximum time (seconds) between two progress lines of a stage. Evidence: none."""
_LINE_PAUSE_S = 1.0
"""Minimum time (seconds) between two progress lines of a stage. Evidence: none."""
_LINE_PROGRESS = 0.1
"""A stage prints its next progress line before `_LINE_PERIOD_S` if it has advanced at least by this fraction
since the last line. Unit: 1 (the whole stage). Evidence: none."""


_SCHEMA = 1
"""Number of the form of the JSON lines. It changes if a field changes its meaning or is removed."""


def print_event(values: Mapping[str, Any]) -> None:
    """Print one JSON line for other programs: the number of its form, the time (UTC), and the values."""
    time_text = dt.datetime.now(dt.UTC).isoformat(timespec="milliseconds")
    print_json({"schema": _SCHEMA, "time": time_text, **values})


class ProgressDisplay(Protocol):
    """A display that shows the events of a job; a context manager."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def __call__(self, event: Event) -> None:
        """Show one event."""


def make_progress_display(*, as_json: bool) -> ProgressDisplay:
    """Return a display: JSON lines if `as_json` is True, else bars on a terminal, else plain lines."""
    if as_json:
        return JsonLines()
    return ProgressBars() if sys.stderr.isatty() else ProgressLines()


class JsonLines:
    """Prints each event as one line with a JSON object on standard output."""

    def __init__(self) -> None:
        self._lock = threading.Lock()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Do nothing: there is nothing to close."""

    def __call__(self, event: Event) -> None:
        """Print one event."""
        with self._lock:
            print_event(event.to_dict())


class ProgressLines:
    """Prints plain lines on standard error: every few seconds, or after every tenth of a stage."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pace: dict[str, _LinePacer] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Do nothing: there is nothing to close."""

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
        text = f"{event.label}: {event.done}"
        text += (
            f" of {event.total} {event.what} ({format_percent(progress)})"
            if event.total
            else f" {event.what}"
        )
        if rate is not None:
            text += f", {rate:.3g}/s"
            if event.done < event.total:
                text += f", {_duration_text((event.total - event.done) / rate)} left"
        return text


class ProgressBars:
    """Shows one bar for each stage and camera on standard error, with the speed and the remaining time."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._bars: dict[str, TaskID] = {}
        self._progress = _make_rich_progress()

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the bars and restore the terminal."""
        self._progress.stop()

    def __call__(self, event: Event) -> None:
        """Update the bar of the event's stage and camera."""
        with self._lock:
            if event.kind == "note":
                self._progress.console.print(printable(event.what), highlight=False, markup=False)
                return
            bar = self._bars.get(event.label)
            if bar is None:
                bar = self._progress.add_task(printable(event.label), total=None, what="")
                self._bars[event.label] = bar
            if event.kind == "progress":
                self._progress.update(
                    bar, completed=event.done, total=event.total or None, what=printable(event.what)
                )
            elif event.kind != "started":
                self._close(bar, event)

    def _close(self, bar: TaskID, event: Event) -> None:
        total = self._progress.tasks[bar].total or 1
        words = {
            "reused": "already done",
            "finished": f"done in {_duration_text(event.seconds)}",
            "failed": "failed",
            "stopped": "stopped",
        }
        if event.kind not in ("failed", "stopped"):
            self._progress.update(bar, completed=total, total=total)
        self._progress.update(bar, what=words[event.kind])
        self._progress.stop_task(bar)


def _make_rich_progress() -> Progress:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn, TimeRemainingColumn
    from rich.text import Text

    class Rate(ProgressColumn):
        """Column of a progress bar: the number of units (for example frames) that are done per second."""

        def render(self, task: Task) -> Text:
            """Return the speed; empty if it is unknown or the stage has finished."""
            speed = task.finished_speed or task.speed
            return Text("" if speed is None or task.finished else f"{speed:.3g}/s", style="dim")

    class Count(ProgressColumn):
        """Column of a progress bar: the number of finished units and the total number of units."""

        def render(self, task: Task) -> Text:
            """Return both numbers; empty if the total is unknown or the stage has finished."""
            known = task.total is not None and not task.finished
            return Text(f"{int(task.completed)}/{int(task.total or 0)}" if known else "")

    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=30),
        Count(),
        TextColumn("{task.fields[what]}", markup=False),
        Rate(),
        TimeRemainingColumn(compact=True, elapsed_when_finished=False),
        console=Console(stderr=True),
    )


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
