"""Block-tridiagonal systems, compared with dense algebra."""

from __future__ import annotations

import tracemalloc
from itertools import pairwise

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import sparse

from bodycap_batch.model.block_tridiagonal import BlockTridiagonal


@pytest.mark.parametrize("factor_bytes", [1.0, 600.0, 1e6])  # bytes of one block, of two, of all
def test_sparse_blocks_of_different_size_equal_the_dense_solution(factor_bytes):
    rng = np.random.default_rng(0)
    bounds = np.array([0, 3, 7, 8, 12])
    rows = np.zeros((0, 12))
    for block in range(4):
        after = bounds[min(block + 2, 4)]
        row = np.zeros((9, 12))
        row[:, bounds[block] : after] = rng.normal(size=(9, after - bounds[block]))
        rows = np.vstack([rows, row])
    order = rng.permutation(12)
    shuffled = np.zeros_like(rows)
    shuffled[:, order] = rows
    matrix = shuffled.T @ shuffled
    system = BlockTridiagonal.from_sparse(sparse.csr_matrix(matrix), order, bounds, factor_bytes)
    rhs = rng.normal(size=(12, 2))
    assert_allclose(np.vstack(system.solve(rhs)), np.linalg.solve(matrix, rhs)[order], atol=1e-9)
    inverse = np.linalg.inv(matrix)[np.ix_(order, order)]
    found = {}
    system.marginals(found.setdefault)
    for block, (start, end) in enumerate(pairwise(bounds.tolist())):
        assert_allclose(found[block], inverse[start:end, start:end], atol=1e-9)


def _dense(diagonal, coupling):
    count, size = diagonal.shape[:2]
    out = np.zeros((count * size, count * size))
    for block in range(count):
        own = slice(block * size, (block + 1) * size)
        out[own, own] = diagonal[block]
        if block + 1 < count:
            following = slice((block + 1) * size, (block + 2) * size)
            out[own, following], out[following, own] = coupling[block], coupling[block].T
    return out


@pytest.mark.parametrize("count", [1, 2, 5])
def test_dense_blocks_equal_the_dense_solution(count):
    rng = np.random.default_rng(count)
    size = 4
    jacobian = rng.normal(size=(count, 3 * size, 2 * size))
    normal = jacobian.swapaxes(1, 2) @ jacobian
    diagonal = normal[:, :size, :size].copy()
    diagonal[1:] += normal[:-1, size:, size:]
    coupling = normal[:-1, :size, size:]
    system = BlockTridiagonal.from_blocks(diagonal, coupling)
    dense = _dense(diagonal, coupling)
    rhs = rng.normal(size=(count * size, 1))
    assert_allclose(np.concatenate(system.solve(rhs)), np.linalg.solve(dense, rhs), atol=1e-9)
    inverse = np.linalg.inv(dense)
    found = np.zeros_like(diagonal)
    system.marginals(found.__setitem__)
    for block in range(count):
        own = slice(block * size, (block + 1) * size)
        assert_allclose(found[block], inverse[own, own], atol=1e-9)


def test_a_matrix_that_is_not_positive_definite_is_refused():
    diagonal, coupling = np.tile(np.eye(2), (2, 1, 1)), 2.0 * np.eye(2)[None]
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        BlockTridiagonal.from_blocks(diagonal, coupling)


def test_few_factors_in_memory_give_the_same_solution():
    size, count = 12, 300
    rng = np.random.default_rng(0)
    eye, side = 4.0 * np.eye(size), 0.1 * rng.normal(size=(size, size))
    rows = [[None] * count for _ in range(count)]
    for block in range(count):
        rows[block][block] = eye
        if block:
            rows[block - 1][block], rows[block][block - 1] = side, side.T
    matrix = sparse.bmat(rows, format="csr")
    order, bounds = np.arange(size * count), size * np.arange(count + 1)
    rhs = rng.normal(size=(size * count, 2))
    found, memory = [], []
    for factor_bytes in (1e9, 20_000.0):
        tracemalloc.start()
        system = BlockTridiagonal.from_sparse(matrix, order, bounds, factor_bytes)
        memory.append(tracemalloc.get_traced_memory()[0])
        tracemalloc.stop()
        marginals = {}
        system.marginals(lambda block, each, known=marginals: known.setdefault(block, each[0, 0]))
        found.append((np.vstack(system.solve(rhs)), marginals))
    assert np.array_equal(found[0][0], found[1][0])
    assert found[0][1] == found[1][1]
    assert memory[0] - memory[1] > 0.9 * (2 * 8 * size**2 * count - 20_000)
