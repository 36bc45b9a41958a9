import numpy as np
import pytest

from netkf.linalg.compiling import kernel
from netkf.linalg.local import local_matrix, local_vector
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


@pytest.mark.parametrize("n", [1, 2, 4, 5])
def test_local_arrays_hold_what_is_written(n):
    random = np.random.default_rng(n)
    matrix, vector = random.standard_normal((n, n)), random.standard_normal(n)
    scratch, line, out = np.full((n, n), np.nan), np.full(n, np.nan), np.empty(n)
    square_times(sized(n), matrix, vector, scratch, line, out)
    np.testing.assert_allclose(out, matrix @ matrix @ vector, rtol=1e-12)
    # Small ones are not in memory, larger ones are.
    assert np.isnan(scratch).all() == np.isnan(line).all() == (n <= 4)


def test_local_arrays_are_for_kernels():
    for local, scratch in ((local_matrix, np.zeros((2, 2))), (local_vector, np.zeros(2))):
        with pytest.raises(TypeError, match="for kernels"):
            local(sized(2), scratch)
