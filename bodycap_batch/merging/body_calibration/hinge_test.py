"""Test whether the motion obeys the hinges of the skeleton, and loosen the violated hinges.

A hinge joint bends about one axis only. There are three reasons why the measured motion can violate a hinge.
First, no elbow is a perfect hinge. Second, the motion capture system that made the skeleton may not treat
this joint as a hinge. Third, a camera strap that slides on the limb looks like sideways bending.

If the graph enforces a violated hinge tightly, mounts and scale become wrong, and the residuals do not show
the violation. Therefore the test first frees the hinge.

Source: estimation of variance components from redundancies, W. Foerstner, "Ein Verfahren zur Schaetzung von
Varianz- und Kovarianzkomponenten", AVN 1979. One variance component is estimated for each hinge.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from bodycap_batch.core.arrays import IntArray
from bodycap_batch.merging.body.bones import JOINT_SLACK_M, Bone, Hinge
from bodycap_batch.merging.body_calibration.mount_covariance import LinearisedCalibration
from bodycap_batch.merging.graph.factors import HINGE_SLACK_RATIO

FREE_SIGMA_M = 0.1
"""Sigma of the distances of a freed hinge, metres.

The distances of a hinge are those between its two anchors and the following joint, see `Hinge`. The value is
ten times `TIGHT_SIGMA_M`. Evidence: none.
"""
TIGHT_SIGMA_M = HINGE_SLACK_RATIO * JOINT_SLACK_M
"""Sigma of the distances of a hinge that the motion obeys, metres."""
_MIN_VARIANCE_RATIO = 1.5
"""Maximum ratio of the variance of a hinge's distances to ``TIGHT_SIGMA_M**2``.

A hinge with a larger ratio is violated. Unit: 1. Evidence: docs/decisions/body_calibration.md.
"""


def observable_hinges(hinges: Sequence[Hinge], measured: Collection[int]) -> list[Hinge]:
    """Return the hinges that the measured camera poses can contradict.

    Such a hinge has a camera on the bone above it, and a camera on one of the two bones below it.

    Args:
        hinges: Hinges of the body.
        measured: Indices of the bones on which cameras are mounted.

    Returns:
        The hinges that measurements can contradict.
    """
    return [
        hinge
        for hinge in hinges
        if hinge.upper in measured and (hinge.lower in measured or hinge.following in measured)
    ]


def hinge_violation_sigma(linearised: LinearisedCalibration) -> dict[int, float]:
    """Return the size of each hinge violation.

    The variance of the hinge's distances is estimated from the residuals. The variance of a hinge that the
    motion obeys, ``TIGHT_SIGMA_M**2``, is subtracted. The square root of the rest is the size of the
    violation.

    Args:
        linearised: The calibration graph, linearised at its solution. Only its freed hinges are examined.

    Returns:
        Sigma in metres by index of the bone below the hinge. The sigma is 0 if the motion obeys the hinge.
    """
    out, reduced = {}, linearised.reduced()
    for number, hinge in enumerate(linearised.body.hinges):
        if hinge.sigma_m < FREE_SIGMA_M:
            continue
        rows = linearised.linear.first_row[_hinge_factors(linearised, number)]
        squares = float((linearised.linear.rhs[rows] ** 2).sum())
        redundancy = max(float(reduced.redundancy[rows].sum()), 1.0)
        variance = hinge.sigma_m**2 * squares / redundancy
        is_violated = variance > _MIN_VARIANCE_RATIO * TIGHT_SIGMA_M**2
        out[hinge.lower] = float(np.sqrt(variance - TIGHT_SIGMA_M**2)) if is_violated else 0.0
    return out


def with_hinge_slack(bones: Sequence[Bone], off_hinge_m: Mapping[int, float]) -> tuple[Bone, ...]:
    """Return the bones with new sigmas for their hinges.

    Args:
        bones: Bones of the graph.
        off_hinge_m: By index of a bone, sigma of the distance between the bone's far end and the plane of
            its hinge, metres. Bones without an entry remain unchanged.

    Returns:
        All bones, in the same order.
    """
    return tuple(
        replace(bone, off_hinge_m=off_hinge_m[index]) if index in off_hinge_m else bone
        for index, bone in enumerate(bones)
    )


def _hinge_factors(linearised: LinearisedCalibration, number: int) -> IntArray:
    """Return the indices of the two distance factors of one hinge at every tick."""
    ticks = np.arange(len(linearised.world_from_bone))
    joints = sum(bone.parent >= 0 for bone in linearised.body.bones)
    first = linearised.first_joint_factor + joints + 2 * number
    return np.asarray((first + linearised.body.factors_per_tick * ticks[:, None] + np.arange(2)).ravel())
