"""check_filter: our own filters pass, and each breach of the contract is named."""

from dataclasses import dataclass

import pytest

from netkf import parts
from netkf.algorithms.filter import commutes
from netkf.core.contracts import require_known_members
from netkf.kernels import Kernels, kernel, load, store
from netkf.testing import check_filter
from tests.conftest import with_slow
from tests.testing.broken_filters import BROKEN

SOUND = {
    "hybrid": [parts.Hybrid(0.3), parts.Hybrid(1.0)],
    "covariance-intersection": [parts.CovarianceIntersection(0.25)],
    "local": [parts.Local()],
    "central": [parts.Central()],
    "gossip": [parts.Gossip()],
    "intermittent": [
        parts.Intermittent(),
        parts.Intermittent(late="drop"),
        parts.Intermittent(window=0.3),
    ],
    "diffusion": [
        parts.DiffusionFilter(),
        parts.DiffusionFilter(on_loss="keep-own"),
        parts.DiffusionFilter(weights=[[0.5, 0.5, 0.0], [0.25, 0.5, 0.25], [0.25, 0.0, 0.75]]),
    ],
    "hcmci": [parts.Hcmci(consensus="information", steps=2)],
    "icf": [parts.Icf()],
    "one-bit": [parts.OneBit()],
    "track-fusion rule=ci": [
        parts.OptimisedIntersection(),
        parts.OptimisedIntersection(minimise="determinant"),
    ],
    "track-fusion rule=ici": [parts.InverseIntersection()],
    "track-fusion rule=cross-covariance": [parts.BarShalomCampo()],
    "event-triggered trigger=consensus": [parts.EventTriggeredCi()],
    "event-triggered trigger=stochastic": [
        parts.StochasticTrigger(parts.Intermittent(), 1.0),
        parts.StochasticTrigger(parts.Hcmci(steps=2), 1.0),
        parts.StochasticTrigger(parts.DiffusionKalman(), 1.0),
    ],
    "belief-propagation": [
        parts.BeliefPropagation(steps=2),
        parts.BeliefPropagation(memory="all"),
    ],
    "consensus-innovations": [parts.ConsensusInnovations()],
    "block-belief-propagation": [
        parts.BlockBeliefPropagation(),
        parts.BlockBeliefPropagation(steps=2, window=2),
    ],
    "block-cross-covariances": [
        parts.BlockCrossCovariances(),
        parts.BlockCrossCovariances(steps=1),
    ],
    "block-intersection": [parts.BlockIntersection(), parts.BlockIntersection(rule="ci")],
    "partition": [parts.Partition()],
    "kcf": [parts.Kcf(epsilon=0.2)],
    "diffusion-kalman": [parts.DiffusionKalman()],
    "push-sum": [
        parts.PushSum(gamma=3, delta=4.0),
        parts.PushSum(gamma=1, delta=4.0, stop="paper", tolerance=0.1),
        parts.PushSum(gamma=1, delta=4.0, asymptotic=True),
        parts.PushSum(gamma=1, delta=4.0, running_sums=True),
    ],
}
KINDS = parts.kinds()


def test_every_kind_of_filter_is_here():
    # The gain of constant-gain fits one number of states; the checker draws several.
    assert set(SOUND) == set(KINDS["filter"]) - {"constant-gain"}
    for name, examples in SOUND.items():
        for part in examples:
            assert type(part) is KINDS["filter"][name]


@pytest.mark.parametrize("name", KINDS["filter"])
def test_a_class_derived_from_any_filter_of_ours_is_sound(name):
    """One that derives from the stochastic trigger ended in an AttributeError."""
    require_known_members(type("Same", (KINDS["filter"][name],), {"__module__": __name__}))


LONG = (
    *("block-belief-propagation", "block-cross-covariances", "block-intersection", "partition"),
    *("push-sum", "diffusion", "hcmci", "belief-propagation", "hybrid"),
    *("track-fusion rule=ci", "track-fusion rule=ici", "event-triggered trigger=stochastic"),
)
"""Filters whose check is slow; others of their kind are checked each time."""


@pytest.mark.one_in(8)
@pytest.mark.parametrize("name", with_slow(SOUND, LONG))
def test_our_own_filters_keep_the_contract(name):
    for part in SOUND[name]:
        assert check_filter(part) is None


@pytest.mark.parametrize("name", SOUND)
def test_our_own_filters_say_that_they_commute(name):
    """Else their errors would lose their digits on unstable plants."""
    assert all(commutes(part) for part in SOUND[name])


@pytest.mark.one_in(8)
@pytest.mark.parametrize("name", BROKEN)
def test_every_breach_is_named(name):
    cls, settings, words = BROKEN[name]
    with pytest.raises(AssertionError) as caught:
        check_filter(cls, **settings)
    text = str(caught.value)
    assert words in text
    assert "\n" not in text
    assert text.startswith(name)


@kernel
def absorb_all(record, h, run):
    """Forget that in some of the runs side by side a message has not arrived."""
    for k in range(run.count):
        for i in range(len(run.size)):
            heard = load(run.lanes, record.payload.xhat, run.message[k], i)
            store(run.lanes, record.xhat, h, i, heard)


@dataclass(frozen=True, eq=False)
class Hasty(parts.Filter):
    timing = parts.Timing(clocks=())
    kernels = Kernels(absorb=absorb_all)


def test_kernels_that_mix_runs_are_told():
    """A single run was right, and so was all of SimPy: ensembles were wrong."""
    with pytest.raises(AssertionError, match=r"Hasty.kernels: must give each run what it has alo"):
        check_filter(Hasty())


def test_what_is_no_filter_is_told():
    for thing in (parts.Poisson(rate=1.0), int, "hybrid"):
        with pytest.raises(AssertionError, match="must be derived from Filter of"):
            check_filter(thing)


def test_a_class_that_workers_could_not_import_is_told():
    @dataclass(frozen=True, eq=False)
    class Inner(parts.Hybrid):
        pass

    with pytest.raises(AssertionError, match="Inner: must be picklable"):
        check_filter(Inner(0.3))


def test_a_filter_with_memory_of_its_own_is_caught():
    class Remembers(parts.Gossip):
        def update(self, state, reading):
            object.__setattr__(self, "count", getattr(self, "count", 0) + 1)
            return super().update(state, reading)

    globals()["Remembers"] = Remembers
    Remembers.__qualname__ = "Remembers"
    with pytest.raises(AssertionError, match=r"Remembers.update: must not change its own object"):
        check_filter(Remembers())


def test_the_numbers_of_a_breach_are_in_the_line():
    cls, settings, _ = BROKEN["Greedy"]
    with pytest.raises(AssertionError, match=r"got 1.5 at a node of 3 links"):
        check_filter(cls(**settings))


@dataclass(frozen=True, eq=False)
class Transposed(parts.DiffusionFilter):
    """Takes columns for rows in the matrix of its weights."""

    @property
    def link_weights(self):
        weights = super().link_weights.matrix
        return parts.Weights(matrix=None if weights is None else weights.T)


@dataclass(frozen=True, eq=False)
class TransposedKalman(parts.DiffusionKalman):
    """The same, where a class also writes down a step that changes nothing."""

    @property
    def link_weights(self):
        weights = super().link_weights.matrix
        return parts.Weights(matrix=None if weights is None else weights.T)

    def absorb(self, state, messages, exchange):
        return super().absorb(state, messages, exchange)


@pytest.mark.parametrize(
    ("cls", "settings"),
    [
        pytest.param(Transposed, {}, marks=pytest.mark.slow),
        (TransposedKalman, {"weights": [[0.6, 0.1, 0.3], [0.3, 0.6, 0.1], [0.1, 0.3, 0.6]]}),
    ],
)
def test_weights_by_rows_in_place_of_columns_are_a_mistake(cls, settings):
    """Whatever weights the class is made with, and whatever else it defines anew."""
    with pytest.raises(AssertionError, match=r"weights: must give node i's weight for node l in"):
        check_filter(cls, **settings)


def test_weights_of_ones_own_are_no_mistake():
    assert check_filter(parts.DiffusionKalman(weights=[[0.5, 0.5], [0.5, 0.5]])) is None
