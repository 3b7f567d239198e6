"""A flipped bit in a small file of the store or the spool: nothing wrong is believed."""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from bodycap_batch.config.models import Job
from bodycap_batch.core.errors import StoreError
from bodycap_batch.pipeline.results import remove_outdated, write_results_file
from bodycap_batch.store import Store
from bodycap_batch.store.artefacts import MANIFEST, ArtefactKey
from bodycap_batch.store.checked_json import CHECKSUM, checked_json, parse_checked_json
from bodycap_batch.store.digests import FileDigests, file_sha256
from bodycap_batch.store.garbage_collection import collect_garbage
from bodycap_batch.store.references import References
from bodycap_batch.watch import active_watcher, job_rows, retry_job
from bodycap_batch.watch.dropped_job import JobPermissions, read_job, write_job
from bodycap_batch.watch.inbox_claim import dropped_name, input_path, return_to_inbox
from bodycap_batch.watch.job_status import JobStatusFile, read_status
from bodycap_batch.watch.spool import RETRY_PREFIX, JobDir, Spool
from bodycap_batch.watch.watcher_status import WatcherStatusFile


def flipped(path: Path) -> Iterator[None]:
    """Flip each bit of a file, one after another, and restore the file at the end."""
    before = path.read_bytes()
    assert before
    for position in range(len(before)):
        for bit in range(8):
            data = bytearray(before)
            data[position] ^= 1 << bit
            path.write_bytes(data)
            yield
    path.write_bytes(before)


def a_spool(tmp_path: Path) -> Spool:
    spool = Spool(inbox=tmp_path / "inbox", root=tmp_path)
    spool.make()
    return spool


def test_a_remembered_digest_with_a_flipped_bit_is_computed_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    video = tmp_path / "torso.mp4"
    video.write_bytes(b"frames")
    monkeypatch.setattr("bodycap_batch.store.digests._MIN_AGE_S", -1.0)
    digests = FileDigests(tmp_path / "digests")
    digest = digests.sha256(video)
    (entry,) = (tmp_path / "digests").iterdir()
    for _ in flipped(entry):
        assert digests.sha256(video) == digest == file_sha256(video)
    entry.write_text("0" * 64)  # as an earlier version wrote it: without a checksum
    assert digests.sha256(video) == digest
    read: list[int] = []
    assert digests.sha256(video, read.append) == digest
    assert read == [], "the entry was written again"


def test_a_remembered_digest_belongs_to_one_state_of_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bodycap_batch.store.digests._MIN_AGE_S", -1.0)
    digests = FileDigests(tmp_path / "digests")
    entries = []
    for name in ("torso", "head"):
        (tmp_path / name).write_text(name)
        digests.sha256(tmp_path / name)
        entries.append(max((tmp_path / "digests").iterdir(), key=os.path.getmtime))
        time.sleep(0.01)
    entries[0].write_bytes(entries[1].read_bytes())
    assert digests.sha256(tmp_path / "torso") == file_sha256(tmp_path / "torso")


def test_a_checked_file_with_a_flipped_bit_is_never_believed(tmp_path: Path) -> None:
    content = {"name": "größe \udcff", "number": 1.25, "none": None, "list": [1, "a"], "deep": {"b": True}}
    path = tmp_path / "file.json"
    path.write_text(checked_json(content), encoding="utf-8")
    assert parse_checked_json(path.read_bytes()) == content
    for _ in flipped(path):
        try:
            found = parse_checked_json(path.read_bytes())
        except ValueError:
            continue
        # A damaged name of the checksum makes a file of an earlier version. Nothing else differs.
        assert {name: found.get(name) for name in content} == content


def test_a_flipped_bit_in_the_status_of_a_job_gives_no_wrong_status(tmp_path: Path) -> None:
    spool = a_spool(tmp_path)
    job = JobDir(spool.failed / "walk")
    job.input.mkdir(parents=True)
    JobStatusFile(job).update(state="failed", dropped="walk", error={"message": "too dark", "hint": "light"})
    status = read_status(job)
    before = job_rows(spool)
    for _ in flipped(job.status):
        found = read_status(job)
        assert not found or {name: found.get(name) for name in status} == status
        (row,) = job_rows(spool)
        assert row == before[0] or (row.name, row.state, row.cause) == ("walk", "failed", "")


def test_a_flipped_bit_in_the_file_of_a_watcher_gives_no_wrong_watcher(tmp_path: Path) -> None:
    spool = a_spool(tmp_path)
    status_file = WatcherStatusFile(spool)
    status_file.write("")
    before = active_watcher(spool)
    assert before is not None
    for _ in flipped(tmp_path / ".watcher.json"):
        assert active_watcher(spool) in (before, None)
    status_file.remove()


def test_a_flipped_bit_in_the_stored_job_is_never_run(tmp_path: Path) -> None:
    spool = a_spool(tmp_path)
    job_dir = JobDir(spool.running / "walk")
    job_dir.input.mkdir(parents=True)
    video = job_dir.input / "torso.mp4"
    video.write_text("frames")
    fields = {"cameras": [{"name": "torso", "video": [str(video)], "calibration": "auto"}]}
    job = Job.model_validate({"capture": fields, "skeleton": "none"})
    write_job(job, job_dir, job_dir.input)
    permissions = JobPermissions()
    before = read_job(job_dir, permissions)
    for _ in flipped(job_dir.job):
        with pytest.raises(StoreError, match="the stored job is damaged") as caught:
            read_job(job_dir, permissions)
        assert "retry" in str(caught.value.hint)
    assert read_job(job_dir, permissions) == before
    job_dir.job.write_text(job_dir.job.read_text().partition("\n")[2])  # as an earlier version wrote it
    assert read_job(job_dir, permissions) == before


@pytest.mark.parametrize("kind", ["file", "folder"])
@pytest.mark.parametrize("name", ["walk", f"{RETRY_PREFIX}walk"])
def test_a_job_with_a_damaged_status_returns_to_the_inbox_complete(
    tmp_path: Path, kind: str, name: str
) -> None:
    spool = a_spool(tmp_path)
    job = JobDir(spool.failed / name)
    job.input.mkdir(parents=True)
    video = "monday.yaml" if kind == "file" else "torso.mp4"
    (job.input / video).write_text("content")
    JobStatusFile(job).update(kind=kind, dropped="monday.yaml" if kind == "file" else "monday")
    job.status.write_bytes(job.status.read_bytes().replace(b"monday", b"mondax"))
    assert read_status(job) == {}
    if kind == "file":
        assert input_path(job) == job.input / "monday.yaml"
        assert dropped_name(job) == "monday.yaml"
    target = retry_job(spool, "walk") if name == "walk" else return_to_inbox(spool, job)
    assert target is not None
    assert not target.name.startswith(".")
    assert (target if kind == "file" else target / video).read_text() == "content"
    assert not job.path.exists()


def test_a_flipped_bit_in_a_list_of_used_artefacts_removes_nothing(tmp_path: Path) -> None:
    store = Store(tmp_path / "store")
    key = ArtefactKey(stage="map", algorithm="1", options={}, inputs={}, libraries={})
    with store.draft(key) as draft:
        (draft.files / "a.txt").write_text("a")
        artefact = store.commit(draft, key, {})
    out = tmp_path / "out"
    out.mkdir()
    References(store, out).add(artefact.path)
    (path,) = (store.root / "references").iterdir()
    for _ in flipped(path):
        with contextlib.suppress(StoreError):
            assert collect_garbage(store, delete=True).artefacts == ()
        assert artefact.path.is_dir()
    path.write_bytes(b"\xff")
    with pytest.raises(StoreError, match="a list of used artefacts is damaged") as caught:
        collect_garbage(store, delete=True)
    assert caught.value.hint
    References(store, out).add(artefact.path)  # the next run of the job writes the list again
    assert collect_garbage(store, delete=True).kept == 1


def test_a_flipped_bit_in_the_record_of_a_run_removes_no_other_file(tmp_path: Path) -> None:
    record = {"files": ["motion.bvh"], "threads": 1}
    write_results_file(tmp_path, "run.json", checked_json(record))
    others = [tmp_path / f"{chr(ord('m') ^ (1 << bit))}otion.bvh" for bit in range(7)]
    for path in others:
        if path.parent == tmp_path:
            path.write_text("the user's own file")
    for _ in flipped(tmp_path / "run.json"):
        (tmp_path / "motion.bvh").write_text("an earlier result")
        remove_outdated(tmp_path, [])
        assert all(path.exists() for path in others if path.parent == tmp_path)
    remove_outdated(tmp_path, [])
    assert not (tmp_path / "motion.bvh").exists()


def test_a_flipped_bit_in_a_manifest_is_found(tmp_path: Path) -> None:
    store = Store(tmp_path)
    key = ArtefactKey(stage="map", algorithm="1", options={}, inputs={}, libraries={})
    with store.draft(key) as draft:
        (draft.files / "a.txt").write_text("a")
        path = store.commit(draft, key, {"seconds": 1.0}).path
    manifest = path / MANIFEST
    before = manifest.read_bytes()
    for position in range(len(before)):
        data = bytearray(before)
        data[position] ^= 1 << (position % 8)
        manifest.write_bytes(data)
        with pytest.raises(StoreError, match="damaged"):
            store.verify(path)
        (aside,) = (store.root / "corrupt").iterdir()
        aside.rename(path)
    assert CHECKSUM not in json.loads(before)
