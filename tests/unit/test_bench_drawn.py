"""The drawn captures: their kinds are unlike, half of them count only in the final check, and they render."""

from collections import Counter
from dataclasses import replace

import numpy as np

from bodycap_batch.formats.tum import read_tum
from tests.bench import drawn


def test_half_of_the_captures_are_final_and_half_have_rolling_shutters():
    assert [capture.name for capture in drawn.CAPTURES] == [f"draw{n:02}" for n in range(1, 25)]
    for final in (False, True):
        half = [capture for capture in drawn.CAPTURES if capture.final is final]
        readouts = [capture.readout_ms for capture in half if capture.readout_ms]
        assert (len(half), len(readouts)) == (12, 6)
        assert all(8.0 <= readout <= 25.0 for readout in readouts)
    # Each kind has one capture of each half.
    assert set(Counter(capture.kind for capture in drawn.CAPTURES).values()) == {2}
    assert len({capture.seed for capture in drawn.CAPTURES}) == 24


def test_the_options_of_all_captures_are_valid():
    for capture in drawn.CAPTURES:
        options = capture.options()
        assert 2 <= len(options.cameras) <= 3
        assert 6.0 <= options.seconds <= 10.0
        assert (options.width, options.height) == capture.size


def test_a_capture_is_rendered_with_its_truth_and_kept(tmp_path, monkeypatch):
    short = replace(drawn.CAPTURES[0], seconds=0.1, cameras=("torso", "left_palm"))
    monkeypatch.setattr(drawn, "CAPTURES", (short,))
    folder = drawn.render("draw01", tmp_path, scale=0.1)
    assert {path.name for path in folder.iterdir()} == {
        *("torso.mp4", "left_palm.mp4", "calib.json", "skeleton.bvh", "gt"),
    }
    truth = read_tum(folder / "gt" / "torso.tum")
    assert len(truth.times_ns) == 3
    assert np.isfinite(truth.world_from_cam).all()
    before = (folder / "torso.mp4").stat().st_mtime_ns
    assert drawn.render("draw01", tmp_path, scale=0.1) == folder
    assert (folder / "torso.mp4").stat().st_mtime_ns == before
