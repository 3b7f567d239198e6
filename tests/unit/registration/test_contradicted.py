"""The poses around keyframes that contradict the map are withdrawn."""

from __future__ import annotations

import numpy as np
import pytest

from bodycap_batch.registration.poses.contradicted import _frames_in_blocks


@pytest.mark.parametrize(
    ("misplaced", "expected"),
    [
        ([], []),
        ([15], []),
        ([14, 15], list(range(11, 20))),
        ([15, 25], []),
        ([32, 35], list(range(31, 40))),
        ([2, 3], list(range(10))),
        # A keyframe that was placed again is in the map.
        ([14, 15, 20], list(range(11, 30))),
    ],
)
def test_a_block_lies_between_two_keyframes_of_the_map(misplaced: list[int], expected: list[int]) -> None:
    kept = np.array([10, 20, 30])
    inside = _frames_in_blocks(40, kept, np.array(misplaced, dtype=np.int64))
    assert np.flatnonzero(inside).tolist() == expected
