"""Check the free space on a disk before a job needs it."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from bodycap_batch.core.errors import StoreError

_BYTES_PER_FRAME = 70_000
"""Disk space (bytes) per frame for intermediate files and results. Evidence: docs/decisions/pipeline.md."""
_BYTES_PER_LARGE_FRAME = 150_000
"""Additional disk space (bytes) per frame of a video with large images. All frames of such a video are
stored, reduced to the work size (the image size that all stages work at). Evidence:
docs/decisions/pipeline.md."""
_HARD_CAPTURE_FACTOR = 4
"""Ratio of the disk space that a difficult capture needs to the disk space that an easy capture needs. A
difficult capture has about four times as many keyframes as an easy capture. Evidence:
docs/decisions/pipeline.md."""
_MIN_BYTES = 50_000_000
"""Disk space (bytes) that every job needs, even a very short job. Evidence: none."""


def require_room(folder: Path, frames: int, large: int = 0) -> list[str]:
    """Check that a folder is writable, and that its disk has room for a job's results and intermediate files.

    Args:
        folder: Folder for the files; it need not exist yet.
        frames: Number of frames of all cameras.
        large: Number of these frames that are much larger than the work size.

    Returns:
        Notes for the user; empty if there is enough space even for a difficult capture.

    Raises:
        StoreError: The free space is too small, or the folder is not writable.
    """
    while not folder.exists():
        folder = folder.parent
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        raise StoreError(
            "the results cannot be written into this folder",
            path=folder,
            hint="choose another folder with --out",
        )
    need = _MIN_BYTES + _BYTES_PER_FRAME * frames + _BYTES_PER_LARGE_FRAME * large
    free = shutil.disk_usage(folder).free
    if free < need:
        raise StoreError(
            f"the disk has {free / 1e6:.0f} MB of free space, but the job needs about {need / 1e6:.0f} MB",
            path=folder,
            hint="free some space, or choose another disk with --out and --store",
        )
    if free < _HARD_CAPTURE_FACTOR * need:
        return [
            f"the disk of {folder} has {free / 1e6:.0f} MB of free space, which may be too little: free "
            "some space, or choose another disk with --out"
        ]
    return []
