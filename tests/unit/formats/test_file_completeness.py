"""Whether a file was copied completely, as the file itself tells."""

from __future__ import annotations

import os
import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import pytest

from bodycap_batch.config.folder import VIDEO_SUFFIXES
from bodycap_batch.formats import file_completeness
from bodycap_batch.formats.file_completeness import is_video_by_content, missing_part
from tests.videos import textured_frame, write_video

FRAMES = [textured_frame(index % 40) for index in range(30)]


def missing(path: Path) -> str:
    part = missing_part(path, VIDEO_SUFFIXES)
    return "" if part is None else part.text


def box(kind: bytes, content: bytes = b"", *, long: bool = False) -> bytes:
    if long:
        return struct.pack(">I4sQ", 1, kind, 16 + len(content)) + content
    return struct.pack(">I4s", 8 + len(content), kind) + content


def riff(kind: bytes, content: bytes) -> bytes:
    return struct.pack("<4sI4s", b"RIFF", 4 + len(content), kind) + content


@pytest.mark.parametrize("name", ["a.mp4", "a.mov", "a.mkv", "a.avi", "a.m4v", "a.3gp", "a.MP4"])
def test_every_shorter_copy_of_a_video_is_known_to_be_incomplete(tmp_path: Path, name: str) -> None:
    whole = write_video(tmp_path / "whole" / name.lower(), FRAMES)
    assert missing(whole) == ""
    data = whole.read_bytes()
    copy = tmp_path / name
    # RIFF tolerates a few bytes, because some programs state a size that is a few bytes too large.
    tolerance = 10 if name == "a.avi" else 1
    lengths = [*range(0, len(data) - tolerance, max(1, len(data) // 200)), len(data) - tolerance]
    for length in lengths:
        copy.write_bytes(data[:length])
        assert missing(copy), length
    copy.write_bytes(data)
    assert missing(copy) == ""


def test_a_webm_file_is_checked_like_matroska(tmp_path: Path) -> None:
    data = write_video(tmp_path / "a.webm", FRAMES[:5], codec="libvpx").read_bytes()
    assert missing(tmp_path / "a.webm") == ""
    (tmp_path / "a.webm").write_bytes(data[:-1])
    assert "bytes are there" in missing(tmp_path / "a.webm")


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv"])
def test_a_file_with_reserved_space_is_incomplete_until_its_index_is_there(tmp_path: Path, name: str) -> None:
    video = write_video(tmp_path / name, FRAMES)
    data = video.read_bytes()
    video.write_bytes(bytes(len(data)))
    assert missing(video)
    video.write_bytes(data[: len(data) // 2] + bytes(len(data) - len(data) // 2))
    # The length of Matroska agrees, and its index is not needed.
    assert bool(missing(video)) == (name == "a.mp4")


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (box(b"ftyp") + box(b"mdat", b"x" * 90) + box(b"moov"), ""),
        (box(b"ftyp") + box(b"mdat", b"x" * 90, long=True) + box(b"moov"), ""),
        (box(b"ftyp") + box(b"moov") + struct.pack(">I4s", 0, b"mdat") + b"x" * 90, ""),
        (box(b"ftyp") + box(b"moov") + box(b"moof") + box(b"mdat", b"x"), ""),
        (box(b"ftyp") + box(b"mdat", b"x" * 90) + box(b"moov") + b"\x00\x01\x02\x03\x04\x05\x06\x07" * 9, ""),
        (box(b"ftyp") + box(b"mdat", b"x" * 90), "moov"),
        (box(b"ftyp") + box(b"moov"), "mdat"),
        (box(b"ftyp") + box(b"mdat", b"x" * 90) + bytes(90), "moov"),
        (box(b"ftyp") + struct.pack(">I4s", 0, b"mdat") + b"x" * 90, "moov"),
        (box(b"ftyp") + struct.pack(">I4sQ", 1, b"mdat", 1 << 40), "1,099,511,627,784 bytes"),
        (box(b"ftyp") + box(b"mdat", b"x" * 90) + box(b"moov") + b"\x00\x00\x00", ""),
        (box(b"ftyp") + box(b"mdat", b"x" * 90) + box(b"moov") + b"Samsung trailer of the camera", ""),
        ((2 * (box(b"ftyp") + box(b"moov") + box(b"mdat", b"x" * 90)))[:-9], "bytes"),
        (box(b"ftyp") + struct.pack(">I4s", 3, b"mdat") + b"x" * 90, "moov"),
        (box(b"ftyp") + struct.pack(">I4s", 1, b"mdat"), "moov"),
        (b"frames of no known format", "not that of a video"),
        (bytes(50), "first bytes"),
        (b"", "empty"),
    ],
)
def test_boxes(tmp_path: Path, content: bytes, expected: str) -> None:
    path = tmp_path / "a.mp4"
    path.write_bytes(content)
    assert (expected in missing(path)) if expected else missing(path) == ""


EBML = b"\x1a\x45\xdf\xa3\x80"
SEGMENT = b"\x18\x53\x80\x67"
CLUSTER = b"\x1f\x43\xb6\x75"
UNKNOWN = b"\x01" + b"\xff" * 7


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (EBML + SEGMENT + b"\x8a" + b"x" * 10, ""),
        (EBML + SEGMENT + b"\x8a" + b"x" * 9, "bytes are there"),
        (EBML + SEGMENT + b"\x8a" + b"x" * 10 + b"more", ""),
        (EBML + SEGMENT + UNKNOWN + CLUSTER + b"\x84" + b"x" * 4, ""),
        (EBML + SEGMENT + UNKNOWN + CLUSTER + b"\x84" + b"x" * 3, "bytes are there"),
        (EBML + SEGMENT + UNKNOWN + CLUSTER + b"\x84" + b"x" * 4 + CLUSTER, "end"),
        (EBML + SEGMENT + UNKNOWN + CLUSTER + UNKNOWN + b"x" * 3, ""),
        (EBML + SEGMENT + b"\x01\xff\xff", "end"),
        (EBML[:4], "end"),
        (EBML + SEGMENT + UNKNOWN + bytes(20), "end"),
    ],
)
def test_elements_of_matroska(tmp_path: Path, content: bytes, expected: str) -> None:
    path = tmp_path / "a.mkv"
    path.write_bytes(content)
    assert (expected in missing(path)) if expected else missing(path) == ""


def test_all_riff_lists_of_an_avi_file_are_needed(tmp_path: Path) -> None:
    path = tmp_path / "a.avi"
    second = riff(b"AVIX", b"y" * 200)

    def file(end: int) -> bytes:
        index = struct.pack("<4sIHBBI4s12xQII", b"indx", 40, 4, 0, 0, 1, b"00dc", max(end - 20, 0), 20, 1)
        headers = struct.pack("<4sI4s", b"LIST", 4 + len(index), b"hdrl") + index
        return riff(b"AVI ", headers + b"x" * 300)

    first = file(0)
    data = file(len(first) + len(second)) + second
    path.write_bytes(data)
    assert missing(path) == ""
    for length in range(20, len(data) - 10):
        path.write_bytes(data[:length])
        assert missing(path), length
    path.write_bytes(first)
    assert missing(path) == "", "this index needs no second list"
    path.write_bytes(struct.pack("<4sI4s", b"RIFF", 0, b"AVI ") + b"x" * 90)
    assert missing(path) == "", "an interrupted recording does not state its length"


def test_a_file_with_very_many_parts_is_not_read_to_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(file_completeness, "_MAX_PARTS", 10)
    path = tmp_path / "a.mp4"
    path.write_bytes(box(b"ftyp") + box(b"moov") + box(b"mdat") + box(b"free") * 50 + b"\x00")
    assert missing(path) == ""


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("calib.json", '{"model": "PINHOLE", "params": [1, 2', "end"),
        ("calib.json", '{"model": "PINH', "end"),
        ("calib.json", '{"model": ', "end"),
        ("calib.json", '{"model": "PINHOLE"}', ""),
        ("calib.json", '{"model": oops, "params": [1]}', ""),
        ("calib.json", "", "empty"),
        ("job.yaml", "", "empty"),
        ("job.yaml", "name: wa", ""),
        ("subject.bvh", "", "empty"),
        ("times.csv", "", "empty"),
        ("notes.txt", "", ""),
        ("a.ts", "", "empty"),
        ("a.ts", "anything at all", "not that of a video"),
    ],
)
def test_text_files(tmp_path: Path, name: str, content: str, expected: str) -> None:
    (tmp_path / name).write_text(content)
    assert (expected in missing(tmp_path / name)) if expected else missing(tmp_path / name) == ""


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (box(b"ftyp", b"isom") + box(b"moov") + box(b"mdat", b"x" * 90)[:-1], "bytes are there"),
        (box(b"ftyp", b"heic") + box(b"meta") + box(b"mdat", b"x" * 90)[:-1], ""),
        (box(b"ftyp", b"M4A ") + box(b"mdat", b"x" * 90), ""),
        (b"the skip is no box", ""),
        (b"\0\0\1\0\1\0 an icon", ""),
        ((b"\x47" + bytes(187)) * 4 + b"\x47", "last packet"),
        (bytes(50), ""),
        (b"", ""),
    ],
)
def test_a_file_of_another_name_is_inspected_if_it_begins_as_a_video(
    tmp_path: Path, content: bytes, expected: str
) -> None:
    path = tmp_path / "Unconfirmed 12.crdownload"
    path.write_bytes(content)
    assert (expected in missing(path)) if expected else missing(path) == ""
    assert is_video_by_content(path) == bool(expected)


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir, lambda path: os.symlink("/dev/zero", path)])
def test_only_files_are_opened(tmp_path: Path, make: Callable[[Path], None]) -> None:
    make(tmp_path / "a.mp4")
    assert missing(tmp_path / "a.mp4") == ""
    shutil.rmtree(tmp_path)
    assert missing(tmp_path / "a.mp4") == ""
