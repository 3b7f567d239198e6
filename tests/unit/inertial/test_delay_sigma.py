"""The stated sigma of a sensor's delay covers its error, also for a motion with fast and slow turns."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.inertial import align_sensor
from bodycap_batch.model.geometry import make_transform, so3_exp
from tests.inertial import Sensor, solved

SEEDS = 6


class Dancer:
    """A camera that turns slowly, and between it by up to 60 degrees a frame."""

    def poses(self, times_s: FloatArray) -> FloatArray:
        burst = np.exp(-(((times_s % 1.5) - 0.7) ** 2) / 0.02)
        turn = np.stack(
            [0.3 * np.sin(2.1 * times_s), burst * np.sin(14.0 * times_s), 0.4 * np.cos(1.3 * times_s)], axis=1
        )
        return make_transform(so3_exp(turn), 0.1 * np.stack([turn[:, 2], turn[:, 0], turn[:, 0]], axis=1))


def test_the_sigma_of_the_delay_covers_its_error() -> None:
    ratios = []
    for seed in range(SEEDS):
        telemetry = Sensor().samples(Dancer(), 6.0, seed)
        fit = align_sensor(solved(Dancer(), 6.0, seed=100 + seed), telemetry).fit
        assert fit is not None
        ratios.append((fit.delay_s - Sensor().late_s) / fit.delay_sigma_s)
    # Errors of neighbouring pairs are not independent: a ratio of 1.2, and of 3.6 if that is ignored.
    assert 0.3 < np.sqrt(np.mean(np.square(ratios))) < 1.8
