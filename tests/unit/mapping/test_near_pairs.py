"""A match that contradicts a map is a look-alike only if its frames are far apart in time."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from bodycap_batch.mapping.matching.near_pairs import NO_TIMES, NearPairs

TIMES = {"torso": np.arange(10) * 10**9, "palm": np.arange(10) * 10**9}
NAMES = {1: "torso/0000000", 2: "torso/0000002", 3: "torso/0000003", 4: "palm/0000000", 5: "other/0000000"}


def model() -> Any:
    return SimpleNamespace(
        reg_image_ids=lambda: list(NAMES), image=lambda number: SimpleNamespace(name=NAMES[number])
    )


@pytest.mark.parametrize(
    ("pair", "is_near"),
    [((1, 2), True), ((3, 2), True), ((1, 3), False), ((1, 4), False), ((5, 5), False), ((1, 9), False)],
)
def test_pairs_of_one_camera_with_little_time_between_them_are_near(
    pair: tuple[int, int], *, is_near: bool
) -> None:
    assert (pair in NearPairs(cast(Any, model()), TIMES)) is is_near


def test_no_pair_is_near_without_times() -> None:
    assert (1, 2) not in NearPairs(cast(Any, model()), NO_TIMES)
