"""Uploads of the live page: names, sizes, idle uploads, and requests at the same time."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from bodycap_batch.config.limits import Limits
from bodycap_batch.core.errors import BodycapError, JobError
from bodycap_batch.watch.spool import Spool
from bodycap_batch.watch.web.uploads import Uploads


class UploadFixture:
    """An empty spool with a receiver of uploads, and a clock that the test sets."""

    def __init__(self, folder: Path) -> None:
        self.now = 0.0
        self.spool = Spool(inbox=folder / "inbox", root=folder)
        self.spool.make()
        self.uploads = Uploads(self.spool, Limits(), lambda: self.now)

    def send(self, key: str, name: str, *chunks: bytes) -> None:
        async def content() -> AsyncIterator[bytes]:
            for chunk in chunks:
                yield chunk

        asyncio.run(self.uploads.write(key, name, len(b"".join(chunks)), content()))


@pytest.fixture
def page(tmp_path: Path) -> UploadFixture:
    return UploadFixture(tmp_path)


@pytest.mark.parametrize(
    ("name", "chunk", "message"),
    [
        ("torso.mp4", b"", "the file is empty"),
        (f"{'x' * 250}.mp4", b"x", "is too long: 254 bytes"),
        (f"{'ü' * 125}.mp4", b"x", "is too long: 254 bytes"),
        (f"{'x' * 254}/torso.mp4", b"x", "is too long: 254 bytes"),
        ("job.yaml/torso.mp4", b"x", "job.yaml is a folder, but only a file may have this name"),
        ("Calib.json/torso.mp4", b"x", "Calib.json is a folder, but only a file may have this name"),
        ("READY/torso.mp4", b"x", "READY is a folder, but only a file may have this name"),
    ],
    ids=lambda value: str(value)[:20],
)
def test_each_error_of_a_file_is_named(page: UploadFixture, name: str, chunk: bytes, message: str) -> None:
    key = page.uploads.start("walk")
    with pytest.raises(BodycapError) as found:
        page.send(key, name, chunk)
    assert message in found.value.message
    assert found.value.hint
    assert "disk" not in found.value.hint


def test_names_of_the_maximum_length_are_accepted(page: UploadFixture) -> None:
    key = page.uploads.start("w" * 200)
    page.send(key, f"{'ü' * 98}.mp4", b"x")
    assert page.uploads.finish(key) == "w" * 200


def test_the_name_of_a_job_is_not_too_long(page: UploadFixture) -> None:
    with pytest.raises(JobError, match="is too long: 254 bytes"):
        page.uploads.start("w" * 254)


def test_uploads_without_data_do_not_block_others(page: UploadFixture) -> None:
    keys = []
    for number in range(8):
        page.now = 100.0 * number
        keys.append(page.uploads.start(f"walk {number}"))
    page.now = 900.0
    with pytest.raises(JobError, match="8 folders are being sent already"):
        page.uploads.start("one more")
    page.now = 901.0
    page.uploads.start("one more")
    with pytest.raises(JobError, match="does not exist or has ended"):
        page.uploads.finish(keys[0])
    with pytest.raises(JobError, match="no video was sent"):
        page.uploads.finish(keys[1])
    page.now = 1e6
    page.uploads.remove_idle()
    assert list(page.spool.inbox.iterdir()) == []


def test_an_upload_that_receives_data_is_kept(page: UploadFixture) -> None:
    key = page.uploads.start("walk")

    async def content() -> AsyncIterator[bytes]:
        for _ in range(10):
            page.now += 800.0
            yield b"x"
            page.uploads.remove_idle()

    asyncio.run(page.uploads.write(key, "torso.mp4", 10, content()))
    assert page.uploads.finish(key) == "walk"


def test_a_folder_can_be_finished_as_soon_as_its_file_is_complete(page: UploadFixture) -> None:
    key = page.uploads.start("walk")
    answers: list[str] = []

    class Lock:
        """A lock. At each release, a request tries to finish the upload."""

        def __init__(self) -> None:
            self._lock = threading.Lock()
            self._is_finishing = False

        def __enter__(self) -> None:
            self._lock.acquire()

        def __exit__(self, *_: object) -> None:
            self._lock.release()
            if self._is_finishing or "walk" in answers:
                return
            self._is_finishing = True
            try:
                answers.append(page.uploads.finish(key))
            except JobError as error:
                answers.append(error.message)
            self._is_finishing = False

    page.uploads._lock = Lock()  # type: ignore[assignment]
    page.send(key, "torso.mp4", b"x")
    assert answers == ["torso.mp4: the browser is still sending this file", "walk"]
