"""Which files a job may name that somebody else hands in.

A file the user runs is the user's own: any path that can be read. A job that was dropped into a watched
folder, or sent to the live page, may name what came with it and what lies below the folders that the
operator opened to all jobs; it cannot open more of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from bodycap_batch.config.models import SKELETON_PRESETS, CaptureConfig, Job
from bodycap_batch.core.errors import JobError


@dataclass(frozen=True, slots=True, kw_only=True)
class PathPolicy:
    """Folders a job's paths have to lie in.

    Attributes:
        folder: The dropped folder; None for a job file that came alone.
        roots: Folders the operator opened to all jobs.
    """

    folder: Path | None
    roots: tuple[Path, ...] = ()

    def require_named(self, job: Job, base: Path) -> None:
        """Check the paths as the job states them, before any of them is read.

        Args:
            job: A validated job, its paths as they stand in the file.
            base: Folder that relative paths start from.

        Raises:
            JobError: A path with ``..``, or one that lies or leads outside.
        """
        for field, path in _named(job):
            if ".." in path.parts:
                raise JobError(f"{path} climbs out of its folder", field=field, hint=self._hint())
            self.require(base / path, field)

    def require_resolved(self, job: Job) -> None:
        """Check every file of a resolved job: chapters and sidecars that were found beside the videos.

        Raises:
            JobError: One of them leads outside by a symbolic link.
        """
        for field, path in _named(job):
            self.require(path, field)

    def require(self, path: Path, field: str | None = None) -> None:
        """Check one path, symbolic links followed.

        Raises:
            JobError: It lies outside.
        """
        try:
            target = path.resolve()
        except (OSError, RuntimeError) as error:  # a loop of links
            raise JobError(
                "leads nowhere", path=path, field=field, hint="put the file itself there"
            ) from error
        allowed = [folder.resolve() for folder in (self.folder, *self.roots) if folder is not None]
        if not any(target == folder or target.is_relative_to(folder) for folder in allowed):
            link = f"{path} is a link to {target}, which is" if target != path.absolute() else f"{path} is"
            raise JobError(f"{link} outside of what this job may read", field=field, hint=self._hint())

    def _hint(self) -> str:
        where = "copy the file into the folder of the job"
        if self.folder is None:
            where = "drop a folder that holds the videos and this file as job.yaml"
        opened = ", ".join(map(str, self.roots))
        also = (
            f"folders open to all jobs: {opened}" if opened else "the operator can open a folder with --root"
        )
        return f"{where}; {also}"


def _named(job: Job) -> Iterator[tuple[str, Path]]:
    """Every path a job reads, with the field that names it."""
    if job.skeleton is not None and job.skeleton not in SKELETON_PRESETS:
        yield "skeleton", Path(job.skeleton)
    yield from _of_capture(job.capture)


def _of_capture(capture: CaptureConfig) -> Iterator[tuple[str, Path]]:
    if isinstance(capture.calibration, Path):
        yield "capture.calibration", capture.calibration
    for index, camera in enumerate(capture.cameras):
        here = f"capture.cameras.{index}"
        yield from ((f"{here}.video", path) for path in camera.video)
        yield from ((f"{here}.timestamps", path) for path in camera.timestamps)
        if isinstance(camera.calibration, Path):
            yield f"{here}.calibration", camera.calibration
        if camera.mask is not None:
            yield f"{here}.mask", camera.mask
