"""Camera settings that a check reads: GoPro's settings box, a phone's metadata, a variable rate."""

import json
import struct

import av
import numpy as np
import pytest

from bodycap_batch.check import check_path
from bodycap_batch.formats.gpmf import gopro_settings
from tests.videos import textured_frame, write_video

FRAMES = [textured_frame(index % 40) for index in range(75)]


def _item(key, text):
    data = text.encode("latin-1")
    return struct.pack(">4sBBH", key.encode(), ord("c"), 1, len(data)) + data + b"\0" * (-len(data) % 4)


def _with_gopro_box(path, settings):
    """Return a settings box as in a GoPro's MP4: moov/udta/GPMF, here in a moov box of its own."""
    items = b"".join(_item(key, text) for key, text in settings.items())
    nested = struct.pack(">4sBBH", b"DEVC", 0, 1, len(items)) + items
    box = struct.pack(">I4s", 8 + len(nested), b"GPMF") + nested
    for kind in (b"udta", b"moov"):
        box = struct.pack(">I4s", 8 + len(box), kind) + box
    return box


def _notes(folder, frames=FRAMES, settings=None, **values):
    path = write_video(folder / "torso.mp4", frames, **values)
    if settings is not None:
        # A second moov box at the end: the file's own moov must not change, because it holds offsets.
        content = path.read_bytes()
        size = struct.unpack(">I", content[:4])[0]
        box = _with_gopro_box(path, settings)
        path.write_bytes(content[:size] + content[size:] + box)
    (camera,) = check_path(folder).cameras
    return camera.notes


def test_a_plain_file_gives_no_note(tmp_path):
    assert _notes(tmp_path) == ()
    assert gopro_settings(tmp_path / "torso.mp4") == {}


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"EISE": "Y", "EISA": "HS High"}, "the camera stabilised the video (HS High)"),
        ({"EISA": "Y"}, "the camera stabilised the video:"),
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
    box = _with_gopro_box(path, {"EISE": "Y"})
    path.write_bytes(box[:-3])
    assert set(gopro_settings(path)) <= {"EISE"}


def test_a_phone_gives_a_note_on_stabilisation(tmp_path):
    plain = write_video(tmp_path / "plain" / "torso.mp4", FRAMES)
    metadata = {"com.apple.quicktime.make": "Apple", "com.apple.quicktime.model": "iPhone 13"}
    (tmp_path / "phone").mkdir()
    named = tmp_path / "phone" / "torso.mov"
    tags = {"movflags": "use_metadata_tags"}
    with av.open(str(plain)) as source, av.open(str(named), "w", options=tags) as target:
        target.metadata.update(metadata)
        stream = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                target.mux(packet)
    (camera,) = check_path(named.parent).cameras
    assert any("phone (Apple iPhone 13)" in note for note in camera.notes)
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
