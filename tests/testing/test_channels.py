"""check_channel and check_clock: our own parts pass, and each breach is named."""

from dataclasses import dataclass

import numpy as np
import pytest

from netkf import parts
from netkf.testing import check_channel, check_clock
from tests.testing.broken_channels import CHANNELS, CLOCKS

KINDS = parts.kinds()


@pytest.fixture
def tables(tmp_path):
    from netkf.core.fields import SourceFile

    (tmp_path / "lost.csv").write_text("sender,receiver,message,delivered\n0,1,2,0\n0,1,3,1\n")
    (tmp_path / "ticks.csv").write_text("t,node,peer\n0.5,0,1\n0.75,1,0\n0.75,1,2\n")
    (tmp_path / "delays.csv").write_text("sender,receiver,message,seconds\n0,1,2,0.25\n")
    rows = "from,until,sender,receiver,delivery\n0,20,0,1,0.25\n20,40,0,1,0.75\n"
    (tmp_path / "schedule.csv").write_text(rows)
    names = ("lost", "ticks", "delays", "schedule")
    return {name: SourceFile(f"{name}.csv", tmp_path) for name in names}


def losses(tables):
    return {
        "none": [parts.NoLoss()],
        "bernoulli": [parts.Bernoulli(0.7), parts.Bernoulli(1.0), parts.Bernoulli(0.0)],
        "shared": [parts.SharedLoss(delivery=0.7, share=0.5)],
        "scheduled": [parts.ScheduledLoss(tables["schedule"])],
        "per-link": [parts.PerLink()],
        "gilbert-elliott": [
            parts.GilbertElliott(to_bad=0.1, to_good=0.3, deliver_bad=0.2),
            parts.GilbertElliott(to_bad=0.3, to_good=0.7),
            parts.GilbertElliott(mean_loss=0.1, mean_burst=50.0),
            parts.GilbertElliott(mean_loss=0.3, mean_burst=4.0, shared=True),
        ],
        "recorded": [parts.RecordedLoss(tables["lost"])],
        "distance": [
            parts.DistanceLoss({"kind": "logistic", "half": 3.0, "width": 0.1}),
            parts.DistanceLoss([[0.0, 1.0], [5.0, 0.0]]),
        ],
    }


DELAYS = {
    "none": [parts.NoDelay()],
    "constant": [parts.ConstantDelay(0.2)],
    "exponential": [parts.ExponentialDelay(0.3)],
    "uniform": [parts.UniformDelay(0.0, 1.0)],
    "lognormal": [parts.LognormalDelay(0.3, 0.5)],
}


def delays(tables):
    return {**DELAYS, "recorded": [parts.RecordedDelay(tables["delays"])]}


def clocks(tables):
    return {
        "poisson": [parts.Poisson(rate=3.0), parts.Poisson(rates=[[1, 0, 5.0]])],
        "renewal": [
            parts.Renewal("gamma", mean=0.5, shape=1.0),
            parts.Renewal("gamma", rate=2.0, shape=0.4),
            parts.Renewal("weibull", scale=0.5, shape=2.0),
            parts.Renewal("uniform", low=0.0, high=1.0),
            parts.Renewal("constant", mean=0.1),
        ],
        "periodic": [
            parts.Periodic(period=0.3),
            parts.Periodic(period=0.3, phase="random", jitter=0.2),
        ],
        "recorded": [parts.RecordedClock(tables["ticks"])],
        "readings": [parts.OnReadings()],
        "contacts": [],  # its rate changes with time: tests/network/test_contacts.py
    }


@dataclass(frozen=True, eq=False)
class Tries(parts.Delay):
    """Geometric: most delays are equal."""

    def draw(self, random):
        return 0.1 * min(random.geometric(0.7), 4)


def test_delays_of_few_values_keep_the_contract():
    assert check_channel(Tries()) is None


@pytest.mark.slow
def test_our_own_channels_keep_the_contract(tables):
    ours = losses(tables)
    assert set(ours) == set(KINDS["loss"])
    late = delays(tables)
    assert set(late) == set(KINDS["delay"])
    for part in [part for table in (ours, late) for listed in table.values() for part in listed]:
        assert check_channel(part) is None
    assert check_channel(parts.Channel(loss=parts.Bernoulli(0.5))) is None


def test_our_own_clocks_keep_the_contract(tables):
    ours = clocks(tables)
    assert set(ours) == set(KINDS["activation"])
    for part in [part for listed in ours.values() for part in listed]:
        assert check_clock(part) is None
    assert check_clock(parts.RecordedClock(tables["ticks"]), link=(1, 2)) is None


@dataclass(frozen=True, eq=False)
class Groups(parts.LinkClock):
    """So many ticks from the beginning of each second, 50 ms apart, from 1 s on."""

    size: int

    def ticks(self, entity, origin, index, now, random, count):
        number = np.arange(index, index + count)
        return 1.0 + number // self.size + 0.05 * (number % self.size)

    def mean_rate(self, entity):
        return float(self.size)


@pytest.mark.parametrize("size", [10, 4])  # in runs of 10 s and 25 s
def test_a_clock_whose_ticks_come_in_groups_keeps_the_contract(size):
    assert check_clock(Groups(size)) is None


@pytest.mark.one_in(12)
@pytest.mark.parametrize("name", CHANNELS)
def test_every_breach_of_a_channel_is_named(name):
    refused(check_channel, *CHANNELS[name])


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", CLOCKS)
def test_every_breach_of_a_clock_is_named(name):
    refused(check_clock, *CLOCKS[name])


def refused(checker, cls, settings, words):
    with pytest.raises(AssertionError) as caught:
        checker(cls, **settings)
    text = str(caught.value)
    assert text.startswith(words)
    assert "\n" not in text


class OneWeather(parts.Loss):
    """Its weather is the same in all runs."""

    def conditions(self, random, horizon):
        return np.cumsum(np.random.default_rng(1).exponential(horizon / 5.0, 9))

    def delivery_probability(self, sent):
        return 0.5 + 0.5 * (np.searchsorted(sent.conditions, sent.time) % 2)


def test_weather_that_is_not_drawn_is_told():
    with pytest.warns(UserWarning, match="OneWeather.conditions: takes no numbers") as told:
        check_channel(OneWeather())
    assert told[0].filename == __file__


def test_a_broken_part_of_a_channel_is_named():
    cls, settings, words = CHANNELS["Backwards"]
    with pytest.raises(AssertionError, match=words.partition(";")[0]):
        check_channel(parts.Channel(delay=cls(**settings)))


def test_what_is_no_channel_or_clock_is_told():
    with pytest.raises(AssertionError, match="must be derived from Channel or Loss or Delay"):
        check_channel(parts.Poisson(rate=1.0))
    with pytest.raises(AssertionError, match="must be derived from LinkClock"):
        check_clock(parts.Matching("maximal"))
