"""Normal and gamma numbers, integers and orders drawn in kernels are those of numpy's Generator."""

import numpy as np
import pytest

from netkf.rng.draws import ziggurat
from netkf.rng.normals import fill_normals_of_all
from netkf.rng.numbers import next_gamma, next_integer, normal_ziggurat, shuffle
from netkf.rng.streams import Streams


def both(seed):
    streams = Streams(seed, 3)
    return streams.states("noise", [(1, 2)]), streams.generator("noise", 1, 2)


def test_normals_with_the_tails_of_the_ziggurat():
    """A million numbers reach the lowest layer some 260 times and wedges 7000 times."""
    states, random = both(5)
    drawn = np.empty(1_000_000)
    fill_normals_of_all(states, normal_ziggurat(), drawn[None])
    np.testing.assert_array_equal(drawn, random.standard_normal(len(drawn)))
    assert (np.abs(drawn) > 3.7).any()


@pytest.mark.parametrize("shape", [0.1, 0.5, 0.99, 1.0, 1.001, 2.0, 3.7, 1e6])
def test_gamma_numbers(shape):
    states, random = both(6)
    tables = ziggurat(), normal_ziggurat()
    drawn = [next_gamma(states, 0, shape, *tables) for _ in range(3000)]
    np.testing.assert_array_equal(drawn, random.standard_gamma(shape, 3000))


@pytest.mark.parametrize("count", [1, 2, 3, 7, 200, 1 << 20, 3_000_000_000])
def test_integers(count):
    states, random = both(count)
    drawn = [next_integer(states, 0, count) for _ in range(200)]
    assert drawn == random.integers(count, size=200).tolist()
    assert next_integer(states, 0, 5) == random.integers(5)  # half a word may be left


@pytest.mark.parametrize("count", [0, 1, 2, 3, 8, 9, 100])
def test_orders(count):
    states, random = both(count)
    for _ in range(50):
        order = np.empty(count, dtype=np.int64)
        shuffle(states, 0, order, count)
        np.testing.assert_array_equal(order, random.permutation(count))
