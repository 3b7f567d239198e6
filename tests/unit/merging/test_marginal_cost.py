"""The scale from the bones, if body poses, mounts and posture are integrated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.merging.body_calibration.marginal_cost import MarginalCost
from bodycap_batch.merging.body_calibration.mount_calibration_graph import CalibrationGraph
from bodycap_batch.merging.body_calibration.scale import estimate_scale
from bodycap_batch.synthetic import SynthOptions
from tests.calibrations import calibration_of


def _walk(seed: int, seconds: float = 12.0) -> SynthOptions:
    return SynthOptions(poses_only=True, seconds=seconds, seed=seed, posture_spread=1.0, outliers=0.0)


def test_the_unit_of_the_map_does_not_matter() -> None:
    samples, graph, metric = calibration_of(_walk(3, seconds=4.0))
    few = slice(None, None, 4)
    samples = replace(
        samples,
        times_ns=samples.times_ns[few],
        map_from_cam=samples.map_from_cam[:, few],
        valid=samples.valid[:, few],
        posture=replace(
            samples.posture,
            walking=samples.posture.walking[few],
            walking_direction=samples.posture.walking_direction[few],
            t_pose=samples.posture.t_pose[few],
            standing=samples.posture.standing[few],
        ),
    )
    rises = []
    for unit in (1.0, 8.0):
        poses = samples.map_from_cam.copy()
        poses[..., :3, 3] *= unit
        scaled = replace(samples, map_from_cam=poses, sigma_map=unit * samples.sigma_map)
        calibration = CalibrationGraph(
            graph._skeleton, graph.bones, scaled, graph.priors, metric / unit, lambda: None
        )
        calibration.solve(metric / unit)
        cost = MarginalCost(calibration)
        rises.append(cost(1.1 * metric / unit) - cost(metric / unit))
    # Both solutions end when the cost changes by less than 0.005.
    assert rises[0] == pytest.approx(rises[1], abs=0.02)


@pytest.mark.slow
def test_the_scale_of_people_with_various_postures_is_unbiased() -> None:
    errors: dict[str, list[float]] = {"integrated": [], "most likely": []}
    for seed in range(20, 26):
        _, graph, metric = calibration_of(_walk(seed))
        graph.solve(metric)
        graph.widen_joint_priors()
        for name, cost in (("integrated", MarginalCost(graph)), ("most likely", graph.solve)):
            found = estimate_scale(cost, graph, metric)
            errors[name].append(float(np.log(found.scale / metric)) / found.sigma_log)
    # The mean of six draws has a sigma of 0.4.
    assert abs(np.mean(errors["integrated"])) < 0.5
    assert np.mean(errors["integrated"]) > np.mean(errors["most likely"]) + 0.3
    assert np.abs(errors["integrated"]).max() < 2.0
