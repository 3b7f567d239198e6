"""Load a job from a YAML file or a folder of videos, and resolve every path in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from bodycap_batch.config.calibration import Calibration, CalibrationEntry, read_calibration
from bodycap_batch.config.folder import chapters_in, folder_capture
from bodycap_batch.config.models import CameraConfig, CaptureConfig, Job
from bodycap_batch.errors import JobError


def load_job(path: Path) -> Job:
    """Load and resolve a job."""
    base = path.resolve()
    job = Job.model_validate({"capture": folder_capture(base)})
    return resolve_job(job, base, name=base.name)


def resolve_job(job: Job, base: Path, name: str) -> Job:
    """Make paths absolute, list chapters, read calibration files, fill in what follows."""
    cameras = tuple(_resolve_camera(camera, job.capture, base) for camera in job.capture.cameras)
    capture = job.capture.model_copy(update={"cameras": cameras, "calibration": None})
    return job.model_copy(update={"capture": capture, "name": job.name or name})


def _resolve_camera(camera: CameraConfig, capture: CaptureConfig, base: Path) -> CameraConfig:
    chapters: list[Path] = []
    for video in camera.video:
        full = base / video
        chapters.extend(chapters_in(full) if full.is_dir() else [full])
    calibration = camera.calibration if camera.calibration is not None else capture.calibration
    entry: CalibrationEntry | None = None
    if isinstance(calibration, Path):
        entry = read_calibration(base / calibration, camera.name)
        calibration = entry.calibration
    update: dict[str, Any] = {"video": tuple(chapters), "calibration": calibration or "auto"}
    if camera.timestamps is not None:
        update["timestamps"] = base / camera.timestamps
    if camera.offset_s is None:
        update["offset_s"] = entry.offset_s if entry else 0.0
    if camera.rolling_shutter_s is None:
        update["rolling_shutter_s"] = entry.rolling_shutter_s if entry else 0.0
    return camera.model_copy(update=update)
