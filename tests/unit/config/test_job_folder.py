"""A folder of videos as a job: names, aliases, sidecars, calibrations."""

from __future__ import annotations

import errno
import json
from collections.abc import Iterator
from itertools import combinations, permutations
from pathlib import Path

import pytest

from bodycap_batch.config.job import Overrides, load_job
from bodycap_batch.config.models import SKELETON_PRESETS, Job
from bodycap_batch.config.mounts import MOUNT_NAMES, ROLES, mount_of, role_of_segment
from bodycap_batch.config.rules import problems_in
from bodycap_batch.config.trust import PathPolicy
from bodycap_batch.core.errors import CaptureError, JobError
from bodycap_batch.merging.body.bones import kinematic_chain
from bodycap_batch.merging.body.provisional_scale import reach_constraint
from bodycap_batch.model.skeleton_presets import load_skeleton
from tests.videos import unopened

LENS = {"model": "PINHOLE", "params": [420, 420, 320, 240], "width": 640, "height": 480}


def folder(tmp_path: Path, *names: str) -> Path:
    for name in names:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(unopened())
    return tmp_path


@pytest.mark.parametrize(
    ("name", "role"),
    [
        ("torso", "Spine1"),
        ("Chest", "Spine1"),
        ("torso_back", "Spine1"),
        ("torso-2", "Spine1"),
        ("head", "Head"),
        ("left_palm", "LeftHand"),
        ("LeftHand", "LeftHand"),
        ("left hand", "LeftHand"),
        ("hand_l", "LeftHand"),
        ("left_palm_b", "LeftHand"),
        ("right_upper_arm", "RightArm"),
        ("right_forearm", "RightForeArm"),
        ("left_thigh", "LeftUpLeg"),
        ("left_shin", "LeftLeg"),
        ("right_foot", "RightFoot"),
        ("waist", "Hips"),
    ],
)
def test_names_say_where_a_camera_sits(name: str, role: str) -> None:
    found = mount_of(name)
    assert found is not None
    assert found[1] == role


@pytest.mark.parametrize(
    "name",
    [
        "",
        "camera",
        "GX010123",
        "left",
        "palm",
        "back",
        "front_2",
        "handle",
        "gopro1",
        "Cam 2",
        "VID_20230101",
        "leftover",
    ],
)
def test_other_names_are_not_guessed(name: str) -> None:
    assert mount_of(name) is None


def test_every_mount_rides_on_a_joint_of_the_presets() -> None:
    for preset in SKELETON_PRESETS[1:]:
        skeleton = load_skeleton(preset)
        assert skeleton.index_of_role("Spine1") is not None
    full = load_skeleton("full_body")
    assert all(full.index_of_role(role) is not None for role in ROLES)
    assert all(mount_of(name) == (name, role_of_segment(name)) for name in MOUNT_NAMES)


def test_a_folder_is_a_job(tmp_path: Path) -> None:
    root = folder(
        tmp_path / "my walk", "torso.mp4", "left_palm.MOV", ".right_palm.mp4", "notes.txt", "gt/torso.tum"
    )
    (root / "calib.json").write_text(
        json.dumps({**LENS, "offsets_s": {"torso": 0.12}, "rolling_shutter_s": 0.02})
    )
    (root / "torso.timestamps.txt").write_text("0\n")
    job = load_job(root)
    assert job.name == "my_walk"
    assert job.skeleton == "auto"
    by_name = {camera.name: camera for camera in job.capture.cameras}
    assert set(by_name) == {"torso", "left_palm"}
    assert by_name["torso"].timestamps == (root / "torso.timestamps.txt",)
    assert (by_name["torso"].offset_s, by_name["left_palm"].offset_s) == (0.12, None)
    assert by_name["left_palm"].rolling_shutter_s == 0.02
    assert by_name["torso"].input_files() == (root / "torso.mp4", root / "torso.timestamps.txt")


def test_the_job_file_of_a_folder_decides(tmp_path: Path) -> None:
    root = folder(tmp_path / "kitchen walk", "torso.mp4", "left_palm.mp4", "right_palm.mp4")
    listed = "cameras_only: true, cameras: [{name: head, video: torso.mp4}]"
    (root / "job.yaml").write_text(f"height_m: 1.8\ncapture: {{{listed}}}\n")
    job = load_job(root)
    assert (job.name, job.height_m) == ("kitchen_walk", 1.8)
    assert [camera.name for camera in job.capture.cameras] == ["head"]
    assert load_job(root / "job.yaml") == job
    assert load_job(root, Overrides(height_m=1.7)).height_m == 1.7
    (root / "run.json").write_text("{}")
    assert len(load_job(root).capture.cameras) == 3, "the job file of results is not used for videos"


def test_a_folder_whose_job_file_is_a_link_keeps_its_name_and_videos(tmp_path: Path) -> None:
    root = folder(tmp_path / "monday", "torso.mp4", "left_palm.mp4")
    (folder(tmp_path / "shared", "torso.mp4") / "usual.yaml").write_text("height_m: 1.8\n")
    (root / "job.yaml").symlink_to("../shared/usual.yaml")
    job = load_job(root)
    assert (job.name, job.height_m) == ("monday", 1.8)
    assert {video.parent for camera in job.capture.cameras for video in camera.video} == {root.resolve()}
    assert len(job.capture.cameras) == 2


def test_a_job_that_names_no_cameras_means_the_videos_beside_it(tmp_path: Path) -> None:
    root = folder(tmp_path, "torso.mp4", "left_palm.mp4")
    (root / "calib.json").write_text(json.dumps(LENS))
    (root / "job.yaml").write_text("height_m: 1.8\n")
    job = load_job(root)
    assert job.height_m == 1.8
    assert job.capture == load_job(folder(root, "run.json")).capture, "as without a job file"
    (root / "walk.yaml").write_text("capture: {calibration: auto, start_s: 2.0}\n")
    job = load_job(root / "walk.yaml")
    assert (job.name, job.capture.start_s, len(job.capture.cameras)) == ("walk", 2.0, 2)
    assert {camera.calibration for camera in job.capture.cameras} == {"auto"}
    (root / "walk.yaml").write_text("captur: {start_s: 2.0}\n")
    with pytest.raises(JobError, match="unknown key 'captur'") as caught:
        load_job(root / "walk.yaml")
    assert caught.value.hint == "did you mean 'capture'?"
    assert "missing" not in caught.value.message
    for word in ("", "capture: {}"):
        (tmp_path / "jobs").mkdir(exist_ok=True)
        (tmp_path / "jobs" / "none.yaml").write_text(f"height_m: 1.8\n{word}\n")
        with pytest.raises(JobError, match="missing"):
            load_job(tmp_path / "jobs" / "none.yaml")


def test_a_job_that_was_dropped_alone_has_no_videos_beside_it(tmp_path: Path) -> None:
    folder(tmp_path, "torso.mp4", "left_palm.mp4")
    (tmp_path / "single.yaml").write_text("height_m: 1.8\n")
    assert load_job(tmp_path / "single.yaml", policy=PathPolicy(folder=tmp_path)).height_m == 1.8
    with pytest.raises(JobError, match="missing"):
        load_job(tmp_path / "single.yaml", policy=PathPolicy(folder=None))


def test_results_beside_the_videos_are_no_camera(tmp_path: Path) -> None:
    root = folder(tmp_path, "torso.mp4", "left_palm.mp4", "results/preview.mp4", "results/run.json")
    assert [camera.name for camera in load_job(root).capture.cameras] == ["left_palm", "torso"]


def test_results_do_not_lie_among_what_they_are_made_from(tmp_path: Path) -> None:
    root = folder(tmp_path / "walk", "torso.mp4", "left_palm.mp4")
    with pytest.raises(JobError, match="folder of the job's own files") as caught:
        load_job(root, Overrides(out=root))
    assert str(root / "results") in str(caught.value.hint)
    own = folder(tmp_path, "jobs/job.yaml") / "jobs" / "job.yaml"
    own.write_text("out: .\ncapture: {cameras: [{name: torso, video: ../walk/torso.mp4}]}\n")
    with pytest.raises(JobError, match="folder of the job's own files"):
        load_job(own)
    folder(tmp_path, "jobs/run.json")
    assert load_job(own).out == own.parent, "the resolved job of results runs again as it is"


def test_a_camera_whose_videos_did_not_come_along(tmp_path: Path) -> None:
    root = folder(tmp_path, "torso.mp4", "left_palm.mp4", "gt/a.tum", "right_palm/notes.txt")
    with pytest.raises(CaptureError, match="the folder of this camera contains no video"):
        load_job(root)
    folder(root, "right_palm/GX010001.MP4")
    (root / "head.mp4").symlink_to(tmp_path / "unplugged" / "head.mp4")
    with pytest.raises(CaptureError, match="leads to a file that does not exist") as caught:
        load_job(root)
    assert caught.value.path == str(root / "head.mp4")
    (root / "job.yaml").write_text("height_m: 1.8\n")
    with pytest.raises(CaptureError, match="leads to a file that does not exist"):
        load_job(root)


def test_a_video_is_no_job(tmp_path: Path) -> None:
    with pytest.raises(JobError, match="this file is a video, not a job") as caught:
        load_job(folder(tmp_path, "torso.mp4") / "torso.mp4")
    assert str(tmp_path) in str(caught.value.hint)


def test_cameras_that_cannot_tell_the_size_are_refused_beforehand() -> None:
    """The rule is the skeleton stage's, which would say so after the map."""
    skeleton, wrong = load_skeleton("full_body"), []
    for roles in combinations(ROLES, 2):
        bones = kinematic_chain(skeleton, set(roles))
        place = {bone.role: index for index, bone in enumerate(bones)}
        known = any(
            reach_constraint(bones, place[one], place[other]) is not None
            for one, other in permutations(roles, 2)
        )
        cameras = [{"name": f"c{n}", "video": [f"{n}.mp4"], "segment": role} for n, role in enumerate(roles)]
        problems = problems_in(Job.model_validate({"capture": {"cameras": cameras}}))
        refused = any("size of the body" in problem.message for problem in problems)
        if refused == known:
            wrong.append(roles)
    assert not wrong


def test_a_single_camera_may_have_any_name(tmp_path: Path) -> None:
    job = load_job(folder(tmp_path, "My Phone.mp4"))
    assert job.skeleton == "none"
    assert job.capture.cameras[0].name == "My_Phone"
    assert job.capture.cameras[0].calibration == "auto"


def test_cameras_on_one_bone_make_no_body(tmp_path: Path) -> None:
    root = folder(tmp_path, "head.mp4")
    assert load_job(root).skeleton == "none"
    assert load_job(folder(tmp_path, "head_back.mp4")).skeleton == "none"
    with pytest.raises(JobError, match="two bones") as caught:
        load_job(root, Overrides(skeleton="upper_body"))
    assert "skeleton: none" in str(caught.value.hint)
    assert load_job(folder(tmp_path, "torso.mp4")).skeleton == "auto"


def test_a_name_is_asked_for_instead_of_guessed(tmp_path: Path) -> None:
    with pytest.raises(JobError, match=r"GX010007\.MP4") as caught:
        load_job(folder(tmp_path, "torso.mp4", "GX010007.MP4"))
    assert "left_ or right_ before it palm" in str(caught.value.hint)
    assert "folder" in str(caught.value.hint)


def test_two_of_one_name(tmp_path: Path) -> None:
    with pytest.raises(JobError, match="two cameras would have the name") as caught:
        load_job(folder(tmp_path, "torso.mp4", "torso.mov"))
    assert "rename" in str(caught.value.hint)


def test_a_camera_may_be_a_folder(tmp_path: Path) -> None:
    root = folder(tmp_path, "torso/GX020001.MP4", "torso/GX010001.MP4", "torso/GX010001.THM", "head.mp4")
    (root / "torso" / "calib.json").write_text(json.dumps(LENS))
    job = load_job(root)
    torso = next(camera for camera in job.capture.cameras if camera.name == "torso")
    assert [path.name for path in torso.video] == ["GX010001.MP4", "GX020001.MP4"]
    assert torso.calibration != "auto"


@pytest.mark.parametrize("names", [(), ("readme.txt", "gt/a.tum")])
def test_a_folder_without_videos(tmp_path: Path, names: tuple[str, ...]) -> None:
    with pytest.raises(CaptureError, match="no video") as caught:
        load_job(folder(tmp_path, *names))
    assert "torso.mp4" in str(caught.value.hint)


def test_sidecars_of_some_chapters_only(tmp_path: Path) -> None:
    root = folder(
        tmp_path,
        *(f"torso/GX0{k}0001.MP4" for k in (1, 2, 3)),
        "torso/GX010001.timestamps.txt",
        "torso/GX020001.timestamps.txt",
    )
    with pytest.raises(CaptureError, match="2 timestamp files for 3 chapters"):
        load_job(root)


@pytest.mark.parametrize(
    ("sidecars", "found"),
    [
        (("GX01.timestamps.txt",), "GX01.timestamps.txt"),
        (("GX01.MP4.timestamps.txt",), "GX01.MP4.timestamps.txt"),
        (("torso.timestamps.txt",), "torso.timestamps.txt"),
        (("torso.timestamps.txt", "GX01.timestamps.txt"), "GX01.timestamps.txt"),
        (("head.timestamps.txt",), None),
    ],
)
def test_sidecars_are_named_after_the_video_or_the_camera(
    tmp_path: Path, sidecars: tuple[str, ...], found: str | None
) -> None:
    folder(tmp_path, "GX01.MP4", *sidecars)
    path = tmp_path / "job.yaml"
    path.write_text("capture: {cameras: [{name: torso, video: GX01.MP4}]}")
    timestamps = load_job(path).capture.cameras[0].timestamps
    assert timestamps == (() if found is None else (tmp_path / found,))


def test_a_failing_disk_is_no_fault_of_the_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = folder(tmp_path / "walk", "torso.mp4") / "job.yaml"
    path.write_text("capture: {cameras: [{name: torso, video: torso.mp4}]}\n")
    read = Path.iterdir

    def failing(self: Path) -> Iterator[Path]:
        if self == path.parent:
            raise OSError(errno.EIO, "Input/output error")
        return read(self)

    monkeypatch.setattr(Path, "iterdir", failing)
    with pytest.raises(OSError, match="Input/output"):
        load_job(path)
