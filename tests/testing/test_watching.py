"""Uses of generators that a process shares are seen, by what they change in their states."""

# ruff: noqa: NPY002 - of the generators that a process shares

import random

import numpy as np
import pytest

from netkf.testing import watching

USES = {
    "a number of Python": random.random,
    "one of a pair of normals": random.gauss,
    "a seed of Python": lambda: random.seed(1),
    "a number of numpy": np.random.random,
    "a seed of numpy": lambda: np.random.seed(1),
}


@pytest.fixture(autouse=True)
def _as_before():
    states = random.getstate(), np.random.get_state()
    yield
    random.setstate(states[0])
    np.random.set_state(states[1])


@pytest.mark.parametrize("name", USES)
def test_a_use_changes_the_state(name):
    for _ in range(2):
        before, kept = (
            watching.global_generator_states(),
            (random.getstate(), np.random.get_state()),
        )
        assert watching.global_generator_states() == before
        USES[name]()
        assert watching.global_generator_states() != before
        random.setstate(kept[0])
        np.random.set_state(kept[1])
        assert watching.global_generator_states() == before
        random.gauss()  # the next one is already drawn
