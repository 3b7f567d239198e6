"""Metric scale: its sources, the estimate from the bones, and the combination of all sources.

A map has no unit. The scale is the number of metres per map unit. The scale has these sources, listed by
their names in the report:

- ``skeleton``, ``height``, ``mean stature``: the bones. `estimate_scale` finds the scale at which the
  calibration graph has the lowest cost; `scale_from_bones` adds the uncertainty of the bone lengths
  (`PROPORTION_SIGMA` in ``skeleton_error_modes.py``). The name says where the bone lengths come from.
- ``floor``: the height of the reference camera's joint over the floor, see `scale_from_floor`. The module
  ``world/floor.py`` finds the floor that the person walks on.
- ``known distance``: a distance given in the job, see ``known_distance.py``.
- ``marker board``: a board that the job describes and that keyframes observe, see ``marker_board.py``.

`combine_sources` combines these sources. A known distance or a marker board replaces bones and floor.
Otherwise the result is the mean of bones and floor, weighted by their precision. If neither a skeleton nor a
height is given, the sigma of the result is at least `STATURE_SIGMA`.

Other modules estimate scales for other purposes. These scales are not used in the result:

- ``body/provisional_scale.py``: the provisional scale, the initial value of the calibration.
- ``map_alignment/similarity_refinement.py`` and ``map_alignment/walked_floor.py``: the scale of the main map
  while other maps are aligned to it. It uses the limbs' reach, the floor and the sources given in the job.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.body_calibration.mount_calibration_graph import CalibrationGraph
from bodycap_batch.merging.body_calibration.skeleton_error_modes import PROPORTION_SIGMA
from bodycap_batch.merging.world.floor import WALKING_HEIGHT_RATIO

MEAN_STATURE = "mean stature"
"""Name, in the report, of the scale from bones of a person of mean stature.

It is used if the job gives neither a skeleton nor the height of the subject.
"""
_COARSE_STEP = 0.16
"""Step of the log of the scale for the first parabola through the costs. Evidence: none."""
_FINE_STEP = 0.05
"""Step of the log of the scale for the second parabola through the costs. Evidence: none.

The cost is not symmetric about its minimum, because an arm can bend but not stretch. The parabola of the
coarse step is therefore biased towards small scales. The fine step removes most of this bias.
"""
_MAX_SOLVES = 14
"""Maximum number of solutions of the graph in the search for the scale. Evidence: none."""
_MIN_SIGMA = 0.01
"""Minimum sigma of the log of the scale from the bones. Evidence: none."""
FLOOR_SIGMA = 0.06
"""Sigma of the log of the scale from a joint's height over the floor.

Bent knees lower the joint by 1 to 6 cm, shoes raise the joint by 1 to 3 cm. Evidence: none.
"""
STATURE_SIGMA = 0.055
"""Sigma of the log of an adult's stature if the sex is unknown.

Within each sex, the stature has a sigma of 7 cm. The mean statures of the two sexes differ by 14 cm.
Evidence: none.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaleEstimate:
    """The result of `estimate_scale`: the scale at which the calibration graph has the lowest cost.

    Attributes:
        scale: Metres per map unit.
        sigma_log: Sigma of the logarithm of the scale, from the curvature of the cost.
        costs: Pairs (scale, cost), one for every solution of the graph.
        mount_slope: By camera, change of joint_from_cam (4,4) per unit of log scale.
    """

    scale: float
    sigma_log: float
    costs: tuple[tuple[float, float], ...]
    mount_slope: Mapping[str, FloatArray]


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaleSource:
    """A source of the metric scale, for example the bones or the floor, with the scale that it gives.

    Attributes:
        name: Name of the source in the report.
        scale: Metres per map unit.
        sigma_log: Sigma of the logarithm of the scale.
        used: False if the source was rejected, or replaced by a better source.
    """

    name: str
    scale: float
    sigma_log: float
    used: bool = True


@dataclass(frozen=True, slots=True)
class MetricScale:
    """The combined metric scale.

    Attributes:
        metres_per_unit: Metres per map unit.
        sigma_log: Sigma of the logarithm of the scale.
        sources: All sources, both used and unused. The scale from the bones is the first.
    """

    metres_per_unit: float
    sigma_log: float
    sources: tuple[ScaleSource, ...]


def estimate_scale(graph: CalibrationGraph, provisional: float) -> ScaleEstimate:
    """Find the scale at which a calibration graph has the lowest cost.

    The search fits a parabola to the costs at three values of log scale, and moves to the minimum of the
    parabola. It does this twice: first with a coarse step between the three values, then with a fine step.

    Args:
        graph: The calibration graph. At the end, its last solution is at the returned scale.
        provisional: Initial value of the scale, metres per map unit.

    Returns:
        The scale, its uncertainty, and the dependence of the mounts on the scale.
    """
    costs: dict[float, float] = {}
    mounts: dict[float, dict[str, FloatArray]] = {}

    def cost(log_scale: float) -> float:
        if log_scale not in costs:
            costs[log_scale] = graph.solve(float(np.exp(log_scale)))
            mounts[log_scale] = {name: pose.copy() for name, pose in graph.mounts.items()}
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
            # No solution exists yet on this side of the minimum. The slope of the mounts needs a solution on
            # both sides.
            cost(centre + side)
    below, above = (_nearest_solution(mounts, centre, sign * _FINE_STEP) for sign in (-1.0, 1.0))
    width = above - below
    slope = {name: (mounts[above][name] - mounts[below][name]) / width for name in mounts[above]}
    # Solve at the minimum once more, because the caller uses the mounts of the graph's last solution.
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
) -> float:
    """Return the solved log scale nearest to ``centre + offset``.

    If the offset is positive, only solutions above the centre are considered. If the offset is negative, only
    solutions below the centre are considered.
    """
    return min((x for x in mounts if (x - centre) * offset > 0.0), key=lambda x: abs(x - centre - offset))


def scale_from_bones(estimate: ScaleEstimate, *, is_measured: bool, has_height: bool) -> ScaleSource:
    """Return the scale from the bones with the uncertainty of their lengths.

    Args:
        estimate: The scale at which the calibration graph has the lowest cost.
        is_measured: True if the bone lengths of the subject were measured.
        has_height: True if the skeleton was scaled to the subject's height.

    Returns:
        The scale from the bones.
    """
    name, lengths_sigma = "skeleton", 0.0
    if not is_measured:
        name, lengths_sigma = "height" if has_height else MEAN_STATURE, PROPORTION_SIGMA
    sigma_log = float(np.hypot(estimate.sigma_log, lengths_sigma))
    return ScaleSource(name=name, scale=estimate.scale, sigma_log=sigma_log)


def scale_from_floor(body: ScaleSource, height_m: float, standing_m: float) -> ScaleSource:
    """Return the scale from a joint's height over the floor.

    Args:
        body: The scale from the bones.
        height_m: Median height of the joint over the floor at the scale from the bones, metres.
        standing_m: Height of the joint over the soles of the standing skeleton, metres.

    Returns:
        The scale from the floor. This source is marked as used if its scale differs from `body` by at most 2
        sigma. If `height_m` is not positive, the source has the scale of `body`, and is marked as unused.
    """
    if height_m <= 0.0:
        return ScaleSource(name="floor", scale=body.scale, sigma_log=FLOOR_SIGMA, used=False)
    difference = float(np.log(WALKING_HEIGHT_RATIO * standing_m / height_m))
    is_accepted = difference**2 <= 4.0 * (body.sigma_log**2 + FLOOR_SIGMA**2)
    scale = body.scale * float(np.exp(difference))
    return ScaleSource(name="floor", scale=scale, sigma_log=FLOOR_SIGMA, used=is_accepted)


def combine_sources(
    bones: ScaleSource, floor: ScaleSource | None, stated: Sequence[ScaleSource]
) -> MetricScale:
    """Combine all sources of the scale.

    Args:
        bones: The scale from the bones.
        floor: The scale from the floor; None if no floor was found.
        stated: Scales from a known distance or a marker board. If there is at least one such scale, bones and
            floor are not used.

    Returns:
        The combined scale.
    """
    measured = [bones] if floor is None else [bones, floor]
    if stated:
        measured = [replace(source, used=False) for source in measured]
    sources = (*measured, *stated)
    scale, sigma_log = weighted_mean(sources)
    if bones.name == MEAN_STATURE and not stated:
        sigma_log = float(np.hypot(sigma_log, STATURE_SIGMA))
    return MetricScale(scale, sigma_log, sources)


def weighted_mean(sources: Sequence[ScaleSource]) -> tuple[float, float]:
    """Return the precision-weighted mean scale of the used sources, and the sigma of its logarithm."""
    used = [source for source in sources if source.used]
    weight = np.array([source.sigma_log**-2 for source in used])
    mean = float(weight @ np.log([source.scale for source in used]) / weight.sum())
    return float(np.exp(mean)), float(1.0 / np.sqrt(weight.sum()))


def chi_square(sources: Sequence[ScaleSource]) -> tuple[float, int]:
    """Return the chi-square of all sources about their weighted mean, and its degrees of freedom.

    Unused sources are included.
    """
    mean, _ = weighted_mean([replace(source, used=True) for source in sources])
    off = np.array([np.log(source.scale / mean) / source.sigma_log for source in sources])
    return float(off @ off), len(sources) - 1
