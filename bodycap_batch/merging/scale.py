"""Metric scale: the one at which the body explains the cameras with least strain, weighed with the floor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bodycap_batch.arrays import FloatArray
from bodycap_batch.merging.calibrate import Calibration
from bodycap_batch.merging.gauge import WALKING_HEIGHT

_FIRST_STEPS = (1.0, 0.85, 1.18)
_MAX_SOLVES = 12
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


def find_scale(calibration: Calibration, provisional: float) -> ScaleEstimate:
    """Minimise the calibration's cost over the logarithm of the scale by successive parabolas.

    The calibration is left solved at the returned scale.
    """
    costs: dict[float, float] = {}
    mounts: dict[float, dict[str, FloatArray]] = {}

    def evaluate(log_scale: float) -> None:
        costs[log_scale] = calibration.solve(float(np.exp(log_scale)))
        mounts[log_scale] = {name: pose.copy() for name, pose in calibration.mounts.items()}

    for factor in _FIRST_STEPS:
        evaluate(float(np.log(provisional * factor)))
    curvature = 0.0
    while len(costs) < _MAX_SOLVES:
        at = sorted(costs)
        lowest = min(at, key=costs.__getitem__)
        if lowest in (at[0], at[-1]):
            evaluate(lowest + (0.15 if lowest == at[-1] else -0.15))
            continue
        middle = at.index(lowest)
        points = at[middle - 1 : middle + 2]
        bend, slope, _ = np.polyfit(np.array(points) - lowest, [costs[x] for x in points], 2)
        curvature = 2.0 * float(bend)
        following = float(np.clip(lowest - slope / curvature, points[0], points[2])) if bend > 0 else lowest
        if abs(following - lowest) < 0.005:
            break
        evaluate(following)
    best = min(costs, key=costs.__getitem__)
    other = min((x for x in costs if x != best), key=lambda x: abs(x - best))
    slope_of = {name: (mounts[other][name] - mounts[best][name]) / (other - best) for name in mounts[best]}
    evaluate(best)
    return ScaleEstimate(
        scale=float(np.exp(best)),
        sigma_log=max(1.0 / np.sqrt(curvature), _MIN_SIGMA) if curvature > 0 else 1.0,
        costs=tuple(sorted((float(np.exp(x)), cost) for x, cost in costs.items())),
        mount_slope=slope_of,
    )


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
