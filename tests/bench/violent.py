"""Whole jobs on captures of violent motion, with and without inertial sensors.

``python -m tests.bench violent FOLDER [FOLDER ...]``: captures of videos with true paths. Where a camera has
no ``.imu.csv``, the samples of a consumer's sensor are drawn from a smooth path through its true poses. Each
capture runs without any use of the telemetry, and with all uses; with ``--separate``, the uses are also added
one after another. Jobs of one capture have one store, so that stages in common run once. Printed for each
job: frames with a pose, the error of the paths, frames that are more than 10 cm off, lost frames in stretches
of up to half a second and in longer ones. Compared with the job without sensors: how many frames of its short
lost stretches have a pose, and the errors on the frames that both jobs localised.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from bodycap_batch import Result
from bodycap_batch.core.arrays import BoolArray, FloatArray, runs
from bodycap_batch.model.geometry import align_points, make_transform, rotation_from_quat_xyzw
from bodycap_batch.model.scene import FrameStatus
from bodycap_batch.synthetic.imu import write_imu
from bodycap_batch.synthetic.options import ImuOptions
from tests.bench import ours
from tests.bench.rows import Row

USES = ("gravity", "tracking", "gps", "smoothing", "gaps")
PLAIN = "without"
"""Name of the job without any use of the telemetry."""
JOBS = {
    PLAIN: (),
    "tracking": ("gravity", "tracking", "gps"),
    "smoothing": ("gravity", "tracking", "gps", "smoothing"),
    "with": USES,
}
"""Uses of the telemetry by name of the job; the middle ones run with ``--separate``."""
OFF_CM = 10.0
"""Error (cm) above which a pose is called wrong."""
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
    shutil.copytree(capture / "gt", folder / "gt", dirs_exist_ok=True)
    for number, video in enumerate(sorted(folder.glob("*.mp4"))):
        if not (folder / f"{video.stem}.imu.csv").exists():
            poses, length_s = smooth_path(folder / "gt" / f"{video.stem}.tum")
            rng = np.random.default_rng([7, number])
            write_imu(folder, video.stem, ImuOptions(), length_s, poses, rng)
    for name, uses in JOBS.items():
        job: dict[str, Any] = {
            "name": name,
            "capture": {
                "cameras": [{"name": v.stem, "video": str(v)} for v in sorted(folder.glob("*.mp4"))],
                "calibration": str(folder / "calib.json"),
            },
            "telemetry": {use: use in uses for use in USES},
            "export": {"formats": ["tum", "csv"], "preview": False},
        }
        if end_s is not None:
            job["capture"]["end_s"] = end_s
        (work / f"{name}.yaml").write_text(yaml.safe_dump(job), encoding="utf-8")
    return folder


@dataclass(frozen=True)
class Frames:
    """The frames of all cameras of a job.

    Attributes:
        posed: By camera, (N,) True for frames with a pose.
        inertial: By camera, (N,) True for frames whose pose comes from the sensor alone.
        times_s: By camera, (N,) times.
        error_cm: By camera, (N,) error of each frame; NaN without a pose.
    """

    posed: dict[str, BoolArray]
    inertial: dict[str, BoolArray]
    times_s: dict[str, FloatArray]
    error_cm: dict[str, FloatArray]

    def short(self) -> dict[str, BoolArray]:
        """Return a mask (N,) of each camera's lost frames in stretches of up to `SHORT_S` between poses."""
        out = {}
        for camera, posed in self.posed.items():
            times_s = self.times_s[camera]
            out[camera] = np.zeros(len(posed), dtype=bool)
            for start, stop in runs(~posed):
                inside = start > 0 and stop < len(posed)
                if inside and times_s[stop] - times_s[start - 1] <= SHORT_S + 1e-6:
                    out[camera][start:stop] = True
        return out


def frames_of(results: Path, truth: Path) -> Frames:
    """Read the frames of a job, and compare their poses with the truth under one similarity."""
    paths = Result(results).trajectories()
    placed = Result(results).placed_trajectories()  # the others have no pose, or poses in another map
    times_s = {camera: path.times_s for camera, path in paths.items()}
    posed = {camera: path.localised & (camera in placed) for camera, path in paths.items()}
    inertial = {
        camera: np.array([status is FrameStatus.INERTIAL for status in path.status])
        for camera, path in paths.items()
    }
    found = {camera: np.where(posed[camera][:, None], path.centres, np.nan) for camera, path in paths.items()}
    true = {camera: smooth_path(truth / f"{camera}.tum")[0](times_s[camera])[:, :3, 3] for camera in paths}
    error_cm = {}
    known = np.concatenate(list(posed.values()))
    places, truths = (np.concatenate(list(each.values())) for each in (found, true))
    fit = align_points(places[known], truths[known])
    for camera in paths:
        error_cm[camera] = 100.0 * np.linalg.norm(fit.apply(found[camera]) - true[camera], axis=1)
    return Frames(posed, inertial, times_s, error_cm)


def figures(frames: Frames, plain: Frames | None) -> dict[str, Any]:
    """Return the figures of a job, compared with the job without sensors."""
    error_cm = np.concatenate(list(frames.error_cm.values()))
    posed = np.concatenate(list(frames.posed.values()))
    short = np.concatenate(list(frames.short().values()))
    inertial = np.concatenate(list(frames.inertial.values()))
    out: dict[str, Any] = {
        "frames": len(posed),
        "posed": int(posed.sum()),
        "inertial": int(inertial.sum()),
        "short": int(short.sum()),
        "long": int((~posed & ~short).sum()),
        "rmse": _rms(error_cm[posed]),
        "max": float(error_cm[posed].max()),
        "off": int((error_cm[posed] > OFF_CM).sum()),
        "cameras": {
            camera: (int(frames.posed[camera].sum()), _rms(errors[frames.posed[camera]]))
            for camera, errors in frames.error_cm.items()
        },
    }
    if plain is not None:
        lost = np.concatenate(list(plain.short().values()))
        common = np.concatenate(list(plain.posed.values())) & posed
        before_cm = np.concatenate(list(plain.error_cm.values()))
        out |= {
            "short_without": int(lost.sum()),
            "of_them_posed": int((lost & posed).sum()),
            "common": int(common.sum()),
            "common_rmse": (_rms(before_cm[common]), _rms(error_cm[common])),
        }
        gained = posed & np.isnan(before_cm)
        out |= {"gained": int(gained.sum()), "gained_rmse": _rms(error_cm[gained])}
    return out


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


def measure(
    capture: Path, work: Path, end_s: float | None, threads: int, *, separate: bool = False
) -> list[dict[str, Any]]:
    """Run a capture with and without its sensors, and return the figures of all jobs."""
    work.mkdir(parents=True)
    folder = prepare(capture, work, end_s)
    out: list[dict[str, Any]] = []
    plain: Frames | None = None
    for name in JOBS if separate else (PLAIN, "with"):
        arguments = ("--skeleton", "none", "--threads", str(threads))
        row = Row(f"{capture.name} {name}", work / f"{name}.yaml", folder / "gt", arguments)
        result = ours.run(row, work / name, work / "store")
        if "trajectories" not in result.get("report", {}):
            out.append({"name": row.name, "error": result.get("error") or result.get("report")})
            continue
        frames = frames_of(work / name / "out", folder / "gt")
        out.append({"name": row.name, **figures(frames, plain)})
        plain = frames if name == PLAIN else plain
    return out


def main(arguments: Sequence[str]) -> int:
    """Print the figures of each capture with and without sensors."""
    parser = argparse.ArgumentParser(prog="make bench ARGS=violent", description=__doc__)
    parser.add_argument("captures", type=Path, nargs="+", help="folders of captures with truth")
    parser.add_argument("--end-s", type=float, help="end of the used part, seconds; default: all")
    parser.add_argument("--separate", action="store_true", help="add the uses one after another")
    parser.add_argument("--work", type=Path, help="folder for the jobs; default: a temporary one")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--json", type=Path, help="file for all figures as JSON")
    options = parser.parse_args(arguments)
    rows = []
    with tempfile.TemporaryDirectory(prefix="bodycap-bench-") as temporary:
        work = options.work or Path(temporary)
        for capture in options.captures:
            done = measure(
                capture, work / capture.name, options.end_s, options.threads, separate=options.separate
            )
            for row in done:
                rows.append(row)
                print(json.dumps(row), flush=True)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")
    return 0 if all("error" not in row for row in rows) else 1
