"""The scale from the bones, if body poses, mounts and posture are integrated."""

from __future__ import annotations

from dataclasses import replace

import pytest

from bodycap_batch.merging.body_calibration.marginal_cost import MarginalCost
from bodycap_batch.merging.body_calibration.mount_calibration_graph import CalibrationGraph
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


def test_a_small_body_is_not_favoured() -> None:
    _, graph, metric = calibration_of(_walk(20))
    graph.solve(metric)
    graph.widen_joint_priors()
    cost, sizes = MarginalCost(graph), (0.85, 1.0, 1.15)
    integrated = [cost(size * metric) for size in sizes]
    most_likely = [graph.solve(size * metric) for size in sizes]
    # A body that is too small by 15 % is two sigma off (a cost of 2). Without integration it is hardly one.
    assert integrated[0] - integrated[1] > 2.0
    assert most_likely[0] - most_likely[1] < 1.0
    # A body that is too large does not reach the palms.
    assert min(integrated[2] - integrated[1], most_likely[2] - most_likely[1]) > 2.0
