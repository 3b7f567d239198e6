"""A drop becomes a job: read where it lies, checked against what it may name, written down for the run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import yaml

from bodycap_batch.config.folder import job_file_in
from bodycap_batch.config.job import load_job, safe_name
from bodycap_batch.config.limits import Limits
from bodycap_batch.config.models import SKELETON_PRESETS, CameraConfig, Job
from bodycap_batch.config.trust import PathPolicy
from bodycap_batch.core.errors import CaptureError, JobError
from bodycap_batch.pipeline.results import write_results_file
from bodycap_batch.watch.drops import YAML_SUFFIXES, Drop, Look
from bodycap_batch.watch.spool import JobDir, visible


@dataclass(frozen=True, slots=True, kw_only=True)
class Terms:
    """What the operator lets a job do.

    Attributes:
        roots: Folders open to all jobs.
        limits: How large a job may be.
    """

    roots: tuple[Path, ...] = ()
    limits: Limits = field(default_factory=Limits)


def read_drop(drop: Drop, look: Look, terms: Terms) -> Job:
    """Resolve a drop where it lies.

    Args:
        drop: A complete drop.
        look: What it looks like.
        terms: What it may name, and how large it may be.

    Returns:
        The job, its paths absolute and all of them allowed.

    Raises:
        JobError: No valid job, a path that is not allowed, or beyond the limits.
        CaptureError: A calibration or a folder of videos cannot be used, or a video is too large.
    """
    if look.garbled:
        shown = look.garbled.encode(errors="backslashreplace").decode()
        raise JobError(f"the name {shown} is no UTF-8 text", hint="rename it and drop it again")
    policy = policy_for(drop.path, terms.roots, is_file=drop.is_file)
    if policy.folder is None:
        # A link must lead to what the operator opened; a file in the inbox itself may always be read.
        if drop.path.is_symlink():
            policy.require(drop.path)
    elif look.files > terms.limits.files:
        hint = "one folder per recording; the operator can raise --limit files"
        raise CaptureError(f"more than {terms.limits.files:g} files", path=drop.path, hint=hint)
    if look.special:
        raise JobError(
            f"{look.special} is neither a file nor a folder", path=drop.path, hint="remove it from the folder"
        )
    decides = None if drop.is_file else job_file_in(drop.path)
    if decides is not None:
        policy.require(decides)
    job = load_job(drop.path, policy=policy, limits=terms.limits)
    if decides is not None and job.name == safe_name(drop.path.resolve().name):
        # Its file gives no name of its own: the drop's, which may be a link to a folder of another.
        job = job.model_copy(update={"name": safe_name(drop.name)})
    _require_sizes(job, terms.limits)
    return job.model_copy(update={"capture": job.capture.model_copy(update={"synthetic": None})})


def policy_for(path: Path, roots: tuple[Path, ...], *, is_file: bool) -> PathPolicy:
    """Which paths a drop may name: those in its folder, unless that is a link or there is none."""
    own = None if is_file or path.is_symlink() else path
    return PathPolicy(folder=own, roots=roots)


def other_job_files(folder: Path) -> list[str]:
    """Job files under names that are not looked for."""
    if job_file_in(folder) is not None:
        return []
    return [path.name for path in visible(folder) if path.suffix.lower() in YAML_SUFFIXES]


def write_job(job: Job, place: JobDir, dropped: Path) -> None:
    """Write a resolved job down, what came with it relative to the job's folder.

    Args:
        job: As `read_drop` returned it.
        place: The job's folder.
        dropped: Where its input lies now.
    """
    here = dropped.resolve()
    place.job.write_text(
        job_text(moved(job, lambda path: _below(path, here, Path("input")))), encoding="utf-8"
    )


def read_job(place: JobDir, terms: Terms) -> Job:
    """Load a job that `write_job` wrote; its paths are checked again.

    Raises:
        JobError: It cannot be read, or names what it may not.
    """
    policy = policy_for(place.input, terms.roots, is_file=False)
    job = load_job(place.job, policy=policy, limits=Limits())
    _require_sizes(job, terms.limits)
    return job.model_copy(update={"out": place.result})


def rewrite_results(place: JobDir, job: Job) -> None:
    """Let the `job.yaml` of the results name the footage relative to itself: the folder will be moved.

    Args:
        place: The job's folder.
        job: The job that was run.

    Raises:
        StoreError: The disk is full or fails.
    """
    for file in (place.result / "job.yaml", place.result / "partial" / "job.yaml"):
        if file.is_file():
            text = job_text(moved(job, lambda path, file=file: _up_from(path, place.path, file)))  # type: ignore[misc]
            write_results_file(file.parent, file.name, text)


def moved(job: Job, change: Callable[[Path], Path]) -> Job:
    """The job with every path changed."""

    def camera(config: CameraConfig) -> CameraConfig:
        return config.model_copy(
            update={
                "video": tuple(map(change, config.video)),
                "timestamps": tuple(map(change, config.timestamps)),
                "mask": None if config.mask is None else change(config.mask),
            }
        )

    capture = job.capture.model_copy(update={"cameras": tuple(map(camera, job.capture.cameras))})
    skeleton = job.skeleton
    if skeleton is not None and skeleton not in SKELETON_PRESETS:
        skeleton = str(change(Path(skeleton)))
    return job.model_copy(update={"capture": capture, "skeleton": skeleton, "out": None})


def job_text(job: Job) -> str:
    """A job as YAML."""
    document = job.model_dump(mode="json", exclude_none=True)
    return yaml.safe_dump(document, sort_keys=False, allow_unicode=True)


def _below(path: Path, here: Path, there: Path) -> Path:
    return there / path.relative_to(here) if path.is_relative_to(here) else path


def _up_from(path: Path, place: Path, file: Path) -> Path:
    if not path.is_relative_to(place):
        return path
    return Path(*[".."] * len(file.parent.relative_to(place).parts), *path.relative_to(place).parts)


def _require_sizes(job: Job, limits: Limits) -> None:
    """Refuse a video that is too large before its bytes are read."""
    for index, camera in enumerate(job.capture.cameras):
        for path in camera.video:
            if path.is_file() and path.stat().st_size > 1e9 * limits.video_gb:
                raise CaptureError(
                    f"{path.stat().st_size / 1e9:.3g} GB, the limit is {limits.video_gb:g}",
                    path=path,
                    field=f"capture.cameras.{index}.video",
                    hint="cut the recording, or ask the operator to raise --limit video_gb",
                )
