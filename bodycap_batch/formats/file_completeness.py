"""Find out from a file's own structure whether the file was copied completely. No frame is decoded.

Sources: ISO/IEC 14496-12 (boxes of MP4 and MOV), RFC 8794 and RFC 9559 (elements of Matroska and WebM), the
OpenDML AVI File Format Extensions 1.02 (RIFF chunks and super index of AVI), ISO/IEC 13818-1 (packets of
MPEG-TS and MPEG-PS), and the Advanced Systems Format 01.20.05 (header of WMV).
"""

from __future__ import annotations

import json
import stat
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from bodycap_batch.core.text_encoding import decode_text

NO_VIDEO = "its content is not that of a video"
"""Text for a file with the name of a video whose first bytes are those of no known kind of video."""
_TEXT_SUFFIXES = frozenset({".yaml", ".yml", ".json", ".bvh", ".csv"})
_FIRST_BOXES = frozenset({b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot", b"styp", b"uuid"})
"""Types of the boxes with which an MP4 or MOV file may start."""
_MOVIE_BOXES = frozenset({b"ftyp", b"moov", b"mdat", b"moof"})
"""Types of the boxes without which frames are lost. Other boxes, and what cameras append, are not needed."""
_UNMISTAKABLE_BOXES = frozenset({b"ftyp", b"moov", b"mdat"})
"""Types of boxes by which a file is known as MP4 or MOV if its name does not say it. The other types are
words that a text may contain at this place."""
_OTHER_BRANDS = (b"M4A", b"M4B", b"hei", b"mif", b"avif", b"crx")
"""Kinds (brands) of files of boxes that hold sound or photos: M4A, M4B, HEIC, AVIF and CR3."""
_PACKET_BYTES, _SYNC = (188, 192, 204), 0x47
"""Lengths (bytes) of the packets of MPEG-TS: plain, with a time stamp (M2TS), and with error correction; and
the first byte of a plain packet."""
_OTHER_STARTS = (b"\x00\x00\x01\xba", b"\x00\x00\x01\xb3", b"\x00\x00\x00\x01", b"\x30\x26\xb2\x75", b"FLV")
"""First bytes of further kinds of video: MPEG-PS; MPEG-2, H.264 and H.265 without a container; WMV, FLV."""
_MAX_HEAD_BYTES = 4 * max(_PACKET_BYTES)
"""Number of bytes from the start of a file that show its kind. The first packet of MPEG-TS may be cut, and
two more must follow it."""
_MAX_PARTS = 100_000
"""Maximum number of boxes, elements or chunks that are read. A recording in fragments of half a second
reaches this number after seven hours. The limit bounds the time for a file that was made to have very many
parts."""
_BOX_HEADER, _LONG_BOX_HEADER = 8, 16
"""Sizes (bytes) of the header of a box: with a size of 32 bits, and with a size of 64 bits."""
_EBML, _SEGMENT = 0x1A45DFA3, 0x18538067
"""Identifiers of elements of Matroska: the header of the file, and its content."""
_EBML_BYTES = _EBML.to_bytes(4, "big")
"""First bytes of a Matroska or WebM file."""
_MAX_VINT_BYTES = 8
"""Maximum length (bytes) of a number of variable length. Source: RFC 8794, section 4."""
_RIFF_HEADER = 12
"""Size (bytes) of the header of a RIFF list: the name, the size and the kind."""
_RIFF_TOLERANCE = 9
"""Maximum number of bytes that an AVI file may be too short. Origin: some programs count the 8 bytes of the
header in the size, and omit the padding byte at the end."""
_MAX_HEADERS_BYTES = 1 << 20
"""Maximum size (bytes) of the headers of an AVI file that are searched for the index, and of a box that is
read. Evidence: none."""
_SUPER_INDEX, _SUPER_INDEX_ENTRY = struct.Struct("<4sIHBBI4s12x"), struct.Struct("<QII")
"""Layout of the index of an AVI file and of its entries: offset, size and duration of a part of the index."""
_MAX_JSON_BYTES = 1 << 20
"""Maximum size (bytes) of a JSON file that is parsed. Calibrations have a few kilobytes. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MissingPart:
    """What is missing in a file.

    Attributes:
        text: Text for the user.
        readable_bytes: Number of bytes from the start of the file in which frames can be found. It is 0 if
            nothing can be read from the file.
    """

    text: str
    readable_bytes: int = 0


def is_video_by_content(path: Path) -> bool:
    """Return True if a file begins as a video, whatever its name is. Links are not opened."""
    head = _head_of(path)
    return head is not None and _begins_as_video(head)


def _head_of(path: Path) -> bytes | None:
    try:
        if not stat.S_ISREG(path.lstat().st_mode):
            return None
        with path.open("rb") as stream:
            return stream.read(_MAX_HEAD_BYTES)
    except OSError:
        return None


def _begins_as_video(head: bytes) -> bool:
    if head[4:8] == b"ftyp":
        return not head[8:12].startswith(_OTHER_BRANDS)
    is_known = head[4:8] in _UNMISTAKABLE_BOXES or head.startswith((_EBML_BYTES, *_OTHER_STARTS))
    return is_known or (head[:4] == b"RIFF" and head[8:12] == b"AVI ") or _packets_of(head) is not None


def missing_part(path: Path, video_suffixes: frozenset[str] | None = None) -> MissingPart | None:
    """Return what is missing in a file that was not copied completely.

    The length of an MP4, MOV, Matroska, WebM, AVI or MPEG-TS file must agree with the sizes in the file. This
    also holds if the name of the file does not say that it is a video. A text file must not be empty, and a
    JSON file must not end in the middle of a value. Nothing is known about other files.

    Args:
        path: Path of the file. Links and special files are not opened.
        video_suffixes: Suffixes of videos, in lower case; None if the file should be a video, whatever its
            suffix is.

    Returns:
        The missing part; None if nothing is missing, or if the file does not show it.
    """
    suffix = path.suffix.lower()
    is_named = video_suffixes is None or suffix in video_suffixes
    try:
        found = path.lstat()
        if not stat.S_ISREG(found.st_mode):
            return None
        if found.st_size == 0:
            return MissingPart(text="it is empty") if is_named or suffix in _TEXT_SUFFIXES else None
        with path.open("rb", buffering=0) as stream:
            if suffix == ".json" and not is_named:
                return _missing_json_part(stream)
            return _missing_video_part(stream, found.st_size, is_named=is_named)
    except OSError:  # the error is reported when the job is read
        return None


def _missing_video_part(stream: BinaryIO, size: int, *, is_named: bool) -> MissingPart | None:
    """Return what is missing in a video.

    Args:
        stream: The file.
        size: Size of the file, bytes.
        is_named: False for a file whose name does not say that it is a video. Such a file is inspected only
            if its first bytes are certainly those of a video.
    """
    head = stream.read(_MAX_HEAD_BYTES)
    if not is_named and not _begins_as_video(head):
        return None
    if head[4:8] in _FIRST_BOXES:
        return _missing_box(stream, size)
    if head.startswith(_EBML_BYTES):
        return _missing_element(stream, size)
    if head[:4] == b"RIFF" and head[8:12] == b"AVI ":
        return _missing_chunk(stream, size)
    if len(head) < _RIFF_HEADER:
        return MissingPart(text="its end is missing")
    if not any(head):
        return MissingPart(text="its first bytes are not there yet")
    if (packets := _packets_of(head)) is not None:
        first, length = packets
        is_cut = first in (0, length - min(_PACKET_BYTES)) and size % length > 0
        return MissingPart(text="its last packet is cut", readable_bytes=size) if is_cut else None
    return None if head.startswith(_OTHER_STARTS) else MissingPart(text=NO_VIDEO)


def _packets_of(head: bytes) -> tuple[int, int] | None:
    """Return the position of the first packet of MPEG-TS, and the length of the packets, bytes.

    Return None if the file does not consist of such packets.
    """
    for length in _PACKET_BYTES:
        for first in range(length):
            starts = head[first::length]
            if len(starts) > 2 and set(starts) == {_SYNC}:
                return first, length
    return None


def _missing_box(stream: BinaryIO, size: int) -> MissingPart | None:
    """Return what is missing in an MP4 or MOV file.

    Some cameras append data of their own after the last box. Such data are ignored if index and pictures are
    complete. A file in fragments is readable up to its end, because each fragment (moof) has an index of its
    own. If the end of an index is missing, the file is readable up to the start of this index.
    """
    found: set[bytes] = set()
    in_fragments = is_owed = False
    second = 0
    for kind, start, content, end in boxes(stream, 0, size):
        has_frames = {b"moov", b"mdat"} <= found
        if (kind == b"" or end > size) and has_frames and not in_fragments and kind not in _MOVIE_BOXES:
            return None
        if kind == b"ftyp" and has_frames:
            second = start
        if kind == b"":
            return MissingPart(text="its end is missing", readable_bytes=start if has_frames else 0)
        if end > size:
            has_index = b"moov" in found
            text = _missing_bytes(size, end) + ("" if has_index else ", and no index (moov)")
            if kind == b"mdat":
                return MissingPart(text=text, readable_bytes=size if in_fragments else second)
            return MissingPart(text=text, readable_bytes=start if has_frames else 0)
        if kind == b"moov":
            in_fragments = any(inner[0] == b"mvex" for inner in boxes(stream, content, end))
        is_owed = kind == b"moof" or (is_owed and kind != b"mdat")
        found.add(kind)
    if is_owed:
        text = "its end is missing: the last index (moof) has no pictures (mdat)"
        return MissingPart(text=text, readable_bytes=size if b"mdat" in found else 0)
    if b"moov" not in found:
        return MissingPart(
            text="its index (moov) is missing, as after a recording or a copy that was interrupted"
        )
    return None if b"mdat" in found else MissingPart(text="its pictures (mdat) are missing")


def movie_starts(stream: BinaryIO, size: int) -> list[int]:
    """Return the position of each movie in a file that may consist of several MP4 or MOV files.

    A movie starts with the box `ftyp` and contains a box `moov`.

    Args:
        stream: The opened file.
        size: Size of the file, bytes.
    """
    starts: list[int] = []
    latest = 0
    for kind, start, _, end in boxes(stream, 0, size):
        latest = start if kind == b"ftyp" else latest
        if kind == b"moov" and latest not in starts and end <= size:
            starts.append(latest)
    return starts


def first_box(path: Path, kind: bytes) -> bytes:
    """Return the content of a box of an MP4 or MOV file that is in no other box; b"" without such a box.

    Args:
        path: Path of the file.
        kind: Type of the box.
    """
    with path.open("rb", buffering=0) as stream:
        head = stream.read(_BOX_HEADER)
        for found, _, content, end in boxes(
            stream, 0, path.stat().st_size if head[4:] in _FIRST_BOXES else 0
        ):
            if found == kind:
                stream.seek(content)
                return stream.read(min(end - content, _MAX_HEADERS_BYTES))
    return b""


def boxes(stream: BinaryIO, position: int, size: int) -> Iterator[tuple[bytes, int, int, int]]:
    """Yield the type, the start, the start of the content, and the end of each box between two positions.

    The type is empty for a box whose header is cut. The boxes end at data that are not a box: data of the
    camera, or bytes that are not there yet.
    """
    for _ in range(_MAX_PARTS):
        if position >= size:
            return
        stream.seek(position)
        header = stream.read(min(_LONG_BOX_HEADER, size - position))
        kind, length, content = header[4:_BOX_HEADER], int.from_bytes(header[:4], "big"), _BOX_HEADER
        if len(header) < _BOX_HEADER:
            yield b"", position, size, size
            return
        if length == 1:
            length, content = int.from_bytes(header[_BOX_HEADER:], "big"), _LONG_BOX_HEADER
        if not kind.decode("latin-1").isprintable() or 0 < length < _BOX_HEADER:
            return
        end = size if length == 0 else position + length  # 0: the box reaches to the end of the file
        yield kind, position, position + content, end
        position = end


def _missing_element(stream: BinaryIO, size: int) -> MissingPart | None:
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
            return MissingPart(text="its end is missing", readable_bytes=size)
        identifier, start, length = element
        if identifier == _SEGMENT:
            if length is not None and start + length > size:
                return MissingPart(text=_missing_bytes(size, start + length), readable_bytes=size)
            if length is not None:
                return None
            position = start
        elif length is None:
            return None
        else:
            position = start + length
            if position > size:
                return MissingPart(text=_missing_bytes(size, position), readable_bytes=size)
    return None


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


def _missing_chunk(stream: BinaryIO, size: int) -> MissingPart | None:
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
    if expected <= size + _RIFF_TOLERANCE:
        return None
    return MissingPart(text=_missing_bytes(size, expected), readable_bytes=size)


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


def _missing_json_part(stream: BinaryIO) -> MissingPart | None:
    """Return what is missing in a JSON file. Any other error in the file is reported when it is read."""
    data = stream.read(_MAX_JSON_BYTES + 1)
    if len(data) > _MAX_JSON_BYTES:
        return None
    text = decode_text(data, "replace")
    try:
        json.loads(text)
    except json.JSONDecodeError as error:
        is_cut = error.pos >= len(text.rstrip()) or error.msg.startswith("Unterminated string")
        return MissingPart(text="its end is missing") if is_cut else None
    except RecursionError:
        return None
    return None


def _missing_bytes(size: int, expected: int) -> str:
    return f"its end is missing: {size:,} of {expected:,} bytes are there"
