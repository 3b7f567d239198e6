"""The weakest link of a map: the share of the common points that holds two parts of it together."""

from __future__ import annotations

import numpy as np
import pytest

from bodycap_batch.core.arrays import IntArray
from bodycap_batch.export import map_links
from bodycap_batch.export.map_links import weakest_link


def two_parts(size: int, bridge: int) -> tuple[IntArray, IntArray]:
    """Return the observations of two parts of keyframes that all see one another, and a few common points.

    Each part has 10 points, which all its keyframes see. The bridge is seen by one keyframe of each part.
    """
    point, keyframe = [], []
    for part in range(2):
        for own in range(10):
            point += [10 * part + own] * size
            keyframe += range(part * size, (part + 1) * size)
    for extra in range(bridge):
        point += [20 + extra] * 2
        keyframe += [size - 1, size]
    return np.array(point, dtype=np.int64), np.array(keyframe, dtype=np.int64)


@pytest.mark.parametrize("bridge", [0, 3, 12])
@pytest.mark.parametrize("dense", [400, 0])
def test_the_cut_between_two_parts_is_found(bridge: int, dense: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(map_links, "_DENSE", dense)
    size = 8
    point, keyframe = two_parts(size, bridge)
    # Each of the 8 keyframes of a part shares 10 points with 7 others; the bridge adds to one of them.
    expected = bridge / (10 * size * (size - 1) + bridge)
    assert weakest_link(point, keyframe) == pytest.approx(expected, abs=5e-5)  # four decimals


def test_the_names_of_points_and_keyframes_do_not_matter() -> None:
    point, keyframe = two_parts(6, 4)
    rng = np.random.default_rng(3)
    order, names = rng.permutation(len(point)), rng.permutation(100)
    again = weakest_link(rng.permutation(60)[point][order], names[keyframe][order])
    assert again == weakest_link(point, keyframe)


def test_a_map_of_few_keyframes_has_no_cut() -> None:
    assert weakest_link(*two_parts(2, 1)) is None
    empty = np.zeros(0, dtype=np.int64)
    assert weakest_link(empty, empty) is None
