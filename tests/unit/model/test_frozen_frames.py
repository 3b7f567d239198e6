"""Frozen frames: repetitions of a picture are found; cameras that stand still, and single copies, are not."""

from __future__ import annotations

import numpy as np
import pytest

from bodycap_batch.model.frozen_frames import find_frozen_frames, picture_change_px

COUNT = 90
TIMES_S = np.arange(COUNT) / 30.0
ROOM = np.kron(np.random.default_rng(3).integers(60, 200, (30, 40)), np.ones((8, 8))).astype(np.uint8)


def _found(change_px: np.ndarray, shift_px: np.ndarray | None = None) -> list[int]:
    shift_px = change_px if shift_px is None else shift_px
    return np.flatnonzero(find_frozen_frames(change_px, shift_px, TIMES_S)).tolist()


def _walking() -> np.ndarray:
    return np.concatenate([[np.nan], np.full(COUNT - 1, 1.5)])


@pytest.mark.parametrize("part", [range(30, 60), range(60, 90), range(1, 30), range(40, 47)])
def test_a_repeated_picture_is_frozen(part: range) -> None:
    change = _walking()
    change[part] = 0.0
    change[part[:2]] = 0.15  # the encoder still refines the picture
    assert _found(change) == list(part)


def test_an_encoder_that_encodes_the_picture_again_does_not_end_the_frozen_part() -> None:
    change = _walking()
    change[30:60] = 0.0
    shift = change.copy()
    change[45] = 1.0
    assert _found(change, shift) == list(range(30, 60))
    # A new picture in between is a measurement.
    shift[45] = 0.6
    assert _found(change, shift) == [*range(30, 45), *range(46, 60)]


def test_single_copies_of_a_converted_frame_rate_are_not_frozen() -> None:
    change = _walking()
    change[5::5] = 0.0
    assert _found(change) == []
    change[40:44] = 0.0
    assert _found(change) == []


def test_a_person_who_stands_still_is_not_frozen() -> None:
    # The movement ends and starts gradually. A strong compression hides the rest of it.
    change = _walking()
    change[20:30] = np.linspace(1.5, 0.21, 10)
    change[30:60] = 0.0
    change[60:70] = np.linspace(0.21, 1.5, 10)
    assert _found(change) == []
    # With sensor noise, no picture is a copy, even if the movement stops at once.
    change = _walking()
    change[30:60] = 0.05
    assert _found(change) == []


def test_a_camera_that_stands_still_throughout_is_not_frozen() -> None:
    assert _found(np.concatenate([[np.nan], np.zeros(COUNT - 1)])) == []


def test_the_change_is_about_the_displacement_of_the_picture() -> None:
    assert picture_change_px(ROOM, ROOM) == 0.0
    smooth = np.tile(100 + 80 * np.sin(np.arange(320) / 6.0), (240, 1))
    half = np.tile(100 + 80 * np.sin((np.arange(320) + 0.5) / 6.0), (240, 1))
    # Only one of the two axes has a gradient.
    assert picture_change_px(smooth.astype(np.uint8), half.astype(np.uint8)) == pytest.approx(1.0, abs=0.1)
    assert np.isnan(picture_change_px(np.full_like(ROOM, 90), np.full_like(ROOM, 91)))
