"""The watched folder under load: memory over a thousand jobs, and a thousand folders dropped at once.

The watcher is real and runs in a process of its own. Only the stages are stand-ins
(`tests/pipeline/fake_stages.py`), because a thousand real captures would take days.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
COMMAND = (sys.executable, str(ROOT / "tests" / "pipeline" / "fake_bodycap.py"))
JOBS = 1000
SAMPLES = 10
COMPUTED_EVERY = 20
"""One job in this many is new to the store, so that child processes run for it. The store answers the
others."""


def run(work: Path, jobs: int = JOBS) -> list[dict[str, Any]]:
    """Run both measurements."""
    return [memory(work / "memory", jobs), at_once(work / "at_once", jobs)]


def lines_of(result: dict[str, Any]) -> list[str]:
    """Return a measurement as text."""
    seconds, jobs = f"{result['seconds']:.0f} s", result["jobs"]
    if result["name"] == "spool memory":
        levels = ", ".join(f"{level:.1f}" for level in result["memory_mb"])
        return [
            f"watcher over {jobs} tiny jobs, {seconds}",
            f"  {result['computed']} of them by stand-in stages, the others answered by the store",
            f"  resident memory after each tenth: {levels} MB",
            f"  from the first tenth to the last: {result['growth']:+.1%}",
        ]
    return [
        f"{jobs} folders dropped at once, {seconds}: {result['lost']} lost",
        f"  {result['done']} done, {result['answered']} of them answered by the store but for the report",
        f"  {result['refused']} refused by the check: {result['refused_by_name']} because of the job, "
        f"{result['refused_by_check']} because of the videos",
    ]


def memory(work: Path, jobs: int) -> dict[str, Any]:
    """Measure the resident memory of a watcher after every tenth of its jobs."""
    inbox = _inbox(work)
    dropped = iter(range(jobs))
    levels: list[float] = []

    def feed(process: subprocess.Popen[bytes]) -> None:
        ended = _ended(work)
        waiting = len(os.listdir(inbox))
        for number in [] if waiting > 20 else _some(dropped, 20):
            _drop(inbox, f"job {number:04}", new=number % COMPUTED_EVERY == 0)
        if ended >= jobs * (len(levels) + 1) // SAMPLES:
            levels.append(_resident_mb(process.pid))

    seconds = _watch(work, feed, lambda: _ended(work) >= jobs and len(levels) == SAMPLES)
    states = _states(work)
    return {
        "name": "spool memory",
        "exit": 0 if states == Counter(done=jobs) else 1,
        "jobs": jobs,
        "computed": len(range(0, jobs, COMPUTED_EVERY)),
        "seconds": seconds,
        "memory_mb": levels,
        "growth": levels[-1] / levels[0] - 1.0,
    }


def at_once(work: Path, jobs: int) -> dict[str, Any]:
    """Drop folders at once: half known to the store, a quarter with an invalid name, a quarter unreadable."""
    inbox = _inbox(work)
    _drop(inbox, "first", new=False)
    _watch(work, lambda _: None, lambda: _ended(work) == 1)
    aside = work / "aside"
    aside.mkdir()
    for number in range(jobs):
        kind = ("known", "known", "nameless", "unreadable")[number % 4]
        _drop(aside, f"{kind} {number:04}", new=False, kind=kind)
    for path in list(aside.iterdir()):
        path.rename(inbox / path.name)
    seconds = _watch(work, lambda _: None, lambda: _ended(work) == jobs + 1)
    found = [json.loads(path.read_text()) for path in work.glob("jobs/*/*/status.json")]
    found = [status for status in found if status["name"] != "first"]
    right = {"known": ("done", 0), "nameless": ("failed", 2), "unreadable": ("failed", 3)}
    count = Counter(
        s["name"].split()[0] for s in found if right[s["name"].split()[0]] == (s["state"], s["exit_code"])
    )
    answered = sum(s["state"] == "done" and _computed(s) <= {"report"} for s in found)
    lost = jobs - sum(count.values())
    left = [path for name in ("inbox", "running") for path in (work / "jobs" / name).iterdir()]
    return {
        "name": "spool at once",
        "exit": 0 if lost == 0 and answered == count["known"] and not left else 1,
        "jobs": jobs,
        "seconds": seconds,
        "done": count["known"],
        "answered": answered,
        "refused": count["nameless"] + count["unreadable"],
        "refused_by_name": count["nameless"],
        "refused_by_check": count["unreadable"],
        "lost": lost,
    }


def _computed(status: dict[str, Any]) -> set[str]:
    """Return the stages that the store did not answer. Each job has its own report, which holds its name."""
    return {stage["stage"] for stage in status["finished_stages"] if not stage["reused"]}


def _inbox(work: Path) -> Path:
    inbox = work / "jobs" / "inbox"
    inbox.mkdir(parents=True)
    return inbox


def _drop(folder: Path, name: str, *, new: bool, kind: str = "known") -> None:
    """Drop a folder of two stand-in videos. It is moved at once, so that it is never seen half complete."""
    capture = folder.parent / f"making {name}"
    capture.mkdir()
    text = f"{'unreadable ' if kind == 'unreadable' else ''}frames{f' of {name}' if new else ''}"
    for camera in ("torso", "zzz" if kind == "nameless" else "left_palm"):
        (capture / f"{camera}.mp4").write_text(
            f"{'unreadable ' if kind == 'unreadable' else ''}{text} {camera}"
        )
    (capture / "READY").touch()
    capture.rename(folder / name)


def _watch(work: Path, tick: Callable[[subprocess.Popen[bytes]], None], ended: Callable[[], bool]) -> float:
    """Run a watcher until all jobs have ended; return the seconds."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    environment.pop("BODYCAP_STORE", None)
    started = time.monotonic()
    with (work / "watch.log").open("ab") as log:
        process = subprocess.Popen(
            [*COMMAND, "watch", "jobs/inbox", "--threads", "1"], cwd=work, env=environment, stderr=log
        )
        try:
            while not ended():
                if process.poll() is not None:
                    raise RuntimeError(f"the watcher ended: see {work / 'watch.log'}")
                tick(process)
                time.sleep(0.2)
            return time.monotonic() - started
        finally:
            process.terminate()
            process.wait()


def _ended(work: Path) -> int:
    return sum(
        len(os.listdir(work / "jobs" / name))
        for name in ("done", "failed")
        if (work / "jobs" / name).is_dir()
    )


def _states(work: Path) -> Counter[str]:
    return Counter(json.loads(path.read_text())["state"] for path in work.glob("jobs/*/*/status.json"))


def _resident_mb(pid: int) -> float:
    found = re.search(r"VmRSS:\s*(\d+)", Path(f"/proc/{pid}/status").read_text())
    assert found is not None
    return int(found[1]) / 1024


def _some(numbers: Iterator[int], most: int) -> Iterator[int]:
    for _, number in zip(range(most), numbers, strict=False):
        yield number
