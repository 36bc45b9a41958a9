"""Seeds made all at once are those that numpy makes one by one."""

import pytest

from netkf.rng.streams import Streams

ENTITIES = [(0, 1), (1, 0), (7, 123456), (2**32 - 1, 5)]


@pytest.mark.parametrize("seed", [0, 1, 2**40 + 3, 2**200 + 17])
@pytest.mark.parametrize("replica", [0, 5, 2**33])
@pytest.mark.parametrize("entities", [ENTITIES, [(3,), (2**31,)], [(2**40, 1)], []])
def test_seeded_streams_are_the_same_streams(seed, replica, entities):
    plain = Streams(seed, replica)
    seeded = plain.with_seeds(("loss", "clock"), entities)
    for one, entity in zip(plain.generators("sky", entities), entities, strict=True):
        assert one.bit_generator.state == plain.generator("sky", *entity).bit_generator.state
    for purpose in ("loss", "clock", "delay"):
        for entity in [*entities, (11, 12, 13)]:
            one, other = (s.generator(purpose, *entity) for s in (plain, seeded))
            assert one.bit_generator.state == other.bit_generator.state
