"""Simulated measured camera poses: true poses with noise, bursts of gross errors, and gaps."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.model.geometry import make_transform, so3_exp
from bodycap_batch.synthetic.options import SynthOptions

_BURST_FRAMES = (2, 7)
"""Range of the length (frames) of a burst of gross errors. The end of the range is not included."""
_GROSS_M = 0.4
"""Standard deviation (metres) of the shift of a gross error along each axis."""
_GROSS_RAD = 0.5
"""Standard deviation (radians) of the rotation of a gross error about each axis."""


def disturb_poses(
    world_from_cam: FloatArray, options: SynthOptions, rng: np.random.Generator
) -> tuple[FloatArray, BoolArray]:
    """Add noise, gross errors and gaps to true poses (T,4,4).

    The first and the last frame are never in a gap.

    Returns:
        (T,4,4) poses with noise and gross errors, and a mask (T,) that is False for a frame in a gap.
    """
    count = len(world_from_cam)
    outlier = _draw_runs(count, round(options.outliers * count), _BURST_FRAMES, rng)
    sigma_rad = np.radians(options.pose_sigma_deg)
    turn = so3_exp(rng.normal(0.0, sigma_rad, (count, 3)))
    shift = rng.normal(0.0, options.pose_sigma_m, (count, 3))
    gross = so3_exp(rng.normal(0.0, _GROSS_RAD, (count, 3)))
    turn = np.where(outlier[:, None, None], gross @ turn, turn)
    shift = shift + outlier[:, None] * rng.normal(0.0, _GROSS_M, (count, 3))
    poses = make_transform(world_from_cam[:, :3, :3] @ turn, world_from_cam[:, :3, 3] + shift)
    present = np.ones(count, dtype=bool)
    # Keep the first and the last frame. `_draw_runs` shortens the last gap that it draws, so that
    # the number of lost frames is exact.
    shortest, longest = options.gap_frames
    present[1:-1] = ~_draw_runs(max(count - 2, 0), round(options.lost * count), (shortest, longest + 1), rng)
    return poses, present


def _draw_runs(count: int, wanted: int, lengths: tuple[int, int], rng: np.random.Generator) -> BoolArray:
    """Draw runs of consecutive frames until exactly `wanted` of `count` frames are in a run.

    Return a mask (count,) that is True for the frames in a run.
    """
    out = np.zeros(count, dtype=bool)
    while int(out.sum()) < min(wanted, count):
        start = int(rng.integers(0, count))
        length = min(int(rng.integers(*lengths)), wanted - int(out.sum()))
        out[start : start + length] = True
    return out
