"""Growth of cost: one walk in three durations, with 1, 2, 3 and 5 cameras, and in three image sizes."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.bench import ours
from tests.bench.rows import BODYCAP, REPOSITORY, Row, row_of

BASE_S = 6
LENGTHS = (1, 2, 4)
CAMERAS = ("torso", "left_palm", "right_palm", "left_upper_arm", "right_upper_arm")
COUNTS = (1, 2, 3, 5)
_USUAL = 3
SIZES = ("640x480", "1440x1080", "2880x2160")
"""Image sizes with the same view; the last two have the height of 1080p and 4K video."""
SIZED_S = 3


@dataclass(frozen=True)
class Case:
    """One capture of a series.

    Attributes:
        row: The benchmark job.
        seconds: Duration of each video.
        cameras: Number of cameras.
        pixels: Image size.
        decoding_s: Seconds of one thread to decode every frame of all cameras once, at the work size.
    """

    row: Row
    seconds: int
    cameras: int
    pixels: str = SIZES[0]
    decoding_s: float = 0.0

    def size(self) -> dict[str, Any]:
        """Return the varied values, for the table."""
        return {
            "scaling_seconds": self.seconds,
            "scaling_cameras": self.cameras,
            "scaling_pixels": self.pixels,
            "decoding_s": self.decoding_s,
        }


SERIES: dict[str, tuple[tuple[int, int, str], ...]] = {
    "length": tuple((BASE_S * times, _USUAL, SIZES[0]) for times in LENGTHS),
    "cameras": tuple((BASE_S, count, SIZES[0]) for count in COUNTS),
    "size": tuple((SIZED_S, 1, pixels) for pixels in SIZES),
}
"""Seconds, cameras and image size of each case; each series is compared with its first case."""


def cases(series: str, work: Path) -> Iterator[Case]:
    """Render the captures of a series one by one; a longer one continues the same walk."""
    for seconds, count, pixels in SERIES[series]:
        folder = work / f"{seconds}s_{count}cameras_{pixels}"
        command = [*BODYCAP, "synth", str(folder), "--seconds", str(seconds), "--seed", "1"]
        command += ["--cameras", ",".join(CAMERAS[:count]), "--size", pixels]
        subprocess.run(
            command, cwd=REPOSITORY, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        arguments = ("--skeleton", "none") if count == 1 else row_of(folder).arguments
        row = Row(folder.name, folder, folder / "gt", arguments)
        yield Case(row, seconds, count, pixels, decoding_seconds(folder))
        shutil.rmtree(folder)


def decoding_seconds(capture: Path) -> float:
    """Return the processor seconds to read every frame of a capture once, as the stages do."""
    from bodycap_batch.capture import open_capture
    from bodycap_batch.config.job import load_job

    opened = open_capture(load_job(capture).capture)
    started = time.process_time()
    for camera in opened.cameras:
        for _ in camera.grey_frames():
            pass
    return time.process_time() - started


def lines_of(result: dict[str, Any], case: Case) -> list[str]:
    """Return one case as two or three lines of text."""
    lines = ours.lines_of(result)
    if len(lines) < 2:
        return lines
    keep = [line for line in lines[1:] if "seconds:" in line or "whole job" in line]
    what = f"{case.seconds} s, {case.cameras} cameras, {case.pixels}"
    return [
        f"scaling, {what}: {lines[0].partition(': ')[2]}",
        *keep,
        f"    to decode all of it once: {case.decoding_s:.1f} s",
    ]


def summary(series: str, results: list[dict[str, Any]]) -> list[str]:
    """Return time, pairs, memory and error of each case of a series relative to the first."""
    found = {_case_of(each): each for each in results if "scaling_seconds" in each and "wall_seconds" in each}
    wanted = SERIES[series]
    if wanted[0] not in found:
        return [f"scaling, {series}: the first case did not run"]
    base = found[wanted[0]]
    lines = [f"scaling, {series}, times {_words(wanted[0])}:"]
    for case in (case for case in wanted if case in found):
        result = found[case]
        ratios = [
            f"whole job {result['wall_s'] / base['wall_s']:.2f}",
            f"its processor seconds {result['cpu_s'] / base['cpu_s']:.2f}",
            f"map and registration {ours.mapping_seconds(result) / ours.mapping_seconds(base):.2f}",
            f"vision without decoding {_vision_seconds(result) / _vision_seconds(base):.2f}",
            f"pairs {_pairs(result) / max(_pairs(base), 1):.2f}",
            f"peak memory {result['peak_memory_mb'] / base['peak_memory_mb']:.2f}",
        ]
        lines.append(f"    {_words(case):28} " + ", ".join(ratios))
    return lines


def _case_of(result: dict[str, Any]) -> tuple[int, int, str]:
    return result["scaling_seconds"], result["scaling_cameras"], result["scaling_pixels"]


def _words(case: tuple[int, int, str]) -> str:
    return f"{case[0]} s, {case[1]} cameras, {case[2]}"


_PASSES = 2
"""Keyframes and registration read every frame once; of large videos, registration reads stored copies."""


def _vision_seconds(result: dict[str, Any]) -> float:
    """Return the seconds of the stages that process frames, one core each, without the time for decoding."""
    stages = ("keyframes", "map", "registration")
    total = sum(result["stage_seconds"].get(stage, 0.0) for stage in stages)
    passes = _PASSES if result["scaling_pixels"] == SIZES[0] else 1
    return float(max(total - passes * result["decoding_s"], 1e-3))


def _pairs(result: dict[str, Any]) -> int:
    """Return the number of matched keyframe pairs from the job's metrics; 0 if they do not state it."""
    return int(result["metrics"].get("mapping", {}).get("pairs", 0))
