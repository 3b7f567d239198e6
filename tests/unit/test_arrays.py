"""Arrays of the frozen types: nobody else can write to them, and long ones are not copied for nothing."""

from __future__ import annotations

import numpy as np
import pytest

from bodycap_batch.core.arrays import frozen_array


def test_an_array_that_may_be_written_to_is_copied() -> None:
    given = np.arange(4.0)
    kept = frozen_array(given, name="given", shape=(4,))
    given[0] = 9.0
    assert kept[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        kept[0] = 1.0


def test_a_frozen_array_is_taken_as_it_is_but_not_a_view() -> None:
    kept = frozen_array(np.arange(4.0), name="kept", shape=(4,))
    assert frozen_array(kept, name="again", shape=(None,)) is kept
    base = np.arange(4.0)
    view = base[:]
    view.flags.writeable = False
    copied = frozen_array(view, name="view", shape=(4,))
    base[0] = 9.0
    assert copied[0] == 0.0
    assert frozen_array(kept, name="other", shape=(4,), dtype=np.float32) is not kept
