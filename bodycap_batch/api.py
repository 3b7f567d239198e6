"""The Python API: load a job, run it, and read its results.

    from bodycap_batch import Result, load_job, run_job

    result = run_job(load_job("my_walk/", height_m=1.75))

All names are also in the package `bodycap_batch` itself. They keep their meaning within a major version. The
errors are those of `bodycap_batch.core.errors`; all of them are subclasses of `BodycapError`, and each has a
message, and a hint if the user can do something.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, Literal

from bodycap_batch.core.context import cores
from bodycap_batch.core.progress import Event
from bodycap_batch.formats.frame_table import FrameTable
from bodycap_batch.formats.joint_table import BodyMotion
from bodycap_batch.results import CameraPath, ClockEstimate, Result

if TYPE_CHECKING:
    from bodycap_batch.config.models import Job as ResolvedJob
    from bodycap_batch.config.overrides import Overrides
    from bodycap_batch.pipeline import RunSummary, Settings
    from bodycap_batch.runner import Children

__all__ = [
    "BodyMotion",
    "CameraPath",
    "ClockEstimate",
    "Event",
    "FrameTable",
    "Job",
    "Result",
    "load_job",
    "run_job",
]

Progress = Callable[[Event], None]


def _ignore(_: object) -> None:
    """Do nothing."""


def _never() -> bool:
    return False


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """A job that is ready to run.

    Attributes:
        source: The job file or the folder of videos.
        out: Folder for the results.
        options: All options of the job with their values, as in the file ``job.yaml`` of the results.
        warnings: Sentences about what the user probably did not intend, and about values of the last run that
            this job uses again.
        overrides: The values given to `load_job`, and those of the last run.
    """

    source: Path
    out: Path
    options: ResolvedJob
    warnings: tuple[str, ...]
    overrides: Overrides

    @property
    def name(self) -> str:
        """Name of the job."""
        return self.options.name

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(camera.name for camera in self.options.capture.cameras)


@dataclass(frozen=True, slots=True, kw_only=True)
class Execution:
    """How a job runs. Nothing of it changes the results.

    Attributes:
        store: Folder for the results of finished stages; None for the one that the results name, else
            ``.store`` beside the results.
        threads: Number of cores to use; None for all.
        memory_mb: Memory limit (MB) of one task; None for four fifths of the machine's memory.
        progress: Receives the events of the run.
        cancelled: Called several times a second; True stops the run.
        children: Processes that were started ahead; None to start them with the run.
        redo: Names of the stages that are computed again although their results are stored.
        until: Name of the last stage to run; "" for all stages.
        results_ready: Called with the folder of the results if only the preview is still being made.
    """

    store: Path | None = None
    threads: int | None = None
    memory_mb: int | None = None
    progress: Progress = _ignore
    cancelled: Callable[[], bool] = _never
    children: Children | None = None
    redo: frozenset[str] = frozenset()
    until: str = ""
    results_ready: Callable[[Path], None] = _ignore

    def settings(self, out: Path, overrides: Overrides | None = None) -> Settings:
        """Return the settings of the pipeline for a job with this folder for its results."""
        from bodycap_batch.config.overrides import Overrides
        from bodycap_batch.job_places import find_store
        from bodycap_batch.pipeline import Settings
        from bodycap_batch.store.artefacts import Store

        return Settings(
            store=Store(self.store or find_store(out)),
            threads=self.threads or cores(),
            children=self.children,
            listener=self.progress,
            cancelled=self.cancelled,
            redo=self.redo,
            until=self.until,
            memory_mb=self.memory_mb,
            results_ready=self.results_ready,
            overrides=overrides or Overrides(),
        )


def load_job(  # noqa: PLR0913 - the options of the command
    path: Path | str,
    *,
    out: Path | str | None = None,
    skeleton: str | None = None,
    height_m: float | Literal["none"] | None = None,
    cameras: Mapping[str, str] | None = None,
    places: Sequence[str] = (),
    activity: str | None = None,
    progress: Progress = _ignore,
) -> Job:
    """Load a job, and check it. The videos of a synthetic capture are rendered if they do not exist.

    Values that are not given are those of the job file, else those of the last run of this job, else the
    defaults.

    Args:
        path: A job file, a folder of videos, or a folder of results, whose job runs again.
        out: Folder for the results; by default ``out/NAME`` beside the job.
        skeleton: ``auto``, ``full_body``, ``none``, or the path of the subject's own BVH file.
        height_m: Height of the subject, metres; ``none`` for the height of a mean adult.
        cameras: Place on the body of cameras whose names do not contain it, by the name of the camera or of
            the video: ``{"gopro1": "torso"}``.
        places: Places where the cameras were, in any order, if it is unknown which camera was where.
        activity: ``walk`` if the subject only walks, else ``generic``.
        progress: Receives the events of rendering.

    Raises:
        JobError: The job is wrong. The error names the file, the line and the field, and gives advice.
        CaptureError: A calibration or a folder of videos cannot be used.
    """
    from bodycap_batch.config.overrides import Overrides

    overrides = Overrides(
        out=None if out is None else Path(out),
        skeleton=skeleton,
        height_m=height_m,
        mounts=dict(cameras or {}),
        places=tuple(places),
        activity=activity,
    )
    return prepare_job(Path(path), overrides, Execution(progress=progress))


def prepare_job(path: Path, overrides: Overrides, execution: Execution) -> Job:
    """Load a job as `load_job` does, with these values and this way to render a synthetic capture."""
    from bodycap_batch.config.job import load_job_with_origins
    from bodycap_batch.job_places import find_job

    def prepare(options: Mapping[str, Any], folder: Path, out: Path) -> None:
        from bodycap_batch.pipeline import prepare_capture

        prepare_capture(options, folder, execution.settings(out, overrides))

    place = find_job(path)
    overrides = replace(overrides, out=overrides.out or place.results)
    loaded = load_job_with_origins(place.file, overrides, prepare=prepare)
    assert loaded.job.out is not None  # the loader gives every job a folder
    return Job(
        source=place.file,
        out=loaded.job.out,
        options=loaded.job,
        warnings=loaded.warnings_of_run(),
        overrides=overrides,
    )


def run_job(
    job: Job,
    *,
    out: Path | str | None = None,
    store: Path | str | None = None,
    threads: int | None = None,
    progress: Progress = _ignore,
    cancelled: Callable[[], bool] = _never,
) -> Result:
    """Run all stages of a job, and return its results. Finished stages are not computed again.

    It does the same as the command `bodycap run`, and shares finished stages with it.

    Args:
        job: A job from `load_job`.
        out: Folder for the results; by default that of the job.
        store: Folder for the results of finished stages; by default the one that earlier results name, else
            ``.store`` beside the results.
        threads: Number of cores to use; by default all.
        progress: Called with each `Event` of the run, from several threads, but never twice at a time.
        cancelled: Called several times a second; if it returns True, the run stops.

    Returns:
        The results, whose files are complete.

    Raises:
        JobError: The job is wrong.
        CaptureError: A video, a calibration or a timestamp cannot be used.
        EstimationError: The videos do not support an answer. If only the skeleton is missing, the other
            results are in the subfolder ``partial``: ``Result(job.out / "partial")``.
        StoreError: The disk is full or cannot be written, or a stored result is damaged.
        Cancelled: `cancelled` returned True. The next run goes on with the finished stages.
    """
    one_at_a_time = Lock()

    def report(event: Event) -> None:
        with one_at_a_time:
            progress(event)

    execution = Execution(
        store=None if store is None else Path(store), threads=threads, progress=report, cancelled=cancelled
    )
    if out is not None:
        job = prepare_job(job.source, replace(job.overrides, out=Path(out)), execution)
    return Result(execute_job(job, execution).out_dir)


def execute_job(job: Job, execution: Execution) -> RunSummary:
    """Run a job, and return the summary of the run. Errors are those of `run_job`."""
    from bodycap_batch import pipeline

    return pipeline.run_job(job.options, out_dir=job.out, settings=execution.settings(job.out, job.overrides))
