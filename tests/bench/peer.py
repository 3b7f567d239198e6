"""The child process of a peer: COLMAP on every frame, with its own features and matcher and our retrieval.

``python -m tests.bench.peer TASK.json``: the parent, `tests.bench.peers`, writes the task. ``database``
extracts and matches features; ``incremental`` and ``global`` map a copy of that database. The figures are
written to the task's ``report`` after each step, so that those of a stopped child are known.
"""

from __future__ import annotations

import json
import resource
import shutil
import sys
import time
import zlib  # noqa: F401 - before pycolmap, else compression breaks in the process
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from bodycap_batch.capture import Capture, open_capture
from bodycap_batch.config.job import load_job
from bodycap_batch.formats.frame_table import COLUMNS, LOST
from bodycap_batch.formats.tum import TimedPoses, seconds_text, write_tum
from tests.bench import peer_database
from tests.bench.peer_database import DATABASE_NAME

_MAX_EXTRA_PARAM = 1e3
"""COLMAP's default limit of 1 silently rejects intrinsics with k3 > 1. The calibration is given, so it is
trusted."""


class Report:
    """The figures of a child process, written after each step."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.values: dict[str, Any] = {"seconds": {}}

    def timed(self, step: str, work: Callable[[], Any]) -> Any:
        """Run a step and record its duration."""
        started = time.monotonic()
        self.values["running"] = step
        self.write()
        outcome = work()
        self.values["seconds"][step] = time.monotonic() - started
        self.values.pop("running")
        self.write()
        return outcome

    def write(self) -> None:
        usage = resource.getrusage(resource.RUSAGE_SELF)
        self.values["peak_memory_mb"] = usage.ru_maxrss / 1024
        self._path.write_text(json.dumps(self.values), encoding="utf-8")


def prepare(capture: Capture, workspace: Path, threads: int, report: Report) -> None:
    """Extract the features of every frame, and match one list of pairs for both mappers."""
    report.timed("features", lambda: peer_database.write_features(capture, workspace, threads))
    pairs = report.timed("pairs", lambda: peer_database.choose(capture, workspace))
    report.values["pairs"] = len(pairs)
    report.timed("matching", lambda: peer_database.match(capture, workspace, pairs, threads))


def incremental(workspace: Path, threads: int) -> list[Any]:
    """Run COLMAP's incremental mapper with default options; given intrinsics are held constant."""
    settings = pycolmap.IncrementalPipelineOptions()
    settings.random_seed = 0
    settings.num_threads = threads
    settings.extract_colors = False
    settings.ba_refine_focal_length = False
    settings.ba_refine_principal_point = False
    settings.ba_refine_extra_params = False
    for part in (settings, settings.mapper, settings.triangulation):
        part.max_extra_param = _MAX_EXTRA_PARAM
    found = pycolmap.incremental_mapping(*_folders(workspace), settings)
    return list(found.values())


def globally(workspace: Path, threads: int) -> list[Any]:
    """Run COLMAP's global mapper with default options; given intrinsics are held constant."""
    settings = pycolmap.GlobalPipelineOptions()
    settings.random_seed = 0
    settings.num_threads = threads
    settings.mapper.bundle_adjustment.refine_focal_length = False
    settings.mapper.bundle_adjustment.refine_extra_params = False
    settings.mapper.retriangulation.max_extra_param = _MAX_EXTRA_PARAM
    found = pycolmap.global_mapping(*_folders(workspace), settings)
    return list(found.values())


def _folders(workspace: Path) -> tuple[str, str, str]:
    images, models = workspace / "images", workspace / "models"
    for folder in (images, models):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
    return str(workspace / DATABASE_NAME), str(images), str(models)


def write_results(capture: Capture, models: list[Any], out: Path, report: Report) -> None:
    """Write the camera paths of the largest model, and frames.csv with every frame, in a job's format."""
    sizes = sorted((int(model.num_reg_images()) for model in models), reverse=True)
    report.values["models"] = sizes
    out.mkdir(parents=True)
    posed: dict[str, dict[int, np.ndarray]] = {camera.name: {} for camera in capture.cameras}
    largest = max(models, key=lambda model: int(model.num_reg_images()), default=None)
    for image_id in () if largest is None else largest.reg_image_ids():
        image = largest.image(image_id)
        camera_name, _, frame = image.name.rpartition("/")
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().inverse().matrix()
        posed[camera_name][int(frame)] = pose
    lines = [",".join(COLUMNS)]
    for camera in capture.cameras:
        for frame, time_ns in enumerate(camera.times_ns.tolist()):
            status = "REGISTERED," if frame in posed[camera.name] else f"{LOST},NO_MAP"
            time = seconds_text(time_ns)
            lines.append(f"{camera.name},{camera.frame_numbers[frame]},{time},{time},{status},0,,,")
    (out / "frames.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    for camera in capture.cameras:
        frames = sorted(posed[camera.name])
        if frames:
            poses = np.array([posed[camera.name][frame] for frame in frames])
            timed = TimedPoses(times_ns=camera.times_ns[frames], world_from_cam=poses)
            write_tum(out / "trajectories" / f"{camera.name}.tum", timed, ("the mapper's own gauge",))


def main(task_path: str) -> None:
    """Run the task of a file."""
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    task = json.loads(Path(task_path).read_text(encoding="utf-8"))
    report, workspace = Report(Path(task["report"])), Path(task["workspace"])
    capture = open_capture(load_job(Path(task["capture"])).capture)
    if task["step"] == "database":
        prepare(capture, workspace, task["threads"], report)
        return
    mapper = {"incremental": incremental, "global": globally}[task["step"]]
    models = report.timed("mapper", lambda: mapper(workspace, task["threads"]))
    write_results(capture, models, Path(task["out"]), report)
    report.write()


if __name__ == "__main__":
    main(sys.argv[1])
