"""The memory of a child: freed memory is returned to the system."""

from __future__ import annotations

import ctypes
import gc
import sys

import pytest

from bodycap_batch.core.memory import exempt_from_collection, release_memory
from bodycap_batch.runner.child_main import StepReporter

_BLOCK, _COUNT = 64 * 1024, 1600


def _resident_mb() -> float:
    with open("/proc/self/status", encoding="ascii") as status:
        return next(int(line.split()[1]) / 1024 for line in status if line.startswith("VmRSS:"))


@pytest.mark.skipif(
    sys.platform != "linux", reason="the C library gives memory back by itself, or not at all"
)
def test_memory_freed_by_earlier_tasks_is_released() -> None:
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "malloc_trim"):
        pytest.skip("not glibc")
    libc.malloc.restype, libc.malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
    libc.free.argtypes = [ctypes.c_void_p]
    blocks = [libc.malloc(_BLOCK) for _ in range(_COUNT)]
    for block in blocks:
        ctypes.memset(block, 1, _BLOCK)
    # One block at the heap's end keeps the freed 100 MB below it from going back by themselves.
    for block in blocks[:-1]:
        libc.free(block)
    held = _resident_mb()
    release_memory()
    assert held - _resident_mb() > 80
    libc.free(blocks[-1])


def test_the_objects_of_libraries_are_not_searched_again() -> None:
    known: list[object] = [[] for _ in range(1000)]
    exempt_from_collection()
    try:
        assert gc.get_freeze_count() > len(known)
        new: list[object] = []
        assert len(gc.get_objects()) < len(known)
        assert any(item is new for item in gc.get_objects())
    finally:
        gc.unfreeze()


def test_freed_memory_is_released_when_another_step_begins() -> None:
    released: list[int] = []
    reported: list[tuple[int, int, str]] = []

    def report(done: int, total: int, what: str) -> None:
        reported.append((done, total, what))

    progress = StepReporter(report, lambda: released.append(len(reported)), period_s=0.0)
    steps = [(1, 2, "features"), (2, 2, "features"), (0, 9, "pairs"), (9, 9, "pairs"), (1, 2, "features")]
    for step in steps:
        progress(*step)
    assert released == [0, 2, 4], "before the first report of each step"
    assert reported == steps


def test_freed_memory_is_not_released_at_each_of_many_short_steps() -> None:
    released: list[str] = []
    progress = StepReporter(lambda *_: None, lambda: released.append(""), period_s=60.0)
    for number in range(10):
        progress(number, 10, f"file {number}")
    assert released == []
