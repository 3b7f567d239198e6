"""How cost grows: the same walk for 1, 2 and 4 times as long, and with 1, 2, 3 and 5 cameras."""

from __future__ import annotations

import shutil
import subprocess
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


@dataclass(frozen=True)
class Case:
    """One capture of the series.

    Attributes:
        row: What is run.
        seconds: Length of each video.
        cameras: How many cameras.
    """

    row: Row
    seconds: int
    cameras: int

    def size(self) -> dict[str, int]:
        """What varies, for the table."""
        return {"scaling_seconds": self.seconds, "scaling_cameras": self.cameras}


def cases(work: Path) -> Iterator[Case]:
    """Render the captures one by one: a longer one is the same walk, continued."""
    sizes = [(BASE_S * times, _USUAL) for times in LENGTHS]
    sizes += [(BASE_S, count) for count in COUNTS if count != _USUAL]
    for seconds, count in sizes:
        folder = work / f"{seconds}s_{count}cameras"
        command = [*BODYCAP, "synth", str(folder), "--seconds", str(seconds), "--seed", "1"]
        command += ["--cameras", ",".join(CAMERAS[:count])]
        subprocess.run(
            command, cwd=REPOSITORY, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        arguments = ("--skeleton", "none") if count == 1 else row_of(folder).arguments
        yield Case(Row(folder.name, folder, folder / "gt", arguments), seconds, count)
        shutil.rmtree(folder)


def lines_of(result: dict[str, Any], case: Case) -> list[str]:
    """One case in two or three lines."""
    lines = ours.lines_of(result)
    if len(lines) < 2:
        return lines
    keep = [line for line in lines[1:] if "seconds:" in line or "whole job" in line]
    return [f"scaling, {case.seconds} s, {case.cameras} cameras: {lines[0].partition(': ')[2]}", *keep]


def summary(results: list[dict[str, Any]]) -> list[str]:
    """Time, pairs and memory of each case over those of the shortest one with three cameras."""
    found = [result for result in results if "scaling_seconds" in result and "wall_seconds" in result]
    base = next((each for each in found if _is_base(each)), None)
    if base is None:
        return ["scaling: the base case did not run"]
    lines = [f"scaling, times the base of {BASE_S} s and {_USUAL} cameras:"]
    for result in found:
        ratios = [
            f"whole job {result['wall_s'] / base['wall_s']:.2f}",
            f"map and registration {ours.mapping_seconds(result) / ours.mapping_seconds(base):.2f}",
            f"pairs {_pairs(result) / max(_pairs(base), 1):.2f}",
            f"peak memory {result['peak_memory_mb'] / base['peak_memory_mb']:.2f}",
        ]
        size = f"{result['scaling_seconds']} s, {result['scaling_cameras']} cameras"
        lines.append(f"    {size:16} " + ", ".join(ratios))
    return lines


def _is_base(result: dict[str, Any]) -> bool:
    return bool(result["scaling_seconds"] == BASE_S and result["scaling_cameras"] == _USUAL)


def _pairs(result: dict[str, Any]) -> int:
    """Keyframe pairs matched, as the job's metrics tell (0 where they do not)."""
    return int(result["metrics"].get("mapping", {}).get("pairs", 0))
