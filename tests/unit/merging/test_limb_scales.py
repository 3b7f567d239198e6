"""The scale of one limb is the minimum of its cost, and unknown if there is none."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np
import pytest

from bodycap_batch.merging.body_calibration import limb_scales


class _Graph:
    """A calibration graph whose cost is a function of the logarithm of the scale."""

    def __init__(self, cost: Callable[[float], float]) -> None:
        self._cost = cost

    def solve(self, scale: float) -> float:
        return self._cost(float(np.log(scale)))


def _found(cost: Callable[[float], float]) -> Any:
    return limb_scales._scale_of_limb("left arm", cast(Any, _Graph(cost)), 1.0)


@pytest.mark.parametrize("true", [-1.2, -0.3, 0.02, 0.4, 1.2])
def test_the_scale_is_the_minimum_of_the_cost(true: float) -> None:
    found = _found(lambda x: 50.0 * (x - true) ** 2)
    assert np.log(found.scale) == pytest.approx(true, abs=1e-6)
    assert found.sigma_log == pytest.approx(0.1)


def test_a_cost_that_levels_off_is_not_extrapolated() -> None:
    # The parabola through the three costs next to the start has its minimum at a ratio of 400.
    assert _found(lambda x: 10.0 * float(np.exp(-x / 6.0))) is None


def test_a_minimum_beside_a_flat_slope_is_found() -> None:
    found = _found(lambda x: -x if x < 0.7 else -0.7 + 200.0 * (x - 0.7) ** 2)
    assert np.log(found.scale) == pytest.approx(0.7, abs=0.05)
