"""Load a job from a YAML file or a folder of videos, and resolve all paths of the job."""

from __future__ import annotations

import json
import re
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeGuard

from pydantic import ValidationError

from bodycap_batch.config.body_height import height_from_text
from bodycap_batch.config.calibration import Calibration, implausible_calibration
from bodycap_batch.config.explain import MAX_FURTHER, Problem, job_error, problems_of
from bodycap_batch.config.folder import (
    ARCHIVE_SUFFIXES,
    CALIBRATION_FILE,
    JOB_FILES,
    PHOTO_SUFFIXES,
    RUN_FILE,
    VIDEO_SUFFIXES,
    folder_capture,
    job_file_in,
    videos_in,
)
from bodycap_batch.config.limits import Limits
from bodycap_batch.config.models import (
    MAX_NAME_LENGTH,
    NO_SKELETON,
    SKELETON_PRESETS,
    Activity,
    CameraConfig,
    CaptureConfig,
    Job,
)
from bodycap_batch.config.mounts import TRUNK_ROLES, mount_of, place_of_role
from bodycap_batch.config.origins import LoadedJob, Source
from bodycap_batch.config.overrides import NO_HEIGHT, Overrides
from bodycap_batch.config.resolved_camera import ResolvedCamera, resolved_camera, with_found_calibrations
from bodycap_batch.config.retired_options import without_retired_options
from bodycap_batch.config.rules import missing_files, problems_in, skeleton_of
from bodycap_batch.config.trust import PathPolicy
from bodycap_batch.config.unfinished_videos import refuse_missing_cameras
from bodycap_batch.config.videos_beside import VideosBeside, find_videos_beside
from bodycap_batch.config.yaml_source import Location, YamlSource, dotted, read_yaml
from bodycap_batch.core.errors import CaptureError, JobError

RESULTS = "out"
"""Name of the folder for results beside a job. The folder of one job's results is a subfolder of it."""

Prepare = Callable[[Mapping[str, Any], Path, Path], None]
"""Function that renders a synthetic capture. Its arguments are the options of `capture.synthetic`, the folder
for the videos, and the folder for the results of the job."""


def results_of_job(path: Path) -> Path:
    """Return the folder for the results of a job. Of a job file, only the name and the folder are read.

    Args:
        path: Path of a YAML file or of a folder of videos.

    Raises:
        JobError: The file is no YAML file, or there is none.
    """
    return _source_at(path.resolve(), None, Limits()).stated_results(Overrides())


def load_job(
    path: Path,
    overrides: Overrides | None = None,
    *,
    prepare: Prepare | None = None,
    policy: PathPolicy | None = None,
    limits: Limits | None = None,
) -> Job:
    """Load a job and resolve it. Arguments and errors are those of `load_job_with_origins`."""
    return load_job_with_origins(path, overrides, prepare=prepare, policy=policy, limits=limits).job


def load_job_with_origins(
    path: Path,
    overrides: Overrides | None = None,
    *,
    prepare: Prepare | None = None,
    policy: PathPolicy | None = None,
    limits: Limits | None = None,
    is_draft: bool = False,
) -> LoadedJob:
    """Load a job and resolve it, and record where its settings come from.

    The resolved job holds absolute paths, all chapters and sidecar files, and the calibrations that were
    read.

    Args:
        path: Path of a YAML file or of a folder of videos. If the folder holds a ``job.yaml``, this file is
            loaded. Paths in a YAML file are relative to the folder of the file; if the file is a symbolic
            link, they are relative to the folder of the link's target. A ``job.yaml`` (or ``job.yml``)
            belongs to its folder: videos that it does not list become cameras, and ``calib.json`` is used as
            in a folder without a job file.
        overrides: Values of the command line. Values of the last run's command line are used for what neither
            they nor the job file give (`Overrides.with_last_run`), but not with a `policy`.
        prepare: Function that renders the videos of a job with `capture.synthetic`. It is called before the
            videos are opened.
        policy: The rules for the files that the job may name. None allows any file, for the user's own job.
        limits: Maximum size and depth of the YAML file; None for the default limits.
        is_draft: True to skip the rules for the values, for a job file with blanks to fill in.

    Returns:
        The resolved job and its origins. `Job.model_validate(job.model_dump(mode="json"))` returns an equal
        job.

    Raises:
        JobError: The file is not a valid job. The error names the file, line and field, and gives advice.
        CaptureError: A calibration or a folder of videos cannot be used.
    """
    full = path.resolve()
    # A job file that was submitted without a folder must not use the files beside it: they belong to other
    # users.
    alone = policy is not None and policy.folder is None and not full.is_dir()
    try:
        source = _source_at(full, policy, limits or Limits())
        full = source.path
        file, retired = without_retired_options(source.file)
        source = replace(source, file=file)
        overrides, kept = overrides or Overrides(), ""
        if policy is None:
            results = source.stated_results(overrides)
            overrides, kept = overrides.with_last_run(source.data, results)
        stated = _stated_job(source, overrides, alone=alone)
        loaded = _resolved_job(stated, overrides, prepare, policy, is_draft=is_draft)
        return replace(loaded, warnings=(*loaded.warnings, *retired, *([kept] if kept else ())))
    except PermissionError as error:
        kind = JobError if error.filename == str(full) else CaptureError
        raise kind(
            "the program has no permission to read the file",
            path=error.filename,
            hint="give the user who runs this program the permission to read the file and to enter its "
            "folders (chmod)",
        ) from error


@dataclass(frozen=True, slots=True, kw_only=True)
class _Source:
    """What a job is loaded from: a folder of videos, or a job file.

    Attributes:
        path: The folder or the file.
        file: The parsed file; None for a folder.
    """

    path: Path
    file: YamlSource | None

    @property
    def folder(self) -> Path:
        """Folder to which the paths of the job are relative."""
        return self.path if self.file is None else self.path.parent

    @property
    def is_folder(self) -> bool:
        """True for a folder of videos, also with a ``job.yaml`` in it."""
        return self.file is None or self.path.name in JOB_FILES

    @property
    def data(self) -> Mapping[str, Any]:
        """The data of the job file; empty if there is none, or if the data are no mapping."""
        return self.file.data if self.file is not None and isinstance(self.file.data, dict) else {}

    @property
    def name(self) -> str:
        """Name of the job if its job file gives none."""
        return safe_name(self.folder.name if self.is_folder else self.path.stem)

    def stated_results(self, overrides: Overrides) -> Path:
        """Return the folder for the results of the job before it is validated."""
        return self.results(self.data.get("name"), self.data.get("out"), overrides)

    def results(self, name: Any, out: Any, overrides: Overrides) -> Path:
        """Return the folder for the results. It does not depend on the working folder.

        Args:
            name: Name of the job in the job file; of another type or empty if it gives none.
            out: Folder for the results in the job file; of another type if it gives none.
            overrides: Values of the command line.
        """
        if overrides.out is not None:
            return overrides.out.resolve()
        if isinstance(out, Path) or _is_path_text(out):
            return (self.folder / out).resolve()
        own = (self.folder.parent if self.is_folder else self.folder) / RESULTS
        named = name if _is_path_text(name) and name else self.name
        return ((overrides.out_parent or own) / named).resolve()

    def error(self, problems: Sequence[Problem]) -> JobError:
        """Return one error for problems of the job, with the file and the line of the first one."""
        return job_error(problems, self.path, self.file)


def _source_at(full: Path, policy: PathPolicy | None, limits: Limits) -> _Source:
    """Read the job file at a path, or the one in the folder at the path, if there is one."""
    found = job_file_in(full) if full.is_dir() else None
    if found is not None:
        if policy is not None:
            policy.require(found)
        full = found
    if full.is_dir():
        return _Source(path=full, file=None)
    _require_job_file(full)
    file = read_yaml(full, max_bytes=int(1024 * limits.yaml_kb), max_depth=int(limits.yaml_depth))
    return _Source(path=full, file=file)


def _require_job_file(full: Path) -> None:
    """Raise `JobError` if a file does not exist, or is a video, a photo or an archive instead of a job."""
    if not full.exists():
        raise JobError(
            "there is no such file or folder",
            path=full,
            hint="correct the path; give a folder of videos, a job file (YAML) or a folder of results",
        )
    for suffixes, message, hint in (
        (VIDEO_SUFFIXES, "a video, not a job", f"give the folder that contains the video: {full.parent}"),
        (PHOTO_SUFFIXES, "a photo, not a job", "give a folder of videos; photos are not used"),
        (
            ARCHIVE_SUFFIXES,
            "an archive, not a folder of videos",
            "unpack it, and give the folder with the videos",
        ),
    ):
        if full.suffix.lower() in suffixes:
            raise JobError(f"this file is {message}", path=full, hint=hint)


@dataclass(frozen=True, slots=True, kw_only=True)
class _StatedJob:
    """A job with the values of its file, before it is resolved.

    Attributes:
        source: The job file, or the folder of videos.
        job: The job as stated, with the cameras that were found in its folder.
        stated: The capture as the job file states it; without cameras if it lists none.
        uses_folder: True if the job uses the videos and the calibration in its folder.
        is_alone: True for a job file that another user submitted without a folder.
        beside: The videos in the folder that the job file does not list.
        placed: Where the place of each camera would come from, by camera name.
    """

    source: _Source
    job: Job
    stated: CaptureConfig
    uses_folder: bool
    is_alone: bool = False
    beside: VideosBeside = field(default_factory=VideosBeside)
    placed: Mapping[str, Source] = field(default_factory=dict)


def _stated_job(source: _Source, overrides: Overrides, *, alone: bool) -> _StatedJob:
    """Return the job with the values of its file and with the cameras of its folder.

    Args:
        source: The job file, or the folder of videos.
        overrides: Values of the command line and of the last run, with the places of cameras on the body.
        alone: True for a job file that another user submitted without a folder.
    """
    stated = _stated_without_places(source, overrides, alone=alone)
    mounted = [overrides.mounted(camera) for camera in stated.job.capture.cameras]
    placed = {camera.name: source for camera, source in mounted}
    overrides.require_used(stated.job.capture.cameras)
    capture = stated.job.capture.model_copy(update={"cameras": tuple(camera for camera, _ in mounted)})
    return replace(stated, job=stated.job.model_copy(update={"capture": capture}), placed=placed)


def _stated_without_places(source: _Source, overrides: Overrides, *, alone: bool) -> _StatedJob:
    stated_data = {} if source.file is None else _top_mapping(source.file)
    data = stated_data if alone else _with_folder_capture(stated_data, source, overrides)
    job = _validated(data, source)
    if data is not stated_data:
        stated = job.capture.model_copy(update={"cameras": ()})
        return _StatedJob(source=source, job=job, stated=stated, uses_folder=True)
    uses_folder = not alone and source.is_folder and not (source.folder / RUN_FILE).is_file()
    stated, beside = job.capture, VideosBeside()
    # The videos of a synthetic capture exist only after they have been rendered, so they are not looked for.
    if uses_folder and not stated.cameras_only and stated.synthetic is None:
        beside = find_videos_beside(source.path, stated.cameras, _knows(data, overrides))
        if beside.cameras:
            capture = {**data["capture"], "cameras": [*data["capture"]["cameras"], *beside.cameras]}
            job = _validated({**data, "capture": capture}, source)
    return _StatedJob(
        source=source, job=job, stated=stated, uses_folder=uses_folder, is_alone=alone, beside=beside
    )


def _knows(data: Mapping[str, Any], overrides: Overrides) -> Callable[[str], bool]:
    """Return a function that returns True if the place of a video is known, or found by the run."""
    are_found = bool(data.get("capture", {}).get("places"))
    return lambda name: are_found or overrides.is_known(name)


def _resolved_job(
    stated: _StatedJob,
    overrides: Overrides,
    prepare: Prepare | None,
    policy: PathPolicy | None,
    *,
    is_draft: bool,
) -> LoadedJob:
    source = stated.source
    base = source.folder
    job = _with_overrides(stated.job, overrides)
    problems = [] if is_draft else problems_in(job)
    if problems:
        is_own = policy is None and job.capture.synthetic is None
        error = source.error(problems)
        for found in missing_files(job, base)[:MAX_FURTHER] if is_own else ():
            error.message += f"; also {dotted(found.location)}: {found.message}"
        raise error
    if policy is not None:
        policy.require_files(job, base)
    if job.capture.synthetic is not None:
        _prepare_synthetic(job, stated, overrides, prepare)
    _require_plausible_calibrations(job, source)
    if stated.uses_folder:
        job = job.model_copy(update={"capture": with_found_calibrations(job.capture, base)})
        if policy is not None:  # before a calibration is read
            policy.require_files(job, base)
    cameras = [
        resolved_camera(index, job.capture, stated.stated, base, stated.placed)
        for index in range(len(job.capture.cameras))
    ]
    resolved = _with_resolved(job, cameras, stated, overrides)
    if policy is None:
        _require_apart(resolved, source.path)
    else:  # the folder of the results is not checked, because the operator chooses it
        policy.require_files(resolved, base)
    return LoadedJob(
        job=resolved,
        origins={camera.config.name: camera.origins for camera in cameras},
        folder=_capture_folder(stated, resolved),
        job_file=None if source.file is None else source.path,
        calibration_files=frozenset(
            camera.calibration_file for camera in cameras if camera.calibration_file is not None
        ),
        beside=stated.beside,
        unlisted=_reason_of_unlisted(stated),
        warnings=(
            *stated.beside.warnings,
            *_calibration_warnings(stated, cameras),
            *_wrist_warnings([camera.config for camera in cameras]),
        ),
        no_body=_no_body(job, resolved),
    )


def _capture_folder(stated: _StatedJob, resolved: Job) -> Path | None:
    """Return the folder of the videos; None if the job file lies elsewhere."""
    videos = [video for camera in resolved.capture.cameras for video in camera.video]
    folder = stated.source.folder
    if stated.uses_folder or any(video.parent == folder for video in videos):
        return folder
    return None


def _reason_of_unlisted(stated: _StatedJob) -> str:
    """Return the reason why a video in the capture's folder is not used although nothing is wrong with it."""
    if stated.stated.cameras_only:
        return "not listed, and the job file says `cameras_only: true`"
    if stated.uses_folder:
        return "not listed"
    return f"not listed; only a {JOB_FILES[0]} adds the videos beside it"


def _calibration_warnings(stated: _StatedJob, cameras: Sequence[ResolvedCamera]) -> list[str]:
    """Return a warning if a calibration beside the job file is ignored although a camera has none."""
    path = stated.source.folder / CALIBRATION_FILE
    if stated.uses_folder or stated.is_alone or not path.is_file():
        return []
    unstated = [camera.config.name for camera in cameras if camera.origins.calibration.source == "default"]
    if not unstated:
        return []
    return [
        f"{path.name} is not used for {', '.join(unstated)}: a job file that is not called {JOB_FILES[0]} "
        f"uses it only if it says `calibration: {path.name}`"
    ]


def _wrist_warnings(cameras: Sequence[CameraConfig]) -> list[str]:
    """Return a warning for each camera whose name says the wrist, which is between two bones."""
    found = []
    for camera in cameras:
        place = mount_of(camera.mount or camera.name)
        if "wrist" in (camera.mount or camera.name).lower() and place is not None and camera.segment is None:
            side = place[0].partition("_")[0]
            found.append(
                f"camera {camera.name} is taken to be on the forearm ({place[0]}), because a camera on the "
                "wrist does not turn with the hand; if it is strapped to the palm or the back of the hand, "
                f"give --camera {camera.name}={side}_palm, or name the video {side}_palm"
            )
    return found


def _no_body(job: Job, resolved: Job) -> str:
    """Return why the job computes no body although it does not say so; "" if there is no reason to say it."""
    if resolved.skeleton != NO_SKELETON or job.skeleton is not None:
        return ""
    cameras = job.capture.worn()
    if not cameras:
        return "no body is computed: nobody wears a camera (mount: none)"
    names = ", ".join(camera.name for camera in cameras)
    places = " and ".join(sorted({_place_of(camera) for camera in cameras}))
    roles = {camera.role for camera in cameras}
    if None in roles:
        add = "name each video after its place on the body, for example torso.mp4, and add left_palm.mp4"
    elif roles & set(TRUNK_ROLES):
        add = "add a camera on a limb, for example left_palm.mp4 and right_palm.mp4"
    else:
        add = "add a camera on the trunk or the head, for example torso.mp4"
    return (
        "no body is computed: a body takes two cameras or more on different bones, and this job has only "
        f"{names} (on {places}); {add}"
    )


def _place_of(camera: CameraConfig) -> str:
    return "an unknown place" if camera.role is None else place_of_role(camera.role)


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


def _with_folder_capture(data: dict[str, Any], source: _Source, overrides: Overrides) -> dict[str, Any]:
    """Return the data of a job. If no cameras are listed, add the videos in the folder of the job.

    A folder without a job file is a job without data. Data with an unknown key are returned unchanged,
    because the unknown key may be a misspelt ``cameras``.
    """
    capture = data.get("capture", {})
    if not isinstance(capture, dict) or "cameras" in capture or capture.get("cameras_only") is True:
        return data
    if not (data.keys() <= Job.model_fields.keys() and capture.keys() <= CaptureConfig.model_fields.keys()):
        return data
    refuse_missing_cameras(source.folder)
    try:
        videos_in(source.folder)
    except CaptureError:
        if source.file is None:
            raise
        return data  # no videos here: the validation reports the missing cameras
    return {
        **data,
        "capture": {**folder_capture(source.folder, _knows(data, overrides)), **capture},
    }


def _validated(data: dict[str, Any], source: _Source) -> Job:
    """Check the types strictly and return the job.

    The data are validated as JSON. A list is therefore accepted for a tuple, but the text "5" is not accepted
    for a number.
    """
    try:
        return Job.model_validate_json(json.dumps(data), strict=True)
    except ValidationError as error:
        raise source.error(problems_of(error, Job, data)) from error


def _with_overrides(job: Job, overrides: Overrides) -> Job:
    update: dict[str, Any] = {}
    if overrides.out is not None:
        update["out"] = overrides.out.resolve()
    if overrides.skeleton is not None:
        preset = overrides.skeleton in SKELETON_PRESETS or not overrides.skeleton.lower().endswith(".bvh")
        update["skeleton"] = overrides.skeleton if preset else str(Path(overrides.skeleton).resolve())
    if overrides.height_m is not None:
        height_m = overrides.height_m
        update["height_m"] = None if height_m == NO_HEIGHT else height_from_text(height_m)
    if overrides.activity is not None:
        update["activity"] = _known_activity(overrides.activity)
    if overrides.require is not None:
        update["require"] = overrides.require
    if overrides.places:
        update["capture"] = job.capture.model_copy(update={"places": overrides.places})
    return job.model_copy(update=update)


def _known_activity(text: str) -> Activity:
    known: tuple[Activity, ...] = typing.get_args(Activity)
    for name in known:
        if text == name:
            return name
    raise JobError(
        f"there is no activity {text[:40]!r}", field="--activity", hint=f"use one of {', '.join(known)}"
    )


def _prepare_synthetic(job: Job, stated: _StatedJob, overrides: Overrides, prepare: Prepare | None) -> None:
    base = stated.source.folder
    folder = synthetic_folder(job, base)
    if prepare is not None:
        options = dict(job.capture.synthetic or {})
        if isinstance(options.get("motion"), str):
            options["motion"] = str((base / options["motion"]).resolve())
        prepare(options, folder, stated.source.results(job.name, job.out, overrides))
    missing = [v for camera in job.capture.cameras for v in camera.video if not (base / v).is_file()]
    if missing:
        raise CaptureError(
            "the videos of this synthetic capture have not been rendered yet",
            path=(base / missing[0]).resolve(),
            field="capture.synthetic",
            hint=f"run `bodycap run {stated.source.path.name}`, which renders the videos first",
        )


def _require_plausible_calibrations(job: Job, source: _Source) -> None:
    """Refuse a job that contains a calibration with a value that no usable calibration has.

    Raises:
        CaptureError: A value is not plausible.
    """
    places: list[tuple[Location, object]] = [(("capture", "calibration"), job.capture.calibration)]
    for index, camera in enumerate(job.capture.cameras):
        places.append((("capture", "cameras", index, "calibration"), camera.calibration))
    for place, calibration in places:
        found = calibration.implausible_value() if isinstance(calibration, Calibration) else None
        if found is not None:
            field = found.field.partition(".")[0]
            line = None if source.file is None else source.file.line_of((*place, field))
            raise implausible_calibration(found, source.path, dotted(place), line)


def _with_resolved(
    job: Job, cameras: Sequence[ResolvedCamera], stated: _StatedJob, overrides: Overrides
) -> Job:
    source, skeleton = stated.source, skeleton_of(job)
    if skeleton not in SKELETON_PRESETS:
        skeleton = str((source.folder / skeleton).resolve())
        if not Path(skeleton).is_file():
            hint = "correct the path of the skeleton; a relative path starts at the folder of the job file"
            raise source.error([Problem(("skeleton",), f"there is no such skeleton file: {skeleton}", hint)])
    configs = tuple(camera.config for camera in cameras)
    capture = job.capture.model_copy(update={"cameras": configs, "cameras_only": True, "calibration": None})
    return job.model_copy(
        update={
            "capture": capture,
            "name": job.name or source.name,
            "skeleton": skeleton,
            "out": source.results(job.name, job.out, overrides),
        }
    )


def _is_path_text(value: object) -> TypeGuard[str]:
    """Return True for a text that a path can hold: without unpaired surrogates, which are refused later."""
    return isinstance(value, str) and value.encode("utf-8", "ignore").decode() == value


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


def safe_name(text: str) -> str:
    """Convert a text to a file name that consists of letters, digits, ``.``, ``_`` and ``-`` only."""
    return re.sub(r"[^A-Za-z0-9._\-]+", "_", text)[:MAX_NAME_LENGTH].strip("._-") or "job"
