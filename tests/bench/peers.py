"""COLMAP on every frame, incremental and global, each in a process of its own with a time limit."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from tests.bench import ours
from tests.bench.rows import REPOSITORY, Row

PEERS = ("incremental", "global")
_POLL_S = 0.2


def run_peers(row: Row, work: Path, limit_s: float) -> list[dict[str, Any]]:
    """Run both peers on a capture. The time of a peer includes features, matches and mapper."""
    shared = work / "database"
    shared.mkdir(parents=True)
    base = _child("database", row, shared, limit_s)
    results = []
    for kind in PEERS:
        if base["stopped"] or base["exit"] != 0:
            outcome = {**base, "seconds": dict(base["seconds"])}
        else:
            workspace = work / kind
            shutil.copytree(shared, workspace)
            left_s = limit_s - sum(base["seconds"].values())
            outcome = _child(kind, row, workspace, max(left_s, 1.0))
            outcome["seconds"] = {**base["seconds"], **outcome["seconds"]}
            outcome["peak_memory_mb"] = max(base["peak_memory_mb"], outcome["peak_memory_mb"])
            outcome["pairs"] = base.get("pairs")
            if (workspace / "out" / "trajectories").is_dir():
                outcome["report"] = ours.score(workspace / "out", row)
            shutil.rmtree(workspace, ignore_errors=True)
        results.append({"name": row.name, "peer": kind, "limit_s": limit_s, **outcome})
    return results


def _child(step: str, row: Row, workspace: Path, limit_s: float) -> dict[str, Any]:
    """Run one step with a time limit; return its report, exit code and whether it was stopped."""
    report, task = workspace / f"{step}.report.json", workspace / f"{step}.task.json"
    values = {
        "step": step,
        "capture": str(row.capture),
        "workspace": str(workspace),
        "report": str(report),
        "out": str(workspace / "out"),
        "threads": os.cpu_count() or 1,
    }
    task.write_text(json.dumps(values), encoding="utf-8")
    started = time.monotonic()
    stopped, peak_mb = False, 0.0
    with (workspace / f"{step}.log").open("wb") as log:
        child = subprocess.Popen(
            [sys.executable, "-m", "tests.bench.peer", str(task)], cwd=REPOSITORY, stdout=log, stderr=log
        )
        try:
            while child.poll() is None:
                peak_mb = max(peak_mb, _peak_memory_mb(child.pid))
                if not stopped and time.monotonic() - started > limit_s:
                    stopped = True
                    child.send_signal(signal.SIGKILL)
                time.sleep(_POLL_S)
        finally:
            child.kill()
            child.wait()
    found = json.loads(report.read_text(encoding="utf-8")) if report.exists() else {"seconds": {}}
    if stopped and "running" in found:
        done_s = sum(found["seconds"].values())
        found["seconds"][found.pop("running")] = time.monotonic() - started - done_s
    found["peak_memory_mb"] = max(peak_mb, found.get("peak_memory_mb", 0.0))
    if child.returncode != 0 and not stopped:
        found["error"] = (workspace / f"{step}.log").read_text(errors="replace").strip().splitlines()[-2:]
    return {**found, "exit": child.returncode, "stopped": stopped}


def _peak_memory_mb(pid: int) -> float:
    """Return the largest resident size of a running process (Linux); 0 on other systems."""
    try:
        for line in Path(f"/proc/{pid}/status").read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    except OSError:
        return 0.0
    return 0.0


def lines_of(result: dict[str, Any], own: dict[str, Any] | None) -> list[str]:
    """Return a peer's outcome, and the ratio of its time to that of our map and registration."""
    name = f"  COLMAP {result['peer']} on every frame"
    seconds = result["seconds"]
    total_s = sum(seconds.values())
    took = f"    seconds: {ours.stage_text(seconds)}; peak memory {result['peak_memory_mb']:.0f} MB"
    if result["stopped"]:
        return [f"{name}: stopped after {result['limit_s'] / 60:g} minutes", took]
    report = result.get("report", {})
    if "trajectories" not in report:
        return [f"{name}: no model; {result.get('error') or report.get('error') or ''}".rstrip("; "), took]
    text = f"{name}: {ours.frames_and_error(report['trajectories'])}"
    if len(result["models"]) > 1:
        text += f"; split into {len(result['models'])} models, the largest counts"
    lines = [text, took]
    if own is not None and ours.mapping_seconds(own) > 0:
        ratio = total_s / ours.mapping_seconds(own)
        lines.append(
            f"    {total_s:.1f} s, {ratio:.1f} times as long as our map and registration "
            f"({ours.mapping_seconds(own):.1f} s)"
        )
    return lines
