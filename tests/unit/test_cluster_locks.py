"""A message of a worker that arrives while the scheduler is asked for its workers."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from bodycap_batch import cluster
from bodycap_batch.runner import Making, Task
from bodycap_batch.store import ArtefactKey, Store


class Client:
    """Its one thread hears messages and answers questions, as Dask's does."""

    status = "running"

    def __init__(self) -> None:
        self.answered: list[bool] = []
        self._hear: Callable[[Any], None] = print

    def subscribe_topic(self, _: str, hear: Callable[[Any], None]) -> None:
        self._hear = hear

    def run_on_scheduler(self, *_: object) -> None:
        pass

    def scheduler_info(self) -> dict[str, Any]:
        message = {"key": "another task", "done": 1, "total": 2, "what": "frames"}
        loop = threading.Thread(target=self._hear, args=[(0.0, message)], daemon=True)
        loop.start()
        loop.join(5.0)
        self.answered.append(not loop.is_alive())
        return {"workers": {}}

    def submit(self, *_: object, **__: object) -> None:
        raise RuntimeError("far enough")


def test_a_message_does_not_wait_for_the_answer_that_waits_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = Client()
    monkeypatch.setattr(cluster, "_connect", lambda _: client)
    task = Task(key=ArtefactKey(stage="map", algorithm="1", options={}, inputs={}, libraries={}))
    making = Making(
        store=Store(tmp_path),
        logs=tmp_path,
        progress=lambda *_: None,
        cancelled=lambda: False,
        may_commit=lambda: True,
    )
    with pytest.raises(RuntimeError, match="far enough"):
        cluster.Cluster("tcp://nowhere:1").make(task, making)
    assert client.answered == [True]
