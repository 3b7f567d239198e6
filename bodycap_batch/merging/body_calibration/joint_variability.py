"""Estimate how much each joint rotation varies within one capture, as a fraction of the prior variance.

The prior variance is the variance of the joint's rotation prior. It describes everyday motion.

Source: estimation of variance components from redundancies, W. Foerstner, "Ein Verfahren zur Schaetzung von
Varianz- und Kovarianzkomponenten", AVN 1979. Each joint has one variance component for all of its axes.
"""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.merging.body_calibration.mount_covariance import LinearisedCalibration, ReducedSystem
from bodycap_batch.merging.graph.error_modes import POSTURE_BIAS_SHARE
from bodycap_batch.merging.graph.joint_priors import samples_per_gesture

_PRIOR_REDUNDANCY = 6.0
"""Weight of the expected fraction against the fraction that is measured in the capture.

The expected fraction has the weight of this number of measured rotation angles from independent gestures: two
gestures with three angles each. Evidence: docs/decisions/body_calibration.md.
"""


def transient_variance_shares(
    linearised: LinearisedCalibration,
    reduced: ReducedSystem,
    ticks: IntArray,
    times_ns: IntArray,
    prior_scale: float,
) -> FloatArray:
    """Return the variance of each joint's rotation within the capture, as a fraction of its prior variance.

    The fraction is estimated from the rotation axes that the cameras observe. It is used for all three axes.

    Args:
        linearised: The calibration graph, linearised at its solution.
        reduced: The reduced system of `linearised`.
        ticks: (N,) indices of the sampled ticks outside a T-pose.
        times_ns: (N,) common times of these ticks.
        prior_scale: Factor on the sigmas of the joint rotation priors in the calibration graph.

    Returns:
        (B,) the fraction for each bone's joint.
    """
    out = np.full(len(linearised.body.bones), 1.0 - POSTURE_BIAS_SHARE**2)
    if not len(ticks):
        return out
    # All samples of one gesture together count as one independent sample.
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
