"""The artefact store: keys, atomic commits, verified look-ups, full disks, races."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from bodycap_batch.core.errors import CaptureError, StoreError
from bodycap_batch.pipeline.results import publish
from bodycap_batch.store.artefacts import MANIFEST, Artefact, ArtefactKey, Store
from bodycap_batch.store.digests import (
    FileDigests,
    file_sha256,
    json_digest,
    remove_abandoned,
    temporary_beside,
)

ROOT = Path(__file__).parents[3]


def key(**changes: object) -> ArtefactKey:
    values: dict[str, object] = {
        "stage": "map",
        "algorithm": "1",
        "options": {"features": 100},
        "inputs": {"video": "abc"},
        "libraries": {"numpy": "2"},
    }
    return ArtefactKey(**{**values, **changes})  # type: ignore[arg-type]


def make(store: Store, which: ArtefactKey, files: dict[str, bytes]) -> Artefact:
    with store.draft(which) as draft:
        for name, data in files.items():
            path = draft.files / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        return store.commit(draft, which, {"seconds": 1.0})


def test_nothing_is_found_before_it_is_made(tmp_path: Path) -> None:
    assert Store(tmp_path).find(key()) is None


def test_an_artefact_is_found_again_by_another_store_object(tmp_path: Path) -> None:
    made = make(Store(tmp_path), key(), {"a.txt": b"one", "deep/b.bin": b"\0\1"})
    found = Store(tmp_path).find(key())
    assert found == made
    assert (found.path / "deep" / "b.bin").read_bytes() == b"\0\1"
    assert found.made == {"seconds": 1.0}


@pytest.mark.parametrize(
    "change",
    [
        {"stage": "merge"},
        {"algorithm": "2"},
        {"options": {"features": 101}},
        {"inputs": {"video": "abd"}},
        {"libraries": {"numpy": "2.1"}},
    ],
)
def test_every_part_of_the_key_counts(tmp_path: Path, change: dict[str, object]) -> None:
    store = Store(tmp_path)
    make(store, key(), {"a.txt": b"one"})
    assert store.find(key(**change)) is None


def test_the_order_of_options_does_not_count() -> None:
    assert key(options={"a": 1, "b": 2}).name == key(options={"b": 2, "a": 1}).name


def test_equal_content_has_an_equal_digest_whatever_it_was_made_from(tmp_path: Path) -> None:
    store = Store(tmp_path)
    first = make(store, key(), {"a.txt": b"one", "database.db": b"first"})
    second = make(store, key(algorithm="2"), {"a.txt": b"one", "database.db": b"second"})
    third = make(store, key(algorithm="3"), {"a.txt": b"two", "database.db": b"first"})
    assert first.digest == second.digest != third.digest


@pytest.mark.parametrize("name", ["a.txt", "deep/b.bin", "database.db", MANIFEST])
def test_a_flipped_byte_is_noticed_set_aside_and_rebuilt(tmp_path: Path, name: str) -> None:
    store = Store(tmp_path)
    files = {"a.txt": b"one", "deep/b.bin": b"0123", "database.db": b"rows"}
    victim = make(store, key(), files).path / name
    data = bytearray(victim.read_bytes())
    data[len(data) // 2] ^= 1
    victim.write_bytes(data)
    assert store.find(key()) is None
    assert len(list((tmp_path / "corrupt").iterdir())) == 1
    assert make(store, key(), files) == store.find(key())


@pytest.mark.parametrize("name", ["a.txt", MANIFEST])
def test_a_missing_file_is_noticed(tmp_path: Path, name: str) -> None:
    store = Store(tmp_path)
    (make(store, key(), {"a.txt": b"one"}).path / name).unlink()
    assert store.find(key()) is None


def test_an_artefact_under_another_key_is_not_taken(tmp_path: Path) -> None:
    store = Store(tmp_path)
    made = make(store, key(), {"a.txt": b"one"})
    other = key(algorithm="2")
    shutil.copytree(made.path, made.path.with_name(other.name))
    assert store.find(other) is None


def test_a_draft_leaves_nothing_behind(tmp_path: Path) -> None:
    store = Store(tmp_path)

    def fail() -> None:
        with store.draft(key()) as draft:
            (draft.work / "scratch").write_bytes(b"x")
            (draft.work / "missing").read_bytes()

    with pytest.raises(FileNotFoundError):
        fail()
    assert list((tmp_path / "tmp").iterdir()) == []
    assert store.find(key()) is None


def test_the_second_of_two_commits_returns_the_first(tmp_path: Path) -> None:
    store = Store(tmp_path)
    with store.draft(key()) as slow:
        (slow.files / "a.txt").write_bytes(b"slow")
        first = make(store, key(), {"a.txt": b"fast"})
        second = store.commit(slow, key(), {"seconds": 9.0})
    assert second == first
    assert (second.path / "a.txt").read_bytes() == b"fast"


def test_a_corrupt_rival_is_replaced(tmp_path: Path) -> None:
    store = Store(tmp_path)
    with store.draft(key()) as slow:
        (slow.files / "a.txt").write_bytes(b"good")
        (make(store, key(), {"a.txt": b"good"}).path / "a.txt").write_bytes(b"evil")
        store.commit(slow, key(), {})
    found = store.find(key())
    assert found is not None
    assert (found.path / "a.txt").read_bytes() == b"good"


@pytest.mark.parametrize("how", ["find", "verify"])
def test_what_another_process_has_made_anew_is_not_set_aside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    slow, quick = Store(tmp_path), Store(tmp_path)
    damaged = make(quick, key(), {"a.txt": b"good"}).path
    (damaged / "a.txt").write_bytes(b"evil")
    set_aside = slow._set_aside

    def later(path: Path, look: Callable[[], Any]) -> Any:
        """Between the first look and the last one, another process finds the damage and mends it."""
        assert quick.find(key()) is None
        make(quick, key(), {"a.txt": b"good"})
        return set_aside(path, look)

    monkeypatch.setattr(slow, "_set_aside", later)
    if how == "find":
        found = slow.find(key())
        assert found is not None
        assert found.path == damaged
    else:
        slow.verify(damaged)
    assert (damaged / "a.txt").read_bytes() == b"good"
    assert [(path / "a.txt").read_bytes() for path in (tmp_path / "corrupt").iterdir()] == [b"evil"]


def test_one_process_at_a_time_takes_artefacts_from_their_places(tmp_path: Path) -> None:
    stores = [Store(tmp_path) for _ in range(4)]
    barrier = threading.Barrier(len(stores), timeout=60)

    def mend(store: Store) -> None:
        """Damage, find and make anew, over and over; what a commit returned must be there and sound."""
        for _ in range(20):
            barrier.wait()
            if (found := store.find(key())) is None:
                found = make(store, key(), {"a.txt": b"good"})
            barrier.wait()
            assert (found.path / "a.txt").read_bytes() == b"good"
            if barrier.wait() == 0:
                (found.path / "a.txt").write_bytes(b"evil")

    with ThreadPoolExecutor(len(stores)) as pool:
        for work in [pool.submit(mend, store) for store in stores]:
            work.result()


def test_what_is_made_anew_where_nothing_lay_is_not_set_aside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slow, quick = Store(tmp_path), Store(tmp_path)
    damaged = make(quick, key(), {"a.txt": b"good"}).path
    (damaged / "a.txt").write_bytes(b"evil")
    look, looks = slow._verified, []

    def late(path: Path, wanted: ArtefactKey) -> Any:
        """After the first look another process takes the damage away, after the last it has mended it."""
        found = look(path, wanted)
        looks.append(found)
        if len(looks) == 1:
            assert quick.find(key()) is None
        else:
            make(quick, key(), {"a.txt": b"good"})
        return found

    monkeypatch.setattr(slow, "_verified", late)
    assert slow.find(key()) is None
    assert looks == [None, None]
    assert (damaged / "a.txt").read_bytes() == b"good"


_COMMIT = """
import sys
from pathlib import Path
from bodycap_batch.store.artefacts import ArtefactKey, Store
store = Store(Path(sys.argv[1]))
key = ArtefactKey(stage="map", algorithm="1", options={}, inputs={}, libraries={})
with store.draft(key) as draft:
    (draft.files / "a.bin").write_bytes(b"same" * 100_000)
    sys.stdin.read()
    print(store.commit(draft, key, {}).digest)
"""


def test_two_processes_commit_the_same_artefact(tmp_path: Path) -> None:
    children = [
        subprocess.Popen(
            [sys.executable, "-c", _COMMIT, str(tmp_path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=ROOT,
        )
        for _ in range(2)
    ]
    for child in children:
        assert child.stdin is not None
        child.stdin.close()
        child.stdin = None
    digests = {child.communicate(timeout=30)[0].strip() for child in children}
    assert [child.returncode for child in children] == [0, 0]
    assert len(digests) == 1
    assert "" not in digests
    assert len(list((tmp_path / "artefacts" / "map").iterdir())) == 1
    assert list((tmp_path / "tmp").iterdir()) == []


def test_many_threads_commit_and_find(tmp_path: Path) -> None:
    store = Store(tmp_path)
    found: list[Artefact] = []
    threads = [
        threading.Thread(target=lambda: found.append(make(store, key(), {"a.txt": b"one"}))) for _ in range(8)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 8
    assert {artefact.digest for artefact in found} == {found[0].digest}


def test_sweeping_removes_the_draft_of_a_killed_process_only(tmp_path: Path) -> None:
    store = Store(tmp_path)
    script = (
        "import os, sys\nfrom pathlib import Path\nfrom bodycap_batch.store import ArtefactKey, Store\n"
        "key = ArtefactKey(stage='map', algorithm='1', options={}, inputs={}, libraries={})\n"
        "with Store(Path(sys.argv[1])).draft(key):\n    os.kill(os.getpid(), 9)\n"
    )
    done = subprocess.run([sys.executable, "-c", script, str(tmp_path)], check=False, cwd=ROOT)
    assert done.returncode == -9
    with store.draft(key()) as mine:
        assert len(list((tmp_path / "tmp").iterdir())) == 2
        assert store.sweep() == 1
        assert mine.files.is_dir()


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EIO])
def test_disk_failures_become_typed_errors_with_a_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    store = Store(tmp_path)

    def fail(handle: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(StoreError) as caught:
        make(store, key(), {"a.txt": b"one"})
    assert caught.value.exit_code == 5
    assert "--store" in str(caught.value.hint)
    monkeypatch.undo()
    assert store.find(key()) is None


def test_a_file_in_the_place_of_the_store_is_named(tmp_path: Path) -> None:
    (tmp_path / "store").write_text("a file")
    with pytest.raises(StoreError, match="store"):
        Store(tmp_path / "store")


def test_only_what_dead_processes_left_is_removed(tmp_path: Path) -> None:
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    mine = temporary_beside(tmp_path / "motion.bvh").name
    own = f".{os.getpid()}."
    assert own in mine
    machine = mine.split(own)[0].rpartition(".")[2]
    elsewhere = mine.replace(own, f".{dead.pid}.").replace(machine, "0123abcd")
    names = [mine.replace(own, f".{dead.pid}."), mine, elsewhere, ".mine.part", "a.part"]
    for name in names:
        (tmp_path / name).touch()
    remove_abandoned(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(names[1:])


def test_a_digest_is_remembered_until_the_file_changes(tmp_path: Path) -> None:
    video = tmp_path / "video.mp4"
    video.write_bytes(b"frames")
    old = time.time() - 100
    digests = FileDigests(tmp_path / "digests")
    os.utime(video, (old, old))
    first = digests.sha256(video)
    assert first == file_sha256(video)
    data = video.stat()
    video.write_bytes(b"frAmes")
    os.utime(video, ns=(data.st_atime_ns, data.st_mtime_ns))
    assert digests.sha256(video) == file_sha256(video) != first


def test_a_remembered_digest_is_not_computed_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    video = tmp_path / "video.mp4"
    video.write_bytes(b"frames")
    monkeypatch.setattr("bodycap_batch.store.digests._MIN_AGE_S", -1.0)
    digests = FileDigests(tmp_path / "digests")
    first, read = digests.sha256(video), []
    assert digests.sha256(video, read.append) == first
    assert read == []


def test_a_broken_entry_of_the_digests_is_not_believed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    video = tmp_path / "video.mp4"
    video.write_bytes(b"frames")
    monkeypatch.setattr("bodycap_batch.store.digests._MIN_AGE_S", -1.0)
    digests = FileDigests(tmp_path / "digests")
    first = digests.sha256(video)
    for entry in (tmp_path / "digests").iterdir():
        entry.write_text("")
    assert digests.sha256(video) == first


def test_another_link_to_a_file_while_it_is_read_is_no_change_of_the_file(tmp_path: Path) -> None:
    video = tmp_path / "video.mp4"
    video.write_bytes(b"0" * 100)
    links = iter(range(9))
    found = FileDigests(tmp_path / "digests").sha256(
        video, lambda _: os.link(video, tmp_path / f"{next(links)}.mp4")
    )
    assert found == file_sha256(video)
    assert next(links) == 2, "the file is read twice"


def test_results_are_published_while_another_job_verifies_them(tmp_path: Path) -> None:
    store = Store(tmp_path / "store")
    made = make(store, key(), {"preview.mp4": bytes(4 << 20)})
    stop = threading.Event()

    def publish_again_and_again() -> None:
        number = 0
        while not stop.is_set():
            publish({"preview.mp4": made.path / "preview.mp4"}, tmp_path / f"out{number}")
            number += 1

    with ThreadPoolExecutor() as pool:
        publishing = pool.submit(publish_again_and_again)
        try:
            assert all(store.find(key()) == made for _ in range(20))
        finally:
            stop.set()
        publishing.result()


def test_a_file_that_grows_while_it_is_read_is_refused(tmp_path: Path) -> None:
    video = tmp_path / "video.mp4"
    video.write_bytes(b"0" * 100)

    def grow(_: int) -> None:
        with video.open("ab") as stream:
            stream.write(b"more" if video.stat().st_size < 1000 else b"")

    with pytest.raises(CaptureError, match="changed while the program read it"):
        FileDigests(tmp_path / "digests").sha256(video, grow)


def test_json_digests_depend_on_values_not_on_order() -> None:
    assert json_digest({"a": 1, "b": [1.5, None]}) == json_digest({"b": [1.5, None], "a": 1})
    assert json_digest({"a": 1}) != json_digest({"a": 2})
    with pytest.raises(ValueError, match="JSON"):
        json_digest({"a": float("nan")})


def test_the_manifest_can_be_read_by_anyone(tmp_path: Path) -> None:
    made = make(Store(tmp_path), key(), {"a.txt": b"one"})
    manifest = json.loads((made.path / MANIFEST).read_text())
    assert manifest["key"]["options"] == {"features": 100}
    assert manifest["files"]["a.txt"] == file_sha256(made.path / "a.txt")
