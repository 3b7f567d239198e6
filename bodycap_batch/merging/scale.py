"""Metric scale: the one at which the body explains the cameras with least strain, weighed with the floor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bodycap_batch.arrays import FloatArray
from bodycap_batch.merging.calibrate import Calibration
from bodycap_batch.merging.gauge import WALKING_HEIGHT, Direction
from bodycap_batch.merging.spread import Spread
from bodycap_batch.skeleton import Mount

_COARSE = 0.16
_FINE = 0.05
"""Steps of the log scale. The cost is skewed (an arm cannot stretch, but it can bend), so that the coarse
parabola leans to small scales; the fine one decides."""
_MAX_SOLVES = 14
_MIN_SIGMA = 0.01
FLOOR_SIGMA = 0.06
"""Of the log of a trunk joint's height over the floor: knees bend 1 to 6 cm, shoes add 1 to 3."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaleEstimate:
    """Metres per map unit.

    Attributes:
        scale: The estimate.
        sigma_log: Sigma of its logarithm, from the cost's curvature.
        costs: (scale, cost) of every solve.
        mount_slope: By camera, change of joint_from_cam (4,4) per unit of log scale.
    """

    scale: float
    sigma_log: float
    costs: tuple[tuple[float, float], ...]
    mount_slope: Mapping[str, FloatArray]


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibrated:
    """What is constant over the capture."""

    scale: float
    sigma_log: float
    estimate: ScaleEstimate
    mounts: tuple[Mount, ...]
    up: Direction
    floor_believed: bool
    height_over_floor_m: float | None
    spread: Spread


def find_scale(calibration: Calibration, provisional: float) -> ScaleEstimate:
    """Minimise the calibration's cost over the logarithm of the scale, by parabolas of shrinking width.

    The calibration is left solved at the returned scale.
    """
    costs: dict[float, float] = {}
    mounts: dict[float, dict[str, FloatArray]] = {}

    def cost(log_scale: float) -> float:
        if log_scale not in costs:
            costs[log_scale] = calibration.solve(float(np.exp(log_scale)))
            mounts[log_scale] = {name: pose.copy() for name, pose in calibration.mounts.items()}
        return costs[log_scale]

    centre, curvature = float(np.log(provisional)), 0.0
    for step in (_COARSE, _FINE):
        while len(costs) < _MAX_SOLVES:
            low, middle, high = cost(centre - step), cost(centre), cost(centre + step)
            if middle <= min(low, high):
                curvature = (low + high - 2.0 * middle) / step**2
                centre += float(0.5 * (low - high) / (curvature * step)) if curvature > 0.0 else 0.0
                break
            centre += step if high < low else -step
    cost(centre)
    before, after = (_mounts_beside(mounts, centre, sign * _FINE) for sign in (-1.0, 1.0))
    width = after[0] - before[0]
    slope = {name: (after[1][name] - before[1][name]) / width for name in after[1]}
    costs.pop(centre)
    cost(centre)
    return ScaleEstimate(
        scale=float(np.exp(centre)),
        sigma_log=max(1.0 / np.sqrt(curvature), _MIN_SIGMA) if curvature > 0 else 1.0,
        costs=tuple(sorted((float(np.exp(x)), value) for x, value in costs.items())),
        mount_slope=slope,
    )


def _mounts_beside(
    mounts: Mapping[float, Mapping[str, FloatArray]], centre: float, offset: float
) -> tuple[float, Mapping[str, FloatArray]]:
    """The solve nearest to an offset from the centre, and its mounts."""
    nearest = min((x for x in mounts if (x - centre) * offset > 0.0), key=lambda x: abs(x - centre - offset))
    return nearest, mounts[nearest]


def weigh_floor(estimate: ScaleEstimate, height_m: float, standing_m: float) -> tuple[float, float, bool]:
    """Let the height of the trunk over the map's floor correct the scale.

    Args:
        estimate: The body's own estimate.
        height_m: Median height of a trunk joint over the floor at that scale.
        standing_m: Its height in the standing skeleton.

    Returns:
        Factor on the scale, its sigma, and whether the floor was believed (within 2 sigma of the body).
    """
    if height_m <= 0.0:
        return 1.0, estimate.sigma_log, False
    difference = float(np.log(WALKING_HEIGHT * standing_m / height_m))
    body, floor = estimate.sigma_log**2, FLOOR_SIGMA**2
    if difference**2 > 4.0 * (body + floor):
        return 1.0, estimate.sigma_log, False
    return (
        float(np.exp(difference * body / (body + floor))),
        float(np.sqrt(body * floor / (body + floor))),
        True,
    )
