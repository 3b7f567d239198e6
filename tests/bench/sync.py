"""Time `bodycap sync` on long recordings: ``python -m tests.bench sync``.

Three cameras, 1080p at 30 frames/s and about 10 Mbit/s. Ten seconds of noise are encoded once and repeated,
because `sync` decodes no pictures. The sound is generated for the whole duration. With ``--repeats`` it is
one piece of ten seconds again and again, which cannot be matched.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from bodycap_batch.formats.mp4_writer import sound_frames
from bodycap_batch.synthetic.sound import Microphone, Samples, make_scene, record
from tests.bench.rows import BODYCAP, REPOSITORY

_FPS, _WIDTH, _HEIGHT, _PART_S, _RATE_HZ = 30, 1920, 1080, 10, 48_000
_BITS_PER_S = 10_000_000
_OFFSETS_S = {"torso": 0.0, "left_palm": 7.31, "right_palm": -4.63}


def main(argv: Sequence[str]) -> int:
    """Make the recordings, run `bodycap sync`, and print time and memory; the exit code is its own."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench sync", description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0, help="duration of each recording (10)")
    parser.add_argument("--repeats", action="store_true", help="sound that repeats every ten seconds")
    parser.add_argument("--times", type=int, default=3, help="number of runs (3)")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="folder in which the recordings are kept")
    options = parser.parse_args(argv)
    with tempfile.TemporaryDirectory(prefix="bodycap-sync-") as temporary:
        folder = options.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        if not list(folder.glob("*.mp4")):
            _write_recordings(folder, 60.0 * options.minutes, options.repeats)
        size = sum(path.stat().st_size for path in folder.glob("*.mp4"))
        sys.stdout.write(f"{len(_OFFSETS_S)} cameras, {options.minutes:g} min, {size / 1e9:.2f} GB\n")
        return max(_run(folder, last=index == options.times - 1) for index in range(options.times))


def _run(folder: Path, *, last: bool) -> int:
    begin = time.perf_counter()
    output = None if last else subprocess.DEVNULL
    child = subprocess.Popen([*BODYCAP, "sync", str(folder)], cwd=REPOSITORY, stdout=output)
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    sys.stdout.write(
        f"sync: exit {child.returncode}, {time.perf_counter() - begin:.1f} s, "
        f"{usage.ru_utime + usage.ru_stime:.1f} s of processor time, {usage.ru_maxrss / 1000:.0f} MB\n"
    )
    sys.stdout.flush()
    return child.returncode


def _write_recordings(folder: Path, seconds: float, repeats: bool) -> None:
    part = folder / "part.h264.mp4"
    _write_part(part)
    margin = max(abs(offset) for offset in _OFFSETS_S.values()) + 1.0
    scene_s = _PART_S if repeats else seconds + margin
    scene = make_scene(-margin, scene_s, seed=7, rate_hz=_RATE_HZ)
    for seed, (camera, offset_s) in enumerate(_OFFSETS_S.items()):
        microphone = Microphone(
            seed=seed,
            seconds=_PART_S if repeats else seconds,
            offset_s=0.0 if repeats else offset_s,
            noise_ratio_db=0.0,
        )
        samples = record(scene, microphone)
        if repeats:
            shifted = np.roll(samples, -round(offset_s * _RATE_HZ))
            samples = np.tile(shifted, round(seconds / _PART_S))
        _write_recording(folder / f"{camera}.mp4", part, samples, seconds)
    part.unlink()


def _write_part(path: Path) -> None:
    """Encode the pictures of some seconds."""
    rng = np.random.default_rng(3)
    noise = rng.integers(0, 255, (_HEIGHT + 64, _WIDTH + 64), np.uint8)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=_FPS, options={"preset": "ultrafast"})
        stream.width, stream.height, stream.pix_fmt = _WIDTH, _HEIGHT, "yuv420p"
        stream.bit_rate = _BITS_PER_S
        for index in range(_FPS * _PART_S):
            y, x = rng.integers(0, 64, 2)
            grey = noise[y : y + _HEIGHT, x : x + _WIDTH] // (1 + index % 3)
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(grey), format="gray")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def _write_recording(path: Path, part: Path, samples: Samples, seconds: float) -> None:
    """Write one recording: the pictures of the part again and again, and the sound."""
    with av.open(str(path), "w") as container, av.open(str(part)) as source:
        packets = [packet for packet in source.demux(video=0) if packet.size]
        pictures = container.add_stream_from_template(source.streams.video[0])
        sound = container.add_stream("aac", rate=_RATE_HZ, layout="mono")
        frames = iter(sound_frames(samples, _RATE_HZ, "mono"))
        base = packets[0].time_base
        length = round(_PART_S / base)
        times = [(packet.pts, packet.dts) for packet in packets]
        for repetition in range(round(seconds / _PART_S)):
            for packet, (pts, dts) in zip(packets, times, strict=True):
                packet.stream = pictures
                packet.pts, packet.dts, packet.time_base = pts, dts, base
                packet.pts += repetition * length
                packet.dts += repetition * length
                container.mux(packet)
            until = Fraction((repetition + 1) * _PART_S)
            for frame in frames:
                container.mux(sound.encode(frame))
                if Fraction(frame.pts, _RATE_HZ) >= until:
                    break
        container.mux([*(packet for frame in frames for packet in sound.encode(frame)), *sound.encode(None)])
