"""The optimisers of the factor graphs: Levenberg-Marquardt, and Gauss-Newton near a solution."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gtsam

_MIN_DAMPING = 1e-5
"""Minimum damping (lambda) of Levenberg-Marquardt. The optimiser increases the damping tenfold until the
error falls. Each attempt solves the linear equations again. Near the solution, no value of the
damping lowers the error. A smaller minimum of the damping would then only add failed attempts."""


def levenberg_marquardt(
    graph: Any,
    values: Any,
    *,
    iterations: int,
    last: Sequence[int] = (),
    step: Callable[[], None] | None = None,
    tolerance: float = 1e-5,
) -> tuple[Any, int]:
    """Minimise the error of a graph by Levenberg-Marquardt.

    Args:
        graph: The factors.
        values: The initial values.
        iterations: Maximum number of iterations.
        last: Keys of variables that are eliminated last, such as a calibration shared by all ticks.
        step: Called after each iteration. It may raise an exception to stop the work.
        tolerance: Minimum relative decrease of the error per iteration. The optimiser stops after a smaller
            decrease.

    Returns:
        The solution and the number of iterations done.
    """
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(iterations)
    params.setlambdaLowerBound(_MIN_DAMPING)
    if last:
        params.setOrdering(gtsam.Ordering.ColamdConstrainedLastNonlinearFactorGraph(graph, list(last)))
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, params)
    error = optimizer.error()
    for count in range(1, iterations + 1):
        optimizer.iterate()
        if step is not None:
            step()
        decrease, error = error - optimizer.error(), optimizer.error()
        if decrease <= tolerance * max(error, 1e-9):
            return optimizer.values(), count
    return optimizer.values(), iterations


def gauss_newton_then_lm(
    graph: Any, values: Any, *, iterations: int, step: Callable[[], None], tolerance: float
) -> tuple[Any, int]:
    """Minimise the error by Gauss-Newton while each step lowers it, then by Levenberg-Marquardt.

    A Gauss-Newton step takes two thirds of the time of a damped step, because damping adds a factor for each
    state.

    Args:
        graph: The factors.
        values: The initial values, near the solution.
        iterations: Maximum number of iterations.
        step: Called after each iteration. It may raise an exception to stop the work.
        tolerance: Minimum relative decrease of the error per iteration. The optimiser stops after a smaller
            decrease.

    Returns:
        The solution and the number of iterations done.
    """
    optimizer = gtsam.GaussNewtonOptimizer(graph, values, gtsam.GaussNewtonParams())
    error = optimizer.error()
    for count in range(1, iterations + 1):
        try:
            optimizer.iterate()
        except RuntimeError:
            # Without damping, the equations of some state are singular.
            break
        step()
        decrease = error - optimizer.error()
        if decrease >= 0.0:
            # Copy the values: `optimizer.values()` refers to memory that the next step overwrites.
            values = gtsam.Values(optimizer.values())
        if abs(decrease) <= tolerance * max(error, 1e-9):
            # Stop also after a small increase: with robust weights, full steps may converge to an error
            # slightly above the minimum.
            return values, count
        if not decrease >= 0.0:
            break
        error -= decrease
    found, more = levenberg_marquardt(
        graph, values, iterations=max(iterations - count, 1), step=step, tolerance=tolerance
    )
    return found, count + more
