"""Clocks of whole captures from videos, and the command that prints them."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from bodycap_batch.cli import main
from bodycap_batch.clocks import clocks_from_motion_notes, decide_clocks, describe_clocks, estimate_clocks
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.config.sample_files import samples_beside
from tests.sounds import heard, scene, write_video_with_sound

SECONDS = 8.0
WAY_S = 0.004
"""The way of sound to two cameras on one body differs by up to 1.3 m."""
PALM_S, HEAD_S = 0.731, -0.42


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three cameras of one take, one of another take, and one without sound."""
    path = tmp_path_factory.mktemp("take")
    room = scene(21, SECONDS)
    dates = {"creation_time": "2024-05-01T10:00:00Z"}
    write_video_with_sound(path / "torso.mp4", heard(room, 1, SECONDS), metadata=dates)
    frames = [0, *range(40, int(1000 * SECONDS), 110)]
    write_video_with_sound(
        path / "left_palm.mp4", heard(room, 2, SECONDS, PALM_S), frame_times=frames, metadata=dates
    )
    write_video_with_sound(
        path / "head.mp4",
        heard(room, 3, SECONDS, HEAD_S),
        metadata={"creation_time": "2024-05-04T10:00:00Z"},
    )
    write_video_with_sound(
        path / "right_palm.mp4",
        heard(scene(22, SECONDS), 4, SECONDS),
        metadata={"creation_time": "2024-05-03T22:00:00Z"},
    )
    write_video_with_sound(path / "left_thigh.mp4", None)
    return path


def capture(folder, *names, **offsets):
    paths = {name: folder / f"{name}.mp4" for name in names}
    cameras = [
        CameraConfig(
            name=name, video=(path,), offset_s=offsets.get(name), samples=samples_beside([path], name)
        )
        for name, path in paths.items()
    ]
    return CaptureConfig(cameras=tuple(cameras))


NAMES = ("left_palm", "torso", "head", "right_palm", "left_thigh")


@pytest.fixture(scope="module")
def estimates(folder):
    return estimate_clocks(capture(folder, *NAMES))


def test_offsets_are_relative_to_the_torso(estimates):
    assert estimates.reference == "torso"
    assert estimates.camera("torso").source == "common"
    assert estimates.camera("torso").offset_s == 0.0
    for name, true_s in (("left_palm", PALM_S), ("head", HEAD_S)):
        clock = estimates.camera(name)
        assert clock.source == "sound"
        assert clock.offset_s == pytest.approx(true_s, abs=WAY_S)
        assert 0.0015 <= clock.sigma_s < 0.003
        assert clock.sigma_at(SECONDS) == pytest.approx(clock.sigma_s, abs=0.001)
        assert (clock.drift_ppm, clock.drift_sigma_ppm) == (0.0, pytest.approx(40.0, rel=0.01))


def test_a_second_take_and_a_silent_camera_have_no_clock(estimates):
    other = estimates.camera("right_palm")
    assert not other.is_known
    assert any("with torso" in reason for reason in other.reasons)
    assert any("2.5 days apart" in reason for reason in other.reasons)
    assert estimates.camera("left_thigh").reasons == ("the video has no sound",)
    with pytest.raises(KeyError):
        estimates.camera("nobody")


def test_dates_days_apart_are_reported_and_do_not_decide(estimates):
    contradictions = estimates.camera("head").notes
    assert any("3.0 days apart" in text for text in contradictions)
    assert not estimates.camera("left_palm").notes


def test_a_stated_offset_is_compared(folder):
    right = estimate_clocks(capture(folder, "torso", "left_palm", left_palm=PALM_S)).camera("left_palm")
    assert not right.notes
    turned = estimate_clocks(capture(folder, "torso", "left_palm", left_palm=-0.73)).camera("left_palm")
    assert turned.source == "sound"
    assert "with the sign turned the sound agrees" in turned.notes[0]
    wrong = estimate_clocks(capture(folder, "torso", "left_palm", left_palm=0.2)).camera("left_palm")
    assert "0.2000 s" in wrong.notes[0]
    assert "sign" not in wrong.notes[0]


def test_a_stated_offset_is_kept_where_there_is_no_sound(folder):
    clock = estimate_clocks(capture(folder, "torso", "left_thigh", left_thigh=0.5)).camera("left_thigh")
    assert (clock.source, clock.offset_s) == ("stated", 0.5)
    assert clock.sigma_s > 0.01


def test_the_first_camera_is_the_reference_without_a_torso(folder):
    assert capture(folder, "head", "left_palm").reference_camera().name == "head"
    assert capture(folder, "left_palm", "torso").reference_camera().name == "torso"


def write_job(folder, tmp_path, *names):
    job = tmp_path / "job.yaml"
    cameras = "".join(f"    - {{name: {name}, video: {folder / name}.mp4}}\n" for name in names)
    job.write_text(f"capture:\n  cameras:\n{cameras}", encoding="utf-8")
    return str(job)


def test_the_command_prints_a_table_and_lines_for_the_job(folder, tmp_path, capsys):
    picture = tmp_path / "clocks.svg"
    assert main(["sync", write_job(folder, tmp_path, "torso", "head"), "--picture", str(picture)]) == 0
    out = capsys.readouterr().out
    assert "common time = time of torso" in out
    assert "contradiction: head:" in out
    assert "    - name: head\n      offset_s: -0.4" in out
    drawing = ET.fromstring(picture.read_text(encoding="utf-8"))  # noqa: S314 - our own file
    assert drawing.tag.endswith("svg")
    assert len(list(drawing.iter("{http://www.w3.org/2000/svg}circle"))) >= 3


def test_the_command_prints_json(folder, tmp_path, capsys):
    assert main(["sync", write_job(folder, tmp_path, "torso", "left_palm", "left_thigh"), "--json"]) == 0
    clocks = json.loads(capsys.readouterr().out)["clocks"]
    assert set(clocks) == {"torso", "left_palm", "left_thigh"}
    keys = {"offset_s", "sigma_s", "drift_ppm", "drift_sigma_ppm", "source"}
    assert all(set(clock) == keys for clock in clocks.values())
    assert clocks["left_palm"]["offset_s"] == pytest.approx(PALM_S, abs=WAY_S)
    assert clocks["left_thigh"]["source"] == "none"


def test_recordings_that_share_no_moment_are_refused(folder, tmp_path, capsys):
    assert main(["sync", write_job(folder, tmp_path, "torso", "right_palm")]) == 4
    error = capsys.readouterr().err
    assert "agrees with that of torso" in error
    assert "2.5 days apart" in error
    assert "hint:" in error


def test_recordings_that_the_files_place_one_after_the_other_are_refused_with_the_gap(tmp_path):
    for seed, name, minute in ((31, "torso", 0), (32, "left_palm", 3)):
        write_video_with_sound(
            tmp_path / f"{name}.mp4",
            heard(scene(seed, 6.0), seed, 6.0),
            metadata={"creation_time": f"2024-05-01T10:0{minute}:00Z"},
        )
    clock = estimate_clocks(capture(tmp_path, "torso", "left_palm")).camera("left_palm")
    assert clock.source == "none"
    # Both last 6 s and start 180 s apart.
    assert any("do not overlap: there are 174.0 s between them" in reason for reason in clock.reasons)


def test_cameras_with_other_formats_are_compared_and_have_a_larger_sigma(tmp_path):
    room = scene(33, 8.0)
    write_video_with_sound(tmp_path / "torso.mp4", heard(room, 1, 8.0))
    low = np.ascontiguousarray(heard(room, 2, 8.0, 0.6, band_hz=(150.0, 3400.0))[::2])
    frames = np.cumsum([0, *np.random.default_rng(0).integers(40, 180, 70)]).tolist()
    write_video_with_sound(
        tmp_path / "left_palm.mp4", np.tile(low, (2, 1)), 8_000, layout="stereo", frame_times=frames
    )
    write_video_with_sound(tmp_path / "head.mp4", np.zeros(8 * 16_000, np.float32))
    found = estimate_clocks(capture(tmp_path, "torso", "left_palm", "head"))
    clock = found.camera("left_palm")
    assert clock.source == "sound"
    assert clock.offset_s == pytest.approx(0.6, abs=WAY_S)
    assert clock.sigma_s >= 0.015
    assert found.camera("head").reasons == ("the sound is silent",)


def test_the_command_shows_what_the_last_run_found_from_the_motion(folder, tmp_path, capsys):
    job = write_job(folder, tmp_path, "torso", "left_palm", "left_thigh")
    assert main(["sync", job]) == 0
    assert "needs a run" in capsys.readouterr().out
    out = tmp_path / "out" / "job"
    out.mkdir(parents=True)
    clock = {"offset_s": 0.5, "sigma_s": 0.02, "drift_ppm": 0.0, "drift_sigma_ppm": 40.0, "source": "motion"}
    (out / "metrics.json").write_text(json.dumps({"clocks": {"left_thigh": clock}}))
    text = (tmp_path / "job.yaml").read_text()
    (tmp_path / "job.yaml").write_text(f"out: {out}\n{text}")
    assert main(["sync", job]) == 0
    shown = capsys.readouterr().out
    assert "+0.5000 s" in shown
    assert "from the last run of the job" in shown


def test_one_camera_has_nothing_to_compare(folder, tmp_path, capsys):
    assert main(["sync", write_job(folder, tmp_path, "torso")]) == 2
    assert "only one camera" in capsys.readouterr().err


def decided(spec):
    return decide_clocks(spec, estimate_clocks(spec)).cameras


def test_an_unstated_clock_comes_from_the_sound_or_is_unknown(folder, estimates):
    clocks = decide_clocks(capture(folder, *NAMES), estimates).cameras
    assert clocks["left_palm"].source == "sound"
    assert clocks["left_palm"].offset_s == pytest.approx(PALM_S, abs=WAY_S)
    for name in ("right_palm", "left_thigh"):
        assert not clocks[name].is_known
        assert "clap once" in clocks[name].notes[0]


def test_offsets_are_on_the_clock_that_the_reference_camera_states(folder):
    clocks = decided(capture(folder, "torso", "left_palm", torso=100.0))
    assert clocks["torso"].offset_s == 100.0
    assert clocks["left_palm"].offset_s == pytest.approx(100.0 + PALM_S, abs=WAY_S)


def test_a_stated_clock_is_used_and_its_contradiction_noted(folder):
    stated = {"left_palm": -PALM_S, "head": HEAD_S + 0.01, "left_thigh": 0.3}
    clocks = decided(capture(folder, "torso", *stated, **stated))
    assert (clocks["left_palm"].source, clocks["left_palm"].offset_s) == ("stated", -PALM_S)
    assert clocks["left_palm"].is_contradicted
    assert "with the sign turned the sound agrees" in clocks["left_palm"].notes[0]
    assert not clocks["head"].is_contradicted
    assert (clocks["left_thigh"].source, clocks["left_thigh"].offset_s) == ("stated", 0.3)


def test_common_clocks_need_no_sound(folder):
    names = ("torso", "left_palm", "left_thigh")
    spec = capture(folder, *names, **dict.fromkeys(names, 0.0)).model_copy(update={"clocks": "common"})
    clocks = decided(spec)
    assert {clock.source for clock in clocks.values()} == {"common"}
    assert clocks["left_palm"].is_contradicted
    assert clocks["left_thigh"].sigma_s == 0.0


def test_cameras_with_one_trigger_share_a_clock(folder):
    cameras = (
        CameraConfig(name="torso", video=(folder / "torso.mp4",)),
        CameraConfig(name="left_palm", video=(folder / "left_palm.mp4",)),
        CameraConfig(name="left_palm_2", mount="left_palm", video=(folder / "left_thigh.mp4",)),
    )
    clocks = decided(CaptureConfig(cameras=cameras, rig="synced"))
    assert clocks["left_palm_2"].source == "common"
    assert clocks["left_palm_2"].offset_s == clocks["left_palm"].offset_s


def test_each_camera_has_a_line_about_its_clock(folder):
    lines = describe_clocks(capture(folder, *NAMES, head=-HEAD_S), with_body=True)
    by_name = {line.partition(":")[0]: line for line in lines}
    assert "reference clock" in by_name["torso"]
    assert "+0.73" in by_name["left_palm"]
    assert "(sound)" in by_name["left_palm"]
    assert "the sound does not give the clock offset (" in by_name["left_thigh"]
    assert "with the sign turned the sound agrees" in by_name["head"]
    assert "the motion of the body is solved without right_palm, left_thigh" in lines[-1]
    assert describe_clocks(capture(folder, "torso"), with_body=True) == []


PLACES = ("torso", "left_palm", "right_palm")


@pytest.mark.parametrize(
    ("names", "heard_names", "places", "with_body", "missing"),
    [
        (("torso", "left_palm"), ("torso",), (), True, "there is no motion of the body"),
        (("a", "b", "c"), ("a", "b"), PLACES, True, "the places of the cameras are not found and"),
        (PLACES, PLACES[:2], (), True, "the motion of the body is solved without right_palm"),
        (("torso", "left_palm"), ("torso",), (), False, "the times of left_palm are not those of"),
    ],
)
def test_what_is_missing_without_a_clock_is_said_before_the_run(
    tmp_path, names, heard_names, places, with_body, missing
):
    known = capture(tmp_path, *names, **dict.fromkeys(heard_names, 0.0)).model_copy(update={"places": places})
    (note,) = clocks_from_motion_notes(known, with_body=with_body)
    assert f"If the motion does not show it, {missing}" in note
    complete = capture(tmp_path, *names, **dict.fromkeys(names, 0.0))
    assert clocks_from_motion_notes(complete, with_body=with_body) == []


def test_check_prints_the_clock_of_each_camera(folder, tmp_path, capfd):
    for name in ("torso", "left_palm"):
        (tmp_path / f"{name}.mp4").symlink_to(folder / f"{name}.mp4")
    main(["check", str(tmp_path)])
    out = capfd.readouterr().out
    assert "left_palm: clock offset +0.73" in out
    assert "auto" in out
