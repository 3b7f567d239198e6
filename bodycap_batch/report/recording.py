"""A job's results as a recording for the Rerun viewer (``.rrd``)."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import yaml

from bodycap_batch.arrays import FloatArray
from bodycap_batch.errors import JobError, StoreError
from bodycap_batch.formats.bvh import read_bvh
from bodycap_batch.formats.open3d_library import load_open3d
from bodycap_batch.formats.tum import read_tum
from bodycap_batch.skeleton import Motion


def write_recording(results: Path, target: Path) -> None:
    """Read a folder of results and write them as one recording: points, camera paths, moving skeleton.

    All of it is on the common clock, which ``frames.csv`` and ``metrics.json`` tell; without them every file
    is taken to start on it.

    Args:
        results: Folder with ``map.ply``, ``trajectories`` and ``motion.bvh``; what is missing is left out.
        target: The ``.rrd`` file.

    Raises:
        JobError: rerun-sdk is not installed, or the folder holds no results.
        StoreError: The file cannot be written.
    """
    try:
        import rerun as rr
    except ImportError as error:
        raise JobError(
            "rerun-sdk is not installed", hint="install the extra: pip install 'bodycap_batch[viewer]'"
        ) from error
    paths = sorted((results / "trajectories").glob("*.tum"))
    cloud = results / "map.ply"
    if not paths and not cloud.is_file():
        raise JobError("no results to record", path=results, hint="name the folder of a finished job")
    stream = rr.RecordingStream("bodycap")
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    if cloud.is_file():
        points, colours = _cloud(cloud)
        stream.log(
            "world/map", rr.Points3D(points, colors=colours, radii=rr.Radius.ui_points(1.5)), static=True
        )
    offsets = offsets_s(results)
    for path in paths:
        _log_path(stream, path, offsets.get(path.stem, 0.0))
    if (results / "motion.bvh").is_file():
        motion = read_bvh(results / "motion.bvh")[1]
        if motion is not None:
            _log_motion(stream, motion, bvh_start_s(results, motion.fps))
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        stream.save(target)
    except OSError as error:
        raise StoreError(
            f"cannot be written: {error}", path=target, hint="name another file with --rerun"
        ) from error


def offsets_s(results: Path) -> dict[str, float]:
    """Common time less camera time, by camera; none without ``frames.csv``."""
    try:
        with (results / "frames.csv").open(encoding="utf-8", newline="") as stream:
            return {
                row["camera"]: float(row["common_time"]) - float(row["time"])
                for row in csv.DictReader(stream)
            }
    except OSError:
        return {}


def bvh_start_s(results: Path, fps: float) -> float:
    """Common time of the first frame of ``motion.bvh``, which holds no clock of its own."""
    try:
        metrics = json.loads((results / "metrics.json").read_text(encoding="utf-8"))
        job = yaml.safe_load((results / "job.yaml").read_text(encoding="utf-8"))
    except OSError:
        return 0.0
    start_s = float(metrics.get("motion", {}).get("start_s", 0.0))
    return start_s - 1.0 / fps if job.get("export", {}).get("tpose") else start_s


def _cloud(path: Path) -> tuple[FloatArray, FloatArray]:
    cloud = load_open3d().io.read_point_cloud(path)
    return np.asarray(cloud.points), np.asarray(cloud.colors)


def _log_path(stream: object, path: Path, offset_s: float) -> None:
    import rerun as rr
    from scipy.spatial.transform import Rotation

    assert isinstance(stream, rr.RecordingStream)
    found = read_tum(path)
    name = f"world/cameras/{path.stem}"
    centres = found.world_from_cam[:, :3, 3]
    stream.log(f"{name}/path", rr.LineStrips3D([centres]), static=True)
    quats = Rotation.from_matrix(found.world_from_cam[:, :3, :3]).as_quat()
    stream.send_columns(
        f"{name}/now",
        indexes=[rr.TimeColumn("time", duration=found.times_ns * 1e-9 + offset_s)],
        columns=rr.Transform3D.columns(translation=centres, quaternion=quats),
    )
    stream.log(f"{name}/now", rr.TransformAxes3D(0.1), static=True)


def _log_motion(stream: object, motion: Motion, start_s: float) -> None:
    import rerun as rr

    assert isinstance(stream, rr.RecordingStream)
    centres = motion.world_from_joint()[..., :3, 3]
    bones = [(int(parent), joint) for joint, parent in enumerate(motion.skeleton.parents) if parent >= 0]
    for tick, time_ns in enumerate(motion.times_ns()):
        stream.set_time("time", duration=start_s + float(time_ns) * 1e-9)
        stream.log("world/body", rr.LineStrips3D([centres[tick, pair] for pair in map(list, bones)]))
