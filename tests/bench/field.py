"""Captures as in practice: rendered, and recorded again as by phones and with covered lenses.

``python -m tests.bench field``: one rendered walk of 5 seconds in three variants: as phones film it (upright,
strongly compressed, with variable rate and exposure), with lenses that are covered for some time, and with
cameras of different rates and sizes. The fourth capture is a person who turns on the spot, so that the
cameras hardly translate.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

from tests.altered import AS_A_PHONE, Recording, alter, covered, slower
from tests.bench.rows import BODYCAP, REPOSITORY, Row, row_of

CAMERAS = ("torso", "left_palm", "right_palm")
RECORDED: dict[str, dict[str, Recording]] = {
    "phones": dict.fromkeys(CAMERAS, AS_A_PHONE),
    "covered": {"torso": covered((0.0, 0.7)), "right_palm": covered((1.5, 2.5))},
    "rates": {"left_palm": slower(2, (320, 240)), "right_palm": slower(3, (640, 480))},
}
ON_THE_SPOT = ("--cameras", "torso,head,left_palm", "--set", "on_the_spot=true")


def cases(work: Path) -> Iterator[Row]:
    """Render and alter the captures one by one."""
    walk = _rendered(work / "walk", "--cameras", ",".join(CAMERAS), "--seed", "37")
    for name, recordings in RECORDED.items():
        yield _row(alter(walk, work / f"field_{name}", recordings))
        shutil.rmtree(work / f"field_{name}")
    yield _row(_rendered(work / "field_on_the_spot", *ON_THE_SPOT, "--seed", "3"))


def _rendered(folder: Path, *options: str) -> Path:
    command = [*BODYCAP, "synth", str(folder), "--seconds", "5", *options]
    subprocess.run(command, cwd=REPOSITORY, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return folder


def _row(capture: Path) -> Row:
    """Return a row that is evaluated with the person's own skeleton, which a rendered capture contains."""
    shutil.copy(capture / "gt" / "motion.bvh", capture / "skeleton.bvh")
    return row_of(capture)
