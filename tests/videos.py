"""Small videos for tests, encoded when they are needed."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]


def textured_frame(index: int, width: int = 64, height: int = 48) -> Image:
    """Return a grey image with a mean of about 40 + 4·index and a brighter top left quarter."""
    image = np.full((height, width), 40 + 4 * index, dtype=np.uint8)
    image[: height // 2, : width // 2] += 60
    return image


def unopened(content: str = "frames") -> bytes:
    """Return a file that is a whole MP4 by its structure, for tests in which no video is opened."""
    data = content.encode()
    return b"\0\0\0\x08ftyp\0\0\0\x08moov\0\0\0" + bytes([8 + len(data)]) + b"mdat" + data


def write_video(
    path: Path,
    frames: Sequence[Image],
    *,
    fps: int = 30,
    pts: Sequence[int] | None = None,
    gop: int = 12,
    rotation: int = 0,
    pix_fmt: str = "yuv420p",
    metadata: dict[str, str] | None = None,
    bframes: bool = True,
    codec: str = "libx264",
    ticks: int = 10,
    pixel_aspect: Fraction | None = None,
    movflags: str = "",
) -> Path:
    """Encode grey (H,W) or RGB (H,W,3) images; `pts` in units of 1/(ticks·fps) s.

    Args:
        rotation: Counter-clockwise degrees by which a player turns the stored frames.
        pixel_aspect: Width of a pixel over its height, as stored in the file.
        movflags: Option of the muxer of MP4 and MOV, for example ``frag_keyframe+empty_moov``.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    muxing = {"movflags": movflags} if movflags else {}
    with _kept_priority(), av.open(str(path), "w", options=muxing) as container:
        container.metadata.update(metadata or {})
        options = (
            {}
            if codec != "libx264"
            else {"crf": "8", "preset": "ultrafast", "g": str(gop), "bf": "2" if bframes else "0"}
        )
        stream = container.add_stream(codec, rate=fps, options=options)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = pix_fmt
        stream.time_base = stream.codec_context.time_base = Fraction(1, ticks * fps)
        if pixel_aspect is not None:
            stream.codec_context.sample_aspect_ratio = pixel_aspect
        if rotation:
            stream.set_display_rotation(rotation)
        for index, image in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(image, format="gray" if image.ndim == 2 else "rgb24")
            frame.pts = ticks * index if pts is None else pts[index]
            frame.time_base = Fraction(1, ticks * fps)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


@contextmanager
def _kept_priority() -> Iterator[None]:
    """Keep the priority of this process: SVT-AV1 gives its caller the highest one if that is root."""
    if not hasattr(os, "sched_getscheduler"):
        yield
        return
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        if os.sched_getscheduler(0) != policy:
            os.sched_setscheduler(0, policy, parameters)


def write_tone(path: Path, seconds: float = 0.2) -> Path:
    """Write a file with sound only."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=16000)
        for start in range(0, int(16000 * seconds), 1024):
            wave = (0.1 * np.sin(np.arange(start, start + 1024) * 0.17)).astype(np.float32)
            frame = av.AudioFrame.from_ndarray(wave[None], format="fltp", layout="mono")
            frame.sample_rate, frame.pts = 16000, start
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path
