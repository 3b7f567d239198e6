"""Decoding: exact timestamps, orientation, random access, grey levels."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Generator, Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pytest
from av.video.frame import VideoFrame

from bodycap_batch.capture import CaptureCamera, decoding, frame_index, open_camera
from bodycap_batch.capture.frame_index import index_video
from bodycap_batch.capture.images import turn_upright
from bodycap_batch.capture.prefetch import prefetch
from bodycap_batch.capture.video import open_container
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.core.errors import CaptureError
from tests.videos import textured_frame, write_tone, write_video

FRAMES = [textured_frame(index) for index in range(40)]


def opened(*videos: Path, **capture: object) -> CaptureCamera:
    config = CameraConfig(name="torso", video=videos, calibration="auto", offset_s=0.0)
    return open_camera(CaptureConfig(cameras=(config,), **capture), config)


def shown_index(image: np.ndarray) -> int:
    """Index a frame was drawn with: the bottom right quarter is 40 + 4·index, then expanded to full range."""
    value = np.median(image[image.shape[0] // 2 + 4 :, image.shape[1] // 2 + 4 :])
    return round((float(value) - 40.0) / 4.0)


def test_times_are_the_containers_exact_timestamps(tmp_path: Path) -> None:
    pts = np.cumsum([0, 10, 13, 7, 22, 10, 10, 31, 9, 10]).tolist()
    video = index_video(write_video(tmp_path / "a.mkv", FRAMES[:10], pts=pts))
    # Matroska keeps milliseconds: half of one is the most it may round.
    assert np.abs(video.times_ns() - np.array(pts) / 300 * 1e9).max() <= 0.5e6 + 1
    exact = index_video(write_video(tmp_path / "a.mp4", FRAMES[:10], pts=pts))
    assert exact.times_ns().tolist() == [round(Fraction(p, 300) * 10**9) for p in pts]


@pytest.mark.parametrize("shift", [-200, -95])
@pytest.mark.parametrize("unknown", [1, 10])
def test_a_missing_timestamp_of_the_first_decoded_frame_removes_no_later_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shift: int, unknown: int
) -> None:
    path = write_video(tmp_path / "a.mkv", FRAMES[:10], bframes=False)
    video = index_video(path)
    negative = replace(video, pts=video.pts + shift, key_pts=video.key_pts + shift)

    class Container:
        def __enter__(self) -> Container:
            return self

        def __exit__(self, *_: object) -> None: ...

        def demux(self, _: object) -> Iterator[VideoFrame]:
            with av.open(str(path)) as container:
                for index, frame in enumerate(container.decode(video=0)):
                    frame.pts = None if index < unknown else frame.pts + shift
                    yield frame

    monkeypatch.setattr(decoding, "open_container", lambda *_: Container())
    context = SimpleNamespace(has_b_frames=0)
    codec = SimpleNamespace(codec_context=context, decode=lambda packet: [packet])
    monkeypatch.setattr(decoding, "open_stream", lambda *_: codec)
    found = frame_index._with_first_frame(negative, "matroska")
    assert found.pts.tolist() == negative.pts[unknown % 10 :].tolist()


def test_b_frames_come_in_display_order(tmp_path: Path) -> None:
    camera = opened(write_video(tmp_path / "a.mp4", FRAMES, bframes=True))
    seen = [(index, shown_index(image)) for index, image in camera.grey_frames()]
    assert seen == [(k, k) for k in range(40)]


def test_random_reads_equal_the_stream(tmp_path: Path) -> None:
    camera = opened(write_video(tmp_path / "a.mp4", FRAMES, gop=8))
    stream = dict(camera.grey_frames())
    for wanted in ([0], [39], [7, 8], [3, 17, 18, 39], list(range(5, 40, 11))):
        got = dict(camera.read(wanted))
        assert list(got) == wanted
        assert all(np.array_equal(got[k], stream[k]) for k in wanted)


def test_a_far_read_skips_what_lies_between(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    video = index_video(write_video(tmp_path / "a.mp4", FRAMES, gop=8, bframes=False))
    sought: list[int] = []
    original = decoding._ForwardDecoder._seek

    def counted(self: decoding._ForwardDecoder, index: int) -> None:
        sought.append(index)
        original(self, index)

    monkeypatch.setattr(decoding._ForwardDecoder, "_seek", counted)
    assert [i for i, _ in decoding.decode_frames(video, np.array([1, 2, 5, 33, 39]))] == [1, 2, 5, 33, 39]
    assert sought == [32]


@pytest.mark.parametrize(("rotation", "turns"), [(0, 0), (90, 1), (180, 2), (-90, 3)])
def test_the_rotation_flag_is_applied(tmp_path: Path, rotation: int, turns: int) -> None:
    camera = opened(write_video(tmp_path / "a.mp4", FRAMES[:3], rotation=rotation))
    upright = np.rot90(textured_frame(0), turns)
    image = next(camera.grey_frames())[1]
    assert image.shape == upright.shape == (camera.camera.height_px, camera.camera.width_px)
    # CRF 8 at flat grey is exact to a few levels; the bright quarter stands 60 above the rest.
    assert np.abs(image.astype(int) - upright).mean() < 4


def test_mirrors_are_undone_too() -> None:
    image = np.arange(6, dtype=np.uint8).reshape(2, 3)
    assert np.array_equal(turn_upright(image, ((-1, 0), (0, 1))), image[:, ::-1])
    assert np.array_equal(turn_upright(image, ((0, 1), (1, 0))), image.T)


@pytest.mark.parametrize("pix_fmt", ["yuv420p", "yuv444p", "yuvj420p"])
def test_grey_is_full_range_whatever_the_video(tmp_path: Path, pix_fmt: str) -> None:
    wedge = np.repeat(np.linspace(0, 255, 64)[None], 48, axis=0).astype(np.uint8)
    camera = opened(write_video(tmp_path / "a.mp4", [wedge] * 3, pix_fmt=pix_fmt))
    image = next(camera.grey_frames())[1].astype(int)
    assert np.abs(image[:, 4:-4] - wedge[:, 4:-4]).max() <= 6  # encoder loss at CRF 8


def test_colour_frames_are_rgb(tmp_path: Path) -> None:
    red = np.zeros((48, 64, 3), dtype=np.uint8)
    red[..., 0], red[..., 1] = 200, 40
    camera = opened(write_video(tmp_path / "a.mp4", [red] * 3, pix_fmt="yuv444p"))
    image = next(camera.read([1], colour=True))[1]
    assert image.shape == (48, 64, 3)
    assert np.abs(image.reshape(-1, 3).mean(axis=0) - (200, 40, 0)).max() < 8


def test_wrong_indices_are_refused(tmp_path: Path) -> None:
    camera = opened(write_video(tmp_path / "a.mp4", FRAMES[:5]))
    for wrong in ([3, 2], [1, 1], [-1], [5]):
        with pytest.raises(ValueError, match="indices"):
            camera.read(wrong)


def counting(made: list[int], closed: list[str]) -> Generator[int, None, None]:
    """Numbers; tells what was made, and the thread that it ended in."""
    try:
        for number in range(1000):
            made.append(number)
            yield number
    finally:
        closed.append(threading.current_thread().name)


def test_decoding_ahead_is_bounded_and_ends_with_its_consumer() -> None:
    made: list[int] = []
    closed: list[str] = []
    threads = threading.active_count()
    stream = prefetch(counting(made, closed), ahead=3)
    assert [next(stream) for _ in range(5)] == list(range(5))
    stream.close()
    assert len(closed) == 1
    assert len(made) <= 5 + 3 + 1
    assert threading.active_count() == threads


def test_an_error_ahead_arrives_in_its_place() -> None:
    def source():  # type: ignore[no-untyped-def]
        yield 1
        yield 2
        raise KeyError("third")

    stream = prefetch(source())
    assert [next(stream), next(stream)] == [1, 2]
    with pytest.raises(KeyError, match="third"):
        next(stream)


def test_one_thread_decodes_what_is_asked_for_and_nothing_ahead() -> None:
    made: list[int] = []
    closed: list[str] = []
    stream = prefetch(counting(made, closed), threads=1)
    assert [next(stream) for _ in range(5)] == made == list(range(5))
    stream.close()
    assert closed == [threading.current_thread().name]


def remuxed(source: Path, target: Path, shift: int = 0, skip: int = 0, **options: str) -> Path:
    """Copy packets into another container, moved by `shift` time units and without the first `skip`."""
    with av.open(str(source)) as old, av.open(str(target), "w", options=options) as new:
        stream = new.add_stream_from_template(old.streams.video[0])
        for number, packet in enumerate(old.demux(video=0)):
            if packet.dts is not None and number >= skip:
                packet.pts, packet.dts = (packet.pts or 0) + shift, packet.dts + shift
                packet.stream = stream
                new.mux(packet)
    return target


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("codec", ["libx264", "mpeg4", "libx265"])
def test_frames_that_no_other_depends_on_are_skipped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, codec: str, threads: int
) -> None:
    camera = replace(opened(write_video(tmp_path / "a.mp4", FRAMES, codec=codec, gop=40)), threads=threads)
    stream = dict(camera.grey_frames())
    decoded: list[VideoFrame] = []
    original = decoding._ForwardDecoder._decoded

    def counted(self: decoding._ForwardDecoder) -> Iterator[VideoFrame]:
        for frame in original(self):
            decoded.append(frame)
            yield frame

    monkeypatch.setattr(decoding._ForwardDecoder, "_decoded", counted)
    for wanted in ([1], [2], [39], [20, 38], list(range(0, 40, 2)), list(range(1, 40, 2))):
        decoded.clear()
        got = dict(camera.read(wanted))
        assert list(got) == wanted
        assert all(np.array_equal(image, stream[k]) for k, image in got.items())
        # Of 40 frames about every second one is a B-frame; H.265's decoder passes over none.
        if codec == "libx264" and wanted[0] >= 20:
            assert len(decoded) <= 30


@pytest.mark.parametrize("codec", ["libx264", "libx265", "mpeg4", "libsvtav1", "libvpx-vp9"])
def test_a_sparse_read_does_not_begin_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, codec: str
) -> None:
    if codec not in av.codecs_available:
        pytest.skip(f"this PyAV has no {codec}")
    camera = opened(write_video(tmp_path / "a.mp4", FRAMES, codec=codec, gop=10))
    made: list[decoding._ForwardDecoder] = []
    original = decoding._ForwardDecoder.__init__

    def noted(self: decoding._ForwardDecoder, *arguments: object) -> None:
        made.append(self)
        original(self, *arguments)

    monkeypatch.setattr(decoding._ForwardDecoder, "__init__", noted)
    wanted = list(range(1, 40, 3))
    assert list(dict(camera.read(wanted))) == wanted
    assert len(made) == 1


@pytest.mark.parametrize(
    ("suffix", "codec", "ticks"),
    [
        ("avi", "libx264", 1),
        ("avi", "mjpeg", 10),  # nine empty packets between frames, as for frames a webcam dropped
        ("avi", "mjpeg", 1),
        ("mkv", "libx264", 10),
        ("ts", "libx264", 10),
        ("mov", "libx264", 10),
        ("mpg", "mpeg2video", 1),
    ],
)
def test_containers(tmp_path: Path, suffix: str, codec: str, ticks: int) -> None:
    pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    path = write_video(tmp_path / f"a.{suffix}", FRAMES, codec=codec, ticks=ticks, pix_fmt=pix_fmt)
    camera = opened(path)
    stream = dict(camera.grey_frames())
    assert list(stream) == list(range(40))
    # Matroska keeps milliseconds.
    assert np.abs(np.diff(camera.times_ns) - 1e9 / 30).max() <= 1.1e6
    if codec == "libx264":  # the others blur levels
        assert [shown_index(image) for image in stream.values()] == list(range(40))
    for wanted in ([39], [5, 20, 38]):
        assert all(np.array_equal(image, stream[k]) for k, image in camera.read(wanted))


def test_a_video_trimmed_by_its_edit_list(tmp_path: Path) -> None:
    source = write_video(tmp_path / "a.mp4", FRAMES, gop=10)
    # 13 of 40 frames lie before the start of the shown part (640 units a frame).
    camera = opened(remuxed(source, tmp_path / "trimmed.mp4", shift=-13 * 640, avoid_negative_ts="disabled"))
    assert camera.times_ns[0] == 0
    assert [shown_index(image) for _, image in camera.grey_frames()] == list(range(13, 40))
    assert [shown_index(image) for _, image in camera.read([0, 26])] == [13, 39]


@pytest.mark.parametrize("suffix", ["mkv", "ts"])
def test_a_stream_cut_inside_a_group_starts_where_it_decodes(tmp_path: Path, suffix: str) -> None:
    source = write_video(tmp_path / "a.mp4", FRAMES, gop=10)
    camera = opened(remuxed(source, tmp_path / f"cut.{suffix}", shift=20 * 640, skip=3))
    assert [shown_index(image) for _, image in camera.grey_frames()] == list(range(10, 40))
    assert camera.frame_numbers[0] == 0


def test_only_a_few_frames_are_in_memory(tmp_path: Path) -> None:
    camera = opened(write_video(tmp_path / "a.mp4", FRAMES))
    alive: list[weakref.ref[np.ndarray]] = []
    most = 0
    for _, image in camera.grey_frames():
        alive = [reference for reference in alive if reference() is not None]
        alive.append(weakref.ref(image))
        most = max(most, len(alive))
    # The one in hand and the one just let go; those decoded ahead are bounded by another test.
    assert most <= 2


def test_nothing_outside_the_window_is_decoded(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mp4", FRAMES, gop=10, bframes=False)
    with av.open(str(path)) as container:
        packets = [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]
    data = bytearray(path.read_bytes())
    for position, size in (*packets[10:20], *packets[30:]):
        data[position : position + size] = bytes(size)
    path.write_bytes(bytes(data))
    # Frames 22 to 26 of the third group; the second and the fourth group are destroyed.
    camera = opened(path, start_s=22 / 30 - 0.01, end_s=26 / 30 + 0.01)
    assert [shown_index(image) for _, image in camera.grey_frames()] == [22, 23, 24, 25, 26]
    with pytest.raises(CaptureError, match=r"frame 1[0-9] |after frame"):
        list(opened(path).grey_frames())


@pytest.mark.parametrize("suffix", ["mp4", "mkv", "avi", "ts"])
def test_damaged_files_give_frames_or_a_typed_error(tmp_path: Path, suffix: str) -> None:
    metadata = {"title": "a title that damage turns into something else than text"}
    data = write_video(tmp_path / f"a.{suffix}", FRAMES[:8], metadata=metadata).read_bytes()
    path = tmp_path / f"damaged.{suffix}"
    outcomes = set()
    for seed in range(15):
        rng = np.random.default_rng(seed)
        damaged = np.frombuffer(data, dtype=np.uint8).copy()
        damaged[rng.integers(0, len(damaged), 8)] = rng.integers(0, 256, 8)
        path.write_bytes(damaged[: None if seed % 4 else int(rng.integers(len(damaged)))].tobytes())
        try:
            outcomes.add(sum(1 for _ in opened(path).grey_frames()) > 0)
        except CaptureError as error:
            outcomes.add(error.path)
    assert outcomes <= {True, str(path)}


def test_text_in_another_encoding_does_no_harm(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mp4", FRAMES[:3], metadata={"title": "Kamera Kuche"})
    data = path.read_bytes()
    assert data.count(b"Kuche") == 1
    path.write_bytes(data.replace(b"Kuche", "Küche".encode("latin-1")))
    assert len(opened(path).frame_numbers) == 3


def test_sound_beside_the_pictures_is_left_alone(tmp_path: Path) -> None:
    pictures, sound = write_video(tmp_path / "a.mp4", FRAMES[:10]), write_tone(tmp_path / "s.m4a", 0.5)
    with (
        av.open(str(pictures)) as video,
        av.open(str(sound)) as audio,
        av.open(str(tmp_path / "both.mp4"), "w") as both,
    ):
        # Sound first, so that the pictures are not stream 0.
        sources = [(audio, audio.streams.audio[0]), (video, video.streams.video[0])]
        streams = [both.add_stream_from_template(stream) for _, stream in sources]
        for (source, old), new in zip(sources, streams, strict=True):
            for packet in source.demux(old):
                if packet.dts is not None:
                    packet.stream = new
                    both.mux(packet)
    camera = opened(tmp_path / "both.mp4")
    assert [shown_index(image) for _, image in camera.grey_frames()] == list(range(10))


@pytest.mark.parametrize(("task", "process", "expected"), [(2, "1", 2), (1, "4", 1), (0, "3", 3)])
def test_a_task_decodes_on_the_threads_it_was_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, task: int, process: str, expected: int
) -> None:
    video = index_video(write_video(tmp_path / "a.mp4", FRAMES[:3]))
    monkeypatch.setenv("OMP_NUM_THREADS", process)
    with open_container(video.path) as container:
        assert decoding.open_stream(container, video, task).codec_context.thread_count == expected


def _write_streams(path: Path, *streams: tuple[str, int, int, int]) -> Path:
    """Write video streams with the codec, width, height and number of pictures of each."""
    with av.open(str(path), "w") as container:
        opened = []
        for codec, width, height, _ in streams:
            stream = container.add_stream(codec, rate=10)
            stream.width, stream.height = width, height
            stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
            opened.append(stream)
        for stream, (_, width, height, count) in zip(opened, streams, strict=True):
            for index in range(count):
                frame = av.VideoFrame.from_ndarray(textured_frame(index, width, height), format="gray")
                frame.pts = index
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
    return path


@pytest.mark.parametrize("suffix", ["mp4", "mov", "mkv", "avi", "ts"])
@pytest.mark.parametrize(
    "other", [("mjpeg", 640, 480, 1), ("libx264", 640, 480, 1), ("libx264", 64, 48, 30)], ids=str
)
def test_the_video_of_the_camera_is_used_beside_a_preview(
    tmp_path: Path, suffix: str, other: tuple[str, int, int, int]
) -> None:
    path = _write_streams(tmp_path / f"a.{suffix}", other, ("libx264", 320, 240, 30))
    video = index_video(path)
    assert video.stored_size == (320, 240)
    assert len(video.pts) == 30
    assert len(list(decoding.decode_frames(video, np.arange(30)))) == 30


@pytest.mark.parametrize("suffix", ["mp4", "mkv", "ts"])
def test_a_file_with_the_videos_of_two_lenses_is_refused(tmp_path: Path, suffix: str) -> None:
    path = _write_streams(tmp_path / f"a.{suffix}", *[("libx264", 96, 96, 30)] * 2)
    with pytest.raises(CaptureError, match=r"2 video tracks \(96×96, 96×96\)") as caught:
        index_video(path)
    assert "one lens" in (caught.value.hint or "")
