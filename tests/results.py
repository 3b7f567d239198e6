"""What two runs of a job have to agree on, byte for byte."""

from __future__ import annotations

from pathlib import Path


def results_of(folder: Path) -> dict[str, bytes]:
    """All files whose bytes may not depend on when, where and how fast they were made, by relative path."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
        and path.name not in ("run.json", "job.yaml")
        and not {"logs", ".store"} & set(path.relative_to(folder).parts)
    }
