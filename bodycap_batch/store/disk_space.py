"""Check the free space on a disk before it is needed."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from bodycap_batch.core.errors import StoreError

_BYTES_PER_FRAME = 70_000
"""Intermediate files and results per frame, bytes. Evidence: docs/decisions/pipeline.md."""
_BYTES_PER_LARGE_FRAME = 150_000
"""Further bytes per frame of a large video, all of whose frames are stored at the size that is processed.
Evidence: docs/decisions/pipeline.md."""
_HARD_CAPTURE_FACTOR = 4
"""How much more a difficult capture may need: it has about four times the keyframes.
Evidence: docs/decisions/pipeline.md."""
_MIN_BYTES = 50_000_000
"""Space that even the shortest job needs, bytes. Evidence: none."""


def require_room(folder: Path, frames: int, large: int = 0) -> list[str]:
    """Check that a job's results and intermediate files fit into a folder, and that it may be written.

    Args:
        folder: Folder of the files; it need not exist yet.
        frames: Frames of all cameras.
        large: How many of them are much larger than the size they are processed at.

    Returns:
        Notes for the user.

    Raises:
        StoreError: The space is too small, or the folder may not be written.
    """
    while not folder.exists():
        folder = folder.parent
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        raise StoreError(
            "results cannot be written here", path=folder, hint="choose another folder with --out"
        )
    need = _MIN_BYTES + _BYTES_PER_FRAME * frames + _BYTES_PER_LARGE_FRAME * large
    free = shutil.disk_usage(folder).free
    if free < need:
        raise StoreError(
            f"{free / 1e6:.0f} MB free, the job needs about {need / 1e6:.0f} MB",
            path=folder,
            hint="make room, or choose another disk with --out",
        )
    if free < _HARD_CAPTURE_FACTOR * need:
        return [f"{free / 1e6:.0f} MB free on the disk of {folder}: enough for an easy capture only"]
    return []
