"""The optimiser of the factor graphs: Levenberg-Marquardt."""

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
    step: Callable[[], None],
    last: Sequence[int] = (),
    tolerance: float = 1e-5,
) -> tuple[Any, int]:
    """Minimise the error of a graph by Levenberg-Marquardt.

    Args:
        graph: The factors.
        values: The initial values.
        iterations: Maximum number of iterations.
        step: Called after each iteration. It may raise an exception to stop the work.
        last: Keys of variables that are eliminated last, such as a calibration shared by all ticks.
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
        step()
        decrease, error = error - optimizer.error(), optimizer.error()
        if decrease <= tolerance * max(error, 1e-9):
            return optimizer.values(), count
    return optimizer.values(), iterations
