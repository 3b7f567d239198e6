"""Run whole jobs on captures with ground truth and print accuracy, coverage, time and memory.

Every capture is run from nothing in a store of its own, through the command line a user types.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("BODYCAP_TEST_DATA") or REPOSITORY.parent / "shared" / "data")
BODYCAP = (sys.executable, "-c", "from bodycap_batch.cli import main; main()")


@dataclass(frozen=True)
class Row:
    """One benchmark job.

    Attributes:
        name: What the table calls it.
        capture: Folder or job file.
        truth: Folder or file of the truth.
        arguments: More of the command line.
        reference: Camera the others are compared with in metres.
    """

    name: str
    capture: Path
    truth: Path
    arguments: tuple[str, ...] = ()
    reference: str | None = None


def rows_in(data: Path, lab: Path, work: Path) -> list[Row]:
    """The captures that are there."""
    rows = [Row("tum_fr1_xyz", data / "tum_fr1_xyz", data / "tum_fr1_xyz" / "groundtruth.txt")]
    for name in ("walk12", "room12", "walk131", "room131"):
        body = ("--skeleton", str(data / name / "skeleton.bvh"))
        rows.append(Row(name, data / name, data / name / "gt", body, "torso"))
    rows.append(Row("cpl_lab", REPOSITORY / "jobs" / "cpl_lab.yaml", lab / "gt", (), "torso"))
    true_mounts = work / "cpl_lab_true_mounts.yaml"
    if (lab / "gt" / "mounts.json").exists():
        _write_true_mounts(lab, true_mounts)
        body = ("--skeleton", str(lab / "skeleton.bvh"))
        rows.append(Row("cpl_lab_true_mounts", true_mounts, lab / "gt", (), "torso"))
        rows.append(Row("cpl_lab_true_mounts_and_bones", true_mounts, lab / "gt", body, "torso"))
    return [row for row in rows if row.capture.exists()]


def _write_true_mounts(lab: Path, target: Path) -> None:
    """A job like the embedded one that states the cameras' true mounts."""
    import yaml

    mounts = json.loads((lab / "gt" / "mounts.json").read_text(encoding="utf-8"))
    cameras = []
    for name, mount in sorted(mounts.items()):
        cameras.append(
            {
                "name": name,
                "video": str(lab / f"{name}.mp4"),
                "mount": name,
                "joint_from_cam": mount["joint_from_cam"],
                "sigma_deg": 1.0,
                "sigma_m": 0.005,
            }
        )
    job = {
        "capture": {"cameras": cameras, "calibration": str(lab / "calib.json")},
        "name": "cpl_lab_true_mounts",
    }
    target.write_text(yaml.safe_dump(job, sort_keys=False), encoding="utf-8")


def run(row: Row, work: Path) -> dict[str, Any]:
    """Run one job and score it; the outcome as plain values."""
    out = work / "out"
    command = [*BODYCAP, "run", str(row.capture), "--out", str(out), "--store", str(work / "store")]
    started = time.monotonic()
    done = subprocess.run(
        [*command, *row.arguments], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    wall_s = time.monotonic() - started
    if not (out / "run.json").exists():
        return {"name": row.name, "exit": done.returncode, "error": done.stderr.strip().splitlines()[-3:]}
    record = json.loads((out / "run.json").read_text(encoding="utf-8"))
    seconds: dict[str, float] = defaultdict(float)
    for stage in record["stages"]:
        seconds[stage["stage"]] += stage["seconds"]
    score = [*BODYCAP, "evaluate", str(out), str(row.truth), "--json"]
    if row.reference:
        score += ["--reference", row.reference]
    scored = subprocess.run(score, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    report = json.loads(scored.stdout) if scored.returncode == 0 else {"error": scored.stderr}
    metrics = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
    return {
        "name": row.name,
        "exit": done.returncode,
        "wall_s": wall_s,
        "seconds": dict(seconds),
        "camera_seconds": camera_seconds(out / "frames.csv"),
        "peak_memory_mb": record["peak_memory_mb"],
        "report": report,
        "metrics": metrics,
    }


def camera_seconds(frames: Path) -> float:
    """Length of all cameras' videos together, from a job's frames.csv."""
    with frames.open(newline="", encoding="utf-8") as stream:
        times: dict[str, list[float]] = defaultdict(list)
        for line in csv.DictReader(row for row in stream if not row.startswith("#")):
            times[line["camera"]].append(float(line["time"]))
    return sum(max(values) - min(values) for values in times.values())


def lines_of(result: dict[str, Any]) -> list[str]:
    """The outcome as a person reads it."""
    if "report" not in result or "trajectories" not in result["report"]:
        return [f"{result['name']}: failed, exit {result['exit']}: {result.get('error') or result['report']}"]
    trajectories = result["report"]["trajectories"]
    total = trajectories["total"]
    text = [
        f"{result['name']}: {total['registered']}/{total['frames']} frames, "
        f"ATE {100 * total['ate_m']['rmse']:.2f} cm (max {100 * total['ate_m']['max']:.1f})"
    ]
    for camera, score in sorted(trajectories["cameras"].items()):
        share = f"{score['registered']}/{score['frames']}"
        text.append(f"    {camera:16} {share:>9}  ATE {100 * score['ate_m']['rmse']:.2f} cm")
    for name, relative in result["report"].items():
        if "vector_m" in relative:
            vector = relative["vector_m"]
            text.append(f"    {name}: mean {100 * vector['mean']:.2f} cm, p95 {100 * vector['p95']:.2f} cm")
    seconds = result["seconds"]
    text.append("    seconds: " + ", ".join(f"{name} {value:.1f}" for name, value in seconds.items()))
    wall_s = result["wall_s"]
    text.append(
        f"    whole job {wall_s:.1f} s, {wall_s / result['camera_seconds']:.2f} s per camera-second, "
        f"peak memory {result['peak_memory_mb']:.0f} MB"
    )
    return text


def main() -> int:
    """Run the chosen benchmarks; the exit code says whether every job ran."""
    parser = argparse.ArgumentParser(prog="make bench ARGS=...", description=__doc__)
    parser.add_argument("only", nargs="*", help="names of rows to run (default: all)")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of captures with ground truth")
    parser.add_argument("--lab", type=Path, default=REPOSITORY / "examples" / "cpl_lab")
    parser.add_argument("--json", type=Path, help="also write all figures here")
    options = parser.parse_args()
    results = []
    with tempfile.TemporaryDirectory(prefix="bodycap-bench-") as folder:
        work = Path(folder)
        for row in rows_in(options.data, options.lab.resolve(), work):
            if options.only and row.name not in options.only:
                continue
            results.append(run(row, work / row.name))
            sys.stdout.write("\n".join(lines_of(results[-1])) + "\n")
            sys.stdout.flush()
    if options.json:
        options.json.write_text(json.dumps(results, indent=1), encoding="utf-8")
    return 0 if results and all(result.get("exit") == 0 for result in results) else 1


if __name__ == "__main__":
    raise SystemExit(main())
