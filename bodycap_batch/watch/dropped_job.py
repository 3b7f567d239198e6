"""Read a job from the inbox, check that it names only permitted paths, and write it to the job's folder."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import yaml

from bodycap_batch.config.folder import job_file_in
from bodycap_batch.config.job import load_job, load_job_with_origins, safe_name
from bodycap_batch.config.limits import Limits
from bodycap_batch.config.models import Job
from bodycap_batch.config.origins import LoadedJob
from bodycap_batch.config.trust import PathPolicy
from bodycap_batch.config.unfinished_videos import unreadable_videos
from bodycap_batch.core.errors import CaptureError, JobError, StoreError
from bodycap_batch.formats.file_completeness import NO_VIDEO
from bodycap_batch.pipeline.results import write_results_file
from bodycap_batch.watch.inbox_entries import YAML_SUFFIXES, EntrySnapshot, InboxEntry
from bodycap_batch.watch.spool import JobDir, visible_entries

_CHECKSUM_LINE = "# SHA-256 of the lines below: "
"""Start of the first line of a job's resolved file in the spool. The SHA-256 follows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JobPermissions:
    """What the operator permits a job to do.

    Attributes:
        roots: Folders that all jobs may read.
        limits: Maximum size of a job.
    """

    roots: tuple[Path, ...] = ()
    limits: Limits = field(default_factory=Limits)


def read_dropped_job(
    entry: InboxEntry, snapshot: EntrySnapshot, permissions: JobPermissions
) -> tuple[Job, tuple[str, ...]]:
    """Read and resolve a job in the inbox. Its videos are opened, but no frame is decoded.

    Args:
        entry: A complete entry of the inbox.
        snapshot: The state of the entry's files.
        permissions: Which folders the job may read, and the maximum size of the job.

    Returns:
        The job, and warnings for the user. All paths of the job are absolute and permitted.

    Raises:
        JobError: The job is not valid, holds a special file, or names a path that is not permitted.
        CaptureError: A calibration, a folder of videos or a video cannot be used, a video is too large, or
            there are too many files.
    """
    if snapshot.undecodable:
        shown = snapshot.undecodable.encode(errors="backslashreplace").decode()
        raise JobError(
            f"the name {shown} is not UTF-8 text",
            hint="rename this file, and put the folder into the inbox again",
        )
    policy = path_policy(entry.path, permissions.roots, is_file=entry.is_file)
    if policy.folder is None:
        # A link must lead to a permitted folder. A job file in the inbox itself may always be read.
        if entry.path.is_symlink():
            policy.require(entry.path)
    elif snapshot.files > permissions.limits.files:
        hint = (
            "put each recording into its own folder, or ask the operator of the watched folder to raise "
            "--limit files"
        )
        raise CaptureError(
            f"the folder contains more than {permissions.limits.files:g} files", path=entry.path, hint=hint
        )
    if snapshot.special:
        raise JobError(
            f"{snapshot.special} is neither a file nor a folder",
            path=entry.path,
            hint="remove this entry from the folder",
        )
    decides = None if entry.is_file else job_file_in(entry.path)
    if decides is not None:
        policy.require(decides)
    loaded = load_job_with_origins(entry.path, policy=policy, limits=permissions.limits)
    job = loaded.job
    if decides is not None and job.name == safe_name(entry.path.resolve().name):
        # The name of the job comes from the real folder. The entry may be a link with another name, so use
        # the name of the entry.
        job = job.model_copy(update={"name": safe_name(entry.name)})
    _require_video_sizes(job, permissions.limits)
    _require_readable_videos(loaded)
    capture = job.capture.model_copy(update={"synthetic": None})
    return job.model_copy(update={"capture": capture}), loaded.warnings_of_run()


def path_policy(path: Path, roots: tuple[Path, ...], *, is_file: bool) -> PathPolicy:
    """Return the policy for the paths that an entry may name.

    An entry may always name paths below `roots`. A folder may also name paths inside itself. A link or a
    single job file may name no other paths.
    """
    own = None if is_file or path.is_symlink() else path
    return PathPolicy(folder=own, roots=roots)


def unread_job_files(folder: Path) -> list[str]:
    """Return the names of the YAML files in a folder without a job file; otherwise return an empty list.

    These YAML files are not read, because none has the name of a job file.
    """
    if job_file_in(folder) is not None:
        return []
    return [path.name for path in visible_entries(folder) if path.suffix.lower() in YAML_SUFFIXES]


def write_job(job: Job, job_dir: JobDir, dropped: Path) -> None:
    """Write a resolved job into its folder. Paths to the job's own input become relative to that folder.

    Args:
        job: The job that `read_dropped_job` returned.
        job_dir: The job's folder.
        dropped: Current path of the job's input.
    """
    here = dropped.resolve()
    text = yaml_from_job(job.with_paths(lambda path: _relocated(path, here, Path("input"))))
    job_dir.job.write_text(f"{_CHECKSUM_LINE}{_checksum(text)}\n{text}", encoding="utf-8")


def read_job(job_dir: JobDir, permissions: JobPermissions) -> Job:
    """Load a job that `write_job` wrote, and check its paths again.

    Raises:
        JobError: The job cannot be read, or names a path that is not permitted.
        CaptureError: A video is too large.
        StoreError: The file is damaged.
    """
    if not job_dir.job.is_file():
        raise JobError(
            "the file of the job no longer exists",
            path=job_dir.job,
            hint="run `bodycap retry` for this job, which reads the job again",
        )
    _require_undamaged(job_dir.job)
    policy = path_policy(job_dir.input, permissions.roots, is_file=False)
    job = load_job(job_dir.job, policy=policy, limits=Limits())
    _require_video_sizes(job, permissions.limits)
    return job.model_copy(update={"out": job_dir.result})


def _require_undamaged(path: Path) -> None:
    """Raise `StoreError` if a job's file was written with a checksum that does not match."""
    first, _, text = path.read_bytes().partition(b"\n")
    start = _CHECKSUM_LINE.encode()
    # The start of the line may be damaged, too. Files of earlier program versions have no such line.
    half = len(start) // 2
    has_line = first[:half] == start[:half] or first[half : len(start)] == start[half:]
    if has_line and first != start + _checksum(text).encode():
        raise StoreError(
            "the stored job is damaged",
            path=path,
            hint="check the disk; `bodycap retry` reads the job again",
        )


def _checksum(text: str | bytes) -> str:
    return hashlib.sha256(text.encode() if isinstance(text, str) else text).hexdigest()


def make_result_paths_relative(job_dir: JobDir, job: Job) -> None:
    """Make the paths in the `job.yaml` of the results relative, because the job's folder will be moved.

    Args:
        job_dir: The job's folder.
        job: The job that was run. It replaces a `job.yaml` of another version, or a damaged one.

    Raises:
        StoreError: The disk is full or fails.
    """
    for file in (job_dir.result / "job.yaml", job_dir.result / "partial" / "job.yaml"):
        if file.is_file():
            try:
                written = Job.model_validate(yaml.safe_load(file.read_text(encoding="utf-8")))
            except (yaml.YAMLError, ValueError):
                written = job
            change = partial(_relative_to_file, job_dir=job_dir.path, file=file)
            write_results_file(file.parent, file.name, yaml_from_job(written.with_paths(change)))


def yaml_from_job(job: Job) -> str:
    """Return a job as YAML text."""
    document = job.model_dump(mode="json", exclude_none=True)
    return yaml.safe_dump(document, sort_keys=False, allow_unicode=True)


def _relocated(path: Path, here: Path, there: Path) -> Path:
    return there / path.relative_to(here) if path.is_relative_to(here) else path


def _relative_to_file(path: Path, job_dir: Path, file: Path) -> Path:
    if not path.is_relative_to(job_dir):
        return path
    return Path(*[".."] * len(file.parent.relative_to(job_dir).parts), *path.relative_to(job_dir).parts)


def _require_video_sizes(job: Job, limits: Limits) -> None:
    """Raise `CaptureError` for a video file that is too large, before any of its bytes are read."""
    for index, camera in enumerate(job.capture.cameras):
        for path in camera.video:
            if path.is_file() and path.stat().st_size > 1e9 * limits.video_gb:
                raise CaptureError(
                    f"the video has {path.stat().st_size / 1e9:.3g} GB, but the limit is "
                    f"{limits.video_gb:g} GB",
                    path=path,
                    field=f"capture.cameras.{index}.video",
                    hint="shorten the recording, or ask the operator of the watched folder to raise "
                    "--limit video_gb",
                )


def _require_readable_videos(loaded: LoadedJob) -> None:
    """Raise `CaptureError` for a video whose structure shows that no frame can be read from it.

    Videos that the job leaves out with a warning are checked, too: nobody reads the warning before the
    result is there.
    """
    found = dict(loaded.beside.unreadable)
    for path in (path for camera in loaded.job.capture.cameras for path in camera.video):
        # FFmpeg knows more kinds of video than the structure of a file shows.
        found.update({video: why for video, why in unreadable_videos(path).items() if why != NO_VIDEO})
    for path, reason in found.items():
        raise CaptureError(
            f"this video cannot be opened: {reason}",
            path=path,
            hint="copy the video again, or remove it",
        )
