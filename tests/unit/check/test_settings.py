"""Camera settings that a check reads: GoPro's settings box, a phone's metadata, a variable rate."""

import json
import struct

import av
import numpy as np
import pytest

from bodycap_batch.check import check_path
from bodycap_batch.formats.gpmf import gopro_settings
from bodycap_batch.formats.gpmf_writer import append_settings, item, nested
from bodycap_batch.telemetry.gopro import read_gopro_file
from tests.gpmf import Sensor, payloads, write_gopro
from tests.videos import textured_frame, write_video

FRAMES = [textured_frame(index % 40) for index in range(75)]


def _notes(folder, frames=FRAMES, settings=None, **values):
    path = write_video(folder / "torso.mp4", frames, **values)
    if settings is not None:
        append_settings(path, settings)
    (camera,) = check_path(folder).cameras
    return camera.notes


def test_a_plain_file_gives_no_note(tmp_path):
    assert _notes(tmp_path) == ()
    assert gopro_settings(tmp_path / "torso.mp4") == {}


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"EISE": "Y", "EISA": "HS High"}, "the camera stabilised the video (HS High)"),
        ({"EISE": "Y", "EISA": "HS High"}, "without a record of their orientations"),
        ({"EISA": "Y"}, "the camera stabilised the video;"),
        ({"FMWR": "HD9.01.01", "DZOM": "Y"}, "digital zoom"),
    ],
)
def test_gopro_settings_that_spoil_a_capture_are_named(tmp_path, settings, words):
    (note,) = _notes(tmp_path, settings=settings)
    assert words in note


@pytest.mark.parametrize("settings", [{"EISE": "N", "EISA": "HS High"}, {"EISA": "N/A", "DZOM": "N"}, {}])
def test_good_gopro_settings_give_no_note(tmp_path, settings):
    assert _notes(tmp_path, settings=settings) == ()


def test_a_damaged_box_is_ignored(tmp_path):
    path = tmp_path / "a.mp4"
    path.write_bytes(struct.pack(">I4s", 4, b"moov") + b"\0" * 40)
    assert gopro_settings(path) == {}
    path.write_bytes(struct.pack(">I4s", 60, b"moov") + struct.pack(">I4s", 500, b"udta") + b"GP")
    assert gopro_settings(path) == {}
    path.write_bytes(b"")
    append_settings(path, {"EISE": "Y"})
    path.write_bytes(path.read_bytes()[:-3])
    assert set(gopro_settings(path)) <= {"EISE"}


def test_a_record_of_the_orientations_is_named(tmp_path):
    record = item("IORI", "s", [32767, 0, 0, 0] * 30, 4)
    stream = nested("STRM", item("SCAL", "s", [32767]), record)
    write_gopro(tmp_path / "torso.mp4", FRAMES, payloads(Sensor(), 3, extra=[stream]))
    append_settings(tmp_path / "torso.mp4", {"EISE": "Y"})
    (camera,) = check_path(tmp_path).cameras
    (note,) = camera.notes
    assert "their recorded orientations turn the poses back" in note
    assert "HyperSmooth" in note


@pytest.mark.parametrize(
    ("name", "comment", "words"),
    [
        ("torso.mp4", "Original filename: GX010017.MP4\n", "original file (GX010017.MP4)"),
        ("torso_stabilized.mp4", "", "original file instead"),
    ],
)
def test_a_video_from_gyroflow_is_named(tmp_path, name, comment, words):
    plain = write_video(tmp_path / "plain" / "torso.mp4", FRAMES)
    _with_metadata(plain, tmp_path / "made" / name, {"comment": comment} if comment else {})
    (camera,) = check_path(tmp_path / "made").cameras
    (note,) = camera.notes
    assert "Gyroflow" in note
    assert words in note
    assert read_gopro_file(tmp_path / "made" / name, 30.0).is_stabilised


def test_a_phone_gives_a_note_on_stabilisation(tmp_path):
    plain = write_video(tmp_path / "plain" / "torso.mp4", FRAMES)
    metadata = {"com.apple.quicktime.make": "Apple", "com.apple.quicktime.model": "iPhone 13"}
    named = tmp_path / "phone" / "torso.mov"
    _with_metadata(plain, named, metadata)
    (camera,) = check_path(named.parent).cameras
    assert any("phone (Apple iPhone 13)" in note for note in camera.notes)


def _with_metadata(plain, named, metadata):
    """Write a copy of a video with metadata."""
    named.parent.mkdir()
    tags = {"movflags": "use_metadata_tags"}
    with av.open(str(plain)) as source, av.open(str(named), "w", options=tags) as target:
        target.metadata.update(metadata)
        stream = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                target.mux(packet)
    assert check_path(plain.parent).cameras[0].notes == ()


def test_a_variable_rate_is_reported_with_the_setting_to_change(tmp_path):
    steps = np.where(np.arange(74) // 20 % 2, 10, 20)
    (note,) = _notes(tmp_path, pts=np.concatenate([[0], np.cumsum(steps)]).tolist())
    assert "varies between 15 and 30 frames per second" in note
    assert "fixed frame rate" in note


def test_dropped_frames_and_jitter_are_not_a_variable_rate(tmp_path):
    rng = np.random.default_rng(0)
    steps = np.where(rng.uniform(size=74) < 0.1, 20, 10) + rng.integers(-1, 2, 74)
    notes = _notes(tmp_path, pts=np.concatenate([[0], np.cumsum(steps)]).tolist())
    assert not any("varies" in note for note in notes)


LENS = {"model": "PINHOLE", "params": [40, 40, 32, 24], "width": 64, "height": 48}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"calibrated_with": {"rms_px": 0.7}}, "large reprojection error (0.70 px)"),
        ({"calibrated_with": {"rms_px": 0.1, "notes": ["tilt more"]}}, "with this note: tilt more"),
        ({"width": 128, "height": 96, "params": [80, 80, 64, 48]}, "with pictures of 128×96 pixels"),
        ({"calibrated_with": {"lens_mode": "Linear"}}, "lens mode Linear, and the video states Wide"),
        ({"calibrated_with": {"camera": "GoPro HERO8 Black"}}, "of the camera GoPro HERO8 Black"),
        ({"params": [30, 40, 32, 24]}, "the focal lengths of the calibration are 0.75 to 1"),
        ({"calibrated_with": {"rms_px": 0.1, "camera": "GoPro HERO9 Black", "lens_mode": "Wide"}}, ""),
    ],
)
def test_a_calibration_that_contradicts_the_video_is_named(tmp_path, change, words):
    (tmp_path / "calib.json").write_text(json.dumps({**LENS, **change}))
    notes = _notes(tmp_path, settings={"MINF": "HERO9 Black", "VFOV": "W", "EISE": "N"})
    assert len(notes) == bool(words)
    assert not notes or words in notes[0]


def test_the_job_can_contradict_the_settings(tmp_path):
    append_settings(write_video(tmp_path / "torso.mp4", FRAMES), {"EISE": "Y"})
    cameras = "capture:\n  cameras: [{name: torso, video: torso.mp4, stabilised: false}]\n"
    (tmp_path / "job.yaml").write_text(cameras)
    (camera,) = check_path(tmp_path).cameras
    assert camera.notes == ()
