"""A spool and a store that version 0.1.0 left: this version takes them over and loses no job.

The archive was made with version 0.1.0 and stand-in stages. Job "first" is done. The watcher was killed
during the merge of job "second". Job "third" waits in the inbox.
"""

from __future__ import annotations

import tarfile
from pathlib import Path

import pytest

from bodycap_batch.store import Store
from bodycap_batch.watch import job_rows
from tests.pipeline.spools import SpoolFixture

ARCHIVE = Path(__file__).with_name("kept") / "spool_0_1_0.tar.xz"
MADE_IN = "/srv/captures"
"""The folder in which the archive was made; its files name it."""


@pytest.fixture
def bench(tmp_path: Path) -> SpoolFixture:
    bench = SpoolFixture(tmp_path)
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(tmp_path, filter="data")
    for path in tmp_path.joinpath("jobs").rglob("*.json"):
        text = path.read_text(encoding="utf-8")
        if MADE_IN in text and "artefacts" not in path.parts:
            path.write_text(text.replace(MADE_IN, str(tmp_path)), encoding="utf-8")
    return bench


def test_the_states_of_old_jobs_are_known(bench: SpoolFixture) -> None:
    states = {row.name: row.state for row in job_rows(bench.spool)}
    assert states["first"] == "done"
    assert states["third"] == "waiting"
    assert states["second"] in ("running", "interrupted")


@pytest.mark.slow
def test_no_old_job_is_lost(bench: SpoolFixture) -> None:
    finished = bench.spool.done / "first" / "result" / "run.json"
    before = finished.read_bytes()
    assert bench.run_once() == 0
    assert {path.name for path in bench.spool.done.iterdir()} >= {"first", "second", "third"}
    assert finished.read_bytes() == before
    assert bench.status("second")["attempts"] == 2
    for name in ("second", "third"):
        assert (bench.job(name).path / "result" / "result.bvh").exists()


def test_an_old_store_is_read(bench: SpoolFixture) -> None:
    store = Store(bench.spool.root / ".store")
    artefacts = [path.parent for path in store.root.glob("artefacts/*/*/manifest.json")]
    assert {path.parent.name for path in artefacts} >= {"check", "keyframes", "map", "registration"}
    for path in artefacts:
        store.verify(path)
