"""The `bodycap` command that is killed, or that gets a full disk, at a chosen moment.

The environment names a JSON file with the orders:

- ``{"kill": "before" | "after", "at": pattern, "done": file}``: the command and all its children get SIGKILL
just before or just after the first rename at which no earlier run was killed. Only renames count whose target
contains a match of the regular expression.
- ``{"fill": stage, "disk": folder}``: the disk is filled to the last byte when this stage starts.

It also names a JSON file with the version of each stage's algorithm, which the test computed once.
"""

from __future__ import annotations

import fcntl
import functools
import json
import os
import re
import signal
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from bodycap_batch.core.context import StageContext
from bodycap_batch.runner import child_main
from bodycap_batch.runner.task import TaskFunction
from bodycap_batch.store import code_version
from bodycap_batch.tasks.stages import STAGES

ORDERS = "BODYCAP_HURT_ORDERS"
PIDS = "BODYCAP_HURT_PIDS"
VERSIONS = "BODYCAP_HURT_VERSIONS"
CHILD = (sys.executable, __file__, "--child")
BALLAST = "ballast.bin"


def rename_name(target: Path) -> str:
    """Return the name of a rename: its target without the parts that differ from run to run."""
    text = re.sub(r"/(\.store/tmp/[a-z]+)-[^/]+", r"/\1", str(target))
    return re.sub(r"/(digests|logs|corrupt)/.*", r"/\1", text)


def kill_everything() -> None:
    """Kill all processes of this run at once, this one last."""
    for name in os.listdir(os.environ[PIDS]):
        if int(name) != os.getpid():
            try:
                os.kill(int(name), signal.SIGKILL)
            except ProcessLookupError:
                continue
    os.kill(os.getpid(), signal.SIGKILL)


def killing(rename: Callable[..., None], orders: Mapping[str, str]) -> Callable[..., None]:
    def wrapped(source: Any, target: Any, **values: Any) -> None:
        place = rename_name(Path(target))
        if not re.search(orders["at"], place):
            return rename(source, target, **values)
        with Path(orders["done"]).open("a+") as done:
            # Child processes run in parallel: a second one that gets here waits until it is killed.
            fcntl.flock(done, fcntl.LOCK_EX)
            done.seek(0)
            if place not in done.read().splitlines():
                done.write(place + "\n")
                done.flush()
                if orders["kill"] == "after":
                    rename(source, target, **values)
                kill_everything()
        return rename(source, target, **values)

    return wrapped


def filling(name: str, disk: Path) -> TaskFunction:
    def run(arguments: Mapping[str, Any], context: StageContext, files: Path) -> None:
        fill(disk)
        STAGES[name].run(arguments, context, files)

    return run


def fill(disk: Path) -> None:
    """Write to the disk until no byte is free."""
    size = 1 << 20
    with (disk / BALLAST).open("ab", buffering=0) as stream:
        while size:
            try:
                while stream.write(bytes(size)) == size:
                    continue
            except OSError:
                size //= 2


def prepare_failure() -> dict[str, TaskFunction]:
    """Prepare the ordered failure; return the stages to run."""
    orders = json.loads(Path(os.environ[ORDERS]).read_text())
    table: dict[str, TaskFunction] = {name: stage.run for name, stage in STAGES.items()}
    (Path(os.environ[PIDS]) / str(os.getpid())).touch()
    if "kill" in orders:
        os.replace = killing(os.replace, orders)
        os.rename = killing(os.rename, orders)
    if "fill" in orders:
        table[orders["fill"]] = filling(orders["fill"], Path(orders["disk"]))
    return table


if __name__ == "__main__":
    stages = prepare_failure()
    if sys.argv[1] == "--child":
        sys.exit(child_main.main(sys.argv[2:], stages))
    versions = json.loads(Path(os.environ[VERSIONS]).read_text())
    code_version.algorithm_version = versions.__getitem__
    from bodycap_batch import pipeline, runner
    from bodycap_batch.cli import main

    pipeline.Settings = functools.partial(pipeline.Settings, command=CHILD)  # type: ignore[assignment, misc]
    runner.Children = functools.partial(runner.Children, command=CHILD)  # type: ignore[assignment, misc]
    sys.exit(main(sys.argv[1:]))
