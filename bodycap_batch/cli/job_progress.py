"""Estimate how much of a job is done, and how long the rest takes."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

from bodycap_batch.core.progress import Event

READING_VIDEOS = "reading videos"
"""Name of what a job does before its first task. It has no event at its end."""
_SHARES = {
    READING_VIDEOS: 0.01,
    "check": 0.045,
    "keyframes": 0.27,
    "map": 0.33,
    "registration": 0.11,
    "extend": 0.03,
    "refine": 0.01,
    "recover": 0.01,
    "places": 0.005,
    "clocks": 0.005,
    "inertial": 0.005,
    "links": 0.02,
    "merge": 0.06,
    "fill": 0.01,
    "export": 0.01,
    "report": 0.02,
    "preview": 0.05,
}
"""Share of each stage in the time of a job, in the order of the stages. Evidence: the sample job, in which
check, keyframes, map, registration, merge and the rest took 14, 65, 84, 30, 21 and 25 of 241 s. In 33 stored
runs with three cameras, keyframes and map took 21 and 37 % of the task time."""
_STEPS: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "keyframes": {
        "frames searched for hands": (0.0, 0.45),
        "steps to the lens": (0.45, 0.7),
        "searching what moves by itself": (0.7, 0.75),
        "frames": (0.75, 1.0),
    },
    "map": {
        "features": (0.0, 0.22),
        "pairs": (0.22, 0.67),
        "reconstruction": (0.67, 0.68),
        "keyframes": (0.68, 0.87),
        "maps adjusted": (0.87, 1.0),
    },
    "registration": {"frames tracked": (0.0, 0.8)},
}
"""Part of a stage that each of its steps takes, from the same run. The progress of a step that is not listed
does not count; that of a stage that is not listed is its only step."""
_LEAST_PART = 0.03
"""Smallest part of a job from whose duration the rest is estimated. Evidence: none."""


class JobProgress:
    """The progress of a job, or of another command that has one stage; it never goes back.

    Args:
        clock: Returns the time, seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._cameras = 1
        self._parts: dict[tuple[str, str], float] = {}
        self._is_job = False
        self._start: tuple[float, float] | None = None
        self._estimate: tuple[float, float] | None = None
        self.fraction = 0.0

    def expect_cameras(self, count: int) -> None:
        """Set the number of cameras, each of which has a task in the stages that run for each camera."""
        self._cameras = count

    def update(self, event: Event) -> None:
        """Take an event into account."""
        if event.kind == "note":
            return
        if event.stage in _SHARES and not self._is_job:
            # What ran before the job, such as rendering its videos, does not count.
            self._is_job, self._start, self._estimate, self.fraction = True, None, None, 0.0
            self._parts.clear()
        key = (event.stage, event.camera)
        self._parts[key] = max(self._parts.get(key, 0.0), _part_of_task(event))
        before = self.fraction
        self.fraction = max(self.fraction, self._fraction_at(event.stage))
        if event.kind == "reused":  # it took no time, so the estimate begins with the next task
            self._start = self._estimate = None
        elif self._start is None:
            self._start = (self._clock(), self.fraction)
        elif self.fraction > before:
            seconds, done = self._clock() - self._start[0], self.fraction - self._start[1]
            if done >= _LEAST_PART:
                self._estimate = (self._clock(), seconds * (1.0 - self.fraction) / done)

    def _fraction_at(self, stage: str) -> float:
        parts = [part for (name, _), part in self._parts.items() if name == stage]
        per_camera = any(camera for name, camera in self._parts if name == stage)
        part = sum(parts) / max(self._cameras if per_camera else 1, len(parts))
        if not self._is_job:
            return part
        if stage not in _SHARES:
            return 0.0
        before = sum(list(_SHARES.values())[: list(_SHARES).index(stage)])
        return before + part * _SHARES[stage]

    def left_s(self) -> float | None:
        """Return the estimated time to the end, seconds; None if it is not known.

        It follows from the time that the part computed so far took. It is not known before there is such a
        part, and after a step without progress has taken longer than all that was expected to follow.
        """
        if self._estimate is None:
            return None
        left = self._estimate[1] - (self._clock() - self._estimate[0])
        return left if left > 0.0 else None


def _part_of_task(event: Event) -> float:
    """Return how much of its task an event says is done."""
    if event.kind in ("finished", "reused"):
        return 1.0
    done = event.done / event.total if event.kind == "progress" and event.total else 0.0
    steps = _STEPS.get(event.stage)
    if steps is None:
        return done
    first, last = steps.get(event.what, (0.0, 0.0))
    return first + done * (last - first)
