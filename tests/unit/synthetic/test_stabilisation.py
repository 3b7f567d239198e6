"""Synthetic captures whose cameras stabilise their pictures."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.capture.frame_index import index_video
from bodycap_batch.core.context import StageContext
from bodycap_batch.formats.tum import read_tum
from bodycap_batch.model.geometry import rotation_angle_rad
from bodycap_batch.synthetic import SynthOptions, synthesise
from bodycap_batch.telemetry import read_telemetry
from bodycap_batch.telemetry.picture_orientation import recorded_turns


def _capture(folder, kind):
    options = SynthOptions(
        seconds=1.5, width=64, height=48, cameras=("left_palm",), seed=2, furnished=False, stabilised=kind
    )
    synthesise(options, folder, StageContext(work_dir=folder.parent))
    return folder


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    return _capture(tmp_path_factory.mktemp("stabilised") / "recorded", "recorded")


def test_the_record_turns_the_pictures_to_the_lens(recorded):
    video = index_video(recorded / "left_palm.mp4")
    telemetry = read_telemetry([video], video.times_ns())
    assert telemetry.is_stabilised
    pictures = read_tum(recorded / "gt" / "left_palm.tum")
    lens = read_tum(recorded / "gt" / "lens" / "left_palm.tum")
    turns, known = recorded_turns(telemetry, pictures.times_ns * 1e-9)
    assert known.all()
    true = np.swapaxes(lens.world_from_cam[:, :3, :3], 1, 2) @ pictures.world_from_cam[:, :3, :3]
    assert np.degrees(rotation_angle_rad(true)).max() > 1.0
    # The stored values are rounded to 1/32767, and the paths to nine digits.
    assert rotation_angle_rad(np.swapaxes(true, 1, 2) @ turns).max() < 6e-5
    np.testing.assert_array_equal(pictures.world_from_cam[:, :3, 3], lens.world_from_cam[:, :3, 3])


def test_the_lens_of_the_crop_is_not_given(recorded):
    assert not (recorded / "calib.json").exists()
    crop = json.loads((recorded / "gt" / "calib.json").read_text())
    assert crop["params"][0] == pytest.approx(1.25 * SynthOptions(width=64, height=48).camera().params[0])


def test_without_a_record_only_the_setting_is_stated(tmp_path):
    folder = _capture(tmp_path / "unrecorded", "unrecorded")
    video = index_video(folder / "left_palm.mp4")
    telemetry = read_telemetry([video], video.times_ns())
    assert telemetry.is_stabilised
    assert not telemetry.streams


def test_a_video_that_players_turn_has_turned_orientations(recorded):
    video = index_video(recorded / "left_palm.mp4")
    quarter = replace(video, orientation=((0, -1), (1, 0)))
    times_s = video.times_ns() * 1e-9
    plain, turned = (
        recorded_turns(read_telemetry([each], video.times_ns()), times_s)[0] for each in (video, quarter)
    )
    shown_from_stored = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(turned, shown_from_stored @ plain @ shown_from_stored.T, atol=1e-12)
