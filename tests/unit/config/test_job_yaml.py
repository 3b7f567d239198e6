"""YAML jobs: typed, and every refusal names file, line, field and remedy."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from bodycap_batch.config.job import Overrides, load_job
from bodycap_batch.config.models import Job
from bodycap_batch.config.options import MARKER_COUNTS
from bodycap_batch.core.errors import CaptureError, JobError
from bodycap_batch.pipeline.inputs import body_input
from bodycap_batch.store.digests import FileDigests

MINIMAL = """\
capture:
  cameras:
    - name: torso
      video: torso.mp4
    - name: left_palm
      video: [left/a.mp4, left/b.mp4]
"""


def load(tmp_path: Path, text: str, overrides: Overrides | None = None) -> Job:
    path = tmp_path / "my job.yaml"
    path.write_text(text, encoding="utf-8")
    return load_job(path, overrides)


def refused(tmp_path: Path, text: str) -> JobError:
    with pytest.raises(JobError) as caught:
        load(tmp_path, text)
    error = caught.value
    assert error.exit_code == 2
    assert error.path == str((tmp_path / "my job.yaml").resolve())
    return error


def test_only_the_capture_is_needed(tmp_path: Path) -> None:
    job = load(tmp_path, MINIMAL)
    assert job.name == "my_job"
    assert job.skeleton == "auto"
    assert job.out == tmp_path / "out" / "my_job"
    torso, palm = job.capture.cameras
    assert torso.video == (tmp_path / "torso.mp4",)
    assert palm.video == (tmp_path / "left/a.mp4", tmp_path / "left/b.mp4")
    assert (torso.role, palm.role) == ("Spine1", "LeftHand")
    assert torso.calibration == "auto"
    assert (torso.offset_s, torso.drift_ppm, torso.rolling_shutter_s) == (0.0, None, None)


def test_clocks_are_stated_or_estimated(tmp_path: Path) -> None:
    cameras = "cameras: [{name: torso, video: torso.mp4, offset_s: %s}, {name: head, video: head.mp4}]"
    for stated, clocks, expected in (
        ("auto", "auto", (0.0, None)),
        ("0.12", "auto", (0.12, None)),
        ("0.12", "common", (0.12, 0.0)),
    ):
        job = load(tmp_path, f"capture: {{clocks: {clocks}, {cameras % stated}}}\n")
        assert tuple(camera.offset_s for camera in job.capture.cameras) == expected
    with pytest.raises(JobError, match="offset_s"):
        load(tmp_path, f"capture: {{{cameras % 'soon'}}}\n")


def test_a_resolved_job_survives_json(tmp_path: Path) -> None:
    text = (
        MINIMAL
        + "  calibration: {model: opencv, params: [1e3, 1000, 960, 540, -0.1, 0, 0, 1e-3],\n"
        + "    width: 1920, height: 1080}\n"
    )
    text += "  start_s: 0.25\nheight_m: 1.8\nout: results\nexport: {units: m}\n"
    job = load(tmp_path, text)
    assert job.out == tmp_path / "results"
    assert Job.model_validate(json.loads(json.dumps(job.model_dump(mode="json")))) == job
    written = tmp_path / "job.json"
    written.write_text(json.dumps(job.model_dump(mode="json"), indent=1))
    assert load_job(written) == job


def test_the_command_line_wins(tmp_path: Path) -> None:
    overrides = Overrides(out=tmp_path / "elsewhere", skeleton="none", height_m=1.62)
    job = load(tmp_path, MINIMAL + "height_m: 1.8\nskeleton: upper_body\n", overrides)
    assert (job.out, job.skeleton, job.height_m) == (tmp_path / "elsewhere", "none", 1.62)
    with pytest.raises(JobError, match=r"17\.5 m is not plausible"):
        load(tmp_path, MINIMAL, Overrides(height_m=17.5))


def test_yaml_words_are_not_turned_into_other_things(tmp_path: Path) -> None:
    text = MINIMAL.replace("name: torso", "name: no\n      mount: torso") + "name: 2026-03-01\n"
    job = load(tmp_path, text)
    assert job.capture.cameras[0].name == "no"
    assert job.name == "2026-03-01"


def test_a_placeholder_is_a_whole_value_and_not_part_of_a_path(tmp_path: Path) -> None:
    walk = tmp_path / "walk <3>"
    walk.mkdir()
    for name in ("torso.mp4", "<left>.mp4"):
        (walk / name).touch()
    text = "capture: {cameras: [{name: torso, video: torso.mp4}, {name: left.palm, video: <left>.mp4}]}"
    assert [camera.video for camera in load(walk, text).capture.cameras] == [
        (walk / "torso.mp4",),
        (walk / "<left>.mp4",),
    ]
    (walk / "<left>.mp4").rename(walk / "left_palm.mp4")
    assert len(load_job(walk).capture.cameras) == 2
    text = 'capture: {cameras: [{name: torso, video: torso.mp4}, {name: a, mount: "<left>", video: b.mp4}]}'
    assert "no mount '<left>'" in refused(walk, text).message


@pytest.mark.parametrize(
    ("text", "line", "field", "message", "hint"),
    [
        (MINIMAL + "heigth_m: 1.8\n", 7, "heigth_m", "unknown key", "'height_m'"),
        (MINIMAL + "  work_pixel: 640\n", 7, "capture.work_pixel", "unknown key", "'work_px'"),
        (MINIMAL + "      montu: torso\n", 7, "capture.cameras.1.montu", "unknown key", "'mount'"),
        (MINIMAL + "map:\n  featurs: 3\n", 8, "map.featurs", "unknown key", "'features'"),
        (MINIMAL + "height_m: tall\n", 7, "height_m", "'tall' is not a body height", None),
        (MINIMAL + "height_m: true\n", 7, "height_m", "True should be a number", None),
        (MINIMAL + 'height_m: "tall"\n', 7, "height_m", "is not a body height", None),
        (MINIMAL + "height_m: 17.5\n", 7, "height_m", "less than or equal to 2.6", None),
        (MINIMAL + "  work_px: 640.5\n", 7, "capture.work_px", "640.5", None),
        (MINIMAL + "  start_s: .nan\n", 7, "capture.start_s", "should be a number", None),
        (MINIMAL + "  start_s: 1e999\n", 7, "capture.start_s", "out of range", "number"),
        (MINIMAL + "activity: wlak\n", 7, "activity", "not one of walk, generic", "'walk'"),
        (MINIMAL + "skeleton: uper_body\n", 7, "skeleton", "no skeleton", "'upper_body'"),
        (MINIMAL + "skeleton: body.bvh\n", 7, "skeleton", "no such skeleton file", "path"),
        (MINIMAL + "name: a/b\n", 7, "name", "cannot be a folder's name", "letters"),
        (MINIMAL + "      mount: left_plam\n", 7, "capture.cameras.1.mount", "no mount", "'left_palm'"),
        (MINIMAL + "      segment: LeftHnad\n", 7, "capture.cameras.1.segment", "no segment", "'LeftHand'"),
        (MINIMAL.replace("left_palm", "Torso"), 5, "capture.cameras.1.name", "two cameras", "torso_back"),
        (MINIMAL.replace("left_palm", "a/../b"), 5, "capture.cameras.1.name", "a file's name", "letters"),
        (MINIMAL.replace("left_palm", "wide"), 5, "capture.cameras.1", "on the body is unknown", "mount"),
        (MINIMAL.replace("left/b", "left/a"), 6, "capture.cameras.1.video", "listed twice", "once"),
        (MINIMAL.replace("[left/a.mp4, left/b.mp4]", "torso.mp4"), 6, "capture.cameras.1.video", "same", ""),
        (MINIMAL.replace("torso.mp4", "17"), 4, "capture.cameras.0.video", "should be a list", None),
        (MINIMAL.replace("left_palm", "left palm"), 5, "capture.cameras.1.name", "a file's", "digits, ., _"),
        (MINIMAL.replace("      video: torso.mp4\n", ""), 3, "capture.cameras.0.video", "missing", "video"),
        (MINIMAL + "  start_s: 5\n  end_s: 5\n", 8, "capture.end_s", "not after", None),
        (MINIMAL.replace("torso.mp4", '"a\\0.mp4"'), 4, "capture.cameras.0.video", "be a path", ""),
        (MINIMAL.replace("torso.mp4", "a" * 300), 4, "capture.cameras.0.video", "be a path", ""),
        (MINIMAL + "      timestamps: " + "a" * 300, 7, "capture.cameras.1.timestamps", "be a path", ""),
        (MINIMAL + "  calibration: " + "a" * 300, 7, "capture.calibration", "be a path", ""),
        (MINIMAL + "skeleton: " + "a" * 300 + ".bvh", 7, "skeleton", "be a path", ""),
        (MINIMAL + "out: " + "a" * 300, 7, "out", "be a path", ""),
        ("height_m: 1.8\n", 1, "capture", "missing", "capture"),
        ("capture: {cameras: []}\n", 1, "capture.cameras", "list is empty", None),
        (MINIMAL + "skeleton: none\nskeleton: none\n", 8, "skeleton", "the first time on line 7", "one"),
        (MINIMAL.replace("    - name: left", "\t- name: left"), 5, None, "tab", "spaces"),
        (MINIMAL + "name:\tx\n\tout: y\n", 8, None, "tab", "spaces"),
        ("capture: [1, 2\n", 2, None, "not valid YAML", None),
        ("", None, None, "empty", "capture"),
        ("- a\n", None, None, "not a block", "capture"),
        (MINIMAL + "name: &a b\n", 7, None, "anchors", "quotes"),
        (MINIMAL + "name: !!python/object:os.system x\n", 7, None, "tags", "quotes"),
        ("{" * 200, 1, None, "deeper", None),
        ("[" * 100_000, 1, None, "deeper", None),
    ],
)  # fmt: skip
def test_refusals(
    tmp_path: Path, text: str, line: int | None, field: str | None, message: str, hint: str | None
) -> None:
    error = refused(tmp_path, text)
    assert message in error.message
    assert error.line == line
    assert error.field == field
    assert hint is None or hint in str(error.hint)


def test_every_problem_is_reported_at_once(tmp_path: Path) -> None:
    error = refused(tmp_path, MINIMAL + "heigth_m: 1.8\nactivity: run\n")
    assert error.line == 7
    assert "also line 8 activity" in error.message


def test_files_that_are_no_text(tmp_path: Path) -> None:
    path = tmp_path / "job.yaml"
    path.write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(JobError):
        load_job(path)
    path.write_bytes(b"capture: \x00")
    with pytest.raises(JobError, match="not valid YAML"):
        load_job(path)
    path.write_text("#" * (1 << 20) + "#")
    with pytest.raises(JobError, match="too large"):
        load_job(path)
    with pytest.raises(JobError, match="no such file or folder"):
        load_job(tmp_path / "other.yaml")


POSE = MINIMAL + "      joint_from_cam: {translation_m: [0.1, 0, 0.02], quat_xyzw: [0, 0, 0.7071, 0.7071]}\n"
MATRIX = MINIMAL + "      joint_from_cam: [[0, -1, 0, 0.1], [1, 0, 0, 0], [0, 0, 1, 0.02], [0, 0, 0, 1]]\n"


def test_measured_mounts(tmp_path: Path) -> None:
    expected = [[0, -1, 0, 0.1], [1, 0, 0, 0], [0, 0, 1, 0.02], [0, 0, 0, 1]]
    for text in (POSE, MATRIX):
        job = load(tmp_path, text + "      sigma_deg: 3\n      sigma_m: 0.01\n")
        matrix = job.capture.cameras[1].mount_matrix()
        assert matrix is not None
        assert np.allclose(matrix, expected, atol=1e-9)
        assert Job.model_validate(job.model_dump(mode="json")) == job
    assert load(tmp_path, MINIMAL).capture.cameras[1].mount_matrix() is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (MATRIX.replace("[0, -1, 0, 0.1]", "[0, -2, 0, 0.1]"), "not a rotation"),
        (MATRIX.replace("[0, -1, 0, 0.1]", "[0, 1, 0, 0.1]"), "not a rotation"),
        (MATRIX.replace("[0, 0, 0, 1]]", "[0, 0, 1, 1]]"), "last row"),
        (POSE.replace("0.7071, 0.7071]", "0, 0]"), "the length of the quaternion is not 1"),
    ],
)
def test_wrong_mount_poses(tmp_path: Path, text: str, message: str) -> None:
    error = refused(tmp_path, text)
    assert message in error.message
    assert error.line == 7


def test_several_cameras_on_one_segment(tmp_path: Path) -> None:
    text = MINIMAL.replace("left_palm", "torso_back")
    assert [camera.role for camera in load(tmp_path, text).capture.cameras] == ["Spine1", "Spine1"]
    text = MINIMAL.replace("left_palm", "wide") + "      segment: LeftForeArm\n"
    assert load(tmp_path, text).capture.cameras[1].role == "LeftForeArm"


def test_a_single_camera_needs_no_body(tmp_path: Path) -> None:
    text = "capture: {cameras: [{name: phone, video: a.mp4}]}\n"
    assert load(tmp_path, text).skeleton == "none"
    assert "on the body is unknown" in refused(tmp_path, text + "skeleton: upper_body\n").message


def test_synthetic_videos_are_prepared_before_they_are_looked_for(tmp_path: Path) -> None:
    path = tmp_path / "job.yaml"
    path.write_text(
        MINIMAL.replace("[left/a.mp4, left/b.mp4]", "left.mp4")
        + "  calibration: calib.json\n  synthetic: {seconds: 2, motion: a.bvh}\n"
    )
    with pytest.raises(CaptureError, match="not been rendered"):
        load_job(path)
    calls: list[tuple[Mapping[str, Any], Path, Path]] = []

    def prepare(options: Mapping[str, Any], folder: Path, out_dir: Path) -> None:
        calls.append((options, folder, out_dir))
        for name in ("torso.mp4", "left.mp4"):
            (folder / name).write_bytes(b"x")
        lens = {"model": "PINHOLE", "params": [420, 420, 320, 240], "width": 640, "height": 480}
        (folder / "calib.json").write_text(json.dumps(lens))

    job = load_job(path, prepare=prepare)
    beside = tmp_path.parent / "out" / tmp_path.name
    assert calls == [({"seconds": 2, "motion": str(tmp_path / "a.bvh")}, tmp_path, beside)]
    assert all(camera.calibration != "auto" for camera in job.capture.cameras)


def test_shipped_jobs(tmp_path: Path) -> None:
    jobs = Path(__file__).resolve().parents[3] / "jobs"
    with pytest.raises(JobError, match="filled in") as unfilled:
        load_job(jobs / "tum_rgbd.yaml")
    assert unfilled.value.field == "capture.cameras.0.video"
    filled = (jobs / "tum_rgbd.yaml").read_text().replace("<path of your camera.mp4>", "camera.mp4")
    job = load(tmp_path, filled)
    assert (job.skeleton, job.name) == ("none", "tum_rgbd")


def test_the_commented_sample_holds_what_it_says(tmp_path: Path) -> None:
    """Every commented line of it, taken as it is, is a valid setting."""
    text = (Path(__file__).resolve().parents[3] / "jobs" / "cpl_lab.yaml").read_text()
    text = re.sub(r"  # Delete this block.*?(?=# none)", "", text, flags=re.DOTALL)
    text = text.replace("calibration: ../examples/cpl_lab/calib.json", "calibration: auto")
    text = re.sub(r"^( *)# ( *[a-z_]+:.*)$", r"\1\2", text, flags=re.MULTILINE)
    (tmp_path / "torso.timestamps.txt").write_text("")
    job = load(tmp_path, text)
    torso, left, right = job.capture.cameras
    assert (torso.role, left.role, right.role) == ("Spine1", "LeftHand", "RightHand")
    assert torso.mount_matrix() is not None
    assert (torso.sigma_deg, torso.sigma_m) == (5, 0.02)
    assert torso.timestamps == (tmp_path / "torso.timestamps.txt",)
    assert (job.capture.start_s, job.capture.work_px) == (2.0, 960)
    assert (job.registration.rounds, job.merge.fps, job.export.units) == (5, 60, "m")


yaml_bits = st.sampled_from(
    ["capture", "cameras", "name", "video", ":", " ", "\n", "\n  ", "- ", "[", "]", "{", "}", "'", '"', "\t",
     "|", "torso", "1", "-", "?", "&a", "*a", "!!set", "#", ",", "~", "1e9", "%", "@", "\x00", "é", "map"]
)  # fmt: skip


@settings(max_examples=150, deadline=None)
@example(text="{}")
@given(st.lists(yaml_bits, max_size=40).map("".join) | st.text(max_size=60))
def test_any_text_is_a_job_or_a_job_error(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzz.yaml"
    path.write_text(text, encoding="utf-8", errors="surrogatepass")
    try:
        load_job(path)
    except JobError as refusal:
        named = refusal.path
    else:
        named = str(path.resolve())
    # A job that names no camera is about the videos in its folder.
    assert named in {str(path.resolve()), str(path.resolve().parent)}


@settings(max_examples=30, deadline=None)
@given(
    st.recursive(
        st.none() | st.booleans() | st.floats(-1e300, 1e300) | st.integers() | st.text(max_size=5),
        lambda inner: st.lists(inner, max_size=3)
        | st.dictionaries(
            st.sampled_from(["capture", "cameras", "name", "video", "calibration", "joint_from_cam",
                             "synthetic", "map", "export", "formats", "start_s", "skeleton", "timestamps"]),
            inner,
        ),
        max_leaves=12,
    )
)  # fmt: skip
def test_any_values_are_a_job_or_a_typed_error(
    tmp_path_factory: pytest.TempPathFactory, value: object
) -> None:
    camera = {"name": "torso", "video": "a.mp4"}
    path = tmp_path_factory.getbasetemp() / "fuzz.json"
    for data in (value, {"capture": value}, {"capture": {"cameras": [value, camera]}}):
        path.write_text(json.dumps(data))
        try:
            load_job(path)
        except (JobError, CaptureError):
            continue


def test_a_synchronised_rig_is_made_of_cameras_on_one_segment(tmp_path: Path) -> None:
    two = MINIMAL + "    - name: torso_back\n      video: back.mp4\n  rig: synced\n"
    assert [[each.name for each in some] for some in load(tmp_path, two).capture.segments()] == [
        ["torso", "torso_back"]
    ]
    error = refused(tmp_path, MINIMAL + "  rig: synced\n")
    assert error.field == "capture.rig"
    assert "no two cameras share a segment" in error.message


@pytest.mark.parametrize(
    ("board", "field", "words"),
    [
        ("dictionary: 4x4_5", ".dictionary", ("no family of markers '4x4_5'", "did you mean '4X4_50'?")),
        ("dictionary: nonsense", ".dictionary", ("no family of markers 'nonsense'", "ARUCO_ORIGINAL")),
        (
            "columns: 11, rows: 10",
            ".dictionary",
            ("needs more markers than the family 4X4_50 has", "a larger family"),
        ),
        ("columns: 3, rows: 3", "", ("3x3 squares has too few corners", "at least four columns")),
        ("kind: chessboard, columns: 6, rows: 6", "", ("6x6 looks the same", "one row more")),
    ],
)
def test_a_board_that_cannot_be_found_is_refused_before_anything_runs(
    tmp_path: Path, board: str, field: str, words: tuple[str, str]
) -> None:
    size = "" if "columns" in board else ", columns: 7, rows: 5"
    error = refused(tmp_path, MINIMAL + f"merge: {{marker_board: {{square_m: 0.1{size}, {board}}}}}\n")
    assert error.field == f"merge.marker_board{field}"
    assert words[0] in error.message
    assert words[1] in (error.hint or "")


@pytest.mark.parametrize(
    "board", ["columns: 10, rows: 10", "columns: 7, rows: 5, dictionary: DICT_apriltag_36h11"]
)
def test_a_board_that_can_be_found_is_taken(tmp_path: Path, board: str) -> None:
    assert load(
        tmp_path, MINIMAL + f"merge: {{marker_board: {{square_m: 0.1, {board}}}}}\n"
    ).merge.marker_board


def test_the_marker_families_are_those_of_opencv() -> None:
    names = [name for name in dir(cv2.aruco) if name.startswith("DICT_")]
    held = {
        name.removeprefix("DICT_").upper(): len(
            cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)).bytesList
        )
        for name in names
    }
    assert held.items() <= MARKER_COUNTS.items()


def test_a_name_that_no_path_can_hold_is_refused_with_its_field(tmp_path: Path) -> None:
    (tmp_path / "torso.mp4").write_bytes(b"")
    job = tmp_path / "walk.yaml"
    job.write_text('name: "\\ud800\\udc00"\ncapture: {cameras: [{name: torso, video: torso.mp4}]}\n')
    with pytest.raises(JobError) as caught:
        load_job(job)
    assert caught.value.field == "name"


TRIPOD = (
    MINIMAL
    + """\
    - name: left_tripod
      video: tripod.mp4
      mount: none
"""
)


def test_a_camera_that_nobody_wears_is_no_part_of_the_body(tmp_path: Path) -> None:
    job = load(tmp_path, TRIPOD)
    tripod = job.capture.cameras[2]
    assert not tripod.is_worn
    assert tripod.role is None
    assert job.skeleton == "auto"
    assert [mount.camera for mount in body_input(job, FileDigests(tmp_path)).mounts] == ["torso", "left_palm"]
    # Its place is not looked for either.
    places = load(tmp_path, TRIPOD.replace("capture:", "capture:\n  places: [torso, left_palm, right_palm]"))
    assert tripod.name not in [camera.name for camera in places.capture.unplaced()]


def test_a_body_needs_cameras_that_somebody_wears(tmp_path: Path) -> None:
    alone = load(tmp_path, "capture: {cameras: [{name: torso, video: a.mp4, mount: none}]}")
    assert alone.skeleton == "none"
    text = "skeleton: auto\ncapture: {cameras: [{name: a, video: a.mp4, mount: none}]}"
    assert "nobody wears a camera" in refused(tmp_path, text).message


def test_a_camera_that_nobody_wears_is_on_no_bone(tmp_path: Path) -> None:
    error = refused(tmp_path, TRIPOD + "      segment: LeftHand\n")
    assert error.field == "capture.cameras.2.segment"
    assert "mount: none" in error.message
