"""Restrict the paths in a job that another user submitted.

The user's own job may name any readable path. Another user may drop a job into a watched folder, or send it
to the live page. Such a job may name the files that were submitted together with it. It may also name files
below the folders that the operator opened to all jobs. No other files are allowed.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bodycap_batch.config.models import Job
from bodycap_batch.config.yaml_source import dotted
from bodycap_batch.core.errors import JobError


@dataclass(frozen=True, slots=True, kw_only=True)
class PathPolicy:
    """The folders that must contain all paths of a job.

    Attributes:
        folder: The folder that was submitted; None for a job file that was submitted alone.
        roots: Folders that the operator opened to all jobs.
    """

    folder: Path | None
    roots: tuple[Path, ...] = ()

    def require_files(self, job: Job, base: Path) -> None:
        """Check the paths that a job names, and those of a resolved job, with chapters and sidecar files.

        Args:
            job: A validated job.
            base: Folder that relative paths start from.

        Raises:
            JobError: A path contains ``..``, or a path leads outside the allowed folders, directly or through
                a symbolic link.
        """
        for place, path in job.files():
            field = dotted(place)
            if ".." in path.parts:
                raise JobError(
                    f"the path {path} is not permitted, because `..` may lead out of the folder of the job",
                    field=field,
                    hint=self._hint(),
                )
            self.require(base / path, field)

    def require(self, path: Path, field: str | None = None) -> None:
        """Check one path; symbolic links are followed.

        Raises:
            JobError: The path is outside the allowed folders.
        """
        try:
            target = path.resolve()
        except (OSError, RuntimeError) as error:  # the links form a loop
            raise JobError(
                "this link cannot be followed, because the links form a loop",
                path=path,
                field=field,
                hint="replace the link by the file itself",
            ) from error
        allowed = [folder.resolve() for folder in (self.folder, *self.roots) if folder is not None]
        if not any(target == folder or target.is_relative_to(folder) for folder in allowed):
            link = f"{path} is a link to {target}, which is" if target != path.absolute() else f"{path} is"
            raise JobError(
                f"{link} outside the folders that this job may read", field=field, hint=self._hint()
            )

    def _hint(self) -> str:
        where = "copy the file into the folder of the job"
        if self.folder is None:
            where = "drop a folder that contains the videos and this job file with the name job.yaml"
        opened = ", ".join(map(str, self.roots))
        also = (
            f"or use a folder that all jobs may read: {opened}"
            if opened
            else "or ask the operator to open the folder of the file with --root"
        )
        return f"{where}; {also}"
