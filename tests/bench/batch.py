"""Many short jobs on two cores: the gain from a second worker, and the cost of scheduling a task."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bodycap_batch.cli import main
from bodycap_batch.runner import Children, Executor, Task, TaskEnvironment
from bodycap_batch.store.artefacts import ArtefactKey, Store
from tests.cluster.site import REAL, Site
from tests.unit.runner.test_runner import FAKE

JOBS = 8
TASKS = 100
JOB = """
name: {name}
capture:
  # Each job differs by a microsecond and a millimetre: the same work, but nothing shared in the store.
  start_s: {start}
  calibration: capture/calib.json
  cameras:
    - {{name: torso, video: capture/torso.mp4}}
    - {{name: left_palm, video: capture/left_palm.mp4}}
height_m: {height}
"""
LAYOUTS = (
    ("two workers, one thread each", 2, 1),
    ("one worker, one thread", 1, 1),
    ("one worker, two threads a task", 1, 2),
)


def run(folder: Path, jobs: int = JOBS, rounds: int = 1) -> dict[str, Any]:
    """Time the jobs on each layout of workers, in alternating order, and a hundred empty tasks."""
    folder.mkdir(parents=True)
    options = ["--seconds", "2", "--size", "320x240", "--cameras", "torso,left_palm"]
    if main(["synth", str(folder / "capture"), *options]) != 0:
        return {"row": "batch", "exit": 1}
    for index in range(jobs):
        text = JOB.format(name=f"job{index}", start=f"{index * 1e-6:.6f}", height=1.75 + 1e-3 * index)
        (folder / f"job{index}.yaml").write_text(text)
    rounds_seconds = [
        {name: _batch(folder, f"out-{turn}", jobs, workers, threads) for name, workers, threads in LAYOUTS}
        for turn in range(rounds)
    ]
    seconds = {name: min(times[name] for times in rounds_seconds) for name, *_ in LAYOUTS}
    sizes = {"jobs": jobs, "rounds": rounds}
    return {"row": "batch", "exit": 0, **sizes, "seconds": seconds, **_overhead(folder / "overhead")}


def lines_of(result: dict[str, Any]) -> Iterator[str]:
    """Return the figures as text."""
    if result["exit"]:
        yield "batch: the capture could not be rendered"
        return
    both, one, threads = result["seconds"].values()
    rounds = f", the best of {result['rounds']} rounds" if result["rounds"] > 1 else ""
    yield f"batch of {result['jobs']} short jobs{rounds}"
    for name, value in result["seconds"].items():
        yield f"  {name}: {value:.1f} s"
    yield f"  two workers / one worker: {one / both:.2f} times as fast (target 1.8)"
    yield f"  two workers / one worker with two threads: {threads / both:.2f} (target 1.2)"
    yield (
        f"  a task: {result['here_ms']:.1f} ms in this process, {result['dask_ms']:.1f} ms through Dask, "
        f"scheduling {result['scheduling_ms']:.1f} ms (target 20); "
        f"starting a child {result['child_ms']:.0f} ms"
    )


def _batch(folder: Path, name: str, jobs: int, workers: int, threads: int) -> float:
    from distributed import Client

    site = Site(folder)
    try:
        address = site.scheduler()
        for index in range(workers):
            site.worker(f"worker{index}", "--nthreads", "1")
        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(workers, timeout=60)
        out = folder / f"{name}-{workers}-{threads}"
        files = [f"job{index}.yaml" for index in range(jobs)]
        started = time.perf_counter()
        code, _, err = site.run(
            *files, "--executor", address, "--out", str(out), "--threads", str(threads), command=REAL
        )
        assert code == 0, err
        return time.perf_counter() - started
    finally:
        site.close()


def _overhead(folder: Path) -> dict[str, float]:
    """Return the milliseconds of an empty task in a child that is already running."""
    from bodycap_batch.runner.dask_cluster import Cluster

    folder.mkdir()
    site, store = Site(folder), Store(folder / "store")
    children = Children(FAKE)
    try:
        started = time.perf_counter()
        _make(children, store, folder, "first")
        child_ms = 1e3 * (time.perf_counter() - started)
        address = site.scheduler()
        site.worker("one", "--nthreads", "1")
        with Cluster(address, FAKE) as cluster:
            _make(cluster, store, folder, "warm")
            # Alternate the two, so that other load on the machine affects both.
            pairs = [
                (_ms(children, store, folder, f"here{index}"), _ms(cluster, store, folder, f"dask{index}"))
                for index in range(TASKS)
            ]
    finally:
        children.close(folder / "logs")
        site.close()
    here_ms, dask_ms = (statistics.median(times) for times in zip(*pairs, strict=True))
    scheduling_ms = statistics.median(dask - here for here, dask in pairs)
    return {"child_ms": child_ms, "here_ms": here_ms, "dask_ms": dask_ms, "scheduling_ms": scheduling_ms}


def _ms(executor: Executor, store: Store, folder: Path, name: str) -> float:
    started = time.perf_counter()
    _make(executor, store, folder, name)
    return 1e3 * (time.perf_counter() - started)


def _make(executor: Executor, store: Store, folder: Path, value: str) -> None:
    key = ArtefactKey(stage="work", algorithm="1", options={"value": value}, inputs={}, libraries={})
    environment = TaskEnvironment(
        store=store,
        logs=folder / "logs",
        progress=lambda done, total, what: None,
        cancelled=lambda: False,
    )
    executor.execute(Task(key=key, arguments={"value": value}), environment)
