"""`bodycap telemetry`: text, JSON and drawing."""

import json
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from bodycap_batch.cli import main
from tests.gpmf import Sensor, item, nested, payloads, write_gopro
from tests.videos import textured_frame, write_video


def _turn(times):
    return np.stack([0.3 + 0 * times, 0.5 * np.sin(times), 0.7 * np.cos(times)], axis=1)


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    exposure = nested("STRM", item("STNM", "c", "Exposure\x1b[2J"), item("SHUT", "f", [0.001] * 30))
    track = payloads(Sensor(device="HERO9\x07 Black"), 6, _turn, extra=[exposure])
    frames = [textured_frame(index % 40) for index in range(180)]
    return write_gopro(tmp_path_factory.mktemp("clip") / "GX010001.MP4", frames, track[:3] + track[4:])


def test_text(clip, capsys):
    assert main(["telemetry", str(clip)]) == 0
    out = capsys.readouterr().out
    assert "GYRO" in out
    assert "201.9" in out
    assert "gaps (s): 2.99" in out
    assert "\x1b" not in out
    assert "\x07" not in out


def test_json(clip, capsys):
    assert main(["telemetry", str(clip), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["source"] == "GPMF"
    gyro = data["streams"]["GYRO"]
    assert gyro["unit"] == "rad/s"
    assert len(gyro["gaps_s"]) == 1
    assert gyro["mean"][0] == pytest.approx(-0.3, abs=0.001)


def test_picture(clip, tmp_path):
    picture = tmp_path / "streams.svg"
    assert main(["telemetry", str(clip), "--picture", str(picture)]) == 0
    root = ET.fromstring(picture.read_text())  # noqa: S314
    titles = [element.text for element in root.iter() if element.tag.endswith("text")]
    assert any("Angular rate" in title for title in titles)
    assert any("Exposure" in title for title in titles)


def test_a_video_without_telemetry(tmp_path, capsys):
    video = write_video(tmp_path / "a.mp4", [textured_frame(index) for index in range(20)])
    picture = tmp_path / "a.svg"
    assert main(["telemetry", str(video), "--picture", str(picture)]) == 0
    assert "no telemetry" in capsys.readouterr().out
    ET.fromstring(picture.read_text())  # noqa: S314


def test_a_folder_of_chapters_and_a_missing_file(clip, capsys):
    assert main(["telemetry", str(clip.parent)]) == 0
    assert "GYRO" in capsys.readouterr().out
    assert main(["telemetry", str(clip.parent / "none.mp4")]) == 3
