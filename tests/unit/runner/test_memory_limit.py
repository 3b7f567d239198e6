"""The memory limit of a child: what exceeds it ends with one typed error, and what respects it passes."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from bodycap_batch.core.errors import EXIT_BUG, BodycapError, OutOfMemory, error_from_dict
from bodycap_batch.runner import child_process, memory_limit
from bodycap_batch.runner.memory_limit import default_limit_mb, is_out_of_memory, machine_memory_mb
from tests.unit.runner.test_runner import Bench, a_task

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the limits are those of Linux")


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    bench = Bench(tmp_path)
    with bench.runner:
        yield bench


def refusal(bench: Bench, memory_mb: int | None, stage: str, mb: int = 0) -> OutOfMemory:
    with pytest.raises(OutOfMemory) as caught:
        bench.with_rules(memory_mb=memory_mb).run(a_task(stage, value=2, mb=mb))
    error = caught.value
    assert error.exit_code == EXIT_BUG
    limit = default_limit_mb() if memory_mb is None else memory_mb
    assert f"{stage} torso: out of memory: its limit is {limit} MB, it had used " in error.message
    assert "--memory-mb" in str(error.hint)
    assert bench.store.find(a_task(stage, value=2).key) is None
    assert list((bench.store.root / "tmp").iterdir()) == []
    return error


def test_a_task_below_its_measured_peak_is_refused_and_one_above_passes(bench: Bench) -> None:
    bench.runner.run(a_task("work"))
    made, _ = bench.runner.run(a_task("allocate", mb=300))
    peak_mb = made.made["peak_memory_mb"]
    assert 300 < peak_mb < 400
    error = refusal(bench, round(0.9 * peak_mb), "allocate", mb=300)
    used_mb = float(error.message.partition("it had used ")[2].split()[0])
    assert 0.85 * peak_mb < used_mb < 1.15 * peak_mb
    assert bench.with_rules(memory_mb=round(1.2 * peak_mb)).run(a_task("allocate", value=2, mb=300))[1]


def test_one_allocation_far_above_the_limit_is_refused_before_the_memory_is_used(bench: Bench) -> None:
    error = refusal(bench, 300, "allocate_at_once", mb=2000)
    assert float(error.message.partition("it had used ")[2].split()[0]) < 100


def test_the_limit_of_a_task_does_not_bind_the_next_task_of_its_child(bench: Bench) -> None:
    children = [
        int((made.path / "process.txt").read_text().split()[2])
        for memory_mb in (300, 3000, 300)
        for made, _ in [bench.with_rules(memory_mb=memory_mb).run(a_task("work", value=len(bench.events)))]
    ]
    assert len(set(children)) == 1
    assert bench.with_rules(memory_mb=3000).run(a_task("allocate_at_once", mb=1500))[1]


@pytest.mark.parametrize("stage", ["hide_memory_error", "native_memory_error"])
@pytest.mark.parametrize("memory_mb", [None, 500])
def test_every_failed_allocation_is_the_same_error(bench: Bench, stage: str, memory_mb: int | None) -> None:
    refusal(bench, memory_mb, stage)
    assert bench.runner.run(a_task("work"))[1]


def test_the_kernels_end_of_a_child_is_the_same_error(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(BodycapError, match="SIGKILL") as caught:
        bench.runner.run(a_task("killed"))
    assert not isinstance(caught.value, OutOfMemory), "somebody else may have killed it"
    counts = iter(range(100))
    monkeypatch.setattr(child_process, "kernel_kills", lambda: next(counts))
    refusal(bench, 500, "killed")


@pytest.mark.parametrize("text", ["Failed to allocate 9 bytes: Insufficient memory", "std::bad_alloc"])
def test_messages_of_libraries_that_mean_a_lack_of_memory(text: str) -> None:
    assert is_out_of_memory(RuntimeError(text))
    assert not is_out_of_memory(RuntimeError("no memory of it"))
    assert not is_out_of_memory(None)


def test_the_error_survives_the_way_between_processes() -> None:
    error = memory_limit.out_of_memory("map", 1000, 950.4)
    back = error_from_dict(error.to_dict())
    assert isinstance(back, OutOfMemory)
    assert str(back) == str(error)
    assert "its limit is 1000 MB, it had used 950 MB" in back.message


@pytest.fixture
def groups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that looks like a control group with a group of this process in it."""
    own = tmp_path / "cgroup" / "own"
    own.mkdir(parents=True)
    monkeypatch.setattr(memory_limit, "_own_group", lambda root: root / "own" / "leaf")
    return own


def test_the_limit_of_the_own_group_counts_as_the_machines_memory(
    groups: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory_limit, "_CGROUPS", groups.parent)
    before = machine_memory_mb()
    (groups / "memory.max").write_text("max\n")
    assert machine_memory_mb() == before
    (groups / "memory.max").write_text(f"{500 << 20}\n")
    assert (machine_memory_mb(), default_limit_mb()) == (500, 400)
