"""Room on the disk."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from bodycap_batch.core.errors import StoreError

# A job of 354 frames kept 24 MB of intermediate files and results: 68 kB a frame, a third of it keyframes'
# pictures. Hard captures have four times the keyframes.
_BYTES_PER_FRAME = 70_000
# Of large videos every frame is kept at the work size: noisy ones took 150 kB each at 960×720.
_BYTES_PER_LARGE_FRAME = 150_000
_HARD_TIMES = 4
_BYTES_AT_LEAST = 50_000_000


def require_room(folder: Path, frames: int, large: int = 0) -> list[str]:
    """See that a job's results and intermediate files fit into a folder that may be written.

    Args:
        folder: Where they go; it need not exist yet.
        frames: Frames of all cameras.
        large: How many of them are much larger than they are worked at.

    Returns:
        What is worth telling.

    Raises:
        StoreError: There is no room, or no right to write.
    """
    while not folder.exists():
        folder = folder.parent
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        raise StoreError(
            "results cannot be written here", path=folder, hint="choose another folder with --out"
        )
    need = _BYTES_AT_LEAST + _BYTES_PER_FRAME * frames + _BYTES_PER_LARGE_FRAME * large
    free = shutil.disk_usage(folder).free
    if free < need:
        raise StoreError(
            f"{free / 1e6:.0f} MB free, the job needs about {need / 1e6:.0f} MB",
            path=folder,
            hint="make room, or choose another disk with --out",
        )
    if free < _HARD_TIMES * need:
        return [f"{free / 1e6:.0f} MB free on the disk of {folder}: enough for an easy capture only"]
    return []
