"""Hinges that the motion does not keep to: found where cameras on both sides contradict them, and loosened.

No elbow is a perfect hinge, a rig's may be none at all, and a strap that slides looks like one that bends
sideways. Held to a centimetre, such a hinge bends mounts and scale instead, and hides in them: how far it
gives shows only where it is let go.

Source: variance components by redundancy, W. Foerstner, "Ein Verfahren zur Schaetzung von Varianz- und
Kovarianzkomponenten", AVN 1979; one component a hinge.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from bodycap_batch.core.arrays import IntArray
from bodycap_batch.merging.body.bones import JOINT_SLACK_M, Bone, Hinge
from bodycap_batch.merging.body_calibration.mount_covariance import LinearisedCalibration
from bodycap_batch.merging.graph.error_modes import BodyModel
from bodycap_batch.merging.graph.factors import HINGE_SLACK_RATIO

FREE_SIGMA_M = 0.1
"""Sigma of the distances of a hinge that is let go: ten times that of one that holds."""
TIGHT_SIGMA_M = HINGE_SLACK_RATIO * JOINT_SLACK_M
_MIN_VARIANCE_RATIO = 1.5
"""Times the variance of a hinge that is kept to, beyond which it gives. Let go, distances are off by 3 to 6
mm where elbows are hinges, by 14 and 24 mm where they turn by 6 and 12 degrees about another axis, too."""


def observable_hinges(hinges: Sequence[Hinge], measured: Collection[int]) -> list[Hinge]:
    """Hinges with a camera on the bone above and on one of the two below: only they can be contradicted.

    Args:
        hinges: Of the body.
        measured: Bones that carry cameras.
    """
    return [
        hinge
        for hinge in hinges
        if hinge.upper in measured and (hinge.lower in measured or hinge.following in measured)
    ]


def hinge_violation_sigma(mounts: LinearisedCalibration) -> dict[int, float]:
    """By lower bone, sigma by which distances leave a hinge that was let go, beyond `TIGHT_SIGMA_M`; 0 where not.

    Args:
        mounts: A calibration at its solution.
    """
    out, solved = {}, mounts.eliminated()
    for number, hinge in enumerate(mounts.body.hinges):
        if hinge.sigma_m < FREE_SIGMA_M:
            continue
        rows = mounts.linear.first_row[_hinge_factors(mounts.body, number, mounts)]
        residuals = float((mounts.linear.rhs[rows] ** 2).sum())
        redundancy = max(float(solved.redundancy[rows].sum()), 1.0)
        variance = hinge.sigma_m**2 * residuals / redundancy
        gives = variance > _MIN_VARIANCE_RATIO * TIGHT_SIGMA_M**2
        out[hinge.lower] = float(np.sqrt(variance - TIGHT_SIGMA_M**2)) if gives else 0.0
    return out


def with_hinge_slack(bones: Sequence[Bone], off_hinge_m: Mapping[int, float]) -> tuple[Bone, ...]:
    """Bones whose hinges give by so much, the others as they are."""
    return tuple(
        replace(bone, off_hinge_m=off_hinge_m[index]) if index in off_hinge_m else bone
        for index, bone in enumerate(bones)
    )


def _hinge_factors(body: BodyModel, number: int, mounts: LinearisedCalibration) -> IntArray:
    """Indices of one hinge's two distances at every tick."""
    ticks = np.arange(len(mounts.world_from_bone))
    first = mounts.first_joint + sum(bone.parent >= 0 for bone in body.bones) + 2 * number
    return np.asarray((first + body.factors_per_tick * ticks[:, None] + np.arange(2)).ravel())
