"""Small GPMF payloads and videos with a GPMF track, written when they are needed."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from bodycap_batch.formats.gpmf_writer import header, item, nested
from tests.videos import Image


def raw(key: str, kind: str, size: int, count: int, content: bytes) -> bytes:
    """Return an item with any content."""
    return header(key, ord(kind), size, count) + content + b"\0" * (-len(content) % 4)


@dataclass(frozen=True)
class Sensor:
    """A gyroscope and an accelerometer that are written into a track.

    Attributes:
        rate_hz: True samples per second of the camera's clock.
        axes: Axes of the stored values (ORIN); "" to leave them out.
        device: Name of the camera.
        stamps: Whether payloads have their own time stamps (STMP).
    """

    rate_hz: float = 201.9
    axes: str = "ZXY"
    device: str = "HERO11 Black"
    stamps: bool = True


def payloads(
    sensor: Sensor, seconds: int, gyro=None, extra: Sequence[bytes] = (), stamp_scale: float = 1.0
) -> list[tuple[bytes, float, float]]:
    """Return payloads of 1.001 s whose rates are a function of time, in GoPro's axes (left, back, up)."""
    out = []
    done = 0
    for number in range(seconds):
        start, end = 1.001 * number, 1.001 * (number + 1)
        last = int(np.floor(end * sensor.rate_hz))
        times = np.arange(done, last) / sensor.rate_hz
        rates = np.zeros((len(times), 3)) if gyro is None else gyro(times)
        forces = np.tile([0.0, 0.0, 9.8], (len(times), 1))
        streams = []
        for key, scale, values in (("ACCL", 400, forces), ("GYRO", 1000, rates)):
            letters = sensor.axes or "ZXY"
            stored = np.stack(
                [values[:, "XYZ".index(c.upper())] * (1 if c.isupper() else -1) for c in letters], axis=1
            )
            parts = [item("TSMP", "L", [last])]
            if sensor.stamps:
                parts.insert(0, item("STMP", "J", [round(5e6 + 1e6 * stamp_scale * done / sensor.rate_hz)]))
            if sensor.axes:
                parts.append(item("ORIN", "c", sensor.axes))
            unit = "m/s²" if key == "ACCL" else "rad/s"
            parts += [item("SIUN", "c", unit), item("SCAL", "s", [scale])]
            parts.append(item(key, "s", np.rint(stored * scale).astype(int), 3))
            streams.append(nested("STRM", *parts))
        device = nested("DEVC", item("DVID", "L", [1]), item("DVNM", "c", sensor.device), *streams, *extra)
        out.append((device, start, 1.001))
        done = last
    return out


def write_gopro(
    path: Path,
    frames: Sequence[Image],
    track: Sequence[tuple[bytes, float, float]],
    fps: Fraction = Fraction(30000, 1001),
    handler: str = "\tGoPro MET",
) -> Path:
    """Encode grey images (H,W) and a GPMF track as an MP4 file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=fps, options={"crf": "10", "preset": "ultrafast"})
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        data = container.add_data_stream("bin_data")
        data.metadata["handler_name"] = handler
        data.time_base = Fraction(1, 1000)
        container.start_encoding()
        for image in frames:
            frame = av.VideoFrame.from_ndarray(image, format="gray")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
        for content, start, duration in track:
            packet = av.Packet(content)
            packet.stream = data
            packet.time_base = Fraction(1, 1000)
            packet.pts = packet.dts = round(1000 * start)
            packet.duration = round(1000 * duration)
            container.mux(packet)
    return path


CONTAINERS = (b"moov", b"trak", b"mdia", b"minf", b"stbl")
"""Boxes of an MP4 file that lead to the tables of offsets."""


def with_wide_offsets(data: bytes) -> bytes:
    """Return an MP4 file whose tables of offsets have 64 bits. Its samples must come before the tables."""
    out, place = b"", 0
    while place + 8 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, place)
        content = data[place + 8 : place + size]
        if kind in CONTAINERS:
            content = with_wide_offsets(content)
        elif kind == b"stco":
            count = struct.unpack_from(">I", content, 4)[0]
            offsets = struct.unpack_from(f">{count}I", content, 8)
            kind, content = b"co64", content[:8] + struct.pack(f">{count}Q", *offsets)
        out += struct.pack(">I4s", len(content) + 8, kind) + content
        place += size
    return out
