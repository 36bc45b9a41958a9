"""Streams are ranges of counters of Philox4x64-10, one for each name."""

import itertools

import numpy as np
import pytest

from netkf.rng.draws import philox
from netkf.rng.streams import KEY, Streams

ONES = 2**64 - 1
PI = (0x243F6A8885A308D3, 0x13198A2E03707344, 0xA4093822299F31D0, 0x082EFA98EC4E6C89)
PURPOSES = (
    *("plant", "samples", "probe", "noise", "cut", "clock", "phase", "loss", "weather", "delay"),
    *("matching", "trigger", "regressor", "sampling"),
)


@pytest.mark.parametrize(
    ("counter", "key", "words"),
    [
        # kat_vectors of Random123, philox4x64 10.
        (
            (0, 0, 0, 0),
            (0, 0),
            (0x16554D9ECA36314C, 0xDB20FE9D672D0FDC, 0xD7E772CEE186176B, 0x7E68B68AEC7BA23B),
        ),
        (
            (ONES,) * 4,
            (ONES,) * 2,
            (0x87B092C3013FE90B, 0x438C3C67BE8D0224, 0x9CC7D7C69CD777B6, 0xA09CAEBF594F0BA0),
        ),
        (
            PI,
            (0x452821E638D01377, 0xBE5466CF34E90C6C),
            (0xA528F45403E61D95, 0x38C72DBD566E9788, 0xA5A1610E72FD18B5, 0x57BD43B5E52B7FE6),
        ),
    ],
)
def test_known_answers(counter, key, words):
    assert philox(*map(np.uint64, (*counter, *key))) == words


@pytest.mark.parametrize("seed", [0, 1, 2**40 + 3, 2**200 + 17])
@pytest.mark.parametrize("replica", [0, 5, 2**32 - 1])
def test_streams_are_numpys_with_this_counter(seed, replica):
    """The sentence of the documentation, with the code of "loss" written out."""
    code = int.from_bytes(bytes.fromhex("2ea71c18"), "little")
    for entity, ids in (((), (0, 0)), ((6,), (7, 0)), ((6, 0), (7, 1))):
        counter = [0, *ids, (code << 32) + replica]
        expected = np.random.Generator(np.random.Philox(seed, counter=counter)).random(9)
        np.testing.assert_array_equal(
            Streams(seed, replica).generator("loss", *entity).random(9), expected
        )


def test_states_of_kernels_are_those_of_generators():
    for entities in ([(0, 1), (7, 2**40)], [(3,)], [()], [(1, 2, 3), (2**64, 1)], []):
        for replica in (0, 2**32 - 2, 2**32):
            together = Streams(5, replica, 3).states("clock", entities)
            names = itertools.product(range(replica, replica + 3), entities)
            for state, (run, entity) in zip(together, names, strict=True):
                found = Streams(5, run).generator("clock", *entity).bit_generator.state["state"]
                np.testing.assert_array_equal(state[:KEY], found["counter"])
                np.testing.assert_array_equal(state[KEY : KEY + 2], found["key"])


def test_other_names_are_other_streams():
    """Also where numbers of a name would run together: (1, 2) is not (12,), nor (0,) nothing."""
    entities = [(), (0,), (0, 0), (1,), (1, 2), (12,), (2, 1), (0, 0, 0), (2**64, 0), (2**70,)]
    seen = set()
    for purpose, entity in itertools.product(PURPOSES, entities):
        for seed, replica in itertools.product((0, 1, 2**64), (0, 1, 2**32, 2**32 + 1)):
            seen.add(Streams(seed, replica).states(purpose, [entity])[0, : KEY + 2].tobytes())
    assert len(seen) == len(PURPOSES) * len(entities) * 12
