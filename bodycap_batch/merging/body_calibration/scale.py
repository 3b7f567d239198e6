"""Metric scale: the one at which the body explains the cameras with least strain, weighed with the floor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.body_calibration.calibration_graph import CalibrationGraph
from bodycap_batch.merging.world.floor import WALKING_HEIGHT_RATIO

_COARSE_STEP = 0.16
_FINE_STEP = 0.05
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
class ScaleSource:
    """Something that knows the metric scale.

    Attributes:
        name: For the report.
        scale: Metres per map unit.
        sigma_log: Sigma of its logarithm.
        used: False where it was not believed, or something better was there.
    """

    name: str
    scale: float
    sigma_log: float
    used: bool = True


def estimate_scale(calibration: CalibrationGraph, provisional: float) -> ScaleEstimate:
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
    for step in (_COARSE_STEP, _FINE_STEP):
        while len(costs) < _MAX_SOLVES:
            low, middle, high = cost(centre - step), cost(centre), cost(centre + step)
            if middle <= min(low, high):
                curvature = (low + high - 2.0 * middle) / step**2
                centre += float(0.5 * (low - high) / (curvature * step)) if curvature > 0.0 else 0.0
                break
            centre += step if high < low else -step
    cost(centre)
    for side in (-_FINE_STEP, _FINE_STEP):
        if not any((x - centre) * side > 0.0 for x in costs):
            # The cost fell all the way to here.
            cost(centre + side)
    before, after = (_nearest_solution(mounts, centre, sign * _FINE_STEP) for sign in (-1.0, 1.0))
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


def _nearest_solution(
    mounts: Mapping[float, Mapping[str, FloatArray]], centre: float, offset: float
) -> tuple[float, Mapping[str, FloatArray]]:
    """The solve nearest to an offset from the centre, and its mounts."""
    nearest = min((x for x in mounts if (x - centre) * offset > 0.0), key=lambda x: abs(x - centre - offset))
    return nearest, mounts[nearest]


def scale_from_floor(body: ScaleSource, height_m: float, standing_m: float) -> ScaleSource:
    """What the height of the trunk over the map's floor says; used within 2 sigma of the body.

    Args:
        body: The bones' own estimate.
        height_m: Median height of a trunk joint over the floor at that scale.
        standing_m: Its height in the standing skeleton.
    """
    if height_m <= 0.0:
        return ScaleSource(name="floor", scale=body.scale, sigma_log=FLOOR_SIGMA, used=False)
    difference = float(np.log(WALKING_HEIGHT_RATIO * standing_m / height_m))
    believed = difference**2 <= 4.0 * (body.sigma_log**2 + FLOOR_SIGMA**2)
    scale = body.scale * float(np.exp(difference))
    return ScaleSource(name="floor", scale=scale, sigma_log=FLOOR_SIGMA, used=believed)


def weighted_mean(sources: Sequence[ScaleSource]) -> tuple[float, float]:
    """Scale and sigma of its logarithm from the sources in use, each by its precision."""
    used = [source for source in sources if source.used]
    weight = np.array([source.sigma_log**-2 for source in used])
    mean = float(weight @ np.log([source.scale for source in used]) / weight.sum())
    return float(np.exp(mean)), float(1.0 / np.sqrt(weight.sum()))


def chi_square(sources: Sequence[ScaleSource]) -> tuple[float, int]:
    """Chi-square of all sources about their weighted mean, used or not, and its degrees of freedom."""
    mean, _ = weighted_mean([replace(source, used=True) for source in sources])
    off = np.array([np.log(source.scale / mean) / source.sigma_log for source in sources])
    return float(off @ off), len(sources) - 1
