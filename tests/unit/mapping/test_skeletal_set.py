"""Which keyframes carry the map of a long capture."""

from __future__ import annotations

import numpy as np

from bodycap_batch.mapping.matching.skeletal_set import select_skeletal_keyframes


def _likeness(places: np.ndarray, reach: float) -> np.ndarray:
    """Likeness of keyframes at places along a way: those nearer than `reach` show the same."""
    apart = np.abs(places[:, None] - places)
    return np.where(apart <= reach, 40, 3).astype(np.int16)


def _spanning(places: np.ndarray, reach: float) -> np.ndarray:
    return select_skeletal_keyframes(_likeness(places, reach), np.arange(len(places)), min_support=3)


def test_a_room_seen_again_and_again_takes_no_more_than_once() -> None:
    once = np.linspace(0.0, 50.0, 100)
    counts = [len(_spanning(np.tile(once, times), 4.0)) for times in (2, 4, 8)]
    assert max(counts) <= 1.2 * min(counts) < 100


def test_a_way_that_leads_ever_on_takes_its_share_of_each_stretch() -> None:
    places = np.arange(400.0)
    rows = _spanning(places, 5.0)
    assert len(rows) < 300
    tied = _likeness(places, 5.0)[:, rows] > 3
    assert (tied.sum(axis=1) >= 3).all()
    assert np.diff(rows).max() <= 5  # the chosen hang together


def test_who_is_like_few_others_is_chosen_with_them_all() -> None:
    rows = _spanning(np.array([0.0, 1.0, 2.0, 100.0, *np.linspace(200.0, 201.0, 60)]), 4.0)
    assert rows.tolist() == [0, 1, 2, 3, 4, 5, 6]


def test_parts_that_are_seen_together_later_are_joined() -> None:
    here, there, between = np.linspace(0.0, 1.0, 20), np.linspace(8.0, 9.0, 20), np.full(20, 4.5)
    rows = _spanning(np.concatenate([here, there, between]), 5.0)
    assert rows.tolist() == [0, 1, 2, 20, 21, 22, 40, 41, 42]


def test_without_keyframes_none_is_chosen() -> None:
    assert len(_spanning(np.zeros(0), 1.0)) == 0
