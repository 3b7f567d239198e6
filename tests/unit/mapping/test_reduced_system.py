"""The normal equations of keyframes and points, with the points eliminated."""

from __future__ import annotations

import numpy as np
import pytest

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.mapping.reconstruction.reduced_system import CommonPoints, NormalEquations

UNKNOWNS, KEYFRAMES, POINTS, COMMON = 4, 6, 20, 2


def equations() -> tuple[NormalEquations, FloatArray]:
    """Equations of random residuals, and the same as one matrix. A keyframe may see a point twice."""
    rng = np.random.default_rng(5)
    keyframe = np.repeat(np.arange(KEYFRAMES), 30)
    point = rng.integers(0, POINTS, len(keyframe))
    common = np.arange(KEYFRAMES) % COMMON
    by_keyframe = rng.standard_normal((len(keyframe), 2, UNKNOWNS + 1))
    by_point = rng.standard_normal((len(keyframe), 2, 3))
    by_common = np.array([0.5, 2.0])
    size = UNKNOWNS * KEYFRAMES + COMMON + 3 * POINTS
    jacobian = np.zeros((2 * len(keyframe), size))
    for row, (k, p) in enumerate(zip(keyframe, point, strict=True)):
        rows = slice(2 * row, 2 * row + 2)
        jacobian[rows, UNKNOWNS * k : UNKNOWNS * (k + 1)] = by_keyframe[row, :, :UNKNOWNS]
        jacobian[rows, UNKNOWNS * KEYFRAMES + common[k]] = by_keyframe[row, :, UNKNOWNS]
        first = UNKNOWNS * KEYFRAMES + COMMON + 3 * p
        jacobian[rows, first : first + 3] = by_point[row]
    matrix = jacobian.T @ jacobian
    matrix[range(size), range(size)] += np.r_[np.zeros(UNKNOWNS * KEYFRAMES), by_common, np.zeros(3 * POINTS)]
    own = np.zeros((KEYFRAMES, UNKNOWNS + 1, UNKNOWNS + 1))
    np.add.at(own, keyframe, np.swapaxes(by_keyframe, 1, 2) @ by_keyframe)
    blocks = np.zeros((POINTS, 3, 3))
    np.add.at(blocks, point, np.swapaxes(by_point, 1, 2) @ by_point)
    gradient = rng.standard_normal(size)
    system = NormalEquations(
        keyframe=keyframe,
        point=point,
        common_points=CommonPoints.of(keyframe, point),
        common=common,
        own=own,
        gradient=gradient[: -3 * POINTS],
        by_common=by_common,
        by_point=blocks,
        point_gradient=gradient[-3 * POINTS :].reshape(-1, 3),
        mixed=np.swapaxes(by_point, 1, 2) @ by_keyframe,
    )
    return system, matrix


def test_the_solution_is_that_of_the_whole_system() -> None:
    system, matrix = equations()
    factored = system.factored(0.0)
    assert factored is not None
    own, points = factored.solve(system.gradient, system.point_gradient)
    expected = np.linalg.solve(matrix, np.r_[system.gradient, system.point_gradient.ravel()])
    assert np.r_[own, points.ravel()] == pytest.approx(expected, rel=1e-5, abs=1e-6)


def test_damping_shortens_the_solution() -> None:
    system, _ = equations()
    sizes = []
    for damping in (0.0, 1.0, 10.0):
        factored = system.factored(damping)
        assert factored is not None
        sizes.append(np.linalg.norm(factored.solve(system.gradient, system.point_gradient)[0]))
    assert sizes[0] > sizes[1] > sizes[2]


def test_a_singular_system_has_no_factor() -> None:
    system, _ = equations()
    system.own[0] = 0.0
    assert system.factored(0.0) is None
