"""A small real job, killed at every commit and at random moments: it always ends with the same bytes."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest

from tests.pipeline.tiny_job import Place, same

pytestmark = pytest.mark.slow

SEED = "BODYCAP_KILL_SEED"
RANDOM_KILLS = 8
COMMITS = "/artefacts/"
DRAFTS = ("check", "keyframes", "map")
"""Stages that are killed at the other renamings of a draft, too, which are the same code in every stage: one
that runs once, one that runs for all cameras at the same time, and one that renames a folder of its own."""
PUBLISHED = {"motion.bvh", "frames.csv", "metrics.json", "report.html", "run.json", "trajectories/torso.tum"}
"""Files of the results at which the job is killed: one loop publishes all files of a stage."""


def killed_at(place: Place, when: str, what: str) -> list[str]:
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


def test_killed_before_every_commit_and_publication_it_ends_with_the_same_bytes(
    place: Place, reference: Place
) -> None:
    files = "|".join(re.escape(name) for name in sorted(PUBLISHED))
    stored = f"{COMMITS}|/[.]store/(digests|references)($|/)|/[.]store/tmp/({'|'.join(DRAFTS)})($|/)"
    points = killed_at(place, "before", f"{stored}|/out/({files})$")
    committed = [line for line in points if COMMITS in line]
    assert len(committed) == len(place.manifests()) >= 8
    assert sum(line.endswith("/files/manifest.json") for line in points) == len(DRAFTS)
    assert {"digests", "references"} <= {part for line in points for part in Path(line).parts}
    published = {Path(line).relative_to(place.out).as_posix() for line in points if ".store" not in line}
    assert published == PUBLISHED
    same(place, reference)


def test_killed_after_every_commit_it_ends_with_the_same_bytes(place: Place, reference: Place) -> None:
    """After a renaming that is no commit nothing is different until just before the next one."""
    assert len(killed_at(place, "after", COMMITS)) == len(place.manifests()) >= 8
    same(place, reference)


def test_killed_at_random_moments_it_ends_with_the_same_bytes(place: Place, reference: Place) -> None:
    seed = int(os.environ.get(SEED) or np.random.SeedSequence().generate_state(1)[0])
    print(f"{SEED}={seed}")
    rng = np.random.default_rng(seed)
    whole_s = json.loads((reference.out / "run.json").read_text())["seconds"]
    kills = completed = 0
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
