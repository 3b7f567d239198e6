"""The longest time without a measurement: between two of them, before the first or after the last."""

from __future__ import annotations

import numpy as np
import pytest

from bodycap_batch.merging.cameras.track import CameraTrack
from bodycap_batch.merging.reporting.report import longest_gap_s

SECOND = 1_000_000_000


def track(seconds: list[float]) -> CameraTrack:
    count = len(seconds)
    return CameraTrack(
        camera="torso",
        bone=0,
        frames=np.arange(count),
        times_ns=np.array([round(each * SECOND) for each in seconds], dtype=np.int64),
        map_from_cam=np.tile(np.eye(4), (count, 1, 1)),
        sigma_rad=np.full(count, 0.01),
        sigma_map=np.full(count, 0.01),
    )


@pytest.mark.parametrize(
    ("seconds", "gap"),
    [
        ([0.0, 1.0, 1.4, 4.0, 5.0], 2.6),
        ([3.2, 4.0, 5.0], 3.2),
        ([0.0, 1.0, 1.5], 3.5),
        ([], 5.0),
        # a measurement half a frame outside the ticks does not make the clip longer
        ([-0.01, 2.0, 5.01], 3.0),
    ],
)
def test_the_ends_of_the_clip_count(seconds: list[float], gap: float) -> None:
    assert longest_gap_s(track(seconds), 0, 5 * SECOND) == pytest.approx(gap)
