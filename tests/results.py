"""The result files that must have equal bytes in two runs of a job."""

from __future__ import annotations

from pathlib import Path


def results_of(folder: Path) -> dict[str, bytes]:
    """Return the content of all files that do not depend on time, place and speed of a run, by path."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
        and path.name not in ("run.json", "job.yaml")
        and not {"logs", ".store"} & set(path.relative_to(folder).parts)
    }
