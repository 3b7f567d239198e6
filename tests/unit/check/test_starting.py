"""`bodycap init`: the job file lists what the folder holds, and gives the same job as the folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from bodycap_batch.check.job_template import job_template, write_job_template
from bodycap_batch.cli import main
from bodycap_batch.config.folder import recordings_in
from bodycap_batch.config.job import load_job
from bodycap_batch.config.models import Job
from bodycap_batch.config.rules import UNKNOWN_MOUNT
from bodycap_batch.core.errors import CaptureError, JobError
from tests.broken import BVH, FRAMES, LENS
from tests.videos import write_video


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    walk = tmp_path / "my walk"
    for name in ("torso.mp4", "left_palm.mp4"):
        write_video(walk / name, FRAMES[:10])
    return walk


def test_the_job_file_and_the_folder_give_the_same_job(folder: Path) -> None:
    (folder / "calib.json").write_text(json.dumps(LENS))
    without = load_job(folder)
    path = write_job_template(folder)
    assert load_job(path) == without
    assert load_job(folder) == without


@pytest.mark.parametrize("named", ["20261121", "1e5", "true", "null"])
def test_names_that_look_like_numbers_stay_text(tmp_path: Path, named: str) -> None:
    for video in ("torso.mp4", "2.mp4"):
        write_video(tmp_path / named / video, FRAMES[:5])
    path = write_job_template(tmp_path / named)
    path.write_text(path.read_text().replace(f'"{UNKNOWN_MOUNT}"', "head"))
    job = load_job(path)
    assert job.name == named
    assert sorted(camera.name for camera in job.capture.cameras) == ["2", "torso"]


def test_every_camera_gets_another_name(tmp_path: Path) -> None:
    for video in ("cam 1.mp4", "cam_1.mp4", "CAM-1.mp4", "left palm.mp4", "left_palm.mp4", f"{'x' * 80}.mp4"):
        write_video(tmp_path / video, FRAMES[:5])
    cameras = yaml.safe_load(job_template(tmp_path))["capture"]["cameras"]
    names = [camera["name"] for camera in cameras]
    assert len({name.lower() for name in names}) == len(names) == 6
    assert {"cam_1", "cam_1_2", "left_palm", "left_palm_2"} <= set(names)
    assert max(map(len, names)) <= 64
    # a mount that the file name states is not asked for
    assert [
        camera["name"] for camera in cameras if "mount" in camera and camera["mount"] != UNKNOWN_MOUNT
    ] == []
    assert sum(camera.get("mount") == UNKNOWN_MOUNT for camera in cameras) == 4


def test_skeleton_video_and_calibration_of_the_folder_are_used(folder: Path) -> None:
    (folder / "subject.bvh").write_text(BVH)
    text = job_template(folder)
    assert yaml.safe_load(text)["skeleton"] == "subject.bvh"
    assert "# 64×48, 30 fps, 0.3 s" in text
    assert "calibration: auto" in text
    (folder / "calib.json").write_text(json.dumps(LENS))
    assert yaml.safe_load(job_template(folder))["capture"]["calibration"] == "calib.json"


def test_chapters_are_one_camera_with_an_unknown_mount(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("GX020042.mp4", "GX010042.mp4"):
        write_video(folder / name, FRAMES[:10])
    assert main(["init", str(folder)]) == 0
    assert "fill in `mount:` (the place on the body) of 1 camera in the file" in capsys.readouterr().out
    data = yaml.safe_load((folder / "job.yaml").read_text())
    (gopro,) = (camera for camera in data["capture"]["cameras"] if camera.get("mount"))
    assert gopro["video"] == ["GX010042.mp4", "GX020042.mp4"]
    with pytest.raises(JobError, match="on the body is not filled in") as caught:
        load_job(folder / "job.yaml")
    assert caught.value.line
    assert "left_palm" in str(caught.value.hint)
    text = (folder / "job.yaml").read_text().replace(f'"{UNKNOWN_MOUNT}"', "head")
    (folder / "job.yaml").write_text(text)
    assert len(load_job(folder / "job.yaml").capture.cameras) == 3


def test_chapters_of_a_gopro_are_one_recording_in_any_case(tmp_path: Path) -> None:
    for name in ("gp010123.mp4", "GOPR0123.MP4", "MYGP-1.mp4", "torso.mov", "torso.mp4"):
        (tmp_path / name).write_bytes(b"not opened")
    found = [(name, [path.name for path in paths]) for name, paths in recordings_in(tmp_path)]
    assert found == [
        ("GO-0123", ["GOPR0123.MP4", "gp010123.mp4"]),
        ("MYGP-1", ["MYGP-1.mp4"]),
        ("torso", ["torso.mov"]),
        ("torso", ["torso.mp4"]),
    ]


def test_init_prints_where_settings_come_from_and_what_is_not_used(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_video(folder / "GX010042.mp4", FRAMES[:10])
    (folder / "notes.txt").touch()
    assert main(["init", str(folder)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "  calibration: auto (default), starting at 70° (default)" in lines
    assert "  timestamps: frame times (from the video metadata)" in lines
    assert (
        f"  mount: {UNKNOWN_MOUNT} (from the job file); pose on the bone: typical of the place (default)"
        in lines
    )
    assert "not used (not a video, and no setting names it): notes.txt" in lines
    (folder / "calib.json").write_text("{}")
    assert main(["init", str(folder), "--force"]) == 0
    assert "problem: " in capsys.readouterr().out


def test_a_calibration_that_is_made_after_init_is_used(folder: Path) -> None:
    path = write_job_template(folder)
    assert {camera.calibration for camera in load_job(path).capture.cameras} == {"auto"}
    (folder / "calib.json").write_text(json.dumps(LENS))
    assert "auto" not in {camera.calibration for camera in load_job(path).capture.cameras}


def options_without_comment_signs(text: str) -> dict[str, Any]:
    """Return the options after the last heading, without their comment signs."""
    lines = text.partition("remove the # before it.\n")[2].splitlines()
    assert all(line.startswith("#") for line in lines)
    return dict(yaml.safe_load("\n".join(line.removeprefix("# ") for line in lines)))


def test_every_option_of_every_stage_is_listed_with_its_default(folder: Path) -> None:
    found = options_without_comment_signs(job_template(folder))
    plain = Job.model_validate({"capture": {"cameras": [{"name": "torso", "video": ["torso.mp4"]}]}})
    for stage, options in found.items():
        assert options == getattr(plain, stage).model_dump(mode="json"), stage
    assert set(found) == {"keyframes", "map", "registration", "merge", "export"}


def test_an_existing_job_file_is_kept_without_force(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "job.yaml").write_text("mine")
    assert main(["init", str(folder)]) == 2
    assert "--force" in capsys.readouterr().err
    assert (folder / "job.yaml").read_text() == "mine"
    assert main(["init", str(folder), "--force"]) == 0
    assert load_job(folder / "job.yaml").name == "my_walk"


def test_a_folder_without_videos_is_refused_and_nothing_is_written(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="the folder contains no video"):
        write_job_template(tmp_path)
    assert list(tmp_path.iterdir()) == []
