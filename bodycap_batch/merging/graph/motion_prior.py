"""The motion prior of the motion graph: white noise on acceleration, and weak priors of the velocity."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np

from bodycap_batch.merging.body.bones import Bone
from bodycap_batch.merging.graph.factors import MotionState

_VELOCITY_SIGMA = np.array([8.0, 8.0, 8.0, 3.0, 3.0, 3.0])
"""Sigmas (rad/s, m/s) of a weak prior on the velocity in a bone's first and last state. The prior is needed
because each of these two states has only one neighbouring state. Evidence: none."""
_REST_VELOCITY_SIGMA = np.array([1.0, 1.0, 1.0, 0.3, 0.3, 0.3])
"""Sigmas (rad/s, m/s) of a prior on a bone's velocities before the first and after the last measurement of
all cameras. The prior makes the body rest at these times. Without the prior, the body would keep its
velocity. Evidence: none."""


def add_motion_prior(
    graph: Any, bone: Bone, chain: Sequence[MotionState], *, start_ns: int, measured_ns: tuple[int, int]
) -> None:
    """Add the motion prior of one bone to a factor graph.

    Successive states are linked by white noise on acceleration. The velocity of the first and the last state
    has a weak prior with mean zero. Before the first and after the last measurement of all cameras, each
    velocity has a stronger prior with mean zero.

    Args:
        graph: The gtsam graph that receives the factors.
        bone: The bone, with the power spectral density of its acceleration.
        chain: The states of the bone in order of time.
        start_ns: Start of the time axis for GTSAM, nanoseconds. GTSAM gets the seconds since this time.
        measured_ns: Times (nanoseconds) of the first and the last measurement of all cameras.

    Source: T. D. Barfoot, C. H. Tong, S. Särkkä, "Batch continuous-time trajectory estimation as exactly
        sparse Gaussian process regression", RSS 2014.
    """
    weak = gtsam.noiseModel.Diagonal.Sigmas(_VELOCITY_SIGMA)
    at_rest = gtsam.noiseModel.Diagonal.Sigmas(_REST_VELOCITY_SIGMA)
    states = [
        gtsam.StateData(state.pose_key, state.velocity_key, 1e-9 * (state.time_ns - start_ns))
        for state in chain
    ]
    for first, second in pairwise(states):
        graph.add(gtsam.WnoaMotionFactorPose3(first, second, bone.psd))
    for state in chain:
        outside = not measured_ns[0] <= state.time_ns <= measured_ns[1]
        if outside or state.time_ns in (chain[0].time_ns, chain[-1].time_ns):
            noise = at_rest if outside else weak
            graph.add(gtsam.PriorFactorVector(state.velocity_key, np.zeros(6), noise))
