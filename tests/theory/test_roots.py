"""Square roots of covariances, and forms of noises."""

import numpy as np
import pytest

from netkf.theory.common.forms import Forms
from netkf.theory.common.observations import Observation
from netkf.theory.stochastic_trigger.errors import measurement_update, triangular_root

SIZES = (1, 2, 3, 5)


def roots(n, count, seed=0):
    return list(np.random.default_rng(seed + n).standard_normal((count, n, n)))


def square(root):
    return root @ root.T


@pytest.mark.parametrize("shape", [(3, 3), (2, 7), (1, 4)])
def test_triangular_roots_have_the_square_of_their_parts(shape):
    parts = np.random.default_rng(2).standard_normal(shape)
    parts[:, -1:] *= 1e9  # columns of any size
    root = triangular_root(parts)
    assert np.array_equal(root, np.tril(root))
    assert np.allclose(square(root), square(parts), rtol=1e-14, atol=0.0)


@pytest.mark.parametrize("n", SIZES)
def test_updates_are_those_of_a_kalman_filter(n):
    random = np.random.default_rng(n)
    (root,), H = roots(n, 1), random.standard_normal((2, n))
    R = square(random.standard_normal((2, 2))) + np.eye(2)
    R.flags.writeable = False  # as those of a scenario
    K, after = measurement_update(root, Observation(H, R, np.eye(2)))
    P = square(root)
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    assert np.allclose(K, gain, atol=1e-12)
    assert np.allclose(square(after), P - gain @ H @ P, atol=1e-12)


def test_settled_forms_stay_valid_while_inputs_are_reduced():
    # Random walks x and y with some common noise: C(s, t) = C(s, s) for s < t.
    forms, random = Forms(1), np.random.default_rng(3)
    rows = forms.take(4)
    kept, covariances, total = [], [], np.zeros((4, 4))
    for step in range(200):
        parts = random.standard_normal((4, 3))
        first = forms.inputs(3)
        forms.table[rows, first : first + 3] += parts
        total += square(parts)
        if step % 40 == 7:
            kept.append(forms.freeze(forms.table[rows[::-1], : forms.used]))
            covariances.append(total[::-1, ::-1].copy())
    assert forms.used < 150
    found = forms.table[rows, : forms.used]
    assert np.allclose(square(found), total, rtol=1e-12)
    for i, one in enumerate(kept):
        for j, other in enumerate(kept):
            width = min(one.shape[1], other.shape[1])
            found = one[:, :width] @ other[:, :width].T
            assert np.allclose(found, covariances[min(i, j)], rtol=1e-10, atol=1e-10)


def test_rows_that_come_back_are_clean():
    forms = Forms(1)
    kept, given = forms.take(1), forms.take(2)
    first = forms.inputs(2)
    forms.table[given, first:] = 7.0
    forms.table[kept, first] = 3.0
    forms.give(given)
    again = forms.take(5)
    assert not forms.table[again, : forms.used].any()
    assert forms.table[kept, : forms.used].tolist() == [[0.0, 3.0, 0.0]]
