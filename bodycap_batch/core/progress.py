"""What a running job tells those who watch it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Literal

Kind = Literal["started", "progress", "finished", "reused", "failed", "stopped", "note"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """One step of a job.

    Attributes:
        kind: What happened: a stage started, moved on, finished, was answered by the store, failed or
            was stopped; or a note for the reader.
        stage: Stage name.
        camera: Camera name; "" when the stage concerns all cameras.
        done: Units done, of `total`.
        total: Units in all; 0 when not known.
        what: The unit (``frames``, ``pairs`` …) or, in a note, the text.
        seconds: How long it took, for a finished stage.
        round: Which round of growing the map, from 0.
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
        """Stage, camera and round as one reads them."""
        return task_label(self.stage, self.camera, self.round)

    def to_dict(self) -> dict[str, Any]:
        """The event as plain JSON values."""
        return asdict(self)


def task_label(stage: str, camera: str = "", map_round: int = 0) -> str:
    """Stage, camera and round as one reads them."""
    again = f"(round {map_round})" if map_round else ""
    return " ".join(part for part in (stage, camera, again) if part)


Listener = Callable[[Event], None]
