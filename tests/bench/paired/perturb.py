"""Perturbations of the input that change nothing of what the pictures show: the seeds of the comparison.

The program gives the same results for the same input, so chance enters with the input. The remaining frames
keep their times, so the truth and the samples of sensors hold as they are. A file of timestamps states these
times, because the program counts a video from its first picture.
"""

from __future__ import annotations

import hashlib
import os
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import av
import av.container
import av.stream
import numpy as np
from av.video.frame import PictureType, VideoFrame
from av.video.stream import VideoStream

from tests.bench.paired.captures import BenchCapture, is_as_it_is, lay_out

_CRF = 18
"""Quality of re-encoded videos (x264): no difference is visible. Origin: x264's documentation."""
_NOISE_CRF = 10
"""Quality for noise of one grey level, which a coarser quantisation would remove."""
_MUXER = {"movie_timescale": "90000"}
"""Units per second in which an MP4 file states the start of its streams. With FFmpeg's 1,000, a video that
starts late is up to 0.5 ms off."""
_writing = threading.Lock()
"""Two captures can have the same videos, with and without their lens."""
_EIGHT_BITS = ("yuv420p", "yuvj420p", "yuv422p", "yuvj422p", "yuv444p", "yuvj444p")


@dataclass(frozen=True, slots=True, kw_only=True)
class Perturbation:
    """A perturbation of the videos of a capture.

    Attributes:
        first: Number of frames that are left out at the start, which also moves the keyframes.
        noise: Maximum of the added noise, grey levels.
        crf: Quality of the encoding.
    """

    first: int = 0
    noise: int = 0
    crf: int = _CRF

    @property
    def text(self) -> str:
        """The perturbation in words."""
        parts = [f"from frame {self.first}"] * bool(self.first) + [f"noise {self.noise}"] * bool(self.noise)
        return ", ".join([*parts, f"CRF {self.crf}"])


_NAMED = (
    Perturbation(first=1),
    Perturbation(noise=1, crf=_NOISE_CRF),
    Perturbation(crf=_CRF - 1),
    Perturbation(crf=_CRF + 1),
    Perturbation(first=2),
    Perturbation(first=3),
)


def perturbation(seed: int) -> Perturbation | None:
    """Return the perturbation of a seed; None for seed 0, the input as it is.

    Seeds 1 to 6 change one thing. Later seeds start later and have noise.
    """
    if seed == 0:
        return None
    return _NAMED[seed - 1] if seed <= len(_NAMED) else Perturbation(first=seed - 3, noise=1, crf=_NOISE_CRF)


def make_input(capture: BenchCapture, seed: int, work: Path) -> tuple[Path, Path]:
    """Return the input of a job, and the folder of its videos. Perturbed videos are written once.

    Args:
        capture: The capture.
        seed: Number of the perturbation.
        work: Folder of the comparison.
    """
    change = perturbation(seed)
    if change is None and is_as_it_is(capture):
        return capture.source, capture.folder

    def video(file: Path) -> Path:
        if change is None:
            return file
        target = work / "videos" / f"{_digest(file)}-{seed}{file.suffix.lower()}"
        with _writing:
            if not target.exists():
                target.parent.mkdir(parents=True, exist_ok=True)
                part = target.with_name(f".{os.getpid()}-{target.name}")
                write_perturbed(file, part, change, seed)
                part.replace(target)
        return target

    folder = work / "inputs" / f"{capture.name.replace(':', '_')}-{seed}"
    return lay_out(capture, folder, video, change.first if change else 0)


def write_perturbed(source: Path, target: Path, change: Perturbation, seed: int = 0) -> None:
    """Encode a video again with a perturbation. Sound and the data of sensors are copied.

    Args:
        source: The video.
        target: The new file.
        change: What is changed.
        seed: Seed of the noise.
    """
    rng = np.random.default_rng(seed)
    with av.open(str(source)) as old, av.open(str(target), "w", _format_of(target), _MUXER) as new:
        pictures = old.streams.video[0]
        frames = _from_frame(old, pictures, change.first)
        head = next(frames)
        stream = _like(new, pictures, head, change.crf)
        copied = _copied_streams(old, new)
        _encode(new, stream, head, change.noise, rng)
        for frame in frames:
            _encode(new, stream, frame, change.noise, rng)
        new.mux(stream.encode())
        if copied:
            old.seek(0)
            for packet in old.demux(list(copied)):
                if packet.dts is not None:
                    packet.stream = copied[packet.stream]
                    new.mux(packet)


def _from_frame(
    container: av.container.InputContainer, stream: VideoStream, first: int
) -> Iterator[VideoFrame]:
    stream.thread_type = "AUTO"
    for index, frame in enumerate(container.decode(stream)):
        if index >= first:
            yield frame


def _like(new: av.container.OutputContainer, old: VideoStream, head: VideoFrame, crf: int) -> VideoStream:
    """Add a stream with the size, the times and the orientation of another one."""
    options = {"crf": str(crf), "preset": "veryfast"}
    stream: VideoStream = new.add_stream("libx264", rate=old.average_rate, options=options)
    stream.width, stream.height = head.width, head.height
    stream.pix_fmt = head.format.name if head.format.name in _EIGHT_BITS else "yuv420p"
    assert old.time_base is not None
    stream.time_base = stream.codec_context.time_base = old.time_base
    if old.sample_aspect_ratio:
        stream.codec_context.sample_aspect_ratio = old.sample_aspect_ratio
    if head.rotation:
        stream.set_display_rotation(head.rotation)
    return stream


def _copied_streams(
    old: av.container.InputContainer, new: av.container.OutputContainer
) -> dict[av.stream.Stream, av.stream.Stream]:
    """Add the streams of sound and of sensors to a new file; returns the new stream of each old one."""
    copied: dict[av.stream.Stream, av.stream.Stream] = {}
    for stream in old.streams:
        if stream.type == "audio":
            copied[stream] = new.add_stream_from_template(stream)
        elif stream.type == "data" and "MET" in stream.metadata.get("handler_name", ""):
            copied[stream] = new._add_stream_without_codec_from_template(stream)
    return copied


def _encode(
    new: av.container.OutputContainer,
    stream: VideoStream,
    frame: VideoFrame,
    noise: int,
    rng: np.random.Generator,
) -> None:
    if frame.format.name != stream.pix_fmt:
        frame = frame.reformat(format=stream.pix_fmt)
    if noise:
        frame.make_writable()
        plane = frame.planes[0]
        grey = (
            np.frombuffer(memoryview(plane), np.uint8).reshape(plane.height, plane.line_size).astype(np.int16)
        )
        grey += rng.integers(-noise, noise + 1, grey.shape, dtype=np.int16)
        plane.update(np.clip(grey, 0, 255).astype(np.uint8).tobytes())
    frame.pict_type = PictureType.NONE
    new.mux(stream.encode(frame))


def _format_of(target: Path) -> str:
    return {".mp4": "mp4", ".mov": "mov", ".mkv": "matroska"}[target.suffix.lower()]


def _digest(file: Path) -> str:
    state = file.stat()
    text = f"{file.resolve()} {state.st_size} {state.st_mtime_ns}"
    return hashlib.sha256(text.encode()).hexdigest()[:16]
