"""check_filter runs a class beside the built-in filter that it derives from."""

import warnings
from dataclasses import dataclass, replace

import numpy as np
import pytest

from netkf import parts
from netkf.algorithms.kernels.estimates import transform_mean
from netkf.algorithms.push_sum import SLOTS
from netkf.algorithms.registry import own_attributes
from netkf.kernels import kernel
from netkf.testing import check_filter
from netkf.testing.filters import check_parent
from netkf.testing.watching import WatchedPart

ADJUSTED, DEFINED, SAME = {}, {}, {}


@kernel
def predict_mean(record, h, run):
    transform_mean(run.lanes, run.size, record.xhat, h, run.model.F, run.moved_mean)


def keep(table, words="", **settings):
    def add(cls):
        made = dataclass(frozen=True, eq=False)(cls)
        table[made.__name__] = (made, settings, words)
        return made

    return add


@keep(ADJUSTED, "Heavier.link_weights: must have the numbers of Hybrid", epsilon=0.3)
class Heavier(parts.Hybrid):
    @property
    def link_weights(self):
        given = super().link_weights
        return parts.Weights(lambda *degrees: 1.02 * given.of(*degrees))


def widen(filtering, node, info, model):
    node["root"][:] *= 1.1


def grow_own_weight(filtering, node, info, model):
    node["own"][...] = 1.2 * info.own_weight


@keep(ADJUSTED, "Averse.kernels: must have the numbers of Hybrid", epsilon=0.3)
class Averse(parts.Hybrid):
    """A first covariance that is too large."""

    kernels = replace(parts.Hybrid.kernels, begin=widen)


@keep(ADJUSTED, "LateStart.timing: must have the numbers of Gossip")
class LateStart(parts.Gossip):
    timing = replace(parts.Gossip.timing, first_slot=3)


@keep(ADJUSTED, "Everyone.timing: must have the numbers of Gossip")
class Everyone(parts.Gossip):
    timing = replace(parts.Gossip.timing, pairwise=False)


@keep(ADJUSTED, "Unfair.kernels: must have the numbers of DiffusionFilter")
class Unfair(parts.DiffusionFilter):
    kernels = replace(parts.DiffusionFilter.kernels, begin=grow_own_weight)


@keep(ADJUSTED, "Certain.kernels: must have the numbers of PushSum", gamma=3, delta=4.0)
class Certain(parts.PushSum):
    """It predicts without process noise."""

    kernels = replace(SLOTS, predict=predict_mean)


@keep(ADJUSTED, "Deaf.timing: must have the numbers of CovarianceIntersection", epsilon=0.25)
class Deaf(parts.CovarianceIntersection):
    timing = replace(parts.CovarianceIntersection.timing, max_age=0.0)


@keep(DEFINED, "its own: absorb", epsilon=0.3)
class Half(parts.Hybrid):
    def absorb(self, state, messages, exchange):
        return super().absorb(state, messages[:1], exchange)

    def shift(self, state, offset):
        return super().shift(state, offset)


@keep(DEFINED, "its own: init", epsilon=0.3)
class Sure(parts.Hybrid):
    def init(self, model, mean, cov, node):
        return super().init(model, mean, 0.9 * cov, node)

    def shift(self, state, offset):
        return super().shift(state, offset)


@keep(SAME, epsilon=0.3)
class Renamed(parts.Hybrid):
    """Nothing but a name."""


@keep(SAME, epsilon=0.3)
class OneClock(parts.Hybrid):
    timing = replace(parts.Hybrid.timing, clocks=("nodes",))

    @property
    def needs(self):
        return replace(super().needs, notes=lambda scenario: ("by nodes",))


@keep(SAME, epsilon=0.3)
class Rewritten(parts.Hybrid):
    """The same update in the form of covariances."""

    def update(self, state, reading):
        if isinstance(reading, parts.Increments) or not len(reading.y):
            return super().update(state, reading)
        P = state.root @ state.root.T
        S = reading.H @ P @ reading.H.T + reading.R
        K = np.linalg.solve(S, reading.H @ P).T
        P = P - K @ S @ K.T
        xhat = state.xhat + K @ (reading.y - reading.H @ state.xhat)
        return state._replace(xhat=xhat, root=np.linalg.cholesky(0.5 * (P + P.T)))

    def shift(self, state, offset):
        return super().shift(state, offset)


@keep(SAME)
class OtherWeights(parts.Gossip):
    """Weights mean nothing to gossip."""

    @property
    def link_weights(self):
        return parts.Weights(lambda degree, peer_degree: 0.01)


def compare(cls, settings, same_as_parent=None):
    return check_parent(WatchedPart(cls(**settings)), same_as_parent)


@pytest.mark.parametrize("name", ADJUSTED)
@pytest.mark.slow
def test_an_adjustment_that_changes_numbers_is_named(name):
    cls, settings, words = ADJUSTED[name]
    with pytest.raises(AssertionError) as caught:
        compare(cls, settings)
    text = str(caught.value)
    assert text.startswith(words)
    assert "same_as_parent=False" in text
    assert "\n" not in text
    assert compare(cls, settings, same_as_parent=False) is None


@pytest.mark.slow
@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", DEFINED)
def test_a_step_that_differs_is_told_and_accused_where_it_should_be_the_same(name):
    cls, settings, words = DEFINED[name]
    with pytest.warns(UserWarning, match=words):
        compare(cls, settings)
    with pytest.raises(AssertionError, match="must have the numbers of Hybrid"):
        compare(cls, settings, same_as_parent=True)
    assert compare(cls, settings, same_as_parent=False) is None


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", SAME)
def test_equal_numbers_pass_silently(name):
    cls, settings, _ = SAME[name]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert compare(cls, settings, same_as_parent=True) is None


@pytest.mark.slow
def test_check_filter_compares_with_the_parent():
    with pytest.raises(AssertionError, match=r"LateStart.timing: must have the numbers of Gos"):
        check_filter(LateStart)
    assert check_filter(LateStart, same_as_parent=False) is None


def test_attributes_of_its_own_are_listed_without_fields_and_new_names():
    assert own_attributes(OneClock(epsilon=0.3)) == ["needs", "timing"]
    assert own_attributes(Averse(epsilon=0.3)) == ["kernels"]
    assert own_attributes(Renamed(epsilon=0.3)) == []
