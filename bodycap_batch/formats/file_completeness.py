"""Find out from a file's own structure whether the file was copied completely. No frame is decoded.

Sources: ISO/IEC 14496-12 (boxes of MP4 and MOV), RFC 8794 and RFC 9559 (elements of Matroska and WebM), and
the OpenDML AVI File Format Extensions 1.02 (RIFF chunks and super index of AVI).
"""

from __future__ import annotations

import json
import stat
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

_TEXT_SUFFIXES = frozenset({".yaml", ".yml", ".json", ".bvh", ".csv"})
_FIRST_BOXES = frozenset({b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot", b"styp", b"uuid"})
"""Types of the boxes with which an MP4 or MOV file may start."""
_MAX_PARTS = 100_000
"""Maximum number of boxes, elements or chunks that are read. A recording in fragments of half a second
reaches this number after seven hours. The limit bounds the time for a file that was made to have very many
parts."""
_BOX_HEADER, _LONG_BOX_HEADER = 8, 16
"""Sizes (bytes) of the header of a box: with a size of 32 bits, and with a size of 64 bits."""
_EBML, _SEGMENT = 0x1A45DFA3, 0x18538067
"""Identifiers of elements of Matroska: the header of the file, and its content."""
_MAX_VINT_BYTES = 8
"""Maximum length (bytes) of a number of variable length. Source: RFC 8794, section 4."""
_RIFF_HEADER = 12
"""Size (bytes) of the header of a RIFF list: the name, the size and the kind."""
_RIFF_TOLERANCE = 9
"""Maximum number of bytes that an AVI file may be too short. Origin: some programs count the 8 bytes of the
header in the size, and omit the padding byte at the end."""
_MAX_HEADERS_BYTES = 1 << 20
"""Maximum size (bytes) of the headers of an AVI file that are searched for the index. Evidence: none."""
_SUPER_INDEX, _SUPER_INDEX_ENTRY = struct.Struct("<4sIHBBI4s12x"), struct.Struct("<QII")
"""Layout of the index of an AVI file and of its entries: offset, size and duration of a part of the index."""
_MAX_JSON_BYTES = 1 << 20
"""Maximum size (bytes) of a JSON file that is parsed. Calibrations have a few kilobytes. Evidence: none."""


def missing_part(path: Path, video_suffixes: frozenset[str]) -> str:
    """Return what is missing in a file that was not copied completely.

    The length of an MP4, MOV, Matroska, WebM or AVI file must agree with the sizes in the file. A text file
    must not be empty, and a JSON file must not end in the middle of a value. Nothing is known about other
    files.

    Args:
        path: Path of the file. Links and special files are not opened.
        video_suffixes: Suffixes of videos, in lower case.

    Returns:
        Text for the user; "" if nothing is missing, or if the file does not tell.
    """
    suffix = path.suffix.lower()
    if suffix not in video_suffixes and suffix not in _TEXT_SUFFIXES:
        return ""
    try:
        found = path.lstat()
        if not stat.S_ISREG(found.st_mode):
            return ""
        if found.st_size == 0:
            return "it is empty"
        with path.open("rb", buffering=0) as stream:
            if suffix in video_suffixes:
                return _missing_video_part(stream, found.st_size)
            return _missing_json_part(stream) if suffix == ".json" else ""
    except OSError:  # the error is reported when the job is read
        return ""


def _missing_video_part(stream: BinaryIO, size: int) -> str:
    head = stream.read(_RIFF_HEADER)
    if len(head) < _RIFF_HEADER:
        return "its end is missing"
    if not any(head):
        return "its first bytes are not there yet"
    if head[4:8] in _FIRST_BOXES:
        return _missing_box(stream, size)
    if head[:4] == _EBML.to_bytes(4, "big"):
        return _missing_element(stream, size)
    if head[:4] == b"RIFF" and head[8:12] == b"AVI ":
        return _missing_chunk(stream, size)
    return ""


def _missing_box(stream: BinaryIO, size: int) -> str:
    """Return what is missing in an MP4 or MOV file.

    Some cameras append data of their own after the last box. Such data are ignored if index and pictures are
    complete.
    """
    found: set[bytes] = set()
    position = 0
    for _ in range(_MAX_PARTS):
        if position == size:
            break
        stream.seek(position)
        header = stream.read(_LONG_BOX_HEADER)
        if len(header) < _BOX_HEADER:
            return "its end is missing"
        kind, length = header[4:_BOX_HEADER], int.from_bytes(header[:4], "big")
        if length == 1:
            length = int.from_bytes(header[_BOX_HEADER:], "big")
        if not kind.decode("latin-1").isprintable() or 0 < length < _BOX_HEADER:
            break  # not a box: data of the camera, or bytes that are not there yet
        end = size if length == 0 else position + length  # 0: the box reaches to the end of the file
        if end > size:
            return _missing_bytes(size, end)
        found.add(kind)
        position = end
    if b"moov" not in found:
        return "its index (moov) is missing"
    return "" if b"mdat" in found else "its pictures (mdat) are missing"


def _missing_element(stream: BinaryIO, size: int) -> str:
    """Return what is missing in a Matroska or WebM file.

    The file of an interrupted or live recording does not state its size. Such a file must end at the end of
    an element. If its clusters do not state their sizes either, nothing is known.
    """
    position = 0
    for _ in range(_MAX_PARTS):
        if position == size:
            break
        element = _read_element(stream, position)
        if element is None:
            return "its end is missing"
        identifier, start, length = element
        if identifier == _SEGMENT:
            if length is not None and start + length > size:
                return _missing_bytes(size, start + length)
            if length is not None:
                return ""
            position = start
        elif length is None:
            return ""
        else:
            position = start + length
            if position > size:
                return _missing_bytes(size, position)
    return ""


def _read_element(stream: BinaryIO, position: int) -> tuple[int, int, int | None] | None:
    """Return the identifier of an element, the position of its content, and its length (None if unknown).

    Return None if the file ends inside the header of the element.
    """
    stream.seek(position)
    header = stream.read(2 * _MAX_VINT_BYTES)
    identifier_bytes = _vint_length(header)
    if identifier_bytes is None or len(header) < identifier_bytes:
        return None
    size_bytes = _vint_length(header[identifier_bytes:])
    if size_bytes is None or len(header) < identifier_bytes + size_bytes:
        return None
    mask = (1 << 7 * size_bytes) - 1
    field = header[identifier_bytes : identifier_bytes + size_bytes]
    length = int.from_bytes(field, "big") & mask
    identifier = int.from_bytes(header[:identifier_bytes], "big")
    return identifier, position + identifier_bytes + size_bytes, None if length == mask else length


def _vint_length(data: bytes) -> int | None:
    """Return the length (bytes) of the number of variable length at the start of some bytes."""
    return 9 - data[0].bit_length() if data and data[0] else None


def _missing_chunk(stream: BinaryIO, size: int) -> str:
    """Return what is missing in an AVI file.

    An AVI file of more than 1 GB consists of several RIFF lists. The index in the first list names positions
    in all lists.
    """
    position = 0
    for _ in range(_MAX_PARTS):
        stream.seek(position)
        header = stream.read(_RIFF_HEADER)
        length = int.from_bytes(header[4:8], "little")
        if header[:4] != b"RIFF" or length == 0:  # an interrupted recording states the length 0
            break
        position += 8 + length + length % 2
    stream.seek(0)
    headers = stream.read(_MAX_HEADERS_BYTES)
    is_list = headers[_RIFF_HEADER:].startswith(b"LIST")
    lists_end = _RIFF_HEADER + 8 + int.from_bytes(headers[16:20], "little") if is_list else 0
    expected = max([position, *_indexed_ends(headers[:lists_end])])
    return _missing_bytes(size, expected) if expected > size + _RIFF_TOLERANCE else ""


def _indexed_ends(headers: bytes) -> Iterator[int]:
    """Yield the end position of each part of the index of an AVI file."""
    start = headers.find(b"indx")
    while 0 <= start <= len(headers) - _SUPER_INDEX.size:
        _, _, words, _, kind, entries, _ = _SUPER_INDEX.unpack_from(headers, start)
        first = start + _SUPER_INDEX.size
        count = min(entries, (len(headers) - first) // _SUPER_INDEX_ENTRY.size)
        if (words, kind) == (4, 0):  # an index of indexes: each entry has four words of 32 bits
            for number in range(count):
                offset, length, _ = _SUPER_INDEX_ENTRY.unpack_from(
                    headers, first + number * _SUPER_INDEX_ENTRY.size
                )
                yield offset + length
        start = headers.find(b"indx", start + 1)


def _missing_json_part(stream: BinaryIO) -> str:
    """Return what is missing in a JSON file. Any other error in the file is reported when it is read."""
    data = stream.read(_MAX_JSON_BYTES + 1)
    if len(data) > _MAX_JSON_BYTES:
        return ""
    text = data.decode("utf-8", "replace")
    try:
        json.loads(text)
    except json.JSONDecodeError as error:
        is_cut = error.pos >= len(text.rstrip()) or error.msg.startswith("Unterminated string")
        return "its end is missing" if is_cut else ""
    except RecursionError:
        return ""
    return ""


def _missing_bytes(size: int, expected: int) -> str:
    return f"{size:,} of {expected:,} bytes are there"
