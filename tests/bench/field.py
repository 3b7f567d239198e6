"""Captures as the field makes them: rendered, and recorded anew the way phones and covered lenses do.

``python -m tests.bench field``: one rendered walk of 5 seconds as phones film it (upright, strongly
compressed, of varying rate and exposure), with lenses that are covered for a while, and with cameras of
unlike rates and sizes; and one of somebody who turns on the spot, so that the cameras hardly move.
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
    """Scored against the wearer's own skeleton, which a rendered capture keeps with its truth."""
    shutil.copy(capture / "gt" / "motion.bvh", capture / "skeleton.bvh")
    return row_of(capture)
