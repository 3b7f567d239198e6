"""Covariance of the solved joints, compared with dense algebra, GTSAM's marginals and changed solutions."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from numpy.testing import assert_allclose

from bodycap_batch.merging.body.bones import kinematic_chain
from bodycap_batch.merging.cameras.track import make_track
from bodycap_batch.merging.graph.error_modes import ErrorModes, no_modes, stack_modes
from bodycap_batch.merging.graph.factors import bone_key
from bodycap_batch.merging.graph.joint_covariance import (
    joint_covariance,
    on_skeleton,
    sigma_percentiles,
)
from bodycap_batch.merging.graph.motion_graph import MotionGraph, MotionSolution
from bodycap_batch.merging.graph.optimiser import levenberg_marquardt
from bodycap_batch.model.geometry import make_transform, se3_adjoint, so3_exp
from bodycap_batch.model.merge_report import Percentiles
from tests.stages.walker import FPS, ROLES, make_inputs, make_walk, record


def test_a_graph_without_factors_has_no_covariance(walk):
    graph, bones, _ = _graph(walk)
    graph.solve(1, lambda: None)
    graph.graph = gtsam.NonlinearFactorGraph()
    poses = np.tile(np.eye(4), (round(FPS), len(bones), 1, 1))
    uncertainty = joint_covariance(graph, poses, no_modes(bones, (), 0))
    assert uncertainty.centre_m2.shape == (*poses.shape[:2], 3, 3)
    assert np.isnan(uncertainty.centre_m2).all()
    assert uncertainty.flexion_rad2.shape == poses.shape[:2]
    assert np.isnan(uncertainty.flexion_rad2).all()


def test_the_adjoint_equals_that_of_gtsam():
    pose = gtsam.Pose3.Expmap(np.array([0.3, -1.1, 0.7, 0.2, 2.0, -0.4]))
    assert_allclose(se3_adjoint(pose.matrix()), pose.AdjointMap(), atol=1e-12)


@pytest.fixture(scope="module")
def walk():
    return make_walk(np.random.default_rng(3), off_deg=8.0, off_m=0.03)


def _graph(walk, mounts=None, change=None, scale=1.0, shift_s=0.0):
    """Return the graph of one second of walking; `change` alters the bones, `scale` the camera paths."""
    bones = list(kinematic_chain(walk.skeleton, set(ROLES.values())))
    if change is not None:
        bones = [change(index, bone) for index, bone in enumerate(bones)]
    index = {bone.role: place for place, bone in enumerate(bones)}
    recorded = [
        record(walk, name, np.random.default_rng(7), seconds=1.0, shift_s=shift_s if name == "torso" else 0.0)
        for name in ROLES
    ]
    inputs = make_inputs(walk, recorded)
    tracks = [make_track(inputs, each, index[ROLES[each.camera]]) for each in recorded]
    middle = np.concatenate([track.map_from_cam[:, :3, 3] for track in tracks]).mean(axis=0)
    stretched = []
    for track in tracks:
        poses = track.map_from_cam.copy()
        poses[:, :3, 3] = middle + scale * (poses[:, :3, 3] - middle)
        stretched.append(replace(track, map_from_cam=poses))
    ticks = np.round(np.arange(round(FPS)) * 1e9 / FPS).astype(np.int64)
    held = {name: mount.joint_from_cam for name, mount in walk.mounts.items()} | (mounts or {})
    return MotionGraph(walk.skeleton, bones, ticks, stretched, held), bones, held


def _solve(graph, modes=None) -> MotionSolution:
    solution = graph.solve(60, lambda: None)
    if modes is None:
        return solution
    return replace(solution, uncertainty=joint_covariance(graph, solution.world_from_bone, modes))


def _no_modes(bones) -> ErrorModes:
    return no_modes(bones, ROLES, 1)


def _centres(solution: MotionSolution) -> np.ndarray:
    assert solution.uncertainty is not None
    return np.asarray(solution.uncertainty.centre_m2)


def _flexion_rad(solution: MotionSolution, bones, side: str) -> np.ndarray:
    """Return the flexion (T,) of an elbow: the angle between the upper arm and the forearm."""
    upper, lower, hand = (
        next(place for place, bone in enumerate(bones) if bone.role == side + part)
        for part in ("Arm", "ForeArm", "Hand")
    )
    centres = solution.world_from_bone[..., :3, 3]
    arm, forearm = centres[:, lower] - centres[:, upper], centres[:, hand] - centres[:, lower]
    cosine = (arm * forearm).sum(-1) / np.linalg.norm(arm, axis=-1) / np.linalg.norm(forearm, axis=-1)
    return np.arccos(np.clip(cosine, -1.0, 1.0))


def _relative(solution: MotionSolution) -> np.ndarray:
    centres = solution.world_from_bone[..., :3, 3]
    return np.asarray(centres - centres[:, :1])


def test_without_error_modes_the_covariance_is_the_marginal_of_gtsam(walk):
    graph, bones, _ = _graph(walk)
    solution = _solve(graph, _no_modes(bones))
    values, _ = _optimised(graph)
    marginals = gtsam.Marginals(graph.graph, values)
    hand = next(place for place, bone in enumerate(bones) if bone.role == "RightHand")
    for tick in (0, 14, 29):
        keys = gtsam.KeyVector([bone_key(tick, 0), bone_key(tick, hand)])
        joint = marginals.jointMarginalCovariance(keys).fullMatrix()
        turns = solution.world_from_bone[tick, [0, hand], :3, :3]
        reader = np.hstack([np.zeros((3, 3)), -turns[0], np.zeros((3, 3)), turns[1]])
        expected = reader @ joint @ reader.T
        # The two are linearised at solutions that differ by the tolerance of the solver.
        assert_allclose(_centres(solution)[tick, hand], expected, rtol=1e-3, atol=1e-9)


def _optimised(graph):

    return levenberg_marquardt(graph.graph, graph.initial_values(), iterations=60, step=lambda: None)


@pytest.mark.parametrize("what", ["mount", "scale", "rest", "offset", "off the ticks"])
def test_the_solution_follows_the_calibration_as_predicted(walk, what):
    shift_s = 0.012 if what == "off the ticks" else 0.0
    graph, bones, held = _graph(walk, shift_s=shift_s)
    modes = _no_modes(bones)
    arm = next(place for place, bone in enumerate(bones) if bone.role == "LeftForeArm")
    changes = {}
    if what in ("mount", "off the ticks"):
        twist = np.array([0.004, -0.006, 0.002, 0.003, 0.001, -0.002])
        modes.mounts["left_palm"][:, 0] = twist
        moved = gtsam.Pose3(held["left_palm"]).compose(gtsam.Pose3.Expmap(twist)).matrix()
        changes["mounts"] = {"left_palm": moved}
    elif what == "scale":
        modes.log_scale[0] = 0.004
        changes["scale"] = float(np.exp(0.004))
    elif what == "rest":
        turn = np.array([0.02, -0.01, 0.015])
        modes.rest[arm, :, 0] = turn
        changes["change"] = lambda place, bone: (
            replace(bone, mean_rotation=bone.mean_rotation @ so3_exp(turn)) if place == arm else bone
        )
    else:
        longer = 0.02 * bones[arm].offset_m
        modes.offsets_m[arm, :, 0] = longer
        changes["change"] = lambda place, bone: (
            replace(bone, offset_m=bone.offset_m + longer) if place == arm else bone
        )
    plain = _solve(graph, _no_modes(bones))
    with_modes = _solve(graph, modes)
    again = _solve(_graph(walk, shift_s=shift_s, **changes)[0])
    actual = _relative(again) - _relative(plain)
    predicted = np.sqrt(np.einsum("tbii->tb", _centres(with_modes) - _centres(plain)).clip(min=0.0))
    size = np.linalg.norm(actual, axis=-1)
    assert size[:, 1:].max() > 5e-4
    # Geman-McClure's curvature is a tenth below that of its weights (residuals of 2.4 sigmas, c = 6).
    assert np.sqrt(((predicted - size) ** 2).mean()) < 0.15 * np.sqrt((size**2).mean())
    for side in ("Left", "Right"):
        bent = np.abs(_flexion_rad(again, bones, side) - _flexion_rad(plain, bones, side))
        place = next(place for place, bone in enumerate(bones) if bone.role == side + "ForeArm")
        variances = [each.uncertainty.flexion_rad2[:, place] for each in (with_modes, plain)]
        stated = np.sqrt((variances[0] - variances[1]).clip(min=0.0))
        assert np.sqrt(((stated - bent) ** 2).mean()) < 0.25 * np.sqrt((bent**2).mean()) + 1e-3


def test_stacked_modes_contain_those_of_all_parts(walk):
    bones = kinematic_chain(walk.skeleton, set(ROLES.values()))
    both = stack_modes([_no_modes(bones), _no_modes(bones)])
    assert both.log_scale.shape == (2,)
    assert both.rest.shape == (len(bones), 3, 2)
    assert both.mounts["torso"].shape == (6, 2)


def test_sigmas_of_observed_and_filled_ticks_are_separate():
    sigma = np.full((10, 3), 0.01)
    sigma[5:, 1] *= 2.0
    sigma[:, 2] = np.nan
    observed = np.ones((10, 3), dtype=bool)
    observed[5:, 1] = False
    sigma[:, 0] = 0.0
    found = sigma_percentiles(("Spine1", "LeftHand", "LeftFoot"), sigma, observed, digits=5)
    assert found == {
        "LeftHand": {"observed": Percentiles(p50=0.01, p95=0.01), "filled": Percentiles(p50=0.02, p95=0.02)}
    }


def test_the_sigma_of_a_hinge_is_that_of_the_bone_below_it(walk):
    graph, bones, _ = _graph(walk)
    solution = _solve(graph, _no_modes(bones))
    roles = [bone.role for bone in bones]
    assert solution.uncertainty is not None
    sigma = on_skeleton(bones, np.sqrt(solution.uncertainty.flexion_rad2), len(walk.skeleton.joints))
    known = {walk.skeleton.roles[joint] for joint in np.flatnonzero(np.isfinite(sigma).all(axis=0))}
    assert known == {"LeftForeArm", "RightForeArm"} & set(roles)
    observed = np.ones(sigma.shape, dtype=bool)
    found = sigma_percentiles(walk.skeleton.roles, np.degrees(sigma), observed, digits=2)
    joint = walk.skeleton.roles.index("LeftForeArm")
    assert found["LeftForeArm"]["observed"].p50 == pytest.approx(
        np.degrees(np.median(sigma[:, joint])), abs=0.01
    )


def test_a_mounts_error_moves_the_joint_by_its_lever(walk):
    # A mount that rotates about the camera's own axis moves the wrist by the lever, and not the camera.
    graph, bones, held = _graph(walk)
    modes = _no_modes(bones)
    modes.mounts["right_palm"][2, 0] = 0.05
    hand = next(place for place, bone in enumerate(bones) if bone.role == "RightHand")
    plain, with_modes = _solve(graph, _no_modes(bones)), _solve(graph, modes)
    added = np.sqrt(np.einsum("tii->t", _centres(with_modes)[:, hand] - _centres(plain)[:, hand]))
    wrist_in_cam = np.linalg.inv(held["right_palm"] @ make_transform(np.eye(3), np.zeros(3)))[:3, 3]
    lever = np.linalg.norm(np.cross([0.0, 0.0, 1.0], wrist_in_cam))
    # Joints and the pose prior take a part of it: between a quarter of the lever and all of it.
    assert 0.25 * 0.05 * lever < np.median(added) <= 1.05 * 0.05 * lever
