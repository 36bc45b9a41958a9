"""Numbers drawn in kernels are those that numpy draws for each stream."""

import numpy as np
import pytest

from netkf.rng.draws import fill_units, next_exponential, next_unit, ziggurat
from netkf.rng.streams import Streams

LINKS = [(k, k + 1) for k in range(20)] + [(2**40, 3)]


@pytest.mark.parametrize("streams", [Streams(3, 1), Streams(2**70, 5, 3)])
def test_exponentials_and_units_are_those_of_numpy(streams):
    """Among 100,000 exponentials are some from every layer and from the tail of the ziggurat."""
    states = streams.states("clock", LINKS)
    generators = [one.generator("clock", *link) for one in streams.per_replica for link in LINKS]
    count, largest = 100_000 // len(generators), 0.0
    for k, random in enumerate(generators):
        drawn = [next_exponential(states, k, ziggurat()) for _ in range(count)]
        np.testing.assert_array_equal(drawn, random.standard_exponential(count))
        largest = max(largest, *drawn)
        units = [next_unit(states, k) for _ in range(7)]
        np.testing.assert_array_equal(units, random.random(7))
    assert largest > 8.0  # beyond the last layer
    units = np.empty(len(generators))
    fill_units(states, units)
    np.testing.assert_array_equal(units, [random.random() for random in generators])
