"""Test whether the motion keeps to the hinges of the skeleton, and loosen those that it violates.

No elbow is a perfect hinge, the joint may be no hinge in a rig, and a sliding strap looks like sideways
bending. If such a hinge is held to a centimetre, mounts and scale absorb its violation and hide it. The
violation can be measured only if the hinge is free.

Source: variance components by redundancy, W. Foerstner, "Ein Verfahren zur Schaetzung von Varianz- und
Kovarianzkomponenten", AVN 1979. Each hinge has one component.
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
"""Sigma of the distances of a freed hinge, metres: ten times that of a tight one. Evidence: none."""
TIGHT_SIGMA_M = HINGE_SLACK_RATIO * JOINT_SLACK_M
"""Sigma of the distances of a hinge that the motion keeps to, metres."""
_MIN_VARIANCE_RATIO = 1.5
"""Minimum variance of a violated hinge's distances, over that of a tight hinge.

Evidence: docs/decisions/body_calibration.md.
"""


def observable_hinges(hinges: Sequence[Hinge], measured: Collection[int]) -> list[Hinge]:
    """Return the hinges with a camera on the bone above and on one of the two bones below.

    Only these can be contradicted by measurements.

    Args:
        hinges: Hinges of the body.
        measured: Bones that carry cameras.
    """
    return [
        hinge
        for hinge in hinges
        if hinge.upper in measured and (hinge.lower in measured or hinge.following in measured)
    ]


def hinge_violation_sigma(linearised: LinearisedCalibration) -> dict[int, float]:
    """Return by lower bone how far the distances of a freed hinge vary beyond `TIGHT_SIGMA_M`.

    Args:
        linearised: A calibration at its solution. Hinges that are not free are left out.

    Returns:
        Sigmas in metres; 0 if the motion keeps to the hinge.
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
    """Return the bones with other sigmas of their hinges.

    Args:
        bones: The graph's bones.
        off_hinge_m: By bone, sigma in metres by which its far end may leave the hinge's plane. Other bones
            stay as they are.
    """
    return tuple(
        replace(bone, off_hinge_m=off_hinge_m[index]) if index in off_hinge_m else bone
        for index, bone in enumerate(bones)
    )


def _hinge_factors(linearised: LinearisedCalibration, number: int) -> IntArray:
    """Return the indices of one hinge's two distance factors at every tick."""
    ticks = np.arange(len(linearised.world_from_bone))
    joints = sum(bone.parent >= 0 for bone in linearised.body.bones)
    first = linearised.first_joint_factor + joints + 2 * number
    return np.asarray((first + linearised.body.factors_per_tick * ticks[:, None] + np.arange(2)).ravel())
