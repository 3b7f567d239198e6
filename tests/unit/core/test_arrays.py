"""Frozen arrays are read-only and are not copied without need; runs and evenly spaced indices."""

from __future__ import annotations

import numpy as np
import pytest

from bodycap_batch.core.arrays import evenly_spaced, frozen_array, runs


def test_a_writeable_array_is_copied() -> None:
    given = np.arange(4.0)
    kept = frozen_array(given, name="given", shape=(4,))
    given[0] = 9.0
    assert kept[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        kept[0] = 1.0


def test_a_frozen_array_is_shared_but_a_view_is_copied() -> None:
    kept = frozen_array(np.arange(4.0), name="kept", shape=(4,))
    assert frozen_array(kept, name="again", shape=(None,)) is kept
    base = np.arange(4.0)
    view = base[:]
    view.flags.writeable = False
    copied = frozen_array(view, name="view", shape=(4,))
    base[0] = 9.0
    assert copied[0] == 0.0
    assert frozen_array(kept, name="other", shape=(4,), dtype=np.float32) is not kept


def test_runs_of_a_mask() -> None:
    assert runs(np.array([True, True, False, True, False, False, True])) == [(0, 2), (3, 4), (6, 7)]
    assert runs(np.zeros(3, dtype=bool)) == runs(np.zeros(0, dtype=bool)) == []
    assert runs(np.ones(3, dtype=bool)) == [(0, 3)]


def test_evenly_spaced_indices() -> None:
    assert evenly_spaced(10, 4).tolist() == [0, 3, 6, 9]
    assert evenly_spaced(3, 8).tolist() == [0, 1, 2]
    assert evenly_spaced(5, 1).tolist() == [0]
    assert evenly_spaced(0, 4).tolist() == evenly_spaced(4, 0).tolist() == []
