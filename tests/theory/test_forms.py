"""Forms of noises."""

import numpy as np
import pytest

from netkf.theory.common.forms import Forms


def square(root):
    return root @ root.T


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


@pytest.mark.parametrize("count", [1, 60])
def test_large_tables_are_reduced_rarely(monkeypatch, count):
    forms, reductions, qr = Forms(1), [], np.linalg.qr
    rows = forms.take(300)
    monkeypatch.setattr(np.linalg, "qr", lambda *a, **k: reductions.append(1) or qr(*a, **k))
    for first in (forms.inputs(count) for _ in range(1800 // count)):
        forms.table[rows[:count], first : first + count] += np.eye(count)
    assert len(reductions) < 6
