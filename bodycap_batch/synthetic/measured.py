"""Camera poses as a localiser would deliver them: noise, gross errors in bursts, gaps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.model.geometry import make_transform, so3_exp
from bodycap_batch.synthetic.options import SynthOptions

_BURST_FRAMES = (2, 7)
_GROSS_M = 0.4
_GROSS_RAD = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredPoses:
    """What is left of a camera's true path.

    Attributes:
        world_from_cam: (T,4,4) noisy poses.
        present: (T,) False in a gap.
        outlier: (T,) True where the pose is grossly wrong.
    """

    world_from_cam: FloatArray
    present: BoolArray
    outlier: BoolArray


def measure(world_from_cam: FloatArray, options: SynthOptions, rng: np.random.Generator) -> MeasuredPoses:
    """Disturb true poses (T,4,4); the first and the last frame are never lost."""
    count = len(world_from_cam)
    outlier = _stretches(count, round(options.outliers * count), _BURST_FRAMES, rng)
    sigma_rad = np.radians(options.pose_sigma_deg)
    turn = so3_exp(rng.normal(0.0, sigma_rad, (count, 3)))
    shift = rng.normal(0.0, options.pose_sigma_m, (count, 3))
    gross = so3_exp(rng.normal(0.0, _GROSS_RAD, (count, 3)))
    turn = np.where(outlier[:, None, None], gross @ turn, turn)
    shift = shift + outlier[:, None] * rng.normal(0.0, _GROSS_M, (count, 3))
    poses = make_transform(world_from_cam[:, :3, :3] @ turn, world_from_cam[:, :3, 3] + shift)
    present = np.ones(count, dtype=bool)
    # The ends stay; the last gap is cut to reach the wanted share exactly.
    shortest, longest = options.gap_frames
    present[1:-1] = ~_stretches(max(count - 2, 0), round(options.lost * count), (shortest, longest + 1), rng)
    return MeasuredPoses(world_from_cam=poses, present=present, outlier=outlier)


def _stretches(count: int, wanted: int, lengths: tuple[int, int], rng: np.random.Generator) -> BoolArray:
    """Mark exactly `wanted` of `count` frames, in stretches."""
    out = np.zeros(count, dtype=bool)
    while int(out.sum()) < min(wanted, count):
        start = int(rng.integers(0, count))
        length = min(int(rng.integers(*lengths)), wanted - int(out.sum()))
        out[start : start + length] = True
    return out
