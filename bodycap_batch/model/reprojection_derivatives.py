"""Derivatives of reprojected points, and errors that neighbouring points in a picture have in common."""

from __future__ import annotations

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.camera import Camera

_RAY_STEP = 1e-4
"""Step of the central differences, in units of the ray (x/z, y/z). For a function of unit scale, a step of
6e-6 has the smallest error: the cube root of the float64 precision. The step used here is 16 times larger.
Evidence: none."""
_BATCH_ROWS = 1 << 14
"""Maximum number of rays that are projected in one call. The projection temporarily needs several times the
memory of its result."""
_CELL_RAY = 0.2
"""Side of a cell in which neighbouring points have an error in common, in units of the ray: 11 degrees in the
middle of the picture. The result changes little with a half and twice the side. Evidence:
docs/decisions/registration.md."""
_CELLS_ACROSS = 1 << 10
"""Number of cells along one side of the picture; rays beyond the outer cells are counted there."""
_MIN_REDUNDANCY = 1.0
"""Minimum number of independent comparisons between cells for an estimate of the common error. With fewer,
the support lies in one or two cells, which cannot contradict each other. Origin: one comparison."""
UPPER_TRIANGLE = tuple((i, j) for i in range(6) for j in range(i, 6))
"""Index pairs of the upper triangle of a 6×6 matrix."""


def projection_jacobian(camera: Camera, rays: FloatArray) -> FloatArray:
    """Return the derivative (N,2,2) of the pixel with respect to the ray (x/z, y/z).

    It is computed from central differences.
    """
    out = np.empty((len(rays), 2, 2))
    for start in range(0, len(rays), _BATCH_ROWS):
        batch = rays[start : start + _BATCH_ROWS]
        one = np.ones((len(batch), 1))
        for axis, step in enumerate(np.eye(2) * _RAY_STEP):
            ahead, behind = (camera.project(np.hstack([batch + sign * step, one])) for sign in (1.0, -1.0))
            out[start : start + _BATCH_ROWS, :, axis] = (ahead - behind) / (2.0 * _RAY_STEP)
    return out


def pose_derivatives(
    a: FloatArray, b: FloatArray, inverse_depth: FloatArray, px_from_ray: FloatArray
) -> FloatArray:
    """Return the derivatives (2,6,N) of pixels with respect to a left perturbation of cam_from_gauge.

    Args:
        a: (N,) rays x/z.
        b: (N,) rays y/z.
        inverse_depth: (N,) 1/z.
        px_from_ray: (2,2,N) derivative of the pixel with respect to the ray.
    """
    jacobian = np.empty((2, 6, len(a)))
    for derivative, (by_a, by_b) in zip(jacobian, px_from_ray, strict=True):
        chain = by_a * a + by_b * b
        derivative[0] = -(b * chain + by_b)
        derivative[1] = a * chain + by_a
        derivative[2] = by_b * a - by_a * b
        derivative[3] = by_a * inverse_depth
        derivative[4] = by_b * inverse_depth
        derivative[5] = -chain * inverse_depth
    return jacobian


def weighted_hessians(jacobian: FloatArray, weight: FloatArray, starts: IntArray) -> FloatArray:
    """Return the sums (G,6,6) of the weighted products of derivatives, for groups of successive columns.

    Args:
        jacobian: (2,6,N) derivatives, ordered by group.
        weight: (N,) weights.
        starts: (G,) first column of each group.
    """
    out = np.empty((len(starts), 6, 6))
    weighted = jacobian * weight
    for i, j in UPPER_TRIANGLE:
        entry = np.add.reduceat(weighted[0, i] * jacobian[0, j] + weighted[1, i] * jacobian[1, j], starts)
        out[:, i, j] = out[:, j, i] = entry
    return out


def picture_cells(rays: FloatArray) -> IntArray:
    """Return the number (N,) of the cell of the picture in which each ray (N,2) lies."""
    half = _CELLS_ACROSS // 2
    cell = np.floor(np.clip(np.nan_to_num(rays) / _CELL_RAY, -half, half - 1)).astype(np.int64) + half
    return np.asarray(cell[:, 0] * _CELLS_ACROSS + cell[:, 1])


def common_error_ratio(
    residual: FloatArray,
    jacobian: FloatArray,
    weight: FloatArray,
    group: IntArray,
    frame: IntArray,
    covariance: FloatArray,
) -> FloatArray:
    """Return by how much the variance of each pose grows because neighbouring points have common errors.

    If the errors of all points were independent, the sum of the scores of the points in one cell of the
    picture would have the variance that follows from their number. If neighbouring points have a common
    error, the variance of these sums is larger. The ratio of both is the variance ratio of the pose. The
    influence of each cell on the pose is taken into account: it makes the residuals of this cell smaller.

    Args:
        residual: (2,N) residuals.
        jacobian: (2,6,N) derivatives of the residuals with respect to the pose of their frame.
        weight: (N,) weights; 0 for an observation that is not used.
        group: (N,) number of the cell of each observation; a cell belongs to one frame.
        frame: (N,) number of the frame of each observation.
        covariance: (F,6,6) covariances of the poses for independent residuals with the variance 1; NaN for a
            frame without a ratio.

    Returns:
        (F,) variance ratio times the variance of the residuals, in the unit of the residuals squared. NaN for
        a frame whose cells cannot be compared.

    Source: Liang, Zeger, "Longitudinal data analysis using generalized linear models", 1986, for the sums
        over clusters; Bell, McCaffrey, "Bias reduction in standard errors for linear regression with
        multi-stage samples", 2002, for their expected values.
    """
    out = np.full(len(covariance), np.nan)
    has_covariance: BoolArray = np.asarray(np.isfinite(covariance).all(axis=(1, 2)))
    used: BoolArray = (weight > 0.0) & has_covariance[frame]
    if not used.any():
        return out
    order = np.flatnonzero(used)
    order = order[np.lexsort((group[order], frame[order]))]
    keys, number = frame[order], group[order]
    starts = np.flatnonzero(np.r_[True, (np.diff(keys) != 0) | (np.diff(number) != 0)])
    derivatives, weights = jacobian[:, :, order], weight[order]
    score = (derivatives * residual[:, None, order]).sum(axis=0) * weights
    score = np.add.reduceat(score, starts, axis=1).T
    own = covariance[keys[starts]]
    leverage = weighted_hessians(derivatives, weights, starts) @ own
    seen = np.einsum("gi,gij,gj->g", score, own, score)
    expected = np.einsum("gii->g", leverage) - np.einsum("gij,gji->g", leverage, leverage)
    seen, expected = (np.bincount(keys[starts], each, len(covariance)) for each in (seen, expected))
    known = expected >= _MIN_REDUNDANCY
    out[known] = seen[known] / expected[known]
    return out
