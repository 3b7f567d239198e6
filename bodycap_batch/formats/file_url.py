"""Name files for FFmpeg."""

from __future__ import annotations

from pathlib import Path


def file_url(path: Path) -> str:
    """Return a path as FFmpeg must get it, so that a colon in the path is a part of the name.

    FFmpeg treats the text before a colon as the name of a protocol: ``http:``, or the date in
    ``2024-03-05T10:11:12.mp4``.
    """
    return f"file:{path}"
