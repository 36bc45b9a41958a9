"""States of many steps at once are those of one step after the other."""

import numpy as np
import pytest

from netkf.plants import linear
from netkf.plants.linear import LinearPlant
from netkf.plants.recursion import Recursion


def plant_of(F):
    eye = np.eye(len(F))
    return LinearPlant(mean=np.ones(len(F)), cov=0.0 * eye, F=np.array(F), Q=eye, period=1.0)


def one_after_the_other(start, noise, F):
    x = [start]
    for k in range(noise.shape[1]):
        x.append(x[-1] @ F.T + noise[:, k])
    return np.stack(x, axis=1)


@pytest.mark.parametrize("growth", [0.5, 0.99, 1.3])
@pytest.mark.parametrize("length", [1, 3, 64])
def test_states_follow_their_equation(growth, length):
    draw = np.random.default_rng([length, round(100 * growth)]).standard_normal
    F = draw((3, 3))
    F *= growth / np.abs(np.linalg.eigvals(F)).max()
    start, noise = draw((2, 3)), draw((2, 4, length, 3))
    found = Recursion(F).states(start, noise)
    plain = one_after_the_other(start, noise.reshape(2, -1, 3), F)
    sizes = np.maximum.accumulate(np.abs(plain).max(axis=2), axis=1)[:, :, None]
    assert (np.abs(found - plain) <= 1e-13 * sizes).all()


def test_paths_are_the_same_alone_and_with_others():
    draw = np.random.default_rng(1).standard_normal
    F, start, noise = 0.3 * draw((3, 3)), draw((5, 3)), draw((5, 4, 64, 3))
    steps = Recursion(F)
    together = steps.states(start, noise)
    for k in range(5):
        alone = steps.states(start[k : k + 1], noise[k : k + 1])
        np.testing.assert_array_equal(alone[0], together[k])


def test_a_path_in_slots_does_not_depend_on_who_asks(monkeypatch):
    plant = plant_of([[1.0, 0.2], [0.0, 0.9]])
    path = plant.truth(np.random.default_rng(3))
    every = [path.state(k) for k in range(200)]
    few = plant.truth(np.random.default_rng(3))
    for k in (0, 0, 5, 64, 65, 190):
        np.testing.assert_array_equal(few.state(k), every[k])
    monkeypatch.setattr(linear, "BLOCK", 1)
    plain = plant.truth(np.random.default_rng(3))
    np.testing.assert_allclose([plain.state(k) for k in range(200)], every, rtol=1e-12)


def test_a_state_that_growth_does_not_reach_stays(recwarn):
    """1e6 to the 64th is no number, and zero times it is zero all the same."""
    F, noise = np.diag([1e6, 0.5]), np.zeros((1, 3, 64, 2))
    noise[..., 1] = 1.0
    found = Recursion(F).states(np.array([[0.0, 2.0]]), noise)
    np.testing.assert_array_equal(found[0, :, 0], 0.0)
    np.testing.assert_allclose(found[0, :, 1], 2.0, rtol=1e-12)
    assert not recwarn


def test_growth_beyond_the_horizon_is_nobodys_business():
    path = plant_of([[1e6]]).truth(np.random.default_rng(3))
    assert path.state(20)[0] == pytest.approx(1e120, rel=1e-5)
