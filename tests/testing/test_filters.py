"""check_filter: our own filters pass, and each breach of the contract is named."""

from dataclasses import dataclass

import pytest

from netkf import parts
from netkf.testing import check_filter
from tests.testing.broken_filters import BROKEN

SOUND = {
    "hybrid": [parts.Hybrid(0.3), parts.Hybrid(1.0)],
    "covariance-intersection": [parts.CovarianceIntersection(0.25)],
    "local": [parts.Local()],
    "central": [parts.Central()],
    "slot gossip": [parts.Gossip()],
    "slot intermittent": [parts.Intermittent()],
    "slot diffusion": [
        parts.DiffusionFilter(),
        parts.DiffusionFilter(on_loss="keep-own"),
        parts.DiffusionFilter(weights=[[0.5, 0.5, 0.0], [0.25, 0.5, 0.25], [0.25, 0.0, 0.75]]),
    ],
    "slot push-sum": [
        parts.PushSum(gamma=3, delta=4.0),
        parts.PushSum(gamma=1, delta=4.0, stop="paper", tolerance=0.1),
        parts.PushSum(gamma=1, delta=4.0, asymptotic=True),
    ],
    "slot local": [parts.SlotLocal()],
    "slot central": [parts.SlotCentral()],
}
KINDS = parts.kinds()


def test_every_kind_of_filter_is_here():
    slots = {f"slot {kind}" for kind in KINDS["slot filter"]}
    assert set(SOUND) == set(KINDS["filter"]) | slots
    for name, examples in SOUND.items():
        family = "slot filter" if name.startswith("slot ") else "filter"
        for part in examples:
            assert type(part) is KINDS[family][name.removeprefix("slot ")]


@pytest.mark.parametrize("name", SOUND)
def test_our_own_filters_keep_the_contract(name):
    for part in SOUND[name]:
        assert check_filter(part) is None


@pytest.mark.parametrize("name", BROKEN)
def test_every_breach_is_named(name):
    cls, settings, words = BROKEN[name]
    with pytest.raises(AssertionError) as caught:
        check_filter(cls, **settings)
    text = str(caught.value)
    assert words in text
    assert "\n" not in text
    assert text.startswith(name)


def test_what_is_no_filter_is_told():
    for thing in (parts.Poisson(rate=1.0), int, "hybrid"):
        with pytest.raises(AssertionError, match="must be derived from FlowFilter or SlotFilter"):
            check_filter(thing)


def test_a_class_that_workers_could_not_import_is_told():
    @dataclass(frozen=True, eq=False)
    class Inner(parts.Hybrid):
        pass

    with pytest.raises(AssertionError, match="Inner: must be picklable"):
        check_filter(Inner(0.3))


def test_a_filter_with_memory_of_its_own_is_caught():
    class Remembers(parts.Gossip):
        def sense(self, state, reading):
            object.__setattr__(self, "count", getattr(self, "count", 0) + 1)
            return super().sense(state, reading)

    globals()["Remembers"] = Remembers
    Remembers.__qualname__ = "Remembers"
    with pytest.raises(AssertionError, match=r"Remembers.sense: must not change its own object"):
        check_filter(Remembers())


def test_the_numbers_of_a_breach_are_in_the_line():
    cls, settings, _ = BROKEN["Greedy"]
    with pytest.raises(AssertionError, match=r"got 1.5 at a node of 3 links"):
        check_filter(cls(**settings))
