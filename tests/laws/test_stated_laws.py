"""A user's clock, loss or delay states its own law, and both checkers hold it to that."""

from dataclasses import dataclass

import numpy as np
import pytest
import scipy.stats

from netkf.laws.stating import stated_law
from netkf.parts import Chain, Delay, Lattice, LinkClock, Loss, Renewal, WaitingLaw
from netkf.testing import check_channel, check_clock
from tests.checks.parts.test_parts import TICKS, broken, from_table, verdicts, with_network
from tests.conftest import with_slow


def erlang(shape, mean=1.0):
    law = scipy.stats.gamma(shape, scale=mean / shape)
    return WaitingLaw(law.cdf, law.ppf, law.var() / law.mean() ** 2)


@dataclass(frozen=True, eq=False)
class Erlang(LinkClock):
    """Gaps are sums of three exponential ones, and of ``stages`` as it says."""

    stages: float = 3.0

    def ticks(self, entity, origin, index, now, random, count):
        gaps = random.standard_exponential((count, 3)).sum(axis=1) / 6.0
        return np.add.accumulate(np.concatenate([[now], gaps]))[1:]

    def mean_rate(self, entity):
        return 2.0

    @property
    def gaps(self):
        return erlang(self.stages)


@dataclass(frozen=True, eq=False)
class Beat(LinkClock):
    """Ticks every half second, ``late`` in truth."""

    late: float = 0.0

    def ticks(self, entity, origin, index, now, random, count):
        return self.late + 0.5 * np.arange(index + 1.0, index + 1.0 + count)

    def mean_rate(self, entity):
        return 2.0

    @property
    def gaps(self):
        return Lattice(0.5, 0.5)


@dataclass(frozen=True, eq=False)
class Queue(Delay):
    """Takes the sum of two exponential times, and of ``stages`` as it says."""

    stages: float = 2.0

    def draw(self, random):
        return 0.1 * float(random.standard_exponential(2).sum())

    @property
    def law(self):
        return erlang(self.stages, 0.2)


@dataclass(frozen=True, eq=False)
class Fading(Loss):
    """A chain of good and bad times, which last ``longer`` than it says."""

    longer: float = 1.0

    @property
    def stateful(self):
        return True

    @property
    def independent(self):
        return False

    def next_state(self, link, bad, random):
        u = random.random()
        if bad is None:
            return bool(u < 0.25)
        return bool(u >= 0.3 / self.longer if bad else u < 0.1 / self.longer)

    def delivery_probability(self, sent):
        return 0.05 if sent.bad else 0.95

    def mean_delivery(self, sent):
        return 0.75 * 0.95 + 0.25 * 0.05

    @property
    def chain(self):
        return Chain(0.1, 0.3, 0.95, 0.05)


PARTS = {
    # Checker, class, what is wrong, what the checker says, and the row of `check`.
    "gaps": (check_clock, Erlang, {"stages": 2.0}, "Erlang.ticks: gaps must have the law of its `g",
             "ticks follow the law of their clocks"),
    "lattice": (check_clock, Beat, {"late": 0.01}, "Beat.ticks: must tick at the times of its",
                "clocks tick at the times"),
    "delay": (check_channel, Queue, {"stages": 1.0}, "Queue.message_delay: delays must have",
              "delays of messages have the law"),
    "chain": (check_channel, Fading, {"longer": 4.0}, "Fading.next_state: losses must follow each",
              "losses follow each other"),
}  # fmt: skip
KEYS = {"delay": "channel", "chain": "channel"}


def scenario(name, settings):
    part = {"kind": f"{__name__}:{PARTS[name][1].__name__}", **settings}
    if name in KEYS:
        return from_table(
            with_network(TICKS, channel={"loss" if name == "chain" else "delay": part})
        )
    return from_table(with_network(TICKS, activation=part))


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", with_slow(PARTS, {"chain"}))
def test_a_law_of_ones_own_is_tested(name):
    checker, cls, wrong, words, promise = PARTS[name]
    assert checker(cls) is None
    with pytest.raises(AssertionError) as caught:
        checker(cls, **wrong)
    assert str(caught.value).startswith(words)
    right, found = (verdicts(scenario(name, settings), 40) for settings in ({}, wrong))
    assert not broken(right)
    assert any(row.promise.startswith(promise) for row in right)
    assert any(one.startswith(promise) for one in broken(found))


@dataclass(frozen=True, eq=False)
class Slower(Renewal):
    """States another rate, so that it need not have the law of its parent."""

    def mean_rate(self, entity):
        return 1.0


def test_what_a_class_inherits_is_a_statement_only_beside_no_other():
    settings = {"distribution": "gamma", "shape": 3.0, "rate": 2.0}
    assert stated_law(Slower(**settings), "activation") is None
    law = stated_law(Renewal(**settings), "activation")
    t = np.linspace(0.1, 3.0, 7)
    assert law.cdf(t) == pytest.approx(scipy.stats.gamma(3.0, scale=1.0 / 3.0).cdf(t))
