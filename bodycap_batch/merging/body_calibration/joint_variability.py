"""How much of its everyday range a joint uses in one capture.

Source: variance components by redundancy, W. Foerstner, "Ein Verfahren zur Schaetzung von Varianz- und
Kovarianzkomponenten", AVN 1979; one component a joint, its axes together.
"""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.merging.body_calibration.mount_covariance import LinearisedCalibration, ReducedSystem
from bodycap_batch.merging.graph.error_modes import POSTURE_BIAS_SHARE
from bodycap_batch.merging.graph.joint_priors import samples_per_gesture

_PRIOR_REDUNDANCY = 6.0
"""Redundant rotations, each of a gesture of its own, that the everyday range counts as much as: two gestures
about three axes. In six captures of walks, reaching and a dance joints used 0.2 to 33 % of its variance."""


def transient_variance_shares(
    mounts: LinearisedCalibration,
    solved: ReducedSystem,
    samples: tuple[IntArray, IntArray],
    prior_scale: float,
) -> FloatArray:
    """Share (B,) of each joint's everyday variance that comes and goes within the capture.

    What cameras see of a joint tells how lively it is about the axes that they do not see, too.

    Args:
        mounts: A calibration at its solution.
        solved: The mounts' share of it.
        samples: (N,) the sampled ticks that are no T-pose, and (N,) their times.
        prior_scale: By how much the everyday ranges were widened.
    """
    ticks, times_ns = samples
    out = np.full(len(mounts.body.bones), 1.0 - POSTURE_BIAS_SHARE**2)
    if not len(ticks):
        return out
    # All samples of one gesture are one draw.
    repeated = samples_per_gesture(times_ns)
    children = [index for index, bone in enumerate(mounts.body.bones) if bone.parent >= 0]
    for place, index in enumerate(children):
        factors = mounts.first_joint + place + mounts.body.factors_per_tick * ticks
        rows = mounts.linear.first_row[factors][:, None] + np.arange(3)
        off = prior_scale * mounts.linear.rhs[rows]
        varied = float(((off - off.mean(axis=0)) ** 2).sum()) / repeated
        redundancy = float(solved.redundancy[rows].sum()) / repeated
        out[index] = (_PRIOR_REDUNDANCY * out[index] + varied) / (_PRIOR_REDUNDANCY + redundancy)
    return out
