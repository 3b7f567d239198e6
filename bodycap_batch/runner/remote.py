"""A task on another machine: the same child, started there."""

from __future__ import annotations

import platform
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from bodycap_batch.core.errors import BodycapError, StoreError
from bodycap_batch.runner.children import Children, Making
from bodycap_batch.runner.task import Task, task_from_json
from bodycap_batch.store.artefacts import Store

_children: dict[tuple[str, ...], Children] = {}
_lock = threading.Lock()


def order_of(task: Task, making: Making, command: tuple[str, ...]) -> dict[str, Any]:
    """All that another machine has to be told: paths on the shared disk, options, digests."""
    return {"task": task.to_json(making.store.root), "logs": str(making.logs), "command": list(command)}


def perform(
    order: Mapping[str, Any], progress: Callable[[int, int, str], None], cancelled: Callable[[], bool]
) -> dict[str, Any]:
    """Make and commit a task's artefact in a child of this machine.

    Args:
        order: What `order_of` gave.
        progress: Called as ``progress(done, total, what)``.
        cancelled: Asked several times a second whether to stop.

    Returns:
        Nothing, or ``error`` and ``notes`` of the `BodycapError` that ended it.
    """
    task, root = task_from_json(order["task"])
    try:
        _require_shared(root)
        _require_same_program(task)
        store = Store(root)
        if not task.replaces and store.find(task.key) is not None:
            return {}  # a worker that died committed it before it could say so
        making = Making(
            store=store,
            logs=Path(order["logs"]),
            progress=progress,
            cancelled=cancelled,
            may_commit=lambda: not cancelled(),
        )
        _children_of(tuple(order["command"])).make(task, making)
    except BodycapError as error:
        return {"error": error.to_dict(), "notes": list(getattr(error, "__notes__", []))}
    return {}


def _children_of(command: tuple[str, ...]) -> Children:
    """This process's children; they end with it."""
    with _lock:
        return _children.setdefault(command, Children(command))


def _require_shared(root: Path) -> None:
    if not (root / "artefacts").is_dir():
        raise StoreError(
            f"worker {platform.node()} does not see the store",
            path=root,
            hint="put the store and the videos on a disk that all machines mount at the same path",
        )


def _require_same_program(task: Task) -> None:
    """Refuse a task if its program differs here: its result must not be stored under the task's key."""
    if task.program is None:
        return
    algorithm, libraries = task.program.versions()
    if (algorithm, libraries) != (task.key.algorithm, dict(task.key.libraries)):
        other = {name for name, version in task.key.libraries.items() if libraries.get(name) != version}
        raise BodycapError(
            f"worker {platform.node()} has another version of {', '.join(sorted(other)) or 'bodycap_batch'}",
            hint="install the same bodycap_batch and the same requirements.lock on all machines",
        )
