"""What a job may name and how large it may be, when somebody else handed it in."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import pytest
from pydantic import BaseModel

from bodycap_batch.check import require_within_limits
from bodycap_batch.config.job import load_job
from bodycap_batch.config.limits import Limits, limits_from
from bodycap_batch.config.models import Job
from bodycap_batch.config.trust import PathPolicy
from bodycap_batch.core.errors import CaptureError, JobError
from bodycap_batch.watch.web.uploads import is_accepted
from tests.videos import textured_frame, write_video


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "drop"
    folder.mkdir()
    (folder / "torso.mp4").touch()
    return folder


def test_own_files_and_opened_folders_are_allowed(folder: Path, tmp_path: Path) -> None:
    opened = tmp_path / "footage"
    opened.mkdir()
    policy = PathPolicy(folder=folder, roots=(opened,))
    policy.require(folder / "torso.mp4")
    policy.require(opened / "any.mp4")
    (folder / "link").symlink_to(opened / "any.mp4")
    policy.require(folder / "link")
    for outside in (tmp_path / "other.mp4", tmp_path / "drop2" / "a.mp4", Path("/etc/passwd")):
        with pytest.raises(JobError, match="outside"):
            policy.require(outside)


def test_nothing_outside_is_read_before_it_is_refused(folder: Path, tmp_path: Path) -> None:
    secret = tmp_path / "secret.json"
    secret.write_text("{not json: password}")
    (folder / "calib.json").symlink_to(secret)
    with pytest.raises(JobError, match="outside") as refused:
        load_job(folder, policy=PathPolicy(folder=folder))
    assert "password" not in str(refused.value)
    with pytest.raises(CaptureError, match="not valid JSON"):
        load_job(folder)


def test_videos_beside_a_job_file_are_used_in_an_opened_folder_but_not_for_a_single_file(
    folder: Path,
) -> None:
    (folder / "job.yaml").write_text("height_m: 1.75\n")
    policy = PathPolicy(folder=None, roots=(folder,))
    assert [camera.name for camera in load_job(folder, policy=policy).capture.cameras] == ["torso"]
    with pytest.raises(JobError, match="missing"):
        load_job(folder / "job.yaml", policy=policy)


def test_a_chapter_that_leads_outside_is_refused(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "secret.mp4").touch()
    (folder / "head").mkdir()
    (folder / "head" / "GX010001.MP4").symlink_to(tmp_path / "secret.mp4")
    with pytest.raises(JobError, match=r"secret\.mp4"):
        load_job(folder, policy=PathPolicy(folder=folder))


def test_limits_are_read_and_wrong_ones_are_named() -> None:
    assert limits_from([]) == Limits()
    assert limits_from(["video_gb=2", "yaml_depth=5"]) == Limits(video_gb=2.0, yaml_depth=5.0)
    for wrong in ("video_gb", "video_gb=much", "video_gb=-1", "video_gb=nan", "vidio=3", "yaml_depth=1000"):
        with pytest.raises(JobError, match=r"limit|deep"):
            limits_from([wrong])


def test_yaml_limits_are_applied(tmp_path: Path) -> None:
    (tmp_path / "job.yaml").write_text("capture: {cameras: [{name: torso, video: torso.mp4}]}")
    load_job(tmp_path / "job.yaml")
    with pytest.raises(JobError, match="deeper than 3"):
        load_job(tmp_path / "job.yaml", limits=Limits(yaml_depth=3))
    with pytest.raises(JobError, match="too large"):
        load_job(tmp_path / "job.yaml", limits=Limits(yaml_kb=0.01))


def test_a_video_is_measured_by_its_container(tmp_path: Path) -> None:
    write_video(tmp_path / "torso.mp4", [textured_frame(index) for index in range(30)])
    job = load_job(tmp_path)
    require_within_limits(job, Limits())
    with pytest.raises(CaptureError, match="pixels") as found:
        require_within_limits(job, Limits(video_px=16))
    assert "video_px" in str(found.value)
    with pytest.raises(CaptureError, match="hours"):
        require_within_limits(job, Limits(video_hours=1e-5))


def test_every_path_a_job_can_name_is_known_to_the_policy() -> None:
    def paths(model: type[BaseModel], prefix: str = "") -> set[str]:
        found = set()
        for name, field in model.model_fields.items():
            inner = [kind for kind in _kinds(field.annotation) if isinstance(kind, type)]
            if any(issubclass(kind, Path) for kind in inner):
                found.add(prefix + name)
            for kind in inner:
                if issubclass(kind, BaseModel):
                    found |= paths(kind, f"{prefix}{name}.")
        return found

    camera = {f"capture.cameras.{name}" for name in ("video", "timestamps", "samples", "calibration", "mask")}
    # `out` is replaced; `skeleton` is a text. A new path must be checked in `trust` and moved in `intake`.
    assert paths(Job) == {"out", "capture.calibration", *camera}


def test_samples_beside_a_video_are_accepted_moved_and_not_read_from_outside(
    folder: Path, tmp_path: Path
) -> None:
    assert is_accepted("walk/torso.gcsv")
    assert is_accepted("torso.imu.csv")
    (tmp_path / "secret").touch()
    (folder / "torso.gcsv").symlink_to(tmp_path / "secret")
    with pytest.raises(JobError, match="outside"):
        load_job(folder, policy=PathPolicy(folder=folder))
    moved = load_job(folder).with_paths(lambda path: Path("input") / path.name)
    assert moved.capture.cameras[0].samples == Path("input/torso.gcsv")


def _kinds(annotation: object) -> Iterator[object]:
    """Every type inside an annotation."""
    inner = get_args(annotation)
    if not inner:
        yield annotation
    for each in inner:
        yield from _kinds(each)
