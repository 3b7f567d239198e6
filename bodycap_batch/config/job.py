"""Load a job from a YAML file or a folder of videos, and resolve all paths of the job."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from bodycap_batch.config.calibration import CalibrationEntry, read_calibration
from bodycap_batch.config.explain import Problem, job_error, problems_of
from bodycap_batch.config.folder import (
    JOB_FILES,
    RUN_FILE,
    VIDEO_SUFFIXES,
    chapters_in,
    folder_capture,
    job_file_in,
    videos_in,
)
from bodycap_batch.config.limits import Limits
from bodycap_batch.config.models import SKELETON_PRESETS, CameraConfig, CaptureConfig, Job
from bodycap_batch.config.rules import problems_in, skeleton_of
from bodycap_batch.config.trust import PathPolicy
from bodycap_batch.config.yaml_source import YamlSource, read_yaml
from bodycap_batch.core.errors import CaptureError, JobError

_HEIGHT_M = (0.4, 2.6)
"""Minimum and maximum stature (metres) on the command line; equal to the limits of ``height_m`` in a job
file. Evidence: none."""
_LISTS = ("video", "timestamps")
"""Names of the fields of a camera in which a job file may give a single path instead of a list of paths."""
_NAME_LENGTH = 100
"""Maximum number of characters of a job's name. If the job is named after a folder with a longer name, the
name is shortened. Evidence: none."""

Prepare = Callable[[Mapping[str, Any], Path], None]
"""Function that renders a synthetic capture. Its arguments are the options of `capture.synthetic` and the
folder for the videos."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Overrides:
    """Values of the command line that replace values of the job. Paths are relative to the working folder."""

    out: Path | None = None
    skeleton: str | None = None
    height_m: float | None = None


def load_job(
    path: Path,
    overrides: Overrides | None = None,
    *,
    prepare: Prepare | None = None,
    policy: PathPolicy | None = None,
    limits: Limits | None = None,
) -> Job:
    """Load a job and resolve it.

    The resolved job holds absolute paths, all chapters and sidecar files, and the calibrations that were
    read.

    Args:
        path: Path of a YAML file or of a folder of videos. If the folder holds a ``job.yaml``, this file is
            loaded. Paths in a YAML file are relative to the folder of the file; if the file is a symbolic
            link, they are relative to the folder of the link's target.
        overrides: Values of the command line.
        prepare: Function that renders the videos of a job with `capture.synthetic`. It is called before the
            videos are opened.
        policy: The rules for the files that the job may name. None allows any file, for the user's own job.
        limits: Maximum size and depth of the YAML file; None for the default limits.

    Returns:
        The resolved job. `Job.model_validate(job.model_dump(mode="json"))` returns an equal job.

    Raises:
        JobError: The file is not a valid job. The error names the file, line and field, and gives advice.
        CaptureError: A calibration or a folder of videos cannot be used.
    """
    full = path.resolve()
    # A job file that was submitted without a folder must not use the files beside it: they belong to other
    # users.
    alone = policy is not None and policy.folder is None and not full.is_dir()
    try:
        full = _job_source(full, policy)
        source = _read_source(full, limits or Limits())
        return _load(full, source, overrides or Overrides(), prepare, policy, alone=alone)
    except PermissionError as error:
        kind = JobError if error.filename == str(full) else CaptureError
        raise kind(
            "the program has no permission to read the file",
            path=error.filename,
            hint="give the user who runs this program the permission to read the file and to enter its "
            "folders (chmod)",
        ) from error


def _job_source(full: Path, policy: PathPolicy | None) -> Path:
    """Return the job file in the folder `full`; return `full` itself if it is a file or has no job file."""
    found = job_file_in(full) if full.is_dir() else None
    if found is None:
        return full
    if policy is not None:
        policy.require(found)
    return found


def _read_source(full: Path, limits: Limits) -> YamlSource | None:
    """Return the parsed YAML file of a job; None for a folder of videos."""
    if full.is_dir():
        return None
    if full.suffix.lower() in VIDEO_SUFFIXES:
        raise JobError(
            "this file is a video, not a job",
            path=full,
            hint=f"give the folder that contains the video: {full.parent}",
        )
    return read_yaml(full, max_bytes=int(1024 * limits.yaml_kb), max_depth=int(limits.yaml_depth))


def _load(
    full: Path,
    source: YamlSource | None,
    overrides: Overrides,
    prepare: Prepare | None,
    policy: PathPolicy | None,
    *,
    alone: bool,
) -> Job:
    if source is None:
        data, base, name = {"capture": folder_capture(full)}, full, full.name
    else:
        base = full.parent
        data = _top_mapping(source)
        if not alone:
            data = _with_videos_beside(data, base)
        name = base.name if full.name in JOB_FILES else full.stem
    job = _with_overrides(_validated(data, full, source), overrides)
    problems = problems_in(job)
    if problems:
        raise job_error(problems, full, source)
    if policy is not None:
        policy.require_named(job, base)
    if job.capture.synthetic is not None:
        _prepare_synthetic(job, base, full, prepare)
    resolved = _resolved(job, base, safe_name(name), full, source)
    if policy is None:
        _require_apart(resolved, full)
    else:  # the folder of the results is not checked, because the operator chooses it
        policy.require_resolved(resolved)
    return resolved


def synthetic_folder(job: Job, base: Path) -> Path:
    """Return the folder for the videos of a synthetic capture. All videos must be in the same folder.

    Raises:
        JobError: The job names videos in several folders.
    """
    folders = {(base / video).resolve().parent for camera in job.capture.cameras for video in camera.video}
    if len(folders) > 1:
        raise JobError(
            "the videos of a synthetic capture must be in one folder, but these videos are in several "
            "folders",
            field="capture.cameras",
            hint="write each video as <folder>/<camera>.mp4, with the same folder for all cameras",
        )
    return folders.pop()


def _top_mapping(source: YamlSource) -> dict[str, Any]:
    if source.data is None:
        raise JobError("the job is empty", path=source.path, hint="write at least `capture:`")
    if not isinstance(source.data, dict):
        raise JobError(
            "the job is not a block of `key: value` lines",
            path=source.path,
            hint="start the file with `capture:`",
        )
    return source.data


def _with_videos_beside(data: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the data of a job file. If no cameras are named, add the videos in the job file's folder.

    The cameras are named after these videos, as for a folder without a job file. Data with an unknown key are
    returned unchanged, because the unknown key may be a misspelt ``cameras``.
    """
    capture = data.get("capture", {})
    if not isinstance(capture, dict) or "cameras" in capture:
        return data
    if not (data.keys() <= Job.model_fields.keys() and capture.keys() <= CaptureConfig.model_fields.keys()):
        return data
    try:
        videos_in(folder)
    except CaptureError:  # no videos here: the validation reports the missing cameras
        return data
    return {**data, "capture": {**folder_capture(folder), **capture}}


def _validated(data: dict[str, Any], path: Path, source: YamlSource | None) -> Job:
    """Check the types strictly and return the job.

    The data are validated as JSON. A list is therefore accepted for a tuple, but the text "5" is not accepted
    for a number.
    """
    try:
        return Job.model_validate_json(json.dumps(_with_lists(data)), strict=True)
    except ValidationError as error:
        raise job_error(problems_of(error, Job, data), path, source) from error


def _with_lists(data: dict[str, Any]) -> dict[str, Any]:
    """Replace a single path by a list with one path, because the strict validation does not convert it."""
    capture = data.get("capture")
    if not isinstance(capture, dict) or not isinstance(capture.get("cameras"), list):
        return data
    cameras = [
        {key: [v] if key in _LISTS and isinstance(v, str) else v for key, v in camera.items()}
        if isinstance(camera, dict)
        else camera
        for camera in capture["cameras"]
    ]
    return {**data, "capture": {**capture, "cameras": cameras}}


def _with_overrides(job: Job, overrides: Overrides) -> Job:
    update: dict[str, Any] = {}
    if overrides.out is not None:
        update["out"] = overrides.out.resolve()
    if overrides.skeleton is not None:
        preset = overrides.skeleton in SKELETON_PRESETS or not overrides.skeleton.lower().endswith(".bvh")
        update["skeleton"] = overrides.skeleton if preset else str(Path(overrides.skeleton).resolve())
    if overrides.height_m is not None:
        if not _HEIGHT_M[0] <= overrides.height_m <= _HEIGHT_M[1]:
            raise JobError(
                f"a body height of {overrides.height_m:g} m is not plausible",
                field="height_m",
                hint="give the height in metres, for example 1.75",
            )
        update["height_m"] = float(overrides.height_m)
    return job.model_copy(update=update)


def _prepare_synthetic(job: Job, base: Path, path: Path, prepare: Prepare | None) -> None:
    folder = synthetic_folder(job, base)
    if prepare is not None:
        options = dict(job.capture.synthetic or {})
        if isinstance(options.get("motion"), str):
            options["motion"] = str((base / options["motion"]).resolve())
        prepare(options, folder)
    missing = [v for camera in job.capture.cameras for v in camera.video if not (base / v).is_file()]
    if missing:
        raise CaptureError(
            "the videos of this synthetic capture have not been rendered yet",
            path=(base / missing[0]).resolve(),
            field="capture.synthetic",
            hint=f"run `bodycap run {path.name}`, which renders the videos first",
        )


def _resolved(job: Job, base: Path, name: str, path: Path, source: YamlSource | None) -> Job:
    cameras = tuple(
        _resolved_camera(camera, index, job.capture, base) for index, camera in enumerate(job.capture.cameras)
    )
    skeleton = skeleton_of(job)
    if skeleton not in SKELETON_PRESETS:
        skeleton = str((base / skeleton).resolve())
        if not Path(skeleton).is_file():
            raise job_error(
                [
                    Problem(
                        ("skeleton",),
                        f"there is no such skeleton file: {skeleton}",
                        "correct the path of the skeleton; a relative path starts at the folder of the job "
                        "file",
                    )
                ],
                path,
                source,
            )
    capture = job.capture.model_copy(update={"cameras": cameras, "calibration": None})
    name = job.name or name
    out = (base / job.out if job.out is not None else Path("out") / name).resolve()
    return job.model_copy(update={"capture": capture, "name": name, "skeleton": skeleton, "out": out})


def _require_apart(job: Job, full: Path) -> None:
    """Refuse a job whose results would go into the folder of its videos or of its job file.

    Otherwise a later run could use the preview as an input video, or the resolved job could overwrite the job
    file.
    """
    videos = {video.parent for camera in job.capture.cameras for video in camera.video}
    kept = full.name == JOB_FILES[0] and full.parent == job.out and not (full.parent / RUN_FILE).is_file()
    if job.out in videos or kept:
        raise JobError(
            f"the results would be written into the folder of the job's own files, {job.out}",
            path=full,
            field="out",
            hint=f"use a separate folder for the results, for example {Path(str(job.out)) / 'results'}",
        )


def _resolved_camera(camera: CameraConfig, index: int, capture: CaptureConfig, base: Path) -> CameraConfig:
    videos, sidecars = _chapters(camera, base)
    if camera.timestamps:
        sidecars = tuple((base / path).resolve() for path in camera.timestamps)
    if len(sidecars) not in (0, 1, len(videos)):
        raise CaptureError(
            f"camera {camera.name} has {len(sidecars)} files of timestamps for {len(videos)} chapters",
            path=sidecars[0],
            field=f"capture.cameras.{index}.timestamps",
            hint="give one file of timestamps for all chapters, or one file for each chapter",
        )
    calibration = camera.calibration if camera.calibration is not None else capture.calibration
    entry: CalibrationEntry | None = None
    if isinstance(calibration, Path):
        entry = read_calibration((base / calibration).resolve(), camera.name)
        calibration = entry.calibration
    update: dict[str, Any] = {"video": videos, "timestamps": sidecars, "calibration": calibration or "auto"}
    if camera.mask is not None:
        update["mask"] = (base / camera.mask).resolve()
    if camera.offset_s is None:
        update["offset_s"] = entry.offset_s if entry else 0.0
    if camera.rolling_shutter_s is None:
        update["rolling_shutter_s"] = entry.rolling_shutter_s if entry else None
    return camera.model_copy(update=update)


def _chapters(camera: CameraConfig, base: Path) -> tuple[tuple[Path, ...], tuple[Path, ...]]:
    """Return the video files of a camera in order, and the sidecar files with the videos' timestamps.

    The first of these that exists is used: the sidecar of a folder of chapters, the sidecars of the chapters
    (``<video>.timestamps.txt``), the file ``<camera>.timestamps.txt``.
    """
    videos: list[Path] = []
    beside: list[Path] = []
    places = [(base / video).resolve() for video in camera.video]
    for place in places:
        chapters = chapters_in(place) if place.is_dir() else (place,)
        whole = sidecars_of(place) if place.is_dir() and len(places) == 1 else []
        videos.extend(chapters)
        beside.extend(whole or [sidecar for chapter in chapters for sidecar in sidecars_of(chapter)])
    return tuple(videos), tuple(beside or _existing(places[0].with_name(f"{camera.name}.timestamps.txt")))


def sidecars_of(video: Path) -> list[Path]:
    """Return the sidecar file of a video or folder: a list with one path, or an empty list.

    Its name is ``torso.timestamps.txt`` or ``torso.mp4.timestamps.txt``; the first name is preferred.
    """
    names = (f"{video.stem}.timestamps.txt", f"{video.name}.timestamps.txt")
    return [found for name in names for found in _existing(video.with_name(name))][:1]


def _existing(path: Path) -> list[Path]:
    return [path] if path.is_file() else []


def safe_name(text: str) -> str:
    """Convert a text to a file name that consists of letters, digits, ``.``, ``_`` and ``-`` only."""
    return re.sub(r"[^A-Za-z0-9._\-]+", "_", text)[:_NAME_LENGTH].strip("._-") or "job"
