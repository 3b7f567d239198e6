"""Find the recordings in a file that was made by joining files byte by byte, as `cat` does.

The demuxers of MP4, MOV, FLV and WMV read the first recording only. Those of other formats read all of them.
"""

from __future__ import annotations

import mmap
from pathlib import Path

from bodycap_batch.formats.file_completeness import movie_starts

_HEADERS = (b"FLV\x01", b"\x30\x26\xb2\x75")
"""First bytes of FLV and WMV files."""
_HEADER_BYTES = 9
"""Number of bytes at the start that all files of one kind have, and that are searched for in the file."""


def parts_of(path: Path) -> tuple[tuple[int, int] | None, ...]:
    """Return the first byte, and the byte after the last byte, of each recording in a file.

    Returns:
        (None,) if the file is one recording, or if its demuxer reads all recordings.
    """
    try:
        size = path.stat().st_size
        with path.open("rb", buffering=0) as stream:
            head = stream.read(_HEADER_BYTES)
            if head[4:8] == b"ftyp":
                starts = movie_starts(stream, size)
            elif head.startswith(_HEADERS):
                starts = _occurrences(stream.fileno(), head)
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
