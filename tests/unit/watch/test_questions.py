"""What the live page asks about a folder, and the job file with the answers."""

from __future__ import annotations

from pathlib import Path

import pytest

from bodycap_batch.config.job import load_job
from bodycap_batch.core.errors import JobError
from bodycap_batch.watch.spool import JobDir
from bodycap_batch.watch.web.job_list import list_result_files
from bodycap_batch.watch.web.questions import earlier_answers, files_below, questions_about, write_answers

NAMES = ("GX010120.MP4", "GX020120.MP4", "left_palm.mp4", "clips/a.mp4", "clips/b.mp4", "IMG_1.jpg")


def folder(path: Path, *names: str) -> Path:
    for name in names:
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_text("frames")
    return path


def test_recordings_without_a_place_are_asked_for() -> None:
    found = questions_about(NAMES)
    assert found["unknown"] == [
        {"name": "clips", "files": ["clips/a.mp4", "clips/b.mp4"]},
        {"name": "GX-0120", "files": ["GX010120.MP4", "GX020120.MP4"]},
    ]
    assert "left_palm" in found["places"]
    assert not found["has_job"]
    assert questions_about(["camera.mp4"])["unknown"] == [], "a single camera needs no place"
    assert questions_about([*NAMES, "job.yaml"])["has_job"]


def test_the_answers_become_a_job_file(tmp_path: Path) -> None:
    root = folder(tmp_path, *NAMES)
    write_answers(root, {"height": "5'9", "places": {"GX-0120": "torso", "clips": "right_palm"}})
    job = load_job(root)
    assert job.height_m == 1.7526  # 69 inches of 2.54 cm
    assert {camera.name: (camera.role, len(camera.video)) for camera in job.capture.cameras} == {
        "GX-0120": ("Spine1", 2),
        "clips": ("RightHand", 2),
        "left_palm": ("LeftHand", 1),
    }
    write_answers(root, {"height": "1.8", "places": {"GX-0120": "torso", "clips": "right_palm"}})
    assert load_job(root).height_m == 1.8


def test_the_run_can_find_the_places_of_three_cameras(tmp_path: Path) -> None:
    names = ("GX010120.MP4", "GX010121.MP4", "torso.mp4")
    assert questions_about(names)["found_places"] == ["torso", "left_palm", "right_palm"]
    assert questions_about(["head.mp4", *names[:2]])["found_places"] == []
    assert questions_about(["torso.mp4", "left_palm.mp4", "right_palm.mp4"])["found_places"] == []
    root = folder(tmp_path, *names)
    write_answers(root, {"height": "", "places": {}, "find_places": True})
    job = load_job(root)
    assert [camera.name for camera in job.capture.unplaced()] == ["GX-0120", "GX-0121"]


def test_the_page_remembers_its_answers(tmp_path: Path) -> None:
    root = folder(tmp_path, "GX010120.MP4", "GX010121.MP4", "torso.mp4")
    assert earlier_answers(root) == {}
    write_answers(root, {"height": "175", "places": {}, "find_places": True})
    assert earlier_answers(root) == {"height": "1.75", "find_places": True}
    (root / "job.yaml").write_text("height_m: 1.8\n")
    assert earlier_answers(root) == {}, "a job file of the user is no answer to the page"


def test_no_answer_writes_no_file(tmp_path: Path) -> None:
    write_answers(folder(tmp_path, *NAMES), {"height": " ", "places": {}})
    assert "job.yaml" not in files_below(tmp_path)


@pytest.mark.parametrize(
    ("answers", "message"),
    [
        ({"height": "tall"}, "not a body height"),
        ({"places": {"GX-0120": ""}}, "is not chosen"),
        ({"places": {"torso": "torso"}}, "there is no video"),
        ({"places": ["torso"]}, "by name"),
    ],
)
def test_wrong_answers_are_refused(tmp_path: Path, answers: dict[str, object], message: str) -> None:
    with pytest.raises(JobError, match=message):
        write_answers(folder(tmp_path, *NAMES), answers)


def test_a_job_file_of_the_user_is_not_replaced(tmp_path: Path) -> None:
    (folder(tmp_path, *NAMES) / "job.yaml").write_text("height_m: 1.6\n")
    with pytest.raises(JobError, match="has a job file"):
        write_answers(tmp_path, {"height": "1.8"})
    assert (tmp_path / "job.yaml").read_text() == "height_m: 1.6\n"


def test_results_are_listed_in_the_order_in_which_people_want_them(tmp_path: Path) -> None:
    names = ("colmap/0/points.bin", "logs/map.log", "map.ply", "metrics.json", "motion.bvh", "preview.mp4")
    folder(tmp_path / "result", *names, "report.html")
    assert list_result_files(JobDir(tmp_path))[:4] == ["motion.bvh", "preview.mp4", "report.html", "map.ply"]
    assert list_result_files(JobDir(tmp_path))[-1] == "logs/map.log"
