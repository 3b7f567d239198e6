"""Parts of the watched folder: complete entries, claims, names and paths."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from bodycap_batch.config.job import load_job
from bodycap_batch.config.models import Job
from bodycap_batch.core.errors import CaptureError, JobError, StoreError
from bodycap_batch.formats.file_completeness import MissingPart
from bodycap_batch.watch.dropped_job import (
    JobPermissions,
    make_result_paths_relative,
    read_dropped_job,
    read_job,
)
from bodycap_batch.watch.inbox_claim import claim_entry
from bodycap_batch.watch.inbox_entries import (
    CompletionTracker,
    InboxEntry,
    entries_in,
    latest_change,
    reason_to_wait,
    take_snapshot,
)
from bodycap_batch.watch.spool import JobDir, Spool, folder_name_from_text, move_to_free_name, spool_from_path
from tests.videos import textured_frame, unopened, write_video

ROOT = Path(__file__).parents[3]


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def completed(tracker: CompletionTracker, inbox: Path) -> list[str]:
    return [entry.name for entry, _ in tracker.complete_entries(entries_in(inbox))]


def waits_for(folder: Path) -> str:
    entry = InboxEntry(folder)
    return reason_to_wait(entry, take_snapshot(entry, 100), 100)


def test_a_folder_is_complete_when_it_is_unchanged_for_long_enough(tmp_path: Path) -> None:
    clock = Clock()
    tracker = CompletionTracker(10.0, 100, clock)
    folder = tmp_path / "walk"
    folder.mkdir()
    assert completed(tracker, tmp_path) == []
    clock.now += 60
    assert completed(tracker, tmp_path) == []  # the folder is empty
    video = folder / "torso.mp4"
    for size in (100, 200):
        video.write_bytes(unopened("x" * size))
        assert completed(tracker, tmp_path) == []
        clock.now += 9.9
        assert completed(tracker, tmp_path) == []
    os.utime(video, ns=(1, 1))  # a copy that preserves times sets them at its end
    assert completed(tracker, tmp_path) == []
    clock.now += 10
    assert completed(tracker, tmp_path) == ["walk"]


@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".avi"])
def test_a_copy_that_stalls_is_never_processed_in_parts(tmp_path: Path, suffix: str) -> None:
    clock = Clock()
    tracker = CompletionTracker(10.0, 100, clock)
    whole = write_video(tmp_path / "outside" / f"torso{suffix}", [textured_frame(0)] * 9).read_bytes()
    shutil.rmtree(tmp_path / "outside")
    video = tmp_path / "walk" / "head" / f"torso{suffix}"
    video.parent.mkdir(parents=True)
    for length in (0, len(whole) // 3, len(whole) // 2, len(whole) - 20):
        video.write_bytes(whole[:length])
        assert completed(tracker, tmp_path) == []
        clock.now += 600
        assert completed(tracker, tmp_path) == []
        assert f"head/torso{suffix} is not complete" in tracker.incomplete[tmp_path / "walk"]
        assert "after 30 minutes" in waits_for(tmp_path / "walk")
    video.write_bytes(whole)
    assert completed(tracker, tmp_path) == []
    clock.now += 10
    assert completed(tracker, tmp_path) == ["walk"]
    assert tracker.incomplete == {}


def test_a_damaged_video_does_not_wait_for_ever(tmp_path: Path) -> None:
    clock = Clock()
    tracker = CompletionTracker(10.0, 100, clock)
    video = tmp_path / "walk" / "torso.mp4"
    write_video(video, [textured_frame(0)] * 9)
    video.write_bytes(video.read_bytes()[:-9])
    completed(tracker, tmp_path)
    clock.now += 1799
    assert completed(tracker, tmp_path) == []
    clock.now += 1
    assert completed(tracker, tmp_path) == ["walk"]
    video.write_bytes(video.read_bytes()[:-1])
    assert completed(tracker, tmp_path) == [], "a change starts the time anew"
    (tmp_path / "walk" / "READY").touch()
    assert completed(tracker, tmp_path) == ["walk"], "the user says that it is complete"


def test_an_unchanged_entry_is_opened_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock, opened = Clock(), []
    tracker = CompletionTracker(10.0, 100, clock)
    (tmp_path / "walk").mkdir()
    (tmp_path / "walk" / "torso.mp4").touch()

    def look(path: Path, _: object) -> MissingPart:
        opened.append(path)
        return MissingPart(text="something")

    monkeypatch.setattr("bodycap_batch.config.unfinished_videos.missing_part", look)
    for _ in range(5):
        assert completed(tracker, tmp_path) == []
        clock.now += 20
    assert len(opened) == 1


UNFINISHED = (
    "head.mp4.part",
    "head.mp4.partial",
    "head.mp4.filepart",
    "head.mp4.tmp",
    "head.mp4.crdownload",
    "head.mp4.!sync",
    "head.MP4~",
    "head.mp4.download/Info.plist",
    ".head.mp4.Xy3abc",
    ".syncthing.head.mp4.tmp",
    "head/.GX01.MP4.tmp",
    "head/GX01.MP4.7f3a.unheard_of",
)
"""Names of files that programs write until a video is complete. Nothing is known about their content."""
CUT = ("Unconfirmed 1234.crdownload", "head.filepart", "5f1e.tmp", ".rsync-partial/head.mp4", ".head.mp4")
"""The same, for names that do not say it. The content is the start of a video."""


@pytest.mark.parametrize(("left", "is_cut"), [*((n, False) for n in UNFINISHED), *((n, True) for n in CUT)])
def test_an_unfinished_copy_delays_a_folder_and_its_job_never_runs(
    tmp_path: Path, left: str, is_cut: bool
) -> None:
    clock = Clock()
    tracker = CompletionTracker(10.0, 100, clock)
    spool = spool_from_path(tmp_path)
    spool.make()
    walk = spool.inbox / "walk"
    (walk / left).parent.mkdir(parents=True)
    (walk / left).write_bytes(unopened()[:-1] if is_cut else b"anything")
    (walk / "torso.mp4").write_bytes(unopened())
    assert completed(tracker, spool.inbox) == []
    for _ in range(3):  # it grows
        clock.now += 1000
        with (walk / left).open("ab") as stream:
            stream.write(b"" if is_cut else b"more")
        os.utime(walk / left, (clock.now, clock.now))
        assert completed(tracker, spool.inbox) == []
    clock.now += 1799
    assert completed(tracker, spool.inbox) == []
    reason = tracker.incomplete[walk]
    assert reason.startswith(f"{left} is not complete: ")
    assert "after 30 minutes" in reason
    assert waits_for(walk) == reason
    clock.now += 1
    ((entry, snapshot),) = tracker.complete_entries(entries_in(spool.inbox))
    claimed = claim_entry(spool, entry, snapshot, JobPermissions())
    assert claimed is not None
    status = json.loads(claimed.status.read_text())
    assert (status["state"], status["exit_code"]) == ("failed", CaptureError.exit_code)
    assert status["error"]["path"] == str(spool.failed / "walk" / "input" / left)


@pytest.mark.parametrize("left", UNFINISHED)
def test_a_user_can_say_that_a_folder_is_complete(tmp_path: Path, left: str) -> None:
    (tmp_path / "walk" / left).parent.mkdir(parents=True)
    (tmp_path / "walk" / left).touch()
    tracker = CompletionTracker(10.0, 100, Clock())
    assert completed(tracker, tmp_path) == []
    (tmp_path / "walk" / "READY").touch()
    assert completed(tracker, tmp_path) == ["walk"]


def test_a_copy_beside_its_whole_video_delays_a_folder_while_it_grows(tmp_path: Path) -> None:
    clock = Clock()
    tracker = CompletionTracker(10.0, 100, clock)
    walk = tmp_path / "walk"
    walk.mkdir()
    (walk / "torso.mp4").write_bytes(unopened("the first version"))
    copy = walk / ".torso.mp4.Xy3abc"
    for length in range(20, 30):
        copy.write_bytes(unopened("the second version")[:length])
        clock.now += 9
        assert completed(tracker, tmp_path) == []
    clock.now += 1800
    assert completed(tracker, tmp_path) == ["walk"]
    assert list(load_job(walk).capture.cameras[0].video) == [walk / "torso.mp4"]


HOUSEKEEPING = (
    ".DS_Store",
    "._torso.mp4",
    "._head.mp4",
    ".@__thumb/s100torso.mp4",
    ".@__thumb/default torso.mp4.jpg",
    ".AppleDouble/torso.mp4",
    ".sync.ffs_db",
    ".dropbox.attr",
    ".nfs000000000012",
    ".fuse_hidden0001",
    ".unheard_of/anything",
    "@eaDir/torso.mp4@SynoEAStream",
    "@eaDir/torso.mp4/SYNOVIDEO_VIDEO_SCREENSHOT.jpg",
    "desktop.ini",
    "Thumbs.db",
)


@pytest.mark.parametrize("name", HOUSEKEEPING)
def test_a_file_that_a_system_keeps_for_itself_delays_nothing(tmp_path: Path, name: str) -> None:
    clock = Clock()
    tracker = CompletionTracker(10.0, 100, clock)
    (tmp_path / "walk" / name).parent.mkdir(parents=True)
    (tmp_path / "walk" / name).write_bytes(np.random.default_rng(0).bytes(300))
    (tmp_path / "walk" / "torso.mp4").write_bytes(unopened())
    assert completed(tracker, tmp_path) == []
    clock.now += 9
    if name not in ("desktop.ini", "Thumbs.db"):
        (tmp_path / "walk" / name).write_bytes(b"changed")
    assert completed(tracker, tmp_path) == []
    clock.now += 1
    assert completed(tracker, tmp_path) == ["walk"]
    assert [camera.name for camera in load_job(tmp_path / "walk").capture.cameras] == ["torso"]


def test_every_reason_to_wait_has_a_limit(tmp_path: Path) -> None:
    clock = Clock()
    tracker = CompletionTracker(10.0, 100, clock)
    (tmp_path / "empty").mkdir()
    (tmp_path / "restless").mkdir()
    (tmp_path / "restless" / "torso.mp4").write_bytes(unopened())
    assert completed(tracker, tmp_path) == []
    for number in range(180):
        (tmp_path / "restless" / "recorder.log").write_text(str(number))
        assert completed(tracker, tmp_path) == [], number
        clock.now += 10
    assert tracker.incomplete[tmp_path / "empty"].startswith("the folder is empty")
    for number in (181, 182):
        (tmp_path / "restless" / "recorder.log").write_text(str(number))
        found = {entry.name: each for entry, each in tracker.complete_entries(entries_in(tmp_path))}
        assert set(found) == {"empty", "restless"}
    (tmp_path / "restless" / "recorder.log").write_text("again")
    now = take_snapshot(InboxEntry(tmp_path / "restless"), 100)
    assert found["restless"].is_same(now), "the file that changes all the time is no reason to put it back"
    (tmp_path / "restless" / "head.mp4").touch()
    assert not found["restless"].is_same(take_snapshot(InboxEntry(tmp_path / "restless"), 100))


def test_the_list_of_jobs_names_the_file_that_changes(tmp_path: Path) -> None:
    walk = tmp_path / "walk"
    walk.mkdir()
    (walk / "torso.mp4").write_bytes(unopened())
    snapshot = take_snapshot(InboxEntry(walk), 100)
    assert latest_change(snapshot).startswith("torso.mp4 changed ")
    os.utime(walk / "torso.mp4", (time.time() - 61, time.time() - 61))
    assert latest_change(take_snapshot(InboxEntry(walk), 100)) == ""


@pytest.mark.parametrize("content", [b"", unopened()[:-1], bytes(100), b"no video"])
def test_a_video_beside_the_listed_ones_that_cannot_be_opened_is_named(
    tmp_path: Path, content: bytes
) -> None:
    clock = Clock()
    tracker = CompletionTracker(10.0, 100, clock)
    walk = tmp_path / "walk"
    walk.mkdir()
    (walk / "torso.mp4").write_bytes(unopened())
    (walk / "GX010042.MP4").write_bytes(content)
    (walk / "job.yaml").write_text("capture: {cameras: [{name: torso, video: torso.mp4}]}\n")
    completed(tracker, tmp_path)
    clock.now += 1799
    assert completed(tracker, tmp_path) == []
    assert tracker.incomplete[walk].startswith("GX010042.MP4 is not complete: ")
    clock.now += 1
    ((entry, snapshot),) = tracker.complete_entries(entries_in(tmp_path))
    with pytest.raises(CaptureError, match="this video cannot be opened") as caught:
        read_dropped_job(entry, snapshot, JobPermissions())
    assert caught.value.path == str(walk / "GX010042.MP4")


@pytest.mark.parametrize("content", [b"", unopened()[:-1], bytes(100)])
def test_a_video_of_a_job_that_cannot_be_opened_fails_before_the_job_runs(
    tmp_path: Path, content: bytes
) -> None:
    walk = tmp_path / "walk"
    walk.mkdir()
    (walk / "torso.mp4").write_bytes(unopened())
    (walk / "head.mp4").write_bytes(content)
    entry = InboxEntry(walk)
    with pytest.raises(CaptureError, match="this video cannot be opened") as caught:
        read_dropped_job(entry, take_snapshot(entry, 100), JobPermissions())
    assert caught.value.path == str(walk / "head.mp4")


def test_the_entry_that_is_complete_for_longest_comes_first(tmp_path: Path) -> None:
    clock = Clock()
    tracker = CompletionTracker(10.0, 100, clock)
    for name in ("b", "a", "c.yaml"):
        (tmp_path / name).write_text("x")
        completed(tracker, tmp_path)
        clock.now += 1
    (tmp_path / "z").mkdir()
    (tmp_path / "z" / "torso.mp4").write_bytes(unopened())
    clock.now += 20
    completed(tracker, tmp_path)
    clock.now += 20
    assert completed(tracker, tmp_path) == ["c", "z"]  # a and b are not job files


def test_moves_never_overwrite(tmp_path: Path) -> None:
    for number in range(3):
        (tmp_path / "from" / "walk").mkdir(parents=True)
        (tmp_path / "from" / "walk" / "n").write_text(str(number))
        (tmp_path / "to").mkdir(exist_ok=True)
        move_to_free_name(tmp_path / "from" / "walk", tmp_path / "to", "walk")
    assert {path.name: (path / "n").read_text() for path in (tmp_path / "to").iterdir()} == {
        "walk": "0",
        "walk-2": "1",
        "walk-3": "2",
    }


def test_names_of_jobs_are_safe_to_show_and_to_type() -> None:
    assert folder_name_from_text("küche 3") == "küche 3"
    assert folder_name_from_text("e\u0301") == "é"
    assert folder_name_from_text("a\n\x1b[31mb") == "a__[31mb"
    assert folder_name_from_text("-rf")[0] != "-"
    assert folder_name_from_text("..")[0] != "."
    assert folder_name_from_text(" ") == "_"
    assert len(folder_name_from_text("日" * 200).encode()) <= 200


def test_the_spool_is_found_from_its_inbox_and_from_its_parent_folder(tmp_path: Path) -> None:
    (tmp_path / "jobs" / "inbox").mkdir(parents=True)
    want = Spool(inbox=tmp_path / "jobs" / "inbox", root=tmp_path / "jobs")
    assert spool_from_path(tmp_path / "jobs") == want
    assert spool_from_path(tmp_path / "jobs" / "inbox") == want


def test_a_linked_entry_uses_the_videos_beside_its_job_file(tmp_path: Path) -> None:
    footage = tmp_path / "footage"
    footage.mkdir()
    (footage / "torso.mp4").write_bytes(unopened())
    (footage / "job.yaml").write_text("height_m: 1.75\n")
    (tmp_path / "tuesday").symlink_to(footage)
    entry = InboxEntry(tmp_path / "tuesday")
    job, _ = read_dropped_job(entry, take_snapshot(entry, 100), JobPermissions(roots=(footage,)))
    assert (job.name, [camera.name for camera in job.capture.cameras]) == ("tuesday", ["torso"])
    with pytest.raises(JobError, match="outside"):
        read_dropped_job(entry, take_snapshot(entry, 100), JobPermissions())


def test_a_video_that_is_not_used_is_a_note_of_a_dropped_job(tmp_path: Path) -> None:
    walk = tmp_path / "inbox" / "walk"
    walk.mkdir(parents=True)
    for name in ("torso.mp4", "left_palm.mp4", "board.mp4"):
        (walk / name).write_bytes(unopened())
    (walk / "job.yaml").write_text("capture: {cameras: [{name: torso, video: torso.mp4}]}\n")
    spool = Spool(inbox=tmp_path / "inbox", root=tmp_path)
    for folder in (spool.running, spool.done, spool.failed):
        folder.mkdir()
    entry = InboxEntry(walk)
    claimed = claim_entry(spool, entry, take_snapshot(entry, 100), JobPermissions())
    assert claimed is not None
    job_dir = claimed
    job = read_job(job_dir, JobPermissions())
    assert [camera.name for camera in job.capture.cameras] == ["torso", "left_palm"]
    assert job.capture.cameras_only
    (note,) = json.loads(job_dir.status.read_text())["notes"]
    assert note.startswith("board.mp4 is not used")


def test_an_unknown_folder_is_the_parent_of_the_inbox(tmp_path: Path) -> None:
    (tmp_path / "jobs").mkdir()
    (tmp_path / "jobs" / "mine.yaml").touch()
    for name in ("jobs", "not yet there"):
        want = Spool(inbox=tmp_path / name / "inbox", root=tmp_path / name)
        assert spool_from_path(tmp_path / name) == want
    Spool(inbox=tmp_path / "drop", root=tmp_path).make()
    assert spool_from_path(tmp_path / "drop") == Spool(inbox=tmp_path / "drop", root=tmp_path)
    with pytest.raises(StoreError, match="not a folder"):
        spool_from_path(tmp_path / "jobs" / "mine.yaml")
    (tmp_path / "broken").symlink_to("nowhere")
    with pytest.raises(StoreError, match="not a folder"):
        spool_from_path(tmp_path / "broken")


def test_the_folders_that_jobs_are_moved_to_are_not_watched(tmp_path: Path) -> None:
    spool = spool_from_path(tmp_path)
    spool.make()
    for folder in (spool.running, spool.done, spool.failed):
        with pytest.raises(StoreError, match="moved to this folder"):
            spool_from_path(folder)


def test_the_service_example_is_a_valid_unit(tmp_path: Path) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("needs systemd-analyze")
    text = (ROOT / "examples" / "bodycap-watch.service").read_text()
    unit = tmp_path / "bodycap-watch.service"
    # systemd-analyze requires that the program exists; the operator chooses where it is installed.
    unit.write_text(text.replace("/opt/bodycap_batch/.venv/bin/bodycap", "/bin/true"))
    assert "/bin/true watch /srv/bodycap/jobs/inbox" in unit.read_text()
    done = subprocess.run(
        ["systemd-analyze", "verify", str(unit)], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr.strip()) == (0, "")


def test_the_job_file_of_the_results_keeps_places_found_from_the_motion(tmp_path: Path) -> None:
    names = ("a", "b", "c")
    found = dict(zip(names, ("left_palm", "torso", "right_palm"), strict=True))
    here = tmp_path / "job"
    cameras = [{"name": name, "video": [str(here / "input" / f"{name}.mp4")]} for name in names]
    capture = {"cameras": cameras, "places": list(found.values())}
    job = Job.model_validate({"capture": capture, "name": "walk", "skeleton": "auto"})
    job_dir = JobDir(here)
    job_dir.result.mkdir(parents=True)
    written = job_dir.result / "job.yaml"
    for document, mounts in (
        (job.with_places(found).model_dump(mode="json", exclude_none=True), found),
        (job.model_dump(mode="json", exclude_none=True), {}),
        ("left by another program", {}),
    ):
        written.write_text(yaml.safe_dump(document))
        make_result_paths_relative(job_dir, job)
        read = yaml.safe_load(written.read_text())["capture"]["cameras"]
        assert [camera["video"] for camera in read] == [[f"../input/{name}.mp4"] for name in names]
        assert {each["name"]: each["mount"] for each in read if "mount" in each} == mounts
