"""Fixtures shared by the tests of whole jobs."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from bodycap_batch.cli import main
from tests.broken import sound
from tests.pipeline.fake_stages import ORDERS
from tests.pipeline.spools import SpoolFixture
from tests.pipeline.tiny_job import STAGES, Place


@pytest.fixture(scope="session")
def sound_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A valid job of two cameras, rendered once; a test that changes it works on a copy."""
    folder = tmp_path_factory.mktemp("sound")
    sound(folder)
    return folder


@pytest.fixture(scope="session")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Place:
    """The job after an uninterrupted run, made once for all test processes. No test changes it."""
    shared = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        shared = shared.parent
    folder, complete = shared / "reference", shared / "reference-complete"
    with (shared / "reference-lock").open("w") as making:
        fcntl.flock(making, fcntl.LOCK_EX)
        if not complete.exists():
            shutil.rmtree(folder, ignore_errors=True)
            place = Place(folder)
            assert main(["run", str(folder / "tiny.yaml"), "--out", str(place.out)]) == 0
            complete.touch()
    place = Place.existing(folder)
    names = set(place.content())
    assert {"motion.bvh", "frames.csv", "metrics.json", "trajectories/torso.tum"} <= names
    assert {name.split("/")[1] for name in names if name.startswith("artefacts/")} >= set(STAGES)
    return place


@pytest.fixture
def place(tmp_path: Path, reference: Place) -> Place:
    return Place(tmp_path / "job", reference.folder / "capture")


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[SpoolFixture]:
    """A watched folder with stand-in stages; the working directory is its parent."""
    bench = SpoolFixture(tmp_path)
    monkeypatch.setenv(ORDERS, str(bench.orders))
    monkeypatch.chdir(tmp_path)
    yield bench
    bench.close()
