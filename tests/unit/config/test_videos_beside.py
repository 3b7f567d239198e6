"""The videos and the calibration beside a job file that lists some cameras."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from bodycap_batch.config.calibration import Calibration
from bodycap_batch.config.job import load_job, load_job_with_origins
from bodycap_batch.config.models import Job
from bodycap_batch.config.trust import PathPolicy
from bodycap_batch.core.errors import CaptureError, JobError
from tests.unit.config.test_job_folder import LENS, folder
from tests.videos import unopened

TORSO = "capture: {cameras: [{name: torso, video: torso.mp4}]}\n"
ONLY = "capture: {cameras_only: true, cameras: [{name: torso, video: torso.mp4}]}\n"


def cameras(job: Job) -> dict[str, list[str]]:
    return {camera.name: [path.name for path in camera.video] for camera in job.capture.cameras}


def unused(path: Path) -> dict[str, str]:
    return {file.path: file.reason for file in load_job_with_origins(path).unused_files()}


@pytest.mark.parametrize("name", ["job.yaml", "job.yml"])
def test_videos_beside_a_job_file_become_cameras(tmp_path: Path, name: str) -> None:
    root = folder(tmp_path, "torso.mp4", "left_palm.mp4", "head/GX020001.MP4", "head/GX010001.MP4")
    (root / name).write_text(TORSO)
    for path in (root, root / name):
        loaded = load_job_with_origins(path)
        assert cameras(loaded.job) == {
            "torso": ["torso.mp4"],
            "head": ["GX010001.MP4", "GX020001.MP4"],
            "left_palm": ["left_palm.mp4"],
        }
        assert loaded.job.skeleton == "auto"
        assert (loaded.warnings, loaded.no_body) == ((), "")
        assert {key: value.video.source for key, value in loaded.origins.items()} == {
            "torso": "job file",
            "head": "folder",
            "left_palm": "folder",
        }


def test_cameras_only_means_exactly_the_listed_cameras(tmp_path: Path) -> None:
    root = folder(tmp_path, "torso.mp4", "left_palm.mp4", "cam1.mp4", "head/a.mp4", "right_palm/notes.txt")
    (root / "job.yaml").write_text(ONLY)
    loaded = load_job_with_origins(root)
    assert cameras(loaded.job) == {"torso": ["torso.mp4"]}
    assert loaded.warnings == ()
    assert {path for path, reason in unused(root).items() if "cameras_only" in reason} == {
        "left_palm.mp4",
        "cam1.mp4",
        "head/",
    }
    (root / "job.yaml").write_text("capture: {cameras_only: true}\n")
    with pytest.raises(JobError, match="missing"):
        load_job(root)


def test_a_resolved_job_lists_exactly_its_cameras(tmp_path: Path) -> None:
    root = folder(tmp_path / "walk", "torso.mp4", "left_palm.mp4")
    job = load_job(root)
    folder(root, "head.mp4")
    (root / "job.yaml").write_text(json.dumps(job.model_dump(mode="json")))
    assert load_job(root) == job


def test_a_job_file_elsewhere_or_of_another_name_lists_exactly_its_cameras(tmp_path: Path) -> None:
    root = folder(tmp_path / "walk", "torso.mp4", "left_palm.mp4")
    (root / "calib.json").write_text(json.dumps(LENS))
    for file, video in ((root / "walk.yaml", "torso.mp4"), (tmp_path / "any.yaml", "walk/torso.mp4")):
        file.write_text(TORSO.replace("torso.mp4", video))
        job = load_job(file)
        assert cameras(job) == {"torso": ["torso.mp4"]}
        assert job.capture.cameras[0].calibration == "auto"
    loaded = load_job_with_origins(root / "walk.yaml")
    assert loaded.warnings == (
        "calib.json is not used for torso: a job file that is not called job.yaml uses it only if it says "
        "`calibration: calib.json`",
    )
    assert unused(root / "walk.yaml") == {
        "calib.json": "only a job.yaml uses it without `calibration:`",
        "left_palm.mp4": "not listed; only a job.yaml adds the videos beside it",
    }
    assert unused(tmp_path / "any.yaml") == {}
    policy = PathPolicy(folder=None, roots=(root,))
    (root / "job.yaml").write_text(TORSO)
    assert cameras(load_job(root / "job.yaml", policy=policy)) == {"torso": ["torso.mp4"]}
    assert cameras(load_job(root, policy=policy)).keys() == {"torso", "left_palm"}
    (root / "run.json").touch()
    assert cameras(load_job(root / "job.yaml")) == {"torso": ["torso.mp4"]}


@pytest.mark.parametrize("name", ["cam1.mp4", "GX010123.MP4", "board.mp4"])
def test_a_video_without_a_known_place_is_a_warning(tmp_path: Path, name: str) -> None:
    root = folder(tmp_path, "torso.mp4", "left_palm.mp4", name)
    (root / "job.yaml").write_text(TORSO)
    loaded = load_job_with_origins(root)
    assert cameras(loaded.job).keys() == {"torso", "left_palm"}
    (warning,) = loaded.warnings
    assert warning.startswith(f"{name} is not used: the name is not a known place on the body")
    assert "cameras_only: true" in warning
    assert unused(root) == {name: "the name is not a known place on the body"}


def test_a_video_whose_name_a_listed_camera_has_is_a_warning(tmp_path: Path) -> None:
    root = folder(tmp_path, "walk/torso.mp4", "walk/left_palm.mp4", "other/a.mp4") / "walk"
    (root / "job.yaml").write_text("capture: {cameras: [{name: Torso, video: ../other/a.mp4}]}\n")
    loaded = load_job_with_origins(root)
    assert cameras(loaded.job) == {"Torso": ["a.mp4"], "left_palm": ["left_palm.mp4"]}
    assert "camera torso of job.yaml lists another video" in loaded.warnings[0]
    with pytest.raises(JobError, match="not permitted"):
        load_job(root, policy=PathPolicy(folder=root))


def test_two_videos_of_one_name_are_a_warning(tmp_path: Path) -> None:
    root = folder(tmp_path, "torso.mp4", "head.mp4", "head.mov")
    (root / "job.yaml").write_text(TORSO)
    loaded = load_job_with_origins(root)
    assert cameras(loaded.job).keys() == {"torso"}
    assert loaded.warnings[0].startswith("head.mov, head.mp4 are not used: their cameras would have the same")


@pytest.mark.parametrize("listed", ["torso.mp4", "./torso.mp4", "head.mp4", "../walk/torso.mp4"])
def test_one_file_under_several_names_is_one_camera(tmp_path: Path, listed: str) -> None:
    root = folder(tmp_path, "walk/torso.mp4", "walk/left_palm.mp4") / "walk"
    (root / "head.mp4").symlink_to("torso.mp4")
    os.link(root / "torso.mp4", root / "hips.mp4")
    (root / "right_palm.mp4").symlink_to("left_palm.mp4")
    (root / "job.yaml").write_text(f"capture: {{cameras: [{{name: torso, video: {listed}}}]}}\n")
    loaded = load_job_with_origins(root)
    assert cameras(loaded.job) == {"torso": ["torso.mp4"], "left_palm": ["left_palm.mp4"]}
    assert loaded.warnings == ()
    reasons = unused(root)
    assert reasons.pop("right_palm.mp4") == "the same file as left_palm.mp4"
    assert set(reasons) == {"torso.mp4", "head.mp4", "hips.mp4"} - {Path(listed).name}
    assert set(reasons.values()) == {"the same file as the video of camera torso"}


@pytest.mark.parametrize("video", ["torso", "torso/GX010001.MP4", "[torso/GX010001.MP4, torso/GX020001.MP4]"])
def test_a_folder_that_holds_a_listed_video_is_no_second_camera(tmp_path: Path, video: str) -> None:
    root = folder(tmp_path, "torso/GX010001.MP4", "torso/GX020001.MP4", "torso/GX010001.THM", "head.mp4")
    (root / "job.yaml").write_text(f"capture: {{cameras: [{{name: trunk, mount: torso, video: {video}}}]}}\n")
    loaded = load_job_with_origins(root)
    assert cameras(loaded.job).keys() == {"trunk", "head"}
    reasons = unused(root)
    assert "not a video" in reasons.pop("torso/GX010001.THM")
    if video == "torso/GX010001.MP4":
        assert reasons == {"torso/GX020001.MP4": "camera trunk lists other chapters of this video"}
        assert loaded.warnings[0].startswith("GX020001.MP4 is not used")
    else:
        assert (reasons, loaded.warnings) == ({}, ())


def test_the_chapters_of_a_listed_gopro_video_are_no_other_camera(tmp_path: Path) -> None:
    root = folder(tmp_path, "GX010123.MP4", "GX020123.MP4", "torso.mp4")
    (root / "job.yaml").write_text("capture: {cameras: [{name: head, video: GX010123.MP4}]}\n")
    loaded = load_job_with_origins(root)
    assert cameras(loaded.job) == {"head": ["GX010123.MP4"], "torso": ["torso.mp4"]}
    assert loaded.warnings == (
        "GX020123.MP4 is not used: camera head lists other chapters of this video; list all chapters, in the "
        "order in which they were recorded",
    )
    (root / "job.yaml").write_text(
        "capture: {cameras: [{name: head, video: [GX010123.MP4, GX020123.MP4]}]}\n"
    )
    assert load_job_with_origins(root).warnings == ()
    assert unused(root) == {}


def test_results_and_both_job_files(tmp_path: Path) -> None:
    root = folder(tmp_path, "torso.mp4", "results/head.mp4", "results/run.json", "results/job.yaml", "a.txt")
    (root / "job.yaml").write_text(TORSO)
    (root / "job.yml").write_text("height_m: 1.8\n")
    (root / ".hips.mp4").touch()
    loaded = load_job_with_origins(root)
    assert cameras(loaded.job) == {"torso": ["torso.mp4"]}
    assert loaded.job.height_m is None
    assert loaded.warnings[0].startswith("job.yml is not used: the job file is job.yaml")
    assert unused(root) == {
        ".hips.mp4": "a hidden file",
        "a.txt": "not a video, and no setting names it",
        "job.yml": "the job file is job.yaml",
        "results/": "results of a run",
    }


def test_a_missing_video_beside_a_job_file_is_not_overlooked(tmp_path: Path) -> None:
    root = folder(tmp_path, "torso.mp4", "left_palm/notes.txt")
    (root / "job.yaml").write_text(TORSO)
    assert "left_palm is not used: holds no video" in load_job_with_origins(root).warnings[0]
    (root / "head.mp4").symlink_to(tmp_path / "unplugged.mp4")
    with pytest.raises(CaptureError, match="leads nowhere") as caught:
        load_job(root)
    assert "cameras_only" in str(caught.value.hint)
    (root / "job.yaml").write_text(ONLY)
    assert load_job_with_origins(root).warnings == ()
    assert unused(root)["head.mp4"] == "a link that leads nowhere"


def test_paths_that_cannot_be_followed_and_names_that_are_no_text(tmp_path: Path) -> None:
    root = folder(tmp_path, "torso.mp4")
    (root / "loop.mp4").symlink_to("loop.mp4")
    (root / "loop.txt").symlink_to("loop.txt")
    with open(os.fsencode(root) + b"/caf\xe9.mp4", "wb") as stream:
        stream.write(unopened())
    (root / "job.yaml").write_text(TORSO)
    (warning,) = load_job_with_origins(root).warnings
    assert warning.startswith(r"caf\udce9.mp4 is not used")
    assert set(unused(root)) == {r"caf\udce9.mp4", "loop.mp4", "loop.txt"}
    for video in ("loop.mp4", '"a\\0.mp4"', "x" * 300):
        (root / "job.yaml").write_text(f"capture: {{cameras: [{{name: head, video: {video}}}]}}\n")
        if video == "loop.mp4":
            assert cameras(load_job(root)).keys() == {"head", "torso"}
        else:
            with pytest.raises(JobError, match="cannot be a path"):
                load_job(root)
    (root / "loop.json").symlink_to("loop.json")
    (root / "job.yaml").write_text(TORSO.replace("torso.mp4", "torso.mp4, calibration: loop.json"))
    with pytest.raises(CaptureError, match="calibration cannot be read"):
        load_job(root)


def test_a_link_beside_a_job_file_that_leads_outside_is_refused_in_a_dropped_folder(tmp_path: Path) -> None:
    root = folder(tmp_path, "walk/torso.mp4", "secret.mp4") / "walk"
    (root / "left_palm.mp4").symlink_to("../secret.mp4")
    (root / "job.yaml").write_text(TORSO)
    with pytest.raises(JobError, match="outside"):
        load_job(root, policy=PathPolicy(folder=root))
    (root / "job.yaml").write_text(ONLY)
    assert cameras(load_job(root, policy=PathPolicy(folder=root))) == {"torso": ["torso.mp4"]}


def test_more_cameras_than_a_job_may_have(tmp_path: Path) -> None:
    root = folder(tmp_path, "torso.mp4", *(f"head_{index}.mp4" for index in range(64)))
    (root / "job.yaml").write_text(TORSO)
    with pytest.raises(JobError, match="64"):
        load_job(root)


def focal_lengths(job: Job) -> dict[str, float | str]:
    return {
        camera.name: camera.calibration.params[0] if isinstance(camera.calibration, Calibration) else "auto"
        for camera in job.capture.cameras
    }


def test_the_calibration_beside_a_job_file_is_used_unless_another_is_stated(tmp_path: Path) -> None:
    root = folder(tmp_path, "torso.mp4", "left_palm.mp4", "head/a.mp4", "hips.mp4")
    beside = {**LENS, "offsets_s": {"left_palm": 0.25}, "rolling_shutter_s": 0.01}
    (root / "calib.json").write_text(json.dumps(beside))
    (root / "head" / "calib.json").write_text(json.dumps({**LENS, "params": [500, 500, 320, 240]}))
    (root / "lenses.json").write_text(json.dumps({**LENS, "params": [600, 600, 320, 240]}))
    text = "capture:\n  cameras:\n    - {name: torso, video: torso.mp4}\n    - {name: head, video: head}\n"
    text += "    - {name: hips, video: hips.mp4, calibration: auto}\n"
    (root / "job.yaml").write_text(text)
    loaded = load_job_with_origins(root)
    assert focal_lengths(loaded.job) == {"torso": 420, "head": 500, "hips": "auto", "left_palm": 420}
    palm = loaded.job.capture.cameras[-1]
    assert (palm.offset_s, palm.rolling_shutter_s) == (0.25, 0.01)
    calibrations = {name: origins.calibration for name, origins in loaded.origins.items()}
    assert {name: (each.source, each.value) for name, each in calibrations.items()} == {
        "torso": ("calib.json", "PINHOLE"),
        "head": ("calib.json", "PINHOLE of head/"),
        "hips": ("job file", "auto"),
        "left_palm": ("calib.json", "PINHOLE"),
    }
    assert unused(root) == {"lenses.json": "not a video, and no setting names it"}
    (root / "job.yaml").write_text(f"{text}  calibration: auto\n")
    assert set(focal_lengths(load_job(root)).values()) == {"auto"}
    assert unused(root)["calib.json"] == "the calibration of every camera comes from elsewhere"
    (root / "job.yaml").write_text(f"{text}  calibration: lenses.json\n")
    assert focal_lengths(load_job(root)) == {"torso": 600, "head": 600, "hips": "auto", "left_palm": 600}
    (root / "job.yaml").unlink()
    assert focal_lengths(load_job(root)) == {"torso": 420, "head": 500, "hips": 420, "left_palm": 420}


def test_a_calibration_beside_a_job_file_is_checked_like_that_of_a_folder(tmp_path: Path) -> None:
    root = folder(tmp_path / "walk", "torso.mp4")
    (root / "job.yaml").write_text(TORSO.replace("torso,", "chest,"))
    (root / "calib.json").write_text(json.dumps({"cameras": {"torso": LENS}}))
    with pytest.raises(CaptureError, match="no calibration of a camera named 'chest'"):
        load_job(root)
    (root / "calib.json").unlink()
    (root / "calib.json").symlink_to(tmp_path / "secret.json")
    with pytest.raises(CaptureError, match="leads nowhere"):
        load_job(root)
    (tmp_path / "secret.json").write_text("{not json: password}")
    with pytest.raises(JobError, match="outside"):
        load_job(root, policy=PathPolicy(folder=root))


def test_where_the_settings_of_a_camera_come_from(tmp_path: Path) -> None:
    root = folder(tmp_path, "a.mp4", "b.mp4", "left_palm.mp4", "left_palm.timestamps.txt", "t.txt")
    (root / "lens.json").write_text(json.dumps({**LENS, "offset_s": -0.5}))
    (root / "job.yaml").write_text(
        "capture:\n  cameras:\n"
        "    - {name: trunk, video: [a.mp4, b.mp4], mount: torso, offset_s: 2, timestamps: t.txt,\n"
        "       calibration: lens.json,\n"
        "       joint_from_cam: {translation_m: [0, 0, 0], quat_xyzw: [0, 0, 0, 1]}}\n"
        "    - {name: head, video: c.mp4, calibration: lens.json}\n"
    )
    origins = load_job_with_origins(root).origins
    assert origins["trunk"].lines() == [
        "video: a.mp4 to b.mp4, 2 files (from the job file)",
        "calibration: PINHOLE in lens.json (from the job file)",
        "timestamps: t.txt (from the job file)",
        "clock: offset 2 s (from the job file); drift 0 ppm (default)",
        "mount: torso (from the job file); pose on the bone: measured (from the job file)",
    ]
    assert origins["head"].clock_offset.text() == "-0.5 s in lens.json (from the job file)"
    assert origins["left_palm"].lines() == [
        "video: left_palm.mp4 (from the folder)",
        "calibration: auto (default)",
        "timestamps: left_palm.timestamps.txt (from the sidecar file)",
        "clock: offset auto (default); drift auto (default)",
        "mount: left_palm (from the camera name); pose on the bone: typical of the place (default)",
    ]


def test_a_sidecar_beside_a_link_or_beside_its_target_is_used(tmp_path: Path) -> None:
    root = folder(tmp_path, "walk/torso.timestamps.txt", "card/x.mp4", "card/y.mp4", "card/y.timestamps.txt")
    for name, target in (("torso", "x"), ("head", "y")):
        (root / "walk" / f"{name}.mp4").symlink_to(root / "card" / f"{target}.mp4")
    for text in ("", "capture: {cameras: [{name: torso, video: torso.mp4}, {name: head, video: head.mp4}]}"):
        if text:
            (root / "walk" / "job.yaml").write_text(text)
        found = {camera.name: camera.timestamps for camera in load_job(root / "walk").capture.cameras}
        assert found == {
            "torso": (root / "walk" / "torso.timestamps.txt",),
            "head": (root / "card" / "y.timestamps.txt",),
        }


def test_a_job_that_computes_no_body_says_what_is_missing(tmp_path: Path) -> None:
    root = folder(tmp_path, "torso.mp4")
    assert "this job has only torso (on torso); add a camera on a limb" in load_job_with_origins(root).no_body
    assert load_job_with_origins(root).warnings_of_run() == ()
    (root / "job.yaml").write_text(f"height_m: 1.7\n{TORSO.replace('torso,', 'left_palm,')}")
    loaded = load_job_with_origins(root)
    assert "add a camera on the trunk or the head" in loaded.no_body
    assert loaded.warnings_of_run() == (loaded.no_body,)
    (root / "job.yaml").write_text(f"skeleton: none\nheight_m: 1.7\n{TORSO}")
    assert load_job_with_origins(root).no_body == ""
    (root / "job.yaml").write_text(f"height_m: 1.7\n{TORSO.replace('torso,', 'phone,')}")
    assert "name each video after its place" in load_job_with_origins(root).no_body


@pytest.mark.parametrize("job", ["", "height_m: 1.7\n", TORSO])
@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("head.mp4.part", b"anything", "unfinished copy of a video: the video head.mp4 itself is not there"),
        ("head/GX010042.MP4.part", b"anything", "the video GX010042.MP4 itself is not there"),
        ("head.mp4.download/head.mp4", unopened(), "the video head.mp4 itself is not there"),
        ("Unconfirmed 12.crdownload", unopened()[:-1], "unfinished copy of a video: its end is missing"),
        (".rsync-partial/head.mp4", unopened()[:-1], "unfinished copy of a video: its end is missing"),
        ("head.flv", b"FLV\x01" + bytes(20), "this file is a video, but .flv does not say so"),
        ("head", unopened(), "this file is a video, but its name does not say so"),
    ],
)
def test_a_camera_whose_file_is_there_is_never_left_out_silently(
    tmp_path: Path, job: str, name: str, content: bytes, message: str
) -> None:
    root = folder(tmp_path, "torso.mp4", "left_palm.mp4")
    (root / name).parent.mkdir(exist_ok=True)
    (root / name).write_bytes(content)
    if job:
        (root / "job.yaml").write_text(job)
    with pytest.raises(CaptureError, match=message) as caught:
        load_job(root)
    assert caught.value.path == str(root / name)
    (root / "job.yaml").write_text(ONLY)
    assert cameras(load_job(root)) == {"torso": ["torso.mp4"]}


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("torso.mp4.part", b"of an earlier copy"),
        ("torso.mp4.timestamps.txt", b""),
        ("head.mp4.imu.csv", b"t_s"),
        ("torso.LRV", unopened()),
        ("head.m4a", b"\0\0\0\x0cftypM4A "),
        ("head.heic", b"\0\0\0\x0cftypheic"),
        ("head.txt", b"FLV is a kind of video"),
        ("notes on the head.docx", b"PK"),
        ("out/head.mp4.part", b"anything"),
        ("#recycle/head.mp4", unopened()),
        ("@Recycle/GX010042.MP4", unopened()[:-1]),
        ("@eaDir/torso.mp4@SynoEAStream", b"anything"),
    ],
)
def test_other_files_beside_the_videos_are_no_reason_to_refuse_a_job(
    tmp_path: Path, name: str, content: bytes
) -> None:
    root = folder(tmp_path, "torso.mp4", "left_palm.mp4")
    (root / name).parent.mkdir(exist_ok=True)
    (root / name).write_bytes(content)
    assert set(cameras(load_job(root))) == {"torso", "left_palm"}
    (root / "job.yaml").write_text(TORSO)
    loaded = load_job_with_origins(root)
    assert set(cameras(loaded.job)) >= {"torso", "left_palm"}
    assert loaded.warnings == ()


def test_a_video_with_two_suffixes_is_a_video(tmp_path: Path) -> None:
    root = folder(tmp_path, "left_palm.MP4.mov")
    assert [path.name for path in load_job(root).capture.cameras[0].video] == ["left_palm.MP4.mov"]


def test_a_listed_file_may_have_any_name(tmp_path: Path) -> None:
    root = folder(tmp_path, "torso.mp4.bak", "head.flv")
    (root / "job.yaml").write_text(
        "capture: {cameras: [{name: torso, video: torso.mp4.bak}, {name: head, video: head.flv}]}\n"
    )
    assert cameras(load_job(root)) == {"torso": ["torso.mp4.bak"], "head": ["head.flv"]}


def test_a_warning_says_that_a_video_cannot_be_opened(tmp_path: Path) -> None:
    root = folder(tmp_path, "torso.mp4", "GX010042.MP4", "cam7/GX010043.MP4")
    (root / "job.yaml").write_text(TORSO)
    assert not any("opened" in warning for warning in load_job_with_origins(root).warnings)
    for name in ("GX010042.MP4", "cam7/GX010043.MP4"):
        (root / name).write_bytes(unopened()[:-1])
    loaded = load_job_with_origins(root)
    for name, warning in zip(("GX010042.MP4", "GX010043.MP4"), sorted(loaded.warnings), strict=True):
        assert f"{name} cannot be opened: its end is missing" in warning
    assert set(loaded.beside.unreadable) == {root / "GX010042.MP4", root / "cam7" / "GX010043.MP4"}
    (root / "job.yaml").write_text(ONLY)
    assert load_job_with_origins(root).warnings == ()
