"""Videos whose end is missing, as after a power loss: used up to the last whole frame, with a note."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.capture.decoding import decode_frames
from bodycap_batch.capture.frame_index import index_video
from bodycap_batch.capture.opening import open_camera
from bodycap_batch.capture.video import VideoFile
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.core.errors import CaptureError
from tests.videos import Image, write_video

COUNT = 40
FRAGMENTS = (
    "frag_keyframe+empty_moov",
    "frag_keyframe",
    "frag_keyframe+delay_moov",
    "frag_every_frame+empty_moov+default_base_moof",
    "frag_keyframe+empty_moov+dash",
    "frag_keyframe+empty_moov+separate_moof+omit_tfhd_offset",
)


def noise() -> list[Image]:
    """Return pictures that are different everywhere, so that a frame cut at any byte is another picture."""
    rng = np.random.default_rng(0)
    return [rng.integers(0, 255, (48, 64), dtype=np.uint8) for _ in range(COUNT)]


def pictures(video: VideoFile, indices: Sequence[int] | None = None, threads: int = 1) -> dict[int, bytes]:
    """Decode frames as a run does; leave out those that the decoder reports as damaged."""
    wanted = np.arange(len(video.pts)) if indices is None else np.array(indices)
    return {
        int(video.pts[index]): frame.to_ndarray().tobytes()
        for index, frame in decode_frames(video, wanted, threads, skip_lost=True)
        if not frame.is_corrupt
    }


def boxes(data: bytes) -> list[tuple[bytes, int, int]]:
    """Return the type, the start and the end of each box of an MP4 file."""
    found, position = [], 0
    while position < len(data):
        length = int.from_bytes(data[position : position + 4], "big")
        found.append((data[position + 4 : position + 8], position, position + length))
        position += length
    return found


def packets_before(whole: VideoFile, end: int) -> int:
    """Return how many packets of a video end before a byte of its file."""
    import av

    with av.open(str(whole.path)) as container:
        ends = [p.pos + p.size for p in container.demux(video=0) if p.size and p.pos is not None]
    return sum(each <= end for each in ends)


@pytest.mark.parametrize(
    ("movflags", "bframes"), [(FRAGMENTS[0], False), *((movflags, True) for movflags in FRAGMENTS)]
)
def test_a_file_in_fragments_is_used_up_to_its_last_whole_frame(
    tmp_path: Path, movflags: str, bframes: bool
) -> None:
    path = write_video(tmp_path / "whole.mp4", noise(), bframes=bframes, movflags=movflags)
    data, whole = path.read_bytes(), index_video(path)
    assert whole.missing_end == ""
    expected = pictures(whole)
    assert len(expected) == COUNT
    parts = boxes(data)
    moofs, mdats = ([part[1:] for part in parts if part[0] == kind] for kind in (b"moof", b"mdat"))
    cuts = {cut for start, end in (moofs[1], moofs[-1]) for cut in range(start, end, 20)}
    cuts |= {end for _, end in (moofs[0], moofs[1], moofs[-1])}
    cuts |= {start + share * (end - start) // 5 for start, end in (mdats[0], mdats[-1]) for share in (1, 4)}
    cuts |= {start + 4 for start, _ in (moofs[1], mdats[1])}
    for cut in sorted(cuts):
        (tmp_path / "cut.mp4").write_bytes(data[:cut])
        count = packets_before(whole, cut)
        if count == 0:
            with pytest.raises(CaptureError):
                index_video(tmp_path / "cut.mp4")
            continue
        video = index_video(tmp_path / "cut.mp4")
        found = pictures(video)
        assert len(video.pts) == len(found) == count, cut
        assert all(expected[pts] == picture for pts, picture in found.items()), cut
        assert ("end is missing" in video.missing_end) or data[cut + 4 : cut + 8] in (b"moof", b"mfra"), cut
        far = [0, count - 1] if count > 1 else [0]
        assert pictures(video, far) == {int(video.pts[i]): found[int(video.pts[i])] for i in far}
        assert pictures(video, threads=4) == found


@pytest.mark.parametrize(
    ("name", "codec", "note"),
    [
        ("a.mkv", "libx264", "bytes are there"),
        ("a.webm", "libvpx", "bytes are there"),
        ("a.avi", "mjpeg", "bytes are there"),
        ("a.avi", "libx264", "bytes are there"),
        ("a.mov", "mjpeg", "bytes are there"),
        ("a.ts", "libx264", "its last packet is cut"),
        ("a.m2ts", "libx264", "its last packet is cut"),
    ],
)
@pytest.mark.parametrize("bframes", [True, False])
def test_a_cut_video_of_another_kind_gives_no_picture_that_is_not_whole(
    tmp_path: Path, name: str, codec: str, note: str, bframes: bool
) -> None:
    pix_fmt, movflags = ("yuvj420p", "frag_keyframe+empty_moov") if codec == "mjpeg" else ("yuv420p", "")
    path = write_video(
        tmp_path / name,
        noise(),
        codec=codec,
        pix_fmt=pix_fmt,
        bframes=bframes,
        movflags=movflags if name.endswith("mov") else "",
    )
    data, expected = path.read_bytes(), pictures(index_video(path))
    counts = []
    for cut in np.random.default_rng(1).integers(len(data) // 3, len(data) - 400, 15):
        path.write_bytes(data[:cut])
        video = index_video(path)
        found = pictures(video)
        assert all(expected[pts] == picture for pts, picture in found.items()), cut
        assert note in video.missing_end
        counts.append((int(cut), len(found)))
    share = [count / COUNT - cut / len(data) for cut, count in counts]
    assert max(map(abs, share)) < 4 / COUNT, "all but the last frames are there"


def test_the_note_says_what_is_missing_and_up_to_where_the_video_is_used(tmp_path: Path) -> None:
    path = write_video(tmp_path / "torso.mkv", noise(), bframes=False)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    config = CameraConfig(name="torso", video=(path,), calibration="auto", offset_s=0.0)
    camera = open_camera(CaptureConfig(cameras=(config,)), config)
    (note,) = camera.notes
    assert note.startswith("torso.mkv: its end is missing: ")
    assert f"up to its last whole frame, at {(len(camera.times_ns) - 1) / 30:.2f} s" in note


def test_a_sidecar_file_may_have_times_of_the_missing_frames(tmp_path: Path) -> None:
    path = write_video(tmp_path / "torso.mp4", noise(), bframes=False, movflags=FRAGMENTS[0])
    times = tmp_path / "torso.timestamps.txt"
    times.write_text("".join(f"{index / 25}\n" for index in range(COUNT)))
    config = CameraConfig(name="torso", video=(path,), timestamps=(times,), calibration="auto", offset_s=0.0)
    whole = open_camera(CaptureConfig(cameras=(config,)), config)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    camera = open_camera(CaptureConfig(cameras=(config,)), config)
    assert 0 < len(camera.times_ns) < COUNT
    assert camera.times_ns.tolist() == whole.times_ns[: len(camera.times_ns)].tolist()


def test_a_link_to_a_cut_video_is_used_like_the_video(tmp_path: Path) -> None:
    path = write_video(tmp_path / "whole.mp4", noise(), movflags=FRAGMENTS[0])
    data = path.read_bytes()
    _, start, end = next(box for box in reversed(boxes(data)) if box[0] == b"moof")
    path.write_bytes(data[: (start + end) // 2])
    (tmp_path / "torso.mp4").symlink_to(path)
    assert index_video(tmp_path / "torso.mp4").missing_end


@pytest.mark.parametrize(
    ("movflags", "message"),
    [
        ("", r"bytes are there, and no index \(moov\)"),
        ("faststart", "is incomplete: its index lists 40 frames"),
    ],
)
def test_a_file_with_one_index_is_refused_with_what_is_missing(
    tmp_path: Path, movflags: str, message: str
) -> None:
    path = write_video(tmp_path / "torso.mp4", noise(), movflags=movflags)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(CaptureError, match=message):
        index_video(path)
