"""The optimiser of the factor graphs: steps, states that nothing determines, and interruption."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from numpy.testing import assert_allclose

from bodycap_batch.merging.graph.optimiser import levenberg_marquardt
from bodycap_batch.model.geometry import make_transform, so3_exp

TURNED = make_transform(so3_exp([0.3, -0.2, 0.4]), [0.1, 0.2, -0.3])


def _start(pose=None):
    values = gtsam.Values()
    values.insert(0, gtsam.Pose3(np.eye(4) if pose is None else pose))
    return values


def _pose_prior():
    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(TURNED), gtsam.noiseModel.Isotropic.Sigma(6, 0.01)))
    return graph


def test_each_iteration_is_reported():
    steps = []
    found, count = levenberg_marquardt(
        _pose_prior(), _start(), iterations=30, step=lambda: steps.append(1), tolerance=1e-5
    )
    # It stops after a step that lowers the error by less than 1e-5 of itself; the residual is zero.
    assert_allclose(found.atPose3(0).matrix(), TURNED, atol=1e-6)
    assert len(steps) == count


def test_unobservable_states_are_left_to_damping():
    graph = gtsam.NonlinearFactorGraph()
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.01)
    graph.add(gtsam.PoseTranslationPrior3D(0, gtsam.Pose3(TURNED), noise))
    found, _ = levenberg_marquardt(graph, _start(), iterations=30, step=lambda: None, tolerance=1e-5)
    assert_allclose(found.atPose3(0).translation(), TURNED[:3, 3], atol=1e-4)
    assert_allclose(found.atPose3(0).rotation().matrix(), np.eye(3), atol=1e-6)


def _ranges(across):
    """Return two ranges of 0.6 m to points 1 m apart, and initial values beside the middle between them."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    values.insert(0, np.array([0.5, across, 0.0]))
    graph.add(gtsam.PriorFactorPoint3(0, np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 1e3)))
    for key, anchor in enumerate(([0.0, 0.0, 0.0], [1.0, 0.0, 0.0]), start=1):
        graph.add(gtsam.PriorFactorPoint3(key, np.array(anchor), gtsam.noiseModel.Isotropic.Sigma(3, 1e-4)))
        graph.add(gtsam.RangeFactor3(0, key, 0.6, gtsam.noiseModel.Isotropic.Sigma(1, 0.01)))
        values.insert(key, np.array(anchor))
    return graph, values


# The square root of 0.6² - 0.5²; the weak prior changes it by a millionth.
ACROSS = np.sqrt(0.11)


def test_a_step_that_raises_the_error_is_not_taken():
    # The ranges hardly change with a step across, so that the full step is 50 m.
    graph, values = _ranges(1e-3)
    full = gtsam.GaussNewtonOptimizer(graph, values, gtsam.GaussNewtonParams())
    before = full.error()
    full.iterate()
    assert full.error() > before, "the full step should raise the error here"
    found, _ = levenberg_marquardt(graph, values, iterations=50, step=lambda: None, tolerance=1e-9)
    assert_allclose(np.hypot(*found.atPoint3(0)[1:]), ACROSS, atol=1e-4)


def test_an_exception_of_the_callback_is_passed_on():
    class Stop(Exception):
        pass

    def stop():
        raise Stop

    with pytest.raises(Stop):
        levenberg_marquardt(_pose_prior(), _start(), iterations=30, step=stop, tolerance=1e-5)
