"""Find the recordings in a file that was made by joining files byte by byte, as `cat` does.

The demuxers of MP4, MOV and FLV read the first recording only. Those of other formats read all of them.
"""

from __future__ import annotations

import mmap
from pathlib import Path

from bodycap_batch.formats.file_completeness import movie_starts

_FLV_HEADER = b"FLV\x01"
"""First bytes of an FLV file."""


def parts_of(path: Path) -> tuple[tuple[int, int] | None, ...]:
    """Return the first byte, and the byte after the last byte, of each recording in a file.

    Returns:
        (None,) if the file is one recording, or if its demuxer reads all recordings.
    """
    try:
        size = path.stat().st_size
        with path.open("rb", buffering=0) as stream:
            head = stream.read(8)
            if head[4:] == b"ftyp":
                starts = movie_starts(stream, size)
            elif head[:4] == _FLV_HEADER:
                starts = _occurrences(stream.fileno(), _FLV_HEADER + head[4:5] + bytes(3) + b"\x09")
            else:
                return (None,)
    except OSError:  # the error is reported when the file is opened
        return (None,)
    ends = [*starts[1:], size]
    return tuple(zip(starts, ends, strict=True)) if len(starts) > 1 else (None,)


def _occurrences(file: int, text: bytes) -> list[int]:
    """Return the positions of a text in a file."""
    starts = []
    with mmap.mmap(file, 0, access=mmap.ACCESS_READ) as content:
        at = content.find(text)
        while at >= 0:
            starts.append(at)
            at = content.find(text, at + 1)
    return starts
