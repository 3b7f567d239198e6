"""360° pictures are refused, by their metadata or by their edges; flat pictures of the same shape are not."""

from __future__ import annotations

import shutil
import struct
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.check import check_path
from bodycap_batch.cli import main
from tests.videos import Image, textured_frame, write_video

PARENTS = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd", b"avc1")
HEADER_BYTES = {b"stsd": 8, b"avc1": 78}
SPHERICAL_XML = (
    b'<?xml version="1.0"?><rdf:SphericalVideo xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#" '
    b'xmlns:GSpherical="http://ns.google.com/videos/1.0/spherical/">'
    b"<GSpherical:Spherical>true</GSpherical:Spherical><GSpherical:Stitched>true</GSpherical:Stitched>"
    b"<GSpherical:StitchingSoftware>x</GSpherical:StitchingSoftware>"
    b"<GSpherical:ProjectionType>equirectangular</GSpherical:ProjectionType></rdf:SphericalVideo>"
)


def box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I4s", 8 + len(content), kind) + content


def spherical_box(projection: bytes) -> bytes:
    """Google's Spherical Video metadata, version 2."""
    head = box(b"svhd", bytes(4) + b"test\0")
    shape = box(projection, bytes(20))
    return box(b"sv3d", head + box(b"proj", box(b"prhd", bytes(16)) + shape))


def with_box(data: bytes, path: tuple[bytes, ...], new: bytes) -> bytes:
    """Append a box to the innermost of some nested boxes. The index is behind the pictures, so they stay."""
    out, start = b"", 0
    while start < len(data):
        size, kind = struct.unpack(">I4s", data[start : start + 8])
        content = data[start + 8 : start + size]
        if path and kind == path[0]:
            skip = HEADER_BYTES.get(kind, 0)
            inner = with_box(content[skip:], path[1:], new) if len(path) > 1 else content[skip:] + new
            content = content[:skip] + inner
        out += box(kind, content)
        start += size
    return out


def errors_of(folder: Path) -> list[str]:
    return [str(error) for error in check_path(folder).errors]


def flat_video(path: Path, width: int = 320, height: int = 160) -> Path:
    return write_video(path, [textured_frame(n % 40, width, height) for n in range(75)])


@pytest.fixture(scope="module")
def sphere() -> list[Image]:
    """Equirectangular pictures of a sphere that is painted with random stripes and turns by 1.1° a frame."""
    rng, width = np.random.default_rng(4), 640
    longitude = (np.arange(width) + 0.5) / width * 2 * np.pi
    latitude = np.pi / 2 - (np.arange(width // 2) + 0.5) / width * 2 * np.pi
    flat = np.cos(latitude)[:, None]
    up = np.broadcast_to(np.sin(latitude)[:, None], (width // 2, width))
    rays = np.stack([flat * np.sin(longitude), up, flat * np.cos(longitude)], axis=-1)
    value = sum(np.sign(np.sin(rays @ rng.normal(0, 6, 3) + rng.uniform(0, 6))) for _ in range(12))
    picture = np.clip(128 + 15 * np.asarray(value), 0, 255).astype(np.uint8)
    return [np.roll(picture, -2 * frame, axis=1) for frame in range(75)]


@pytest.mark.parametrize(
    ("kind", "words"),
    [(b"equi", "equirectangular in its metadata"), (b"cbmp", "a cube map in its metadata")],
)
def test_spherical_metadata_are_refused_with_what_to_export(tmp_path: Path, kind: bytes, words: str) -> None:
    path = flat_video(tmp_path / "torso.mp4")
    path.write_bytes(with_box(path.read_bytes(), PARENTS, spherical_box(kind)))
    (error,) = errors_of(tmp_path)
    assert f"a 360° picture ({words})" in error
    assert "export a flat view first" in error


def test_the_first_version_of_the_metadata_is_read(tmp_path: Path) -> None:
    path = flat_video(tmp_path / "torso.mp4")
    identifier = bytes.fromhex("ffcc8263f8554a938814587a02521fdd")
    path.write_bytes(with_box(path.read_bytes(), PARENTS[:2], box(b"uuid", identifier + SPHERICAL_XML)))
    (error,) = errors_of(tmp_path)
    assert "a 360° picture (equirectangular in its metadata)" in error


def test_a_sphere_is_seen_without_metadata(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], sphere: list[Image]
) -> None:
    write_video(tmp_path / "torso.mp4", sphere)
    assert main(["check", str(tmp_path)]) == 3
    output = " ".join(capsys.readouterr().out.split())
    assert "a 360° picture (equirectangular, because the left edge continues the right edge)" in output
    assert "first guess" not in output


def test_flat_pictures_of_the_same_shape_are_accepted(tmp_path: Path, sphere: list[Image]) -> None:
    frames = [picture[60:260, 100:500] for picture in sphere]
    assert frames[0].shape[1] == 2 * frames[0].shape[0]
    write_video(tmp_path / "torso.mp4", frames)
    assert errors_of(tmp_path) == []


@pytest.mark.parametrize(
    ("name", "size", "is_refused"),
    [
        ("torso.360", (320, 96), True),
        ("torso.insv", (160, 160), True),
        ("torso.insv", (320, 160), True),
        ("torso.insv", (320, 176), False),  # the flat mode of a camera with one lens
    ],
)
def test_files_of_two_lenses_are_refused(
    tmp_path: Path, name: str, size: tuple[int, int], is_refused: bool
) -> None:
    flat_video(tmp_path / "a.mp4", *size)
    shutil.move(tmp_path / "a.mp4", tmp_path / name)
    found = errors_of(tmp_path)
    assert len(found) == is_refused
    assert not found or "unstitched pictures of a 360° camera" in found[0]
