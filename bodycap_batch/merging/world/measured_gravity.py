"""The vertical that the accelerometers of the cameras measure along the solved paths."""

from __future__ import annotations

from collections.abc import Mapping

from bodycap_batch.merging.world.vertical import ACCELEROMETERS, VerticalHypothesis
from bodycap_batch.model.geometry import Similarity
from bodycap_batch.model.gravity import GRAVITY_M_S2, fit_gravity
from bodycap_batch.model.merge_data import MergeInputs

_MAX_SIGMA_DEG = 5.0
"""Maximum sigma (degrees) of a vertical from the accelerometers. Planes and the walk are better than one with
a larger sigma. Evidence: none."""
_MAX_GRAVITY_ERROR_M_S2 = 0.4
"""Maximum deviation (m/s²) of the measured gravity from that of Earth: 4 sigma of `model.gravity`. With a
larger one, units, axes or poses are wrong."""


def verticals_from_accelerometers(
    inputs: MergeInputs, target_from_gauge: Mapping[str, Similarity]
) -> tuple[VerticalHypothesis, ...]:
    """Return the vertical that the accelerometers measure.

    Args:
        inputs: The inputs of the stage. Only the trajectories' gauges and the windows of force are used.
        target_from_gauge: By gauge, the similarity to the gauge in which the vertical is wanted. Cameras in
            other gauges are not used.

    Returns:
        The vertical; empty if no camera has a usable accelerometer, or if they do not determine the vertical.
    """
    windows = [
        inputs.force_windows[each.camera].in_gauge(target_from_gauge[each.gauge])
        for each in inputs.trajectories
        if each.camera in inputs.force_windows and each.gauge in target_from_gauge
    ]
    found = fit_gravity(windows)
    if found is None or found.sigma_deg > _MAX_SIGMA_DEG:
        return ()
    if abs(found.gravity_m_s2 - GRAVITY_M_S2) > _MAX_GRAVITY_ERROR_M_S2:
        return ()
    return (VerticalHypothesis(source=ACCELEROMETERS, up=found.up, sigma_deg=found.sigma_deg),)
