"""A Dask scheduler and workers of this machine, each a process of its own."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.pipeline.fake_stages import ORDERS, give_orders
from tests.processes import END_WITH_PARENT
from tests.results import results_of

ROOT = Path(__file__).parents[2]
FAKE = (sys.executable, str(ROOT / "tests" / "pipeline" / "fake_bodycap.py"))
REAL = (sys.executable, "-c", "from bodycap_batch.cli import main; main()")
CALM = {
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
    "DASK_DISTRIBUTED__ADMIN__TICK__INTERVAL": "500ms",
    "DASK_DISTRIBUTED__ADMIN__SYSTEM_MONITOR__INTERVAL": "5s",
}
"""What docs/how-to/batch_and_cluster.md advises on small machines."""
NAMES = ("monday", "tuesday", "wednesday")


def wait_for(condition: Callable[[], Any], what: str, seconds: float = 60.0) -> Any:
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end, f"{what}: it never happened"
        time.sleep(0.05)
    return found


class Site:
    """A scheduler and workers on loopback, and jobs for them in one folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.environment = {
            **os.environ,
            "PYTHONPATH": str(ROOT),
            ORDERS: str(folder / "orders.json"),
            "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "5s",
            **CALM,
        }
        self.environment.pop("BODYCAP_STORE", None)
        self.order()

    def captures(self) -> None:
        for name in NAMES:
            (self.folder / name).mkdir()
            for camera in ("torso", "left_palm"):
                (self.folder / name / f"{camera}.mp4").write_text(f"frames of {camera} on {name}")

    def order(self, **orders: Any) -> None:
        give_orders(self.folder, **orders)

    def spawn(self, name: str, module: str, *arguments: str) -> None:
        with (self.folder / f"{name}.log").open("ab") as log:
            self.processes[name] = subprocess.Popen(
                [*END_WITH_PARENT, sys.executable, "-m", f"distributed.cli.{module}", *arguments],
                cwd=self.folder,
                env=self.environment,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    def scheduler(self, *options: str) -> str:
        """Start it; returns its address."""
        told = self.folder / "scheduler.json"
        told.unlink(missing_ok=True)
        where = ("--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(told))
        self.spawn("scheduler", "dask_scheduler", *where, *options)
        # The file is not written at once.
        wait_for(lambda: told.exists() and told.read_text().strip().endswith("}"), "the scheduler's address")
        return str(json.loads(told.read_text())["address"])

    def worker(self, name: str, *options: str) -> None:
        where = ("--scheduler-file", str(self.folder / "scheduler.json"), "--host", "127.0.0.1")
        plain = ("--no-nanny", "--no-dashboard", "--local-directory", str(self.folder / "dask"))
        self.spawn(name, "dask_worker", *where, *plain, "--name", name, *(options or ("--nthreads", "1")))

    def kill(self, name: str) -> None:
        process = self.processes.pop(name)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()

    def close(self) -> None:
        for name in list(self.processes):
            self.kill(name)

    def start(self, *arguments: str, command: tuple[str, ...] = FAKE) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [*END_WITH_PARENT, *command, "batch", *arguments],
            cwd=self.folder,
            env=self.environment,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )

    def run(self, *arguments: str, command: tuple[str, ...] = FAKE) -> tuple[int, str, str]:
        process = self.start(*arguments, command=command)
        out, err = process.communicate(timeout=200)
        return process.returncode, out, err

    def hanging(self, other_than: int = 0) -> int:
        """Wait for the child that hangs."""

        def pid() -> int:
            path = self.folder / "started"
            found = int(path.read_text() or 0) if path.exists() else 0
            return found if found != other_than else 0

        return int(wait_for(pid, "a child that hangs"))

    def worker_of(self, child: int) -> str:
        parent = int(Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()[1])
        return next(name for name, process in self.processes.items() if process.pid == parent)

    def results(self, out: str = "out") -> dict[str, bytes]:
        return results_of(self.folder / out)
