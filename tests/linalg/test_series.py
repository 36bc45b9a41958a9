"""Power series are summed as far as a gap needs, and no further."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from netkf.linalg.series import fill_series, polynomial, with_reach
from tests import reference

TERMS = 19
RATES = st.floats(-3.0, 3.0).map(lambda rate: rate if abs(rate) > 1e-9 else 0.0)


def exponentials(rates):
    """Coefficients of exp(rate gap) and of its integral."""
    k = np.arange(TERMS)
    orders = np.array([math.factorial(m) for m in range(TERMS + 1)], dtype=float)
    rates = np.asarray(rates)[None]
    plain = rates ** k[:, None] / orders[:-1, None]
    integral = np.vstack([np.zeros_like(rates), rates ** k[:-1, None] / orders[1:-1, None]])
    return np.hstack([plain, integral])


def summed(table, gap):
    """The sum, of all columns and of all but the last."""
    whole, part, last = polynomial(table, gap), np.empty(table.shape[1] - 2), table.shape[1] - 1
    fill_series(part, len(part), table, table, last, gap)
    np.testing.assert_array_equal(part, whole[:-1])
    return whole


@settings(deadline=None)  # the first call compiles
@given(
    st.lists(RATES, min_size=1, max_size=4),
    st.floats(1e-9, 1.0),
)
def test_what_is_left_out_is_rounding(rates, share):
    longest = 0.3
    gap, series = share * longest, exponentials(rates)
    table = with_reach(series, longest)
    exact = [math.exp(rate * gap) for rate in rates]
    exact += [math.expm1(rate * gap) / rate if rate else gap for rate in rates]
    size = (np.abs(series) * gap ** np.arange(TERMS)[:, None]).max(axis=0)
    assert (np.abs(summed(table, gap) - exact) <= 1e-15 * size).all()


def test_short_gaps_take_few_terms():
    table = with_reach(exponentials([-2.0, 1.0]), 0.5)
    reach = table[:, -1]
    assert (np.diff(reach[:-1]) >= 0.0).all()
    assert reach[-1] == np.inf
    used = [int(np.searchsorted(reach, gap)) + 1 for gap in (0.5, 0.05, 0.005)]
    assert used[0] > used[1] > used[2] > 4


def test_an_entry_that_begins_late_is_kept():
    """The chain of integrators: what is of seventh order in the gap is not nothing."""
    series = np.zeros((TERMS, 2))
    series[0, 0], series[7, 1] = 1.0, 1.0
    table = with_reach(series, 1.0)
    assert summed(table, 0.01)[1] == pytest.approx(1e-14, rel=1e-12)


def test_a_table_without_columns_is_one():

    assert with_reach(np.ones((3, 0)), 1.0).shape == (3, 1)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("size", [1, 4, 20])
def test_the_sum_is_the_plain_one(seed, size):
    series = np.random.default_rng(seed).normal(size=(TERMS, size))
    series /= np.array([math.factorial(k) for k in range(TERMS)])[:, None]
    for gap in (1e-3, 0.1, 0.5):
        expected = reference.polynomial(series, gap)
        np.testing.assert_allclose(summed(with_reach(series, 0.5), gap), expected, rtol=1e-10)
