"""How the scheduler is asked for its workers: while messages arrive, and before any worker is there."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from bodycap_batch.core.errors import Cancelled, StoreError
from bodycap_batch.runner import Task, TaskEnvironment, dask_cluster
from bodycap_batch.store.artefacts import ArtefactKey, Store


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
        return {"workers": {"one": {"resources": {"memory": 2000.0}}} if len(self.answered) > 1 else {}}

    def submit(self, *_: object, resources: object, **__: object) -> None:
        raise RuntimeError(f"handed over with {resources}")


def make(client: Client, folder: Path, told: list[str], *, cancelled: bool = False) -> None:
    """Hand a map, which declares 1,500 MB, over."""
    key = ArtefactKey(stage="map", algorithm="1", options={}, inputs={}, libraries={})
    environment = TaskEnvironment(
        store=Store(folder),
        logs=folder,
        progress=lambda done, total, what: told.append(what),
        cancelled=lambda: cancelled,
    )
    dask_cluster.Cluster("tcp://nowhere:1").execute(Task(key=key, memory_mb=1500), environment)


def test_a_task_waits_for_the_first_worker_so_that_its_limits_are_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And a message of another worker does not wait for the answer that waits for it."""
    client, told = Client(), list[str]()
    monkeypatch.setattr(dask_cluster, "_connect", lambda _: client)
    with pytest.raises(RuntimeError, match=r"handed over with {'memory': 1500.0}"):
        make(client, tmp_path, told)
    assert client.answered == [True, True]
    assert told == ["waiting for a worker"]


def test_waiting_for_a_worker_can_be_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    client = Client()
    monkeypatch.setattr(dask_cluster, "_connect", lambda _: client)
    with pytest.raises(Cancelled):
        make(client, tmp_path, [], cancelled=True)


@pytest.mark.parametrize("how", ["closed", "no answer"])
def test_a_scheduler_lost_during_a_request_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    client = Client()
    monkeypatch.setattr(dask_cluster, "_connect", lambda _: client)

    def fail() -> None:
        raise OSError("the connection is closed")

    if how == "closed":
        client.status = "closed"
    else:
        monkeypatch.setattr(client, "scheduler_info", fail)
    with pytest.raises(StoreError, match="the scheduler was lost"):
        make(client, tmp_path, [])


@pytest.mark.parametrize("what", ["run_on_scheduler", "subscribe_topic", "submit"])
def test_a_scheduler_lost_at_any_request_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError("the connection is closed")

    client = Client()
    monkeypatch.setattr(client, what, fail)
    monkeypatch.setattr(dask_cluster, "_connect", lambda _: client)
    with pytest.raises(StoreError, match="the scheduler was lost") as caught:
        make(client, tmp_path, [])
    assert caught.value.exit_code == 5
    assert "start the scheduler" in str(caught.value.hint)


def test_a_scheduler_lost_before_the_answer_is_read_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A future can be finished, and the way to what it gave be closed a moment later."""

    def lost() -> None:
        raise OSError("Stream is closed")

    future = SimpleNamespace(status="finished", result=lost, add_done_callback=lambda call: call(None))
    client = Client()
    monkeypatch.setattr(client, "submit", lambda *_, **__: future)
    monkeypatch.setattr(dask_cluster, "_connect", lambda _: client)
    with pytest.raises(StoreError, match="the scheduler was lost"):
        make(client, tmp_path, [])


@pytest.mark.parametrize(("threads", "tasks_at_once", "want"), [(6, 4, 2), (1, 4, 1), (6, 16, 1), (6, 1, 6)])
def test_the_tasks_of_a_worker_share_its_cores(
    monkeypatch: pytest.MonkeyPatch, threads: int, tasks_at_once: int, want: int
) -> None:
    worker = SimpleNamespace(
        get_current_task=lambda: "key",
        state=SimpleNamespace(nthreads=tasks_at_once, tasks={}, total_resources={}),
    )
    monkeypatch.setattr("distributed.get_worker", lambda: worker)
    monkeypatch.setattr(dask_cluster.os, "cpu_count", lambda: 8)
    monkeypatch.setattr(dask_cluster, "run_order", lambda order, *_: order["task"])
    answer = dask_cluster._on_worker({"task": {"threads": threads}, "memory_mb": None}, "topic")
    assert answer["threads"] == want
    assert answer["threads"] * tasks_at_once <= max(8, tasks_at_once)


@pytest.mark.parametrize(
    ("asked_mb", "declared", "want"),
    [
        (None, {}, None),
        (None, {"memory": 4000.0}, 4000),
        (3000, {}, 3000),
        (3000, {"memory": 4000.0}, 3000),
        (9000, {"memory": 4000.0}, 4000),
    ],
)
def test_a_task_on_a_worker_may_use_the_memory_that_the_worker_declares(
    monkeypatch: pytest.MonkeyPatch, asked_mb: int | None, declared: dict[str, float], want: int | None
) -> None:
    state = SimpleNamespace(nthreads=1, tasks={}, total_resources=declared)
    worker = SimpleNamespace(get_current_task=lambda: "key", state=state)
    monkeypatch.setattr("distributed.get_worker", lambda: worker)
    monkeypatch.setattr(dask_cluster, "run_order", lambda order, *_: order)
    answer = dask_cluster._on_worker({"task": {"threads": 1}, "memory_mb": asked_mb}, "topic")
    assert answer["memory_mb"] == want


def test_a_worker_tells_its_progress_not_more_often_than_once_a_second(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told: list[int] = []
    now = [100.0]
    worker = SimpleNamespace(
        get_current_task=lambda: "key",
        state=SimpleNamespace(nthreads=1, tasks={}, total_resources={}),
        log_event=lambda _, message: told.append(message["done"]),
    )
    monkeypatch.setattr("distributed.get_worker", lambda: worker)
    monkeypatch.setattr(dask_cluster.time, "monotonic", lambda: now[0])

    def perform(_: object, progress: Callable[[int, int, str], None], __: object) -> dict[str, Any]:
        for done in range(10):  # five a second, as a child does
            progress(done, 10, "frames")
            now[0] += 0.2
        return {}

    monkeypatch.setattr(dask_cluster, "run_order", perform)
    dask_cluster._on_worker({"task": {"threads": 1}, "memory_mb": None}, "topic")
    assert told[0] == 0
    # 2 s, rounding of the clock's steps aside.
    assert len(told) == 2
