"""A small real job, killed at every renaming and at random moments: it always ends with the same bytes."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from tests.pipeline.tiny_job import STAGES, Place, same

pytestmark = pytest.mark.slow

SEED = "BODYCAP_KILL_SEED"
RANDOM_KILLS = 20


def killed_at(place: Place, when: str, what: str = "") -> list[str]:
    """Run until it is killed at no renaming any more; returns those it was killed at, one a run."""
    place.order(kill=when, at=what, done=str(place.folder / "done.txt"))
    kills = 0
    while (end := place.run())[0] == -signal.SIGKILL:
        kills += 1
        assert kills < 150, "no progress"
    assert end[0] == 0, end[2]
    points = (place.folder / "done.txt").read_text().splitlines()
    assert len(points) == kills
    return points


def test_killed_before_every_renaming_it_ends_with_the_same_bytes(place: Place, reference: Place) -> None:
    points = killed_at(place, "before")
    committed = [line for line in points if "/artefacts/" in line]
    assert len(committed) == len(place.manifests()) >= 8
    assert sum(line.endswith("/files/manifest.json") for line in points) >= len(STAGES)
    published = {Path(line).relative_to(place.out).as_posix() for line in points if ".store" not in line}
    assert published >= {"motion.bvh", "frames.csv", "metrics.json", "run.json", "trajectories/torso.tum"}
    same(place, reference)


def test_killed_after_every_commit_it_ends_with_the_same_bytes(place: Place, reference: Place) -> None:
    """After a renaming that is no commit nothing is different until just before the next one."""
    assert len(killed_at(place, "after", "/artefacts/")) == len(place.manifests()) >= 8
    same(place, reference)


def test_killed_at_random_moments_it_ends_with_the_same_bytes(place: Place, reference: Place) -> None:
    seed = int(os.environ.get(SEED) or np.random.SeedSequence().generate_state(1)[0])
    print(f"{SEED}={seed}")
    rng = np.random.default_rng(seed)
    started_s = time.monotonic()
    assert place.run()[0] == 0
    whole_s = time.monotonic() - started_s
    same(place, reference)
    kills = completed = 0
    place.remove_results()
    while kills < RANDOM_KILLS:
        process = place.start()
        try:
            process.communicate(timeout=rng.uniform(0.0, whole_s))
        except subprocess.TimeoutExpired:
            place.kill(process)
            kills += 1
            continue
        assert process.returncode == 0
        completed += 1
        same(place, reference)
        place.remove_results()
    code, _, err = place.run()
    assert code == 0, err
    same(place, reference)
    print(f"{kills} kills within {whole_s:.1f} s each, {completed} runs completed between them")
