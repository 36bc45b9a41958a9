import numpy as np
import pytest

from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import MANY, load, store
from netkf.linalg.local import (
    local_lanes_matrix,
    local_lanes_vector,
    local_matrix,
    local_vector,
)
from netkf.linalg.structs import sized


@kernel
def square_times(size, matrix, vector, scratch, line, out):
    """out = (matrix matrix) vector, by way of a matrix and a vector that are local."""
    n, square, product = len(size), local_matrix(size, scratch), local_vector(size, line)
    for i in range(n):
        for j in range(n):
            square[i, j] = 0.0
            for k in range(n):
                square[i, j] += matrix[i, k] * matrix[k, j]
    for i in range(n):
        product[i] = 0.0
        for j in range(n):
            product[i] += square[i, j] * vector[j]
    for i in range(n):
        out[i] = product[i]


@pytest.mark.one_in(2)
@pytest.mark.parametrize("n", [1, 2, 4, 5])
def test_local_arrays_hold_what_is_written(n):
    random = np.random.default_rng(n)
    matrix, vector = random.standard_normal((n, n)), random.standard_normal(n)
    scratch, line, out = np.full((n, n), np.nan), np.full(n, np.nan), np.empty(n)
    square_times(sized(n), matrix, vector, scratch, line, out)
    np.testing.assert_allclose(out, matrix @ matrix @ vector, rtol=1e-12)
    # Small ones are not in memory, larger ones are.
    assert np.isnan(scratch).all() == np.isnan(line).all() == (n <= 4)


@kernel
def matrix_times(size, matrix, vector, scratch, line, out):
    """``square_times`` without the square, in lanes."""
    n = len(size)
    mine, product = local_lanes_matrix(size, MANY, scratch), local_lanes_vector(size, MANY, line)
    for i in range(n):
        for j in range(n):
            store(MANY, mine, i, j, load(MANY, matrix, i, j))
    for i in range(n):
        store(MANY, product, i, 0.0)
        for j in range(n):
            total = load(MANY, product, i) + load(MANY, mine, i, j) * load(MANY, vector, j)
            store(MANY, product, i, total)
    for i in range(n):
        store(MANY, out, i, load(MANY, product, i))


@pytest.mark.one_in(2)
@pytest.mark.parametrize("n", [1, 2, 4, 5])
def test_local_arrays_of_lanes_hold_what_is_written(n):
    random = np.random.default_rng(n)
    matrix, vector = random.standard_normal((n, n, 8)), random.standard_normal((n, 8))
    scratch, line, out = np.full((n, n, 8), np.nan), np.full((n, 8), np.nan), np.empty((n, 8))
    matrix_times(sized(n), matrix, vector, scratch, line, out)
    np.testing.assert_allclose(out, np.einsum("ijq,jq->iq", matrix, vector), rtol=1e-12, atol=1e-14)
    assert np.isnan(scratch).all() == np.isnan(line).all() == (n <= 4)
