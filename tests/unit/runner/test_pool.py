"""Cores and memory shared by the tasks of several jobs."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest

from bodycap_batch.core.errors import Cancelled
from bodycap_batch.runner import Task, TaskEnvironment
from bodycap_batch.runner.memory_limit import machine_memory_mb
from bodycap_batch.runner.pool import Slots
from bodycap_batch.runner.turns import turn
from bodycap_batch.store.artefacts import ArtefactKey, Store


def a_task(threads: int = 1, memory_mb: int = 100, priority: int = 0) -> Task:
    key = ArtefactKey(stage="map", algorithm="1", options={}, inputs={}, libraries={})
    return Task(key=key, threads=threads, memory_mb=memory_mb, priority=priority)


class Busy:
    """Threads that hold slots until the test releases them."""

    def __init__(self, slots: Slots) -> None:
        self.slots = slots
        self.order: list[str] = []
        self.now = self.most = 0
        self._lock = threading.Lock()
        self.threads: list[threading.Thread] = []

    def start(self, name: str, task: Task, hold: threading.Event | None = None) -> None:
        def work() -> None:
            with self.slots.taken(task, lambda: False):
                with self._lock:
                    self.order.append(name)
                    self.now += 1
                    self.most = max(self.most, self.now)
                (hold or threading.Event()).wait(5.0 if hold else 0.02)
                with self._lock:
                    self.now -= 1

        thread = threading.Thread(target=work)
        thread.start()
        self.threads.append(thread)
        time.sleep(0.01)  # waiting tasks of one priority go in the order they came

    def join(self) -> None:
        for thread in self.threads:
            thread.join(10)
            assert not thread.is_alive()


@pytest.mark.parametrize(
    ("task", "most"),
    [
        (a_task(), 4),
        (a_task(threads=2), 2),
        (a_task(threads=3), 1),
        (a_task(memory_mb=400), 2),
        (a_task(memory_mb=600), 1),
        (a_task(threads=99, memory_mb=99_000), 1),
    ],
)
def test_no_more_at_once_than_there_are_cores_and_memory_for(task: Task, most: int) -> None:
    busy = Busy(Slots(cores=4, memory_mb=1000))
    for index in range(8):
        busy.start(str(index), task)
    busy.join()
    assert len(busy.order) == 8
    assert busy.most <= most


def test_high_priority_goes_first_then_who_came_first() -> None:
    busy, hold = Busy(Slots(cores=1, memory_mb=1000)), threading.Event()
    busy.start("first", a_task(), hold)
    for name, priority in (("a", 0), ("b", 0), ("urgent", 5), ("late", -1), ("c", 0)):
        busy.start(name, a_task(priority=priority))
    hold.set()
    busy.join()
    assert busy.order == ["first", "urgent", "a", "b", "c", "late"]


def test_a_large_task_is_not_passed_by_small_ones() -> None:
    busy, hold = Busy(Slots(cores=2, memory_mb=1000)), threading.Event()
    busy.start("first", a_task(), hold)
    busy.start("large", a_task(threads=2))
    busy.start("small", a_task())
    assert busy.order == ["first"]
    hold.set()
    busy.join()
    assert busy.order == ["first", "large", "small"]


def test_a_task_that_waits_can_be_stopped_and_leaves_no_trace() -> None:
    busy, hold = Busy(Slots(cores=1, memory_mb=1000)), threading.Event()
    busy.start("first", a_task(), hold)
    with pytest.raises(Cancelled), busy.slots.taken(a_task(priority=9), lambda: True):
        pytest.fail("there was no room")
    busy.start("next", a_task())
    hold.set()
    busy.join()
    assert busy.order == ["first", "next"]


def test_this_machine_has_memory() -> None:
    assert machine_memory_mb() > 256


def environment_in(store: Store, cancelled: threading.Event | None = None) -> TaskEnvironment:
    return TaskEnvironment(
        store=store,
        logs=store.root,
        progress=lambda *_: None,
        cancelled=(cancelled or threading.Event()).is_set,
    )


@pytest.mark.parametrize("again", [False, True])
def test_a_task_of_two_jobs_is_computed_once_unless_it_replaces_its_artefact(
    tmp_path: Path, again: bool
) -> None:
    store, task = Store(tmp_path), replace(a_task(), replaces=again)
    made: list[int] = []

    def work(number: int) -> None:
        with turn(task, environment_in(store)) as there:
            if there:
                return
            made.append(number)
            time.sleep(0.05)
            with store.draft(task.key) as draft:
                (draft.files / "made_by").write_text(str(number))
                store.commit(draft, task.key, {}, replace=again)

    threads = [threading.Thread(target=work, args=[number]) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(10)
    assert len(made) == (4 if again else 1)
    assert (store.find(task.key) or pytest.fail("lost")).path.joinpath("made_by").read_text() == str(made[-1])


def test_a_waiting_job_can_be_stopped_and_takes_over_if_the_other_failed(tmp_path: Path) -> None:
    store, stop = Store(tmp_path), threading.Event()
    stop.set()

    def fail_while_another_is_stopped() -> None:
        with turn(a_task(), environment_in(store)) as there:
            assert not there
            with pytest.raises(Cancelled), turn(a_task(), environment_in(store, stop)):
                pytest.fail("two at once")
            with turn(replace(a_task(), key=replace(a_task().key, stage="merge")), environment_in(store)):
                raise RuntimeError("no map")

    with pytest.raises(RuntimeError, match="no map"):
        fail_while_another_is_stopped()
    with turn(a_task(), environment_in(store)) as there:
        assert not there
