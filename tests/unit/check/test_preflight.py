"""The check before a job: a good capture gives no notes, and each fault is reported."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.capture import CaptureCamera, open_camera, open_capture
from bodycap_batch.check import check_job, check_path, preflight, require_ready
from bodycap_batch.check.picture_quality import sample_indices
from bodycap_batch.cli import main
from bodycap_batch.config.job import Overrides, load_job
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.config.options import ExportOptions
from bodycap_batch.core.errors import Cancelled, JobError, StoreError
from bodycap_batch.formats import optional_libraries
from bodycap_batch.formats.bvh import write_bvh
from bodycap_batch.store.disk_space import require_room
from tests.bodies import reaching
from tests.videos import textured_frame, unopened, write_video

FRAMES = [textured_frame(index % 40) for index in range(75)]
LENS = {"model": "PINHOLE", "params": [40, 40, 32, 24], "width": 64, "height": 48}

FOCAL_KEY = "com.apple.quicktime.camera.focal_length.35mm_equivalent"


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    """Two cameras, 2.5 s each."""
    root = tmp_path / "walk"
    write_video(root / "torso.mp4", FRAMES)
    write_video(root / "left_palm.mp4", [frame[:, ::-1] for frame in FRAMES])
    (root / "calib.json").write_text(json.dumps({**LENS, "offset_s": 0.0}))
    return root


def test_a_good_capture(walk: Path, tmp_path: Path) -> None:
    report = check_path(walk, Overrides(out=tmp_path / "out", height_m=1.8))
    assert report.ready
    assert report.exit_code == 0
    palm, torso = report.cameras
    assert (torso.name, torso.role, torso.frames, torso.used_frames) == ("torso", "Spine1", 75, 75)
    assert torso.size_px == torso.work_size_px == (64, 48)
    assert not torso.variable_rate
    assert torso.notes == palm.notes == ()
    text = "\n".join(report.lines())
    assert "torso: torso.mp4 -> torso" in text
    assert "all cameras recorded at the same time for 2.5 s" in text
    assert json.loads(json.dumps(report.to_dict()))["ready"] is True
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("block", "fps"), [("merge", 240), ("export", 1000)])
def test_a_rate_that_gives_too_many_ticks_is_refused_before_any_work(
    walk: Path, monkeypatch: pytest.MonkeyPatch, block: str, fps: int
) -> None:
    (walk / "job.yaml").write_text(
        f"capture: {{calibration: calib.json}}\nout: out\nheight_m: 1.8\n{block}: {{fps: {fps}}}\n"
    )
    assert check_path(walk).ready
    monkeypatch.setattr(preflight, "MAX_TICKS", 500)
    (error,) = check_path(walk).errors
    assert (error.exit_code, error.field) == (2, f"{block}.fps")
    assert f"at {fps} ticks per second are more than 500 ticks" in error.message
    assert "at most 20" in str(error.hint)


def test_an_unlikely_calibration_and_dropped_frames_are_reported(walk: Path) -> None:
    lens = {**LENS, "params": [4, 4, 32, 24]}
    sharp = {**LENS, "params": [40, 40, 55, 24]}
    (walk / "calib.json").write_text(json.dumps({"cameras": {"torso": lens, "left_palm": sharp}}))
    times = np.delete(np.arange(79), [10, 11, 30, 31]) / 30
    (walk / "torso.timestamps.txt").write_text("".join(f"{t:.6f}\n" for t in times))
    palm, torso = check_path(walk).cameras
    assert torso.variable_rate
    assert "the camera dropped 4 frames at 2 places of the video; the longest gap is 0.10 s" in torso.notes
    assert any("focal length" in note for note in torso.notes)
    assert any("principal point" in note for note in palm.notes)


def test_short_grey_and_partly_black_videos_are_reported(tmp_path: Path) -> None:
    flat, black = np.full((48, 64), 120, np.uint8), np.zeros((48, 64), np.uint8)
    write_video(tmp_path / "torso.mp4", [flat] * 20)
    write_video(tmp_path / "head.mp4", [black] * 10 + FRAMES[:20], gop=5)
    head, torso = check_path(tmp_path).cameras
    assert any("contrast" in note for note in torso.notes)
    assert any("hardly enough movement" in note for note in torso.notes)
    assert any("are black" in note for note in head.notes)


def test_an_interlaced_video_is_reported_once(walk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def open_interlaced(spec: CaptureConfig, config: CameraConfig) -> CaptureCamera:
        camera = open_camera(spec, config)
        return replace(camera, videos=tuple(replace(video, is_interlaced=True) for video in camera.videos))

    monkeypatch.setattr(preflight, "open_camera", open_interlaced)
    for camera in check_path(walk).cameras:
        assert sum("interlaced" in note for note in camera.notes) == 1


def test_cameras_that_never_ran_together(walk: Path) -> None:
    job = load_job(walk)
    palm, torso = job.capture.cameras

    def with_offset(offset_s: float):  # type: ignore[no-untyped-def]
        cameras = (palm.model_copy(update={"offset_s": offset_s}), torso)
        return check_job(
            job.model_copy(update={"capture": job.capture.model_copy(update={"cameras": cameras})})
        )

    assert with_offset(2.0).ready
    late = with_offset(2.6)
    assert late.exit_code == 3
    assert "left_palm recorded from 2.60 to 5.07 s" in late.errors[0].message
    assert late.errors[0].field == "offset_s"
    assert "Unix" in str(with_offset(1.7e9).errors[0].hint)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("merge: {known_distance: ['torso:0', 'torso:75', 2.5]}", "camera torso has no frame 75"),
        ("merge: {known_distance: ['torso:0', 'trso:9', 2.5]}", "there is no camera 'trso'"),
        ("map: {init_frames: ['left_palm:400', 'torso:9']}", "camera left_palm has no frame 400"),
        ("map: {init_frames: ['left_palm:74', 'torso:9']}", ""),
        (
            "capture: {start_s: 1.0}\nmerge: {known_distance: ['torso:0', 'torso:60', 2.5]}",
            "frame 0 of camera torso is not used",
        ),
        (
            "capture: {end_s: 1.0}\nmap: {init_frames: ['left_palm:9', 'torso:31']}",
            "frame 31 of camera torso is not used",
        ),
        ("capture: {start_s: 1.0}\nmerge: {known_distance: ['torso:30', 'torso:74', 2.5]}", ""),
    ],
)
def test_named_frames_that_do_not_exist_or_are_unused_are_errors(walk: Path, text: str, message: str) -> None:
    (walk / "job.yaml").write_text(f"{text}\n")
    report = check_path(walk)
    assert report.exit_code == (2 if message else 0)
    assert [error.message for error in report.errors] == ([message] if message else [])
    if "frame 0 of" in message:
        assert "choose a frame from 30 to 74" in str(report.errors[0].hint)


def test_every_problem_is_collected(walk: Path) -> None:
    (walk / "torso.mp4").write_bytes(b"")
    (walk / "left_palm.mp4").write_bytes(b"no video at all")
    report = check_path(walk)
    assert len(report.errors) == 2
    assert report.exit_code == 3
    assert report.lines()[-1] == "not ready: 2 problems"


def test_the_skeleton_file_must_carry_the_cameras(walk: Path, tmp_path: Path) -> None:
    bvh = tmp_path / "s.bvh"
    channels = "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation"
    bvh.write_text(
        f"HIERARCHY\nROOT Hips\n{{\nOFFSET 0 0 0\n{channels}\nEnd Site\n{{\nOFFSET 0 10 0\n}}\n}}\n"
        "MOTION\nFrames: 1\nFrame Time: 0.0333333\n0 0 0 0 0 0\n"
    )
    report = check_path(walk, Overrides(skeleton=str(bvh)))
    assert report.exit_code == 2
    assert report.errors[0].path == str(bvh)
    assert "LeftHand" in report.errors[0].message
    bvh.write_text("HIERARCHY\n")
    assert check_path(walk, Overrides(skeleton=str(bvh))).errors[0].path == str(bvh)


def test_formats_that_cannot_be_written_are_errors(
    walk: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    job = load_job(walk, Overrides(out=tmp_path / "out", height_m=1.8))

    def errors(**export: object) -> list[str]:
        options = ExportOptions.model_validate({**job.export.model_dump(), **export})
        found = check_job(job.model_copy(update={"export": options})).errors
        return [str(error) for error in found if isinstance(error, JobError)]

    assert errors() == []
    monkeypatch.setattr(optional_libraries, "find_spec", lambda name: None)
    (text,) = errors(formats=("bvh", "usd"))
    assert text.startswith("export.formats: USD files need a library")
    monkeypatch.setenv("BODYCAP_BLENDER", str(tmp_path / "nothing"))
    (text,) = errors(formats=("fbx",))
    assert "BODYCAP_BLENDER is not the path of a program" in text


def test_a_skeleton_file_keeps_its_names(walk: Path, tmp_path: Path) -> None:
    write_bvh(tmp_path / "s.bvh", reaching(1))
    job = load_job(walk, Overrides(out=tmp_path / "out", skeleton=str(tmp_path / "s.bvh")))
    other = job.model_copy(update={"export": ExportOptions(names="unreal")})
    assert not [error for error in check_job(job).errors if isinstance(error, JobError)]
    (error,) = [error for error in check_job(other).errors if isinstance(error, JobError)]
    assert error.field == "export.names"
    mapped = job.model_copy(update={"skeleton_map": {"LeftHand": "none"}})
    (error,) = [error for error in check_job(mapped).errors if isinstance(error, JobError)]
    assert "camera left_palm is mounted on LeftHand" in error.message
    assert "skeleton_map" in str(error.hint)


def test_what_a_skeleton_file_means_is_said_before_the_run(walk: Path, tmp_path: Path) -> None:
    """Findings about the file are notes; a joint that the cameras need, and a wrong height, are refused."""
    body = reaching(1).skeleton
    sideways = body.offsets_m[:, [1, 0, 2]] * [-1.0, 1.0, 1.0]
    turned = replace(body, offsets_m=sideways, end_offsets_m=body.end_offsets_m[:, [1, 0, 2]] * [-1, 1, 1])
    write_bvh(tmp_path / "s.bvh", replace(reaching(1), skeleton=turned))
    overrides = Overrides(out=tmp_path / "out", skeleton=str(tmp_path / "s.bvh"), height_m=1.75)
    job = load_job(walk, overrides)
    notes = [note for note in check_job(job).notes if note.startswith("skeleton s.bvh")]
    assert "up is +Y and the body faces +X" in notes[1]
    assert "skeleton file" not in " ".join(notes)
    (note,) = [
        note
        for note in check_job(job.model_copy(update={"skeleton_map": {"Neck": "none"}})).notes
        if "warning" in note
    ]
    assert "no joint has the role Neck" in note
    mapped = job.model_copy(update={"skeleton_map": {"LeftForeArm": "none", "LeftArm": "none"}})
    (error,) = [error for error in check_job(mapped).errors if isinstance(error, JobError)]
    assert "camera left_palm is mounted on LeftHand" in error.message
    assert "the role LeftArm, LeftForeArm" in error.message
    assert "skeleton_map: {JOINT: LeftArm, JOINT: LeftForeArm}" in str(error.hint)
    (error,) = [
        error
        for error in check_job(job.model_copy(update={"height_m": 1.3})).errors
        if isinstance(error, JobError)
    ]
    assert "the stated height is 1.3 m" in error.message


def test_room_on_the_disk(walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import shutil
    from collections import namedtuple

    usage = namedtuple("usage", "total used free")
    job = load_job(walk, Overrides(out=tmp_path / "a" / "b", height_m=1.8))
    free = 10**6
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(10**9, 10**9 - free, free))
    report = check_job(job)
    assert report.exit_code == 5
    assert report.errors[0].path == str(tmp_path)
    assert "--out" in str(report.errors[0].hint)
    # Two cameras of 75 frames need at least 50 MB and 70 kB per frame; four times that is ample.
    free = 61 * 10**6
    assert any("may be too little" in note for note in check_job(job).notes)
    with pytest.raises(StoreError, match="61 MB of free space, but the job needs about 83 MB"):
        require_room(tmp_path, 150, 150)  # large frames, of which copies are stored
    free = 243 * 10**6
    assert len(check_job(job).notes) == 1


def test_samples_are_key_frames_and_the_end(tmp_path: Path) -> None:
    write_video(tmp_path / "torso.mp4", FRAMES, gop=5, bframes=False)
    capture = open_capture(load_job(tmp_path).capture)
    samples = sample_indices(capture.camera("torso"), 8)
    assert (samples[:-1] % 5 == 0).all()
    assert (len(samples), samples[-1]) == (9, 74)


def test_the_sample_job_before_it_is_rendered(tmp_path: Path) -> None:
    path = tmp_path / "lab.yaml"
    path.write_text(
        "capture:\n  cameras: [{name: torso, video: sample/torso.mp4}]\n  synthetic: {seconds: 1}\n"
    )
    report = check_path(path)
    assert report.ready
    assert "renders these videos first" in report.notes[0]


def test_a_stopped_check_does_not_wait_for_the_remaining_cameras(
    walk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = load_job(walk)
    checked: list[object] = []

    def check_camera(_: object, config: object, *_args: object, **_options: object) -> None:
        if config is job.capture.cameras[0]:
            raise Cancelled("stopped on request")
        checked.append(config)
        time.sleep(0.5 if len(checked) == 1 else 0.0)

    monkeypatch.setattr(preflight, "_check_camera", check_camera)
    cameras = (job.capture.cameras[0], *job.capture.cameras[1:] * 50)
    many = job.model_copy(update={"capture": job.capture.model_copy(update={"cameras": cameras})})
    with pytest.raises(Cancelled):
        require_ready(many, threads=1)
    assert len(checked) < 50


def test_the_check_says_where_settings_come_from_and_what_is_not_used(
    walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_video(walk / "head.mkv", FRAMES[20:], metadata={FOCAL_KEY: "28"})
    for name in ("board.mp4", "notes.txt", "left_palm.timestamps.txt"):
        (walk / name).write_bytes(unopened() if name == "board.mp4" else b"")
    times = "".join(f"{index / 30:.6f}\n" for index in range(75))
    (walk / "left_palm.timestamps.txt").write_text(times)
    (walk / "job.yaml").write_text(
        "height_m: 1.7\ncapture:\n  cameras:\n"
        "    - {name: torso, video: torso.mp4, offset_s: 0.2}\n"
        "    - {name: head, video: head.mkv, calibration: auto}\n"
    )
    assert main(["check", str(walk), "--out", str(tmp_path / "out")]) == 0
    text = capsys.readouterr().out
    for line in (
        "  calibration: PINHOLE (from calib.json)",
        "  calibration: auto (from the job file), starting at 65° (from the video metadata)",
        "  timestamps: left_palm.timestamps.txt (from the sidecar file)",
        "  clock: offset 0.2 s (from the job file); drift 0 ppm (default)",
        "  mount: torso (from the camera name); pose on the bone: typical of the place (default)",
        "  video: left_palm.mp4 (from the folder)",
        "not used (the name is not a known place on the body): board.mp4",
        "not used (not a video, and no setting names it): notes.txt",
    ):
        assert line in text.splitlines(), line
    assert "note: board.mp4 is not used: the name is not a known place" in text
    assert main(["check", str(walk), "--out", str(tmp_path / "out"), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    torso, head, palm = (camera["origins"] for camera in data["cameras"])
    assert torso["clock_offset"] == {"source": "job file", "value": "0.2 s"}
    assert head["first_guess"] == {"source": "video metadata", "value": "65°"}
    assert palm["video"]["source"] == "folder"
    assert [file["path"] for file in data["unused_files"]] == ["board.mp4", "notes.txt"]


def test_one_camera_with_a_height_gets_no_body(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_video(tmp_path / "walk" / "torso.mp4", FRAMES)
    command = ["check", str(tmp_path / "walk"), "--height", "1.7", "--out", str(tmp_path / "out")]
    assert main(command) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == "ready to run: map and camera paths, no body"
    (note,) = (line for line in lines if "no body is computed" in line)
    assert "two cameras or more on different bones" in note
    assert "for example left_palm.mp4" in note
    assert main([*command, "--skeleton", "none"]) == 0
    assert "no body is computed" not in capsys.readouterr().out
