"""A spool with stand-in stages, for tests."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bodycap_batch.watch import JobPermissions, Spool, Watcher, WatchOptions
from bodycap_batch.watch.spool import JobDir
from tests.pipeline.fake_stages import ORDERS, give_orders
from tests.videos import unopened

ROOT = Path(__file__).parents[2]
CHILD = (sys.executable, str(Path(__file__).with_name("fake_stages.py")))
BODYCAP = (sys.executable, str(Path(__file__).with_name("fake_bodycap.py")))
CAMERAS = ("torso", "left_palm")


class SpoolFixture:
    """An empty spool, methods to drop jobs into it, and a watcher that runs them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.orders = folder / "orders.json"
        self.spool = Spool(inbox=folder / "jobs" / "inbox", root=folder / "jobs")
        self.spool.make()
        self.lines: list[str] = []
        self._processes: list[subprocess.Popen[str]] = []
        self.order()

    def order(self, **orders: Any) -> None:
        give_orders(self.folder, **orders)

    def drop(self, name: str, job: str | None = None, *, ready: bool = True) -> Path:
        """Drop a folder of two videos, with a job file if a text is given."""
        folder = self.folder / "outside"
        folder.mkdir(exist_ok=True)
        capture = folder / name
        capture.mkdir()
        for camera in CAMERAS:
            (capture / f"{camera}.mp4").write_bytes(unopened(f"frames of {camera} in {name}"))
        if job is not None:
            (capture / "job.yaml").write_text(job)
        if ready:
            (capture / "READY").touch()
        return capture.rename(self.spool.inbox / name)

    def options(self, **changes: Any) -> WatchOptions:
        terms = JobPermissions(**{key: changes.pop(key) for key in ("roots", "limits") if key in changes})
        defaults: dict[str, Any] = {"unchanged_s": 0.0, "once": True, "threads": 1, "command": CHILD}
        return WatchOptions(permissions=terms, **{**defaults, **changes})

    def watcher(self, **changes: Any) -> Watcher:
        return Watcher(self.spool, self.options(**changes), self.lines.append)

    def run_once(self, **changes: Any) -> int:
        """Watch until nothing is left to do; return the exit code."""
        return self.watcher(**changes).run()

    def job(self, name: str) -> JobDir:
        found = self.spool.find(name)
        assert found is not None, self.lines
        return found

    def status(self, name: str) -> dict[str, Any]:
        return dict(json.loads(self.job(name).status.read_text()))

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        """Start the command with stand-in stages in a process of its own."""
        environment = {**os.environ, "PYTHONPATH": str(ROOT), ORDERS: str(self.orders)}
        environment.pop("BODYCAP_STORE", None)
        process = subprocess.Popen(
            [*BODYCAP, *arguments],
            cwd=self.folder,
            env=environment,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        self._processes.append(process)
        return process

    def close(self) -> None:
        """End the processes that a failed test left running."""
        for process in self._processes:
            if process.poll() is None:
                process.kill()
                process.wait()

    def wait_until_hanging(self) -> int:
        """Wait until a stage hangs as ordered; return its process id."""
        started = self.folder / "started"
        wait_for(lambda: started.exists() and bool(started.read_text()))
        return int(started.read_text())


def remove_in_use(folder: Path) -> None:
    """Remove a folder into which another process may write meanwhile."""

    def removed() -> bool:
        shutil.rmtree(folder, ignore_errors=True)
        return not folder.exists()

    wait_for(removed)


def wait_for(condition: Callable[[], bool], seconds: float = 30.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "the condition did not become true"
        time.sleep(0.02)
