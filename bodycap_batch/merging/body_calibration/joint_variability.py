"""Estimate the part of a joint's everyday variance that occurs within one capture.

Source: variance components by redundancy, W. Foerstner, "Ein Verfahren zur Schaetzung von Varianz- und
Kovarianzkomponenten", AVN 1979. Each joint has one component for all of its axes.
"""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.merging.body_calibration.mount_covariance import LinearisedCalibration, ReducedSystem
from bodycap_batch.merging.graph.error_modes import POSTURE_BIAS_SHARE
from bodycap_batch.merging.graph.joint_priors import samples_per_gesture

_PRIOR_REDUNDANCY = 6.0
"""Weight of the prior variance, as a number of redundant rotations of different gestures.

It corresponds to two gestures about three axes. Evidence: docs/decisions/body_calibration.md.
"""


def transient_variance_shares(
    linearised: LinearisedCalibration,
    reduced: ReducedSystem,
    ticks: IntArray,
    times_ns: IntArray,
    prior_scale: float,
) -> FloatArray:
    """Return the part (B,) of each joint's everyday variance that varies within the capture.

    The variance estimated for the observable axes of a joint is used for its unobservable axes as well.

    Args:
        linearised: A calibration at its solution.
        reduced: Its reduced system.
        ticks: (N,) sampled ticks that are no T-pose.
        times_ns: (N,) their times.
        prior_scale: Factor by which the sigmas of the joint rotation priors were widened.
    """
    out = np.full(len(linearised.body.bones), 1.0 - POSTURE_BIAS_SHARE**2)
    if not len(ticks):
        return out
    # All samples of one gesture count as one draw.
    repeated = samples_per_gesture(times_ns)
    children = [index for index, bone in enumerate(linearised.body.bones) if bone.parent >= 0]
    for number, index in enumerate(children):
        factors = linearised.first_joint_factor + number + linearised.body.factors_per_tick * ticks
        rows = linearised.linear.first_row[factors][:, None] + np.arange(3)
        off = prior_scale * linearised.linear.rhs[rows]
        varied = float(((off - off.mean(axis=0)) ** 2).sum()) / repeated
        redundancy = float(reduced.redundancy[rows].sum()) / repeated
        out[index] = (_PRIOR_REDUNDANCY * out[index] + varied) / (_PRIOR_REDUNDANCY + redundancy)
    return out
