"""Square-root recursions against the covariances that they stand for."""

import numpy as np
import pytest

from netkf.algorithms.kernels.square_root import lower_triangular, reflect
from tests import reference


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (2, 5), (4, 4), (6, 9)])
def test_reflections_make_an_array_triangular(seed, rows, columns):
    array = np.random.default_rng(seed).normal(size=(rows, columns))
    expected, work = reference.triangular_root(array), array.copy()
    for i in range(rows):
        reflect(work, i, i, rows, columns)
    found = np.tril(work[:, :rows])  # what is right of the diagonal is left as rubbish
    signs = np.where(np.diag(found) < 0.0, -1.0, 1.0)
    np.testing.assert_allclose(found * signs, expected, rtol=1e-10, atol=1e-12)
    L = lower_triangular(array)
    np.testing.assert_allclose(L @ L.T, array @ array.T, rtol=1e-10, atol=1e-12)
