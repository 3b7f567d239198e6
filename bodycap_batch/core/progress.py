"""The progress events of a running job."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Literal

Kind = Literal["started", "progress", "finished", "reused", "failed", "stopped", "note"]
RECONSTRUCTION = "reconstruction"
"""Name of the step of a map that begins when all pairs are matched. From there on, a map uses one core."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """One progress event of a job.

    Attributes:
        kind: Kind of the event: a task started, made progress, finished, was reused from the store, failed or
            was stopped; or a note for the user.
        stage: Stage name.
        camera: Camera name; "" if the stage concerns all cameras.
        done: Number of finished units.
        total: Number of all units; 0 if the number is unknown.
        what: Name of the unit, for example ``frames``; or the text of a note.
        seconds: Duration of a finished task, seconds.
        round: Number of the round, counted from 0. In each round after the first, keyframes are added to the
            map.
    """

    kind: Kind
    stage: str
    camera: str = ""
    done: int = 0
    total: int = 0
    what: str = ""
    seconds: float = 0.0
    round: int = 0

    @property
    def label(self) -> str:
        """Text that names the stage, the camera and the round."""
        return task_label(self.stage, self.camera, self.round)

    def to_dict(self) -> dict[str, Any]:
        """Return the event as plain JSON values."""
        return asdict(self)


def task_label(stage: str, camera: str = "", map_round: int = 0) -> str:
    """Return a text that names the stage, the camera and the round. The first round is not mentioned."""
    round_text = f"(round {map_round})" if map_round else ""
    return " ".join(part for part in (stage, camera, round_text) if part)


class StepProgress:
    """Passes the progress of a task on, and completes each step when the next one begins, or the task ends.

    A step ends before it reports its last unit if the other units need no work.

    Args:
        report: Called as ``report(done, total, what)``.
    """

    def __init__(self, report: Callable[[int, int, str], None]) -> None:
        self._report = report
        self._last = (0, 0, "")

    def __call__(self, done: int, total: int, what: str = "") -> None:
        """Report that `done` of `total` units are done. A smaller number than before begins another step."""
        before, total_before, what_before = self._last
        if done < before or (done == before and total != total_before and what != what_before):
            self.complete()
        self._last = (done, total, what)
        self._report(done, total, what)

    def complete(self) -> None:
        """Report that all units of the last step are done."""
        done, total, what = self._last
        if done < total:
            self._report(total, total, what)
        self._last = (0, 0, "")


Listener = Callable[[Event], None]
"""A function that is called with every event."""
