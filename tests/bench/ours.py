"""Run a whole job through the command line, evaluate it and print its figures."""

from __future__ import annotations

import json
import resource
import subprocess
import time
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from bodycap_batch import Result
from tests.bench import poses
from tests.bench.rows import BODYCAP, REPOSITORY, Row

MAPPING = ("map", "registration", "recover")
"""Stages that do the same as the peers: they estimate the pose of every frame."""


def run(row: Row, work: Path, store: Path | None = None) -> dict[str, Any]:
    """Run one job, by default without earlier results in a store of its own, and evaluate it.

    Args:
        row: The job.
        work: Folder for the results.
        store: A store that several jobs have in common.

    Returns:
        Plain values.
    """
    out, store = work / "out", store or work / "store"
    work.mkdir(parents=True, exist_ok=True)
    command = [*BODYCAP, "run", str(row.capture), "--out", str(out), "--store", str(store)]
    started, before = time.monotonic(), _children_cpu_s()
    with (work / "stderr.txt").open("w+", encoding="utf-8") as errors:
        job = subprocess.Popen(
            [*command, *row.arguments, "--json-progress"],
            cwd=REPOSITORY,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        )
        with job:
            wall = _wall_seconds(job.stdout or ())
        wall_s, cpu_s = time.monotonic() - started, _children_cpu_s() - before
        errors.seek(0)
        last_errors = errors.read().strip().splitlines()[-3:]
    if not (out / "run.json").exists():
        return {"name": row.name, "exit": job.returncode, "error": last_errors}
    found = Result(out)
    record = found.record()
    stages: dict[str, float] = defaultdict(float)
    for stage in record["stages"]:
        stages[stage["stage"]] += stage["seconds"]
    return {
        "name": row.name,
        "exit": job.returncode,
        "wall_s": wall_s,
        "cpu_s": cpu_s,
        "wall_seconds": wall,
        "stage_seconds": dict(stages),
        "registration_cpu_s": registration_cpu_s(record["stages"]),
        "camera_seconds": sum(float(np.ptp(frames.times_s)) for frames in found.frames().values()),
        "peak_memory_mb": record["peak_memory_mb"],
        "report": score(out, row),
        "covariance": poses.consistency(out, store, row.truth),
        "metrics": found.metrics(),
    }


def registration_cpu_s(stages: Iterable[dict[str, Any]]) -> tuple[float, float]:
    """Return the processor seconds of the first round, which tracks every frame, and of all rounds."""
    registrations = [stage for stage in stages if stage["stage"] == "registration"]
    first = sum(stage["cpu_seconds"] for stage in registrations if stage["round"] == 0)
    return first, sum(stage["cpu_seconds"] for stage in registrations)


def _children_cpu_s() -> float:
    """Return the processor seconds of all ended child processes, including their own children."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def score(results: Path, row: Row) -> dict[str, Any]:
    """Return the figures of `bodycap evaluate`, or its error."""
    command = [*BODYCAP, "evaluate", str(results), str(row.truth), "--json"]
    if row.reference:
        command += ["--reference", row.reference]
    scored = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    return dict(json.loads(scored.stdout)) if scored.returncode == 0 else {"error": scored.stderr.strip()}


def _wall_seconds(lines: Iterable[str]) -> dict[str, float]:
    """Return the seconds during which each stage ran, from the events of ``--json-progress``."""
    out: dict[str, float] = defaultdict(float)
    running: dict[str, int] = defaultdict(int)
    since: dict[str, float] = {}
    for line in lines:
        if not line.startswith("{"):
            continue
        event, now = json.loads(line), time.monotonic()
        stage = event.get("stage", "")
        if event.get("kind") == "started":
            since.setdefault(stage, now)
            running[stage] += 1
        elif event.get("kind") in ("finished", "failed", "stopped") and running[stage]:
            running[stage] -= 1
            if not running[stage]:
                out[stage] += now - since.pop(stage)
    return dict(out)


def mapping_seconds(result: dict[str, Any]) -> float:
    """Return the wall seconds of map and registration."""
    return sum(result["wall_seconds"].get(stage, 0.0) for stage in MAPPING)


def lines_of(result: dict[str, Any]) -> list[str]:
    """Return the outcome as text."""
    if "report" not in result or "trajectories" not in result["report"]:
        return [f"{result['name']}: failed, exit {result['exit']}: {result.get('error') or result['report']}"]
    trajectories = result["report"]["trajectories"]
    text = [f"{result['name']}: {frames_and_error(trajectories)}"]
    for camera, figures in sorted(trajectories["cameras"].items()):
        share = f"{figures['registered']}/{figures['frames']}"
        text.append(f"    {camera:16} {share:>9}  ATE {_centimetres(figures)}")
    for name, relative in result["report"].items():
        if "vector_m" in relative:
            vector = relative["vector_m"]
            text.append(f"    {name}: mean {100 * vector['mean']:.2f} cm, p95 {100 * vector['p95']:.2f} cm")
    if result.get("covariance"):
        text.append("    " + poses.line_of(result["covariance"]))
    text.append("    seconds: " + stage_text(result["wall_seconds"]))
    frames = trajectories["total"]["frames"]
    tracked_ms, all_rounds_ms = (1000 * seconds / max(frames, 1) for seconds in result["registration_cpu_s"])
    text.append(
        f"    registration {tracked_ms:.1f} ms of a core per frame to track and solve every frame, "
        f"{all_rounds_ms:.1f} with all further rounds"
    )
    wall_s = result["wall_s"]
    text.append(
        f"    whole job {wall_s:.1f} s ({result['cpu_s']:.1f} of a core), "
        f"{wall_s / result['camera_seconds']:.2f} s per camera-second, "
        f"peak memory {result['peak_memory_mb']:.0f} MB"
    )
    return text


def frames_and_error(trajectories: dict[str, Any]) -> str:
    """Return the coverage and the error of all cameras together, as text."""
    total = trajectories["total"]
    text = f"{total['registered']}/{total['frames']} frames, ATE {_centimetres(total)}"
    return text + (f" (max {100 * total['ate_m']['max']:.1f})" if total["ate_m"] else "")


def _centimetres(figures: dict[str, Any]) -> str:
    return f"{100 * figures['ate_m']['rmse']:.2f} cm" if figures["ate_m"] else "unknown"


def stage_text(seconds: dict[str, float]) -> str:
    """Return the seconds of each stage in one line."""
    return ", ".join(f"{name} {value:.1f}" for name, value in seconds.items())
