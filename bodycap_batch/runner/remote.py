"""Run a task on another machine, in the same kind of child process as on this machine."""

from __future__ import annotations

import platform
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from bodycap_batch.core.errors import BodycapError, StoreError
from bodycap_batch.runner.child_pool import Children, TaskEnvironment
from bodycap_batch.runner.task import Task, task_from_json
from bodycap_batch.store.artefacts import Store

_children: dict[tuple[str, ...], Children] = {}
_lock = threading.Lock()


def remote_order(task: Task, environment: TaskEnvironment, command: tuple[str, ...]) -> dict[str, Any]:
    """Return what another machine needs to run a task, as JSON values; paths refer to the shared disk."""
    return {
        "task": task.to_json(environment.store.root),
        "logs": str(environment.logs),
        "command": list(command),
        "memory_mb": environment.memory_mb,
    }


def run_order(
    order: Mapping[str, Any], progress: Callable[[int, int, str], None], cancelled: Callable[[], bool]
) -> dict[str, Any]:
    """Compute and commit a task's artefact in a child process of this machine.

    Args:
        order: The order that `remote_order` returned on the other machine.
        progress: Called as ``progress(done, total, what)``.
        cancelled: Called several times a second; True stops the task.

    Returns:
        An empty dict if the artefact is stored, else ``error`` and ``notes`` of the `BodycapError` that ended
        the task.
    """
    task, root = task_from_json(order["task"])
    try:
        _require_shared(root)
        _require_same_program(task)
        store = Store(root)
        if not task.replaces and store.find(task.key) is not None:
            return {}  # another worker committed the artefact and died before it could report this
        environment = TaskEnvironment(
            store=store,
            logs=Path(order["logs"]),
            progress=progress,
            cancelled=cancelled,
            memory_mb=order["memory_mb"],
        )
        _children_of(tuple(order["command"])).execute(task, environment)
    except BodycapError as error:
        return {"error": error.to_dict(), "notes": list(getattr(error, "__notes__", []))}
    return {}


def _children_of(command: tuple[str, ...]) -> Children:
    """Return this process's `Children` for a command line; the child processes end with this process."""
    with _lock:
        return _children.setdefault(command, Children(command))


def _require_shared(root: Path) -> None:
    if not (root / "artefacts").is_dir():
        raise StoreError(
            f"worker {platform.node()} cannot find the store",
            path=root,
            hint="put the store and the videos on a disk that all machines mount under the same path",
        )


def _require_same_program(task: Task) -> None:
    """Refuse a task if this machine has another version of its program or libraries.

    The result would not match the task's key.
    """
    if task.program is None:
        return
    algorithm, libraries = task.program.versions()
    if (algorithm, libraries) != (task.key.algorithm, dict(task.key.libraries)):
        other = {name for name, version in task.key.libraries.items() if libraries.get(name) != version}
        raise BodycapError(
            f"worker {platform.node()} has another version of {', '.join(sorted(other)) or 'bodycap_batch'}",
            hint="install the same bodycap_batch and the same requirements.lock on all machines",
        )
