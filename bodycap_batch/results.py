"""Read a folder of results: frames, camera paths, body motion, clocks, figures and the verdict."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, set_array
from bodycap_batch.core.errors import JobError
from bodycap_batch.formats.frame_table import FrameTable, read_frame_table
from bodycap_batch.formats.joint_table import BodyMotion, read_joint_table
from bodycap_batch.formats.tum import TimedPoses, read_tum
from bodycap_batch.model.scene import FrameStatus

METRICS_FILE = "metrics.json"
VERDICT_FILE = "verdict.json"
_RECORD_FILE = "run.json"
_PARTIAL = "partial"
_UNPLACED = "unplaced"
"""Subfolder of ``trajectories`` with the cameras that could not be placed in the frame of the results."""
_KINDS = {
    "motion": ("motion.*", "joints.*", "fill.json"),
    "map": ("map*.ply", "colmap/*"),
    "trajectories": ("trajectories/*",),
    "cameras": ("cameras.*", "cameras/*"),
    "frames": ("frames.csv",),
    "figures": (METRICS_FILE, VERDICT_FILE),
    "report": ("report.html",),
    "preview": ("preview.mp4",),
    "scene": ("blender_scene.*", "bodycap_blender.zip"),
    "record": (_RECORD_FILE, "job.yaml"),
    "logs": ("logs/*",),
}
"""Names of the files of each kind, relative to the folder of the results."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraPath:
    """The path of one camera: a pose for each of its N frames, NaN for lost frames.

    A frame with the status ROTATION_ONLY has a rotation, and NaN as its position. It is not localised.

    Attributes:
        frames: Number, time, status and sigma of each frame.
        frame_of_reference: ``world`` (metres, Z up, floor at z = 0), or the name of the gauge of a map, whose
            scale and axes are arbitrary. Paths in different frames of reference must not be combined.
        world_from_cam: (N,4,4) pose of the camera in the frame of reference. Axes of the camera: x right,
            y down, z forward. NaN for lost frames.
    """

    frames: FrameTable
    frame_of_reference: str
    world_from_cam: FloatArray

    def __post_init__(self) -> None:
        set_array(self, "world_from_cam", (len(self.frames.status), 4, 4), finite=False)

    @property
    def camera(self) -> str:
        """Name of the camera."""
        return self.frames.camera

    @property
    def times_s(self) -> FloatArray:
        """Time (N,) of each frame on the camera's own clock, seconds."""
        return self.frames.times_s

    @property
    def status(self) -> tuple[FrameStatus, ...]:
        """Status (N,) of each frame: localised, or the reason why the frame is lost."""
        return self.frames.status

    @property
    def localised(self) -> BoolArray:
        """Mask (N,) of the frames with a pose."""
        return self.frames.localised

    @property
    def poses(self) -> TimedPoses:
        """The times and poses of the localised frames alone."""
        posed = self.localised
        return TimedPoses(times_ns=self.frames.times_ns[posed], world_from_cam=self.world_from_cam[posed])

    @property
    def centres(self) -> FloatArray:
        """Centre (N,3) of the camera in the frame of reference, metres in the world; NaN for lost frames."""
        return self.world_from_cam[:, :3, 3]

    @property
    def rotations(self) -> FloatArray:
        """Orientation (N,3,3) of the camera, world_from_cam; NaN for lost frames."""
        return self.world_from_cam[:, :3, :3]


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockEstimate:
    """The clock of one camera relative to the common clock.

    Common time = camera time · (1 + drift) + offset.

    Attributes:
        offset_s: Offset to the reference camera, seconds; NaN if it is unknown.
        sigma_s: Standard deviation of the offset, seconds; NaN if the offset is unknown.
        drift_ppm: Drift, parts per million.
        drift_sigma_ppm: Standard deviation of the drift, parts per million.
        source: Where the offset comes from, for example ``sound``, ``motion``, ``stated`` or ``common``.
    """

    offset_s: float
    sigma_s: float
    drift_ppm: float
    drift_sigma_ppm: float
    source: str


@dataclass(frozen=True, slots=True)
class Result:
    """A folder of results. Nothing is computed; each method reads its file when it is called.

    Attributes:
        folder: The folder, for example ``out/my_walk``. A job without a skeleton that it asks for leaves its
            other results in ``out/my_walk/partial``.

    Raises:
        JobError: The folder holds no results.
    """

    folder: Path

    def __post_init__(self) -> None:
        object.__setattr__(self, "folder", Path(self.folder))
        if not (self.folder / METRICS_FILE).is_file():
            partial = self.folder / _PARTIAL
            is_partial = (partial / METRICS_FILE).is_file()
            raise JobError(
                "the folder holds no results of a job",
                path=self.folder,
                hint=f"the job ended without a skeleton; its other results are in {partial}"
                if is_partial
                else f"give the folder of a finished job, which holds {METRICS_FILE}",
            )

    def frames(self) -> dict[str, FrameTable]:
        """Return the frames of each camera, by the name of the camera (``frames.csv``).

        Raises:
            JobError: The file is missing or malformed.
        """
        return read_frame_table(self.folder / "frames.csv")

    def trajectories(self) -> dict[str, CameraPath]:
        """Return the path of each camera, by the name of the camera (``frames.csv`` and ``trajectories``).

        Raises:
            JobError: A file is missing or malformed, or the files are not of the same run.
        """
        figures = self.metrics()["cameras"]
        return {
            camera: self._path(table, str(figures[camera]["frame"]))
            for camera, table in self.frames().items()
        }

    def placed_trajectories(self) -> dict[str, CameraPath]:
        """Return the paths in the frame of reference of the results, which can be combined.

        Raises:
            JobError: As `trajectories`.
        """
        main = self.metrics()["frame"]
        return {
            camera: path for camera, path in self.trajectories().items() if path.frame_of_reference == main
        }

    def other_trajectories(self) -> dict[int, dict[str, TimedPoses]]:
        """Return the poses of frames that are in another map than the path of their camera.

        The place of these maps in the room is unknown, and each has its own scale and axes.

        Returns:
            By number n of the map, as in ``map_<n>.ply``, and name of the camera, times and poses
            map_from_camera. Empty if the job has no such frames.

        Raises:
            JobError: A file is malformed.
        """
        files = sorted((self.folder / "trajectories").glob("map_*/*.tum"))
        out: dict[int, dict[str, TimedPoses]] = {}
        for file in files:
            out.setdefault(int(file.parent.name.removeprefix("map_")), {})[file.stem] = read_tum(file)
        return out

    def _path(self, table: FrameTable, frame_of_reference: str) -> CameraPath:
        folder, name = self.folder / "trajectories", f"{table.camera}.tum"
        unplaced = folder / _UNPLACED / name
        poses = read_tum(unplaced if unplaced.is_file() else folder / name)
        world_from_cam = np.full((len(table.status), 4, 4), np.nan)
        posed = np.flatnonzero(table.localised | table.rotation_only)
        if not np.array_equal(table.times_ns[posed], poses.times_ns):
            raise JobError(
                f"frames.csv and the trajectory of {table.camera} do not have the same frames",
                path=self.folder,
                hint="one of the files was changed or comes from another run; run the job again",
            )
        world_from_cam[posed] = poses.world_from_cam
        world_from_cam[table.rotation_only, :3, 3] = np.nan
        return CameraPath(frames=table, frame_of_reference=frame_of_reference, world_from_cam=world_from_cam)

    def motion(self) -> BodyMotion:
        """Return the motion of the body (``joints.npz`` or ``joints.csv``).

        Raises:
            JobError: The results hold no motion, or a file is malformed.
        """
        files = [self.folder / name for name in ("joints.npz", "joints.csv")]
        found = [file for file in files if file.is_file()]
        if not found:
            raise JobError(
                "the results hold no table of the joints",
                path=files[-1],
                hint="a job without a skeleton has no motion; a job with one writes this table if "
                "export.formats contains csv or npz",
            )
        return read_joint_table(found[0])

    def clocks(self) -> dict[str, ClockEstimate]:
        """Return the clock of each camera, by the name of the camera (``metrics.json``).

        Raises:
            JobError: The file cannot be read.
        """

        def number(value: float | None) -> float:
            return float("nan") if value is None else float(value)

        return {
            camera: ClockEstimate(
                offset_s=number(clock["offset_s"]),
                sigma_s=number(clock["sigma_s"]),
                drift_ppm=number(clock["drift_ppm"]),
                drift_sigma_ppm=number(clock["drift_sigma_ppm"]),
                source=str(clock["source"]),
            )
            for camera, clock in self.metrics()["clocks"].items()
        }

    def metrics(self) -> dict[str, Any]:
        """Return all figures of the job (``metrics.json``), as plain JSON values.

        Raises:
            JobError: The file cannot be read.
        """
        return _read_json(self.folder / METRICS_FILE, "run the job again")

    def verdict(self) -> Mapping[str, Any]:
        """Return the verdict (``verdict.json``), as plain JSON values.

        Among its keys are ``grade``, ``coverage`` (with ``share``, from 0 to 1), ``cameras`` and ``body``.

        Raises:
            JobError: The file is missing, because an earlier version made the results, or it cannot be read.
        """
        return _read_json(
            self.folder / VERDICT_FILE,
            "results of earlier versions have no verdict in a file; run the job again",
        )

    def record(self) -> dict[str, Any]:
        """Return the record of the run (``run.json``): versions, and time and memory of each stage.

        Raises:
            JobError: The file is missing or cannot be read.
        """
        return _read_json(self.folder / _RECORD_FILE, "run the job again")

    def files(self) -> dict[str, tuple[Path, ...]]:
        """Return the paths of all files that are in the folder, sorted, by kind.

        The kinds are ``motion``, ``map``, ``trajectories``, ``cameras``, ``frames``, ``figures``, ``report``,
        ``preview``, ``scene``, ``record`` and ``logs``. A kind without a file has an empty list.
        """
        return {
            kind: tuple(
                sorted(
                    path
                    for pattern in patterns
                    for found in self.folder.glob(pattern)
                    for path in (found.rglob("*") if found.is_dir() else (found,))
                    if path.is_file()
                )
            )
            for kind, patterns in _KINDS.items()
        }


def _read_json(path: Path, hint: str) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_bytes()))
    except FileNotFoundError:
        raise JobError("there is no such file in the results", path=path, hint=hint) from None
    except (OSError, ValueError, TypeError) as error:
        raise JobError(f"the file cannot be read: {error}", path=path, hint=hint) from error
