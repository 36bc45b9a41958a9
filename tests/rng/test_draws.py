"""Numbers drawn for many streams at once are those that numpy draws for each."""

import numpy as np
import pytest

from netkf.rng.draws import StreamBatch
from netkf.rng.streams import ReplicaStreams, Streams

LINKS = [(k, k + 1) for k in range(200)] + [(2**40, 3)]


@pytest.mark.parametrize("streams", [Streams(3, 1), ReplicaStreams(2**70, 5, 3)])
def test_exponentials_and_units_are_those_of_numpy(streams):
    """A million of each, among them those from every layer and from the tail of the ziggurat."""
    draws = StreamBatch(streams, "clock", LINKS)
    generators = [one.generator("clock", *link) for one in streams.per_replica for link in LINKS]
    random = np.random.default_rng(0)
    for turn in range(4):
        which = np.flatnonzero(random.random(len(generators)) < 0.7)
        counts = random.integers(0, 4000, len(which))
        made = draws.exponentials if turn % 2 else draws.units
        name = "standard_exponential" if turn % 2 else "random"
        expected = [getattr(generators[k], name)(n) for k, n in zip(which, counts, strict=True)]
        np.testing.assert_array_equal(made(which, counts), np.concatenate(expected))
        assert turn % 2 == 0 or made(which, counts).max() > 8.0  # beyond the last layer
        for k, n in zip(which, counts, strict=True):
            if turn % 2:
                generators[k].standard_exponential(n)
