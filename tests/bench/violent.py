"""Whole jobs on captures of violent motion, with and without inertial sensors.

``python -m tests.bench violent FOLDER [FOLDER ...]``: captures of videos with true paths. Where a camera has
no ``.imu.csv``, the samples of a consumer's sensor are drawn from a smooth path through its true poses. Each
capture runs with all uses of the telemetry and without any. Printed: frames with a pose, the error of the
paths, frames that are more than 10 cm off, and lost frames in stretches of up to half a second.
"""

from __future__ import annotations

import argparse
import csv
import json
import shutil
import tempfile
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.geometry import make_transform, rotation_from_quat_xyzw
from bodycap_batch.synthetic.imu import write_imu
from bodycap_batch.synthetic.imu_options import ImuOptions
from tests.bench import ours
from tests.bench.rows import Row

USES = ("gravity", "blur", "tracking", "gps", "search", "gaps")
SHORT_S = 0.5
"""Longest stretch of lost frames that counts as short, seconds."""


def smooth_path(tum: Path) -> tuple[Callable[[FloatArray], FloatArray], float]:
    """Return a smooth path through the true poses of a camera, and its length in seconds."""
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    table = np.loadtxt(tum)
    place = CubicSpline(table[:, 0], table[:, 1:4])
    turn = RotationSpline(table[:, 0], Rotation.from_matrix(rotation_from_quat_xyzw(table[:, 4:8])))

    def poses(times_s: FloatArray) -> FloatArray:
        inside = np.clip(times_s, table[0, 0], table[-1, 0])
        return make_transform(turn(inside).as_matrix(), place(inside))

    return poses, float(table[-1, 0])


def prepare(capture: Path, work: Path, end_s: float | None) -> Path:
    """Return a copy of a capture in which each camera has inertial samples."""
    folder = work / "capture"
    (folder / "gt").mkdir(parents=True)
    for file in (*capture.glob("*.mp4"), *capture.glob("*.imu.csv"), capture / "calib.json"):
        shutil.copy(file, folder)
    for file in (capture / "gt").iterdir():
        shutil.copy(file, folder / "gt")
    for number, video in enumerate(sorted(folder.glob("*.mp4"))):
        if not (folder / f"{video.stem}.imu.csv").exists():
            poses, length_s = smooth_path(folder / "gt" / f"{video.stem}.tum")
            seed = np.random.SeedSequence([7, number])
            write_imu(folder, video.stem, ImuOptions(), length_s, poses, seed)
    for name, used in (("without", False), ("with", True)):
        job: dict[str, Any] = {
            "name": name,
            "capture": {
                "cameras": [{"name": v.stem, "video": str(v)} for v in sorted(folder.glob("*.mp4"))],
                "calibration": str(folder / "calib.json"),
            },
            "telemetry": dict.fromkeys(USES, used),
            "export": {"formats": ["tum", "csv"], "preview": False},
        }
        if end_s is not None:
            job["capture"]["end_s"] = end_s
        (work / f"{name}.yaml").write_text(yaml.safe_dump(job), encoding="utf-8")
    return folder


def lost_stretches(frames: Path) -> tuple[int, int]:
    """Return the number of lost frames in stretches of up to `SHORT_S`, and in longer ones."""
    status: dict[str, list[tuple[float, bool]]] = defaultdict(list)
    with frames.open(newline="", encoding="utf-8") as stream:
        for line in csv.DictReader(row for row in stream if not row.startswith("#")):
            status[line["camera"]].append((float(line["time"]), line["status"] == "LOST"))
    short = long = 0
    for rows in status.values():
        times_s, lost = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
        edges = np.flatnonzero(np.diff(np.concatenate([[False], lost, [False]])))
        for first, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            span_s = float(times_s[min(stop, len(times_s) - 1)] - times_s[max(first - 1, 0)])
            if span_s <= SHORT_S + 1e-6 and first > 0 and stop < len(times_s):
                short += stop - first
            else:
                long += stop - first
    return short, long


def measure(capture: Path, work: Path, end_s: float | None, threads: int) -> list[dict[str, Any]]:
    """Run a capture with and without its sensors, and return the figures of both."""
    work.mkdir(parents=True)
    folder = prepare(capture, work, end_s)
    out = []
    for name in ("without", "with"):
        arguments = ("--skeleton", "none", "--threads", str(threads))
        row = Row(f"{capture.name} {name}", work / f"{name}.yaml", folder / "gt", arguments)
        result = ours.run(row, work / name)
        if "trajectories" not in result.get("report", {}):
            out.append({"name": row.name, "error": result.get("error") or result.get("report")})
            continue
        total = result["report"]["trajectories"]["total"]
        short, long = lost_stretches(work / name / "out" / "frames.csv")
        out.append(
            {
                "name": row.name,
                "frames": total["frames"],
                "posed": total["registered"],
                "short": short,
                "long": long,
                **{key: 100.0 * total["ate_m"][key] for key in ("rmse", "max")},
                "cameras": {
                    camera: (figures["registered"], 100.0 * (figures["ate_m"] or {"rmse": np.nan})["rmse"])
                    for camera, figures in result["report"]["trajectories"]["cameras"].items()
                },
            }
        )
    return out


def main(arguments: Sequence[str]) -> int:
    """Print the figures of each capture with and without sensors."""
    parser = argparse.ArgumentParser(prog="make bench ARGS=violent", description=__doc__)
    parser.add_argument("captures", type=Path, nargs="+", help="folders of captures with truth")
    parser.add_argument("--end-s", type=float, help="end of the used part, seconds; default: all")
    parser.add_argument("--work", type=Path, help="folder for the jobs; default: a temporary one")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--json", type=Path, help="file for all figures as JSON")
    options = parser.parse_args(arguments)
    rows = []
    with tempfile.TemporaryDirectory(prefix="bodycap-bench-") as temporary:
        work = options.work or Path(temporary)
        for capture in options.captures:
            for row in measure(capture, work / capture.name, options.end_s, options.threads):
                rows.append(row)
                print(json.dumps(row), flush=True)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")
    return 0 if all("error" not in row for row in rows) else 1
