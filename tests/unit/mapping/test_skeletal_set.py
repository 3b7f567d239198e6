"""Selection of the skeletal keyframes of a long capture."""

from __future__ import annotations

import numpy as np

from bodycap_batch.mapping.matching.skeletal_set import select_skeletal_keyframes


def _matches(positions: np.ndarray, limit: float) -> np.ndarray:
    """Return matches of keyframes at positions along a path: those nearer than `limit` show the same."""
    apart = np.abs(positions[:, None] - positions)
    return np.where(apart <= limit, 40, 3).astype(np.int16)


def _select(positions: np.ndarray, limit: float) -> np.ndarray:
    return select_skeletal_keyframes(_matches(positions, limit), np.arange(len(positions)), min_support=3)


def test_repeated_views_of_a_room_add_few_keyframes() -> None:
    once = np.linspace(0.0, 50.0, 100)
    counts = [len(_select(np.tile(once, times), 4.0)) for times in (2, 4, 8)]
    assert max(counts) <= 1.2 * min(counts) < 100


def test_a_long_path_is_covered_evenly() -> None:
    positions = np.arange(400.0)
    rows = _select(positions, 5.0)
    assert len(rows) < 300
    matched = _matches(positions, 5.0)[:, rows] > 3
    assert (matched.sum(axis=1) >= 3).all()
    assert np.diff(rows).max() <= 5  # the selection is connected


def test_keyframes_with_few_matches_are_all_selected() -> None:
    rows = _select(np.array([0.0, 1.0, 2.0, 100.0, *np.linspace(200.0, 201.0, 60)]), 4.0)
    assert rows.tolist() == [0, 1, 2, 3, 4, 5, 6]


def test_components_that_are_linked_later_are_joined() -> None:
    here, there, between = np.linspace(0.0, 1.0, 20), np.linspace(8.0, 9.0, 20), np.full(20, 4.5)
    rows = _select(np.concatenate([here, there, between]), 5.0)
    assert rows.tolist() == [0, 1, 2, 20, 21, 22, 40, 41, 42]


def test_without_keyframes_none_is_selected() -> None:
    assert len(_select(np.zeros(0), 1.0)) == 0
