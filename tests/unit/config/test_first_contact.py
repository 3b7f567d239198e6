"""Heights, names and wrong inputs as people give them."""

from __future__ import annotations

from pathlib import Path

import pytest

from bodycap_batch.config.body_height import describe_height, height_from_text
from bodycap_batch.config.job import Overrides, load_job, load_job_with_origins
from bodycap_batch.config.mounts import mount_of
from bodycap_batch.core.errors import CaptureError, JobError

METRES = ("1.75", "1,75", "175", "1.75m", "1,75 m", "175cm", "175 cm", "1750mm", " 1.75 ")
FEET = ("5'9\"", "5'9", "5' 9\"", "5′9″", "5ft 9in", "5 ft 9", "5 feet 9 inches", "69in", '69"')


def folder(path: Path, *names: str) -> Path:
    path.mkdir(parents=True, exist_ok=True)
    for name in names:
        (path / name).parent.mkdir(exist_ok=True)
        (path / name).write_bytes(b"x")
    return path


@pytest.mark.parametrize("text", METRES)
def test_metric_heights_are_understood(text: str) -> None:
    assert height_from_text(text) == 1.75


@pytest.mark.parametrize("text", FEET)
def test_feet_and_inches_are_understood(text: str) -> None:
    assert height_from_text(text) == 1.7526  # 69 inches of 2.54 cm


@pytest.mark.parametrize("text", ["tall", "", "1.75 ell", "-1.75", "5.9", "17.5", "1m75", "nan", "9'0"])
def test_other_heights_are_refused(text: str) -> None:
    with pytest.raises(JobError) as caught:
        height_from_text(text)
    assert caught.value.field == "height_m"


def test_a_height_is_shown_in_both_systems() -> None:
    assert describe_height(1.75) == "1.75 m (5 ft 9 in)"


@pytest.mark.parametrize("text", ["175", "'1,75'", "1.75m", "1.75"])
def test_a_job_file_takes_the_same_heights(tmp_path: Path, text: str) -> None:
    (folder(tmp_path, "torso.mp4", "left_palm.mp4") / "job.yaml").write_text(f"height_m: {text}\n")
    assert load_job(tmp_path).height_m == 1.75


@pytest.mark.parametrize(
    ("name", "mount"),
    [
        ("chest_cam", "torso"),
        ("Torso Cam 1", "torso"),
        ("left_hand_cam", "left_palm"),
        ("LeftPalmGoPro", "left_palm"),
        ("palm-cam-L", "left_palm"),
        ("torso_20240102", "torso"),
        ("forehead GoPro HERO11", "head"),
        ("Right wrist cam", "right_forearm"),
    ],
)
def test_usual_names_of_videos_are_understood(name: str, mount: str) -> None:
    found = mount_of(name)
    assert found is not None
    assert found[0] == mount


def test_the_command_line_gives_the_places_of_other_names(tmp_path: Path) -> None:
    folder(tmp_path, "gopro1.mp4", "GOPRO2.MP4")
    with pytest.raises(JobError) as caught:
        load_job(tmp_path)
    assert "--camera GOPRO2=torso" in str(caught.value.hint)
    assert "bodycap init" in str(caught.value.hint)
    assert "with left_ or right_ before it palm, upper_arm" in str(caught.value.hint)
    job = load_job(tmp_path, Overrides(mounts={"gopro1": "torso", "gopro2.mp4": "left_hand"}))
    assert {camera.name: camera.role for camera in job.capture.cameras} == {
        "GOPRO2": "LeftHand",
        "gopro1": "Spine1",
    }
    (tmp_path / "job.yaml").write_text("capture: {cameras: [{name: gopro1, video: gopro1.mp4}]}\n")
    job = load_job(tmp_path, Overrides(mounts={"gopro1": "torso", "GOPRO2": "left_hand"}))
    assert {camera.role for camera in job.capture.cameras} == {"Spine1", "LeftHand"}


@pytest.mark.parametrize(
    ("mounts", "message"), [({"torso": "tail"}, "no place 'tail'"), ({"head": "head"}, "no camera 'head'")]
)
def test_wrong_places_are_refused(tmp_path: Path, mounts: dict[str, str], message: str) -> None:
    with pytest.raises(JobError, match=message):
        load_job(folder(tmp_path, "torso.mp4", "left_palm.mp4"), Overrides(mounts=mounts))


def test_a_wrist_camera_says_its_bone(tmp_path: Path) -> None:
    loaded = load_job_with_origins(folder(tmp_path, "torso.mp4", "left_wrist.mp4"))
    (warning,) = loaded.warnings
    assert "left_wrist is taken to be on the forearm (left_forearm)" in warning
    assert "--camera left_wrist=left_palm" in warning


def test_the_activity_of_the_command_line_wins(tmp_path: Path) -> None:
    folder(tmp_path, "torso.mp4", "left_palm.mp4")
    assert load_job(tmp_path).activity == "generic"
    assert load_job(tmp_path, Overrides(activity="walk")).activity == "walk"
    with pytest.raises(JobError, match="no activity 'jump'"):
        load_job(tmp_path, Overrides(activity="jump"))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("photo.jpg", "this file is a photo"),
        ("films.zip", "this file is an archive"),
        ("torso.mp4", "this file is a video"),
        ("nothing", "there is no such file or folder"),
    ],
)
def test_other_files_are_named_as_what_they_are(tmp_path: Path, name: str, message: str) -> None:
    folder(tmp_path, *([name] if name != "nothing" else []))
    with pytest.raises(JobError, match=message):
        load_job(tmp_path / name)


def test_a_folder_without_videos_says_what_it_contains(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="no video; it contains photos and an archive"):
        load_job(folder(tmp_path, "a.jpg", "b.zip"))


def test_videos_in_one_subfolder_are_no_chapters(tmp_path: Path) -> None:
    folder(tmp_path, "films/torso.mp4", "films/left_palm.mp4")
    with pytest.raises(JobError, match="the videos are in the subfolder films"):
        load_job(tmp_path)
    assert len(load_job(tmp_path / "films").capture.cameras) == 2


def test_the_former_name_of_the_skeleton_stays_valid(tmp_path: Path) -> None:
    folder(tmp_path, "torso.mp4", "left_palm.mp4")
    assert load_job(tmp_path, Overrides(skeleton="upper_body")) == load_job(tmp_path)
    (tmp_path / "job.yaml").write_text("skeleton: upper_body\n")
    assert load_job(tmp_path).skeleton == "auto"


def test_all_problems_of_a_job_are_reported_at_once(tmp_path: Path) -> None:
    cameras = "[{name: torso, video: gone.mp4}, {name: left_palm, video: away.mp4, mount: tail}]"
    (tmp_path / "walk.yaml").write_text(f"capture: {{cameras: {cameras}}}\nskeleton: uper\n")
    with pytest.raises(JobError) as caught:
        load_job(tmp_path / "walk.yaml")
    for part in ("no mount 'tail'", "no skeleton 'uper'", "gone.mp4", "away.mp4"):
        assert part in caught.value.message


THREE = "torso,left_palm,right_palm"


def test_the_run_may_find_which_camera_was_where(tmp_path: Path) -> None:
    folder(tmp_path, "gopro1.mp4", "gopro2.mp4", "left_palm.mp4")
    with pytest.raises(JobError) as caught:
        load_job(tmp_path)
    assert f"--places {THREE}" in str(caught.value.hint)
    loaded = load_job_with_origins(tmp_path, Overrides(places=tuple(THREE.split(","))))
    assert [camera.name for camera in loaded.job.capture.unplaced()] == ["gopro1", "gopro2"]
    assert "found by the run" in loaded.origins["gopro1"].mount.text()
    (tmp_path / "job.yaml").write_text("capture: {places: [left_palm, torso, right_hand]}\n")
    assert len(load_job(tmp_path).capture.unplaced()) == 2


@pytest.mark.parametrize(
    ("names", "places", "message"),
    [
        (("a.mp4", "b.mp4", "c.mp4"), ("head", "left_palm", "right_palm"), "can find from the motion only"),
        (("a.mp4", "b.mp4", "c.mp4"), ("left_palm", "right_palm"), "can find from the motion only"),
        (
            ("a.mp4", "b.mp4", "head.mp4"),
            ("torso", "left_palm", "right_palm"),
            "can find from the motion only",
        ),
        (("a.mp4", "b.mp4", "c.mp4"), ("torso", "left_plam", "right_palm"), "no place 'left_plam'"),
    ],
)
def test_places_that_no_run_can_find_are_refused(
    tmp_path: Path, names: tuple[str, ...], places: tuple[str, ...], message: str
) -> None:
    with pytest.raises(JobError, match=message):
        load_job(folder(tmp_path, *names), Overrides(places=places))


def test_a_given_place_replaces_one_that_was_found(tmp_path: Path) -> None:
    folder(tmp_path, "a.mp4", "b.mp4", "c.mp4")
    cameras = [
        f"{{name: {name}, video: {name}.mp4, mount: {place}, mount_source: motion}}"
        for name, place in zip("abc", THREE.split(","), strict=True)
    ]
    (tmp_path / "job.yaml").write_text(f"capture: {{cameras: [{', '.join(cameras)}]}}\n")
    loaded = load_job_with_origins(tmp_path)
    assert loaded.origins["a"].mount.text() == "torso (from the motion)"
    cameras_now = load_job(tmp_path, Overrides(mounts={"a": "head"})).capture.cameras
    assert [camera.mount_source for camera in cameras_now] == [None, "motion", "motion"]


def test_a_folder_with_an_archive_says_to_unpack_it(tmp_path: Path) -> None:
    with pytest.raises(CaptureError) as caught:
        load_job(folder(tmp_path, "walk.zip"))
    assert str(caught.value.hint).startswith("unpack the archive")


def test_a_subfolder_with_a_space_is_quoted(tmp_path: Path) -> None:
    folder(tmp_path, "day 1/torso.mp4", "day 1/left_palm.mp4")
    with pytest.raises(JobError) as caught:
        load_job(tmp_path)
    assert f"'{tmp_path / 'day 1'}'" in str(caught.value.hint)


def test_an_origin_names_the_place_and_not_the_bone(tmp_path: Path) -> None:
    loaded = load_job_with_origins(folder(tmp_path, "chest.mp4", "left_hand.mp4"))
    assert loaded.origins["left_hand"].mount.text() == "left_palm (from the camera name)"
