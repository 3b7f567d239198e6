"""A capture of many minutes: a rendered one played forwards and backwards, with new noise and light each
time.

Rendering ten minutes takes hours. A person who walks through one room again and again sees about the same.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tests.bench import ours
from tests.bench.rows import BODYCAP, REPOSITORY, row_of

Picture = npt.NDArray[np.uint8]

_PATTERNS, _SHIFT_PX = 8, 64
_GAIN = 0.12
_QUALITY = {"crf": "20", "preset": "ultrafast"}


def main(argv: Sequence[str]) -> int:
    """Render, replay, run the job and print its figures; the exit code is the job's."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench long", description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0, help="duration of each camera's video (10)")
    parser.add_argument("--seconds", type=float, default=60.0, help="duration of the rendered part (60)")
    parser.add_argument("--seed", type=int, default=3, help="seed of body, walk and room (3)")
    parser.add_argument(
        "--noise", type=float, default=2.0, help="noise added at each repetition, grey levels (2)"
    )
    options = parser.parse_args(argv)
    with tempfile.TemporaryDirectory(prefix="bodycap-long-") as folder:
        once, long = Path(folder) / "once", Path(folder) / "long"
        command = [*BODYCAP, "synth", str(once), "--seconds", str(options.seconds)]
        subprocess.run([*command, "--seed", str(options.seed)], cwd=REPOSITORY, check=True)
        times = max(1, round(60.0 * options.minutes / options.seconds))
        play(once, long, Replay(times=times, noise=options.noise))
        result = ours.run(row_of(long), Path(folder) / "job")
        sys.stdout.write("\n".join([*ours.lines_of(result), *_stages(result)]) + "\n")
    return int(result["exit"])


def _stages(result: dict[str, Any]) -> list[str]:
    mapping = result.get("metrics", {}).get("mapping", {})
    figures = {name: mapping.get(name) for name in ("keyframes", "pairs", "placed")}
    return [f"    {figures}"]


@dataclass(frozen=True, kw_only=True)
class Replay:
    """Number of repetitions of a capture, alternating forwards and backwards, and the added noise.

    Attributes:
        times: Number of repetitions.
        noise: Standard deviation of the noise from the second repetition on, grey levels.
    """

    times: int
    noise: float = 0.0

    def order(self, count: int) -> list[int]:
        """Return frame numbers in the order in which they are played; those at the ends once."""
        forwards = list(range(count))
        out = forwards[:1]
        for number in range(self.times):
            out += forwards[::-1][1:] if number % 2 else forwards[1:]
        return out


def play(source: Path, target: Path, replay: Replay) -> None:
    """Write the replayed videos of a capture and the true paths of its cameras.

    Args:
        source: Folder of a rendered capture.
        target: New folder, which also gets the skeleton and the calibration.
        replay: The repetitions.
    """
    (target / "gt").mkdir(parents=True)
    for name in ("calib.json", "skeleton.bvh"):
        shutil.copy(source / name, target / name)
    for video in sorted(source.glob("*.mp4")):
        count = _play_video(video, target / video.name, replay)
        rows = np.loadtxt(source / "gt" / f"{video.stem}.tum", ndmin=2)
        order = replay.order(count)
        step = (rows[-1, 0] - rows[0, 0]) / max(1, count - 1)
        again = np.column_stack([rows[0, 0] + step * np.arange(len(order)), rows[order, 1:]])
        np.savetxt(target / "gt" / f"{video.stem}.tum", again, fmt="%.7f")


def _play_video(source: Path, target: Path, replay: Replay) -> int:
    """Write one replayed video; return the number of frames of the source."""
    import av

    with av.open(str(source)) as opened:
        stream = opened.streams.video[0]
        rate = Fraction(stream.average_rate or 30)
        frames = [frame.to_ndarray(format="yuv420p") for frame in opened.decode(stream)]
    with av.open(str(target), "w") as written:
        out = written.add_stream("libx264", rate=rate, options=_QUALITY)
        out.width, out.height, out.pix_fmt = frames[0].shape[1], frames[0].shape[0] * 2 // 3, "yuv420p"
        for number, picture in enumerate(_replayed_pictures(frames, replay)):
            image = av.VideoFrame.from_ndarray(picture, format="yuv420p")
            image.pts, image.time_base = number, 1 / rate
            written.mux(out.encode(image))
        written.mux(out.encode())
    return len(frames)


def _replayed_pictures(frames: Sequence[Picture], replay: Replay) -> Iterator[Picture]:
    """Yield the pictures in the order of the replay, with new brightness and noise at each repetition."""
    rng = np.random.default_rng(0)
    height, width = frames[0].shape[0] * 2 // 3, frames[0].shape[1]
    size = (_PATTERNS, height + _SHIFT_PX, width + _SHIFT_PX)
    noise = rng.normal(0.0, replay.noise, size).astype(np.float32)
    for number, index in enumerate(replay.order(len(frames))):
        time = max(0, number - 1) // max(1, len(frames) - 1)
        picture = frames[index].copy()
        if time:
            row, column = rng.integers(0, _SHIFT_PX, 2)
            pattern = noise[rng.integers(_PATTERNS), row : row + height, column : column + width]
            bright = picture[:height] * np.float32(1.0 + _GAIN * np.sin(1.7 * time)) + pattern
            picture[:height] = np.clip(bright, 0.0, 255.0).astype(np.uint8)
        yield picture
