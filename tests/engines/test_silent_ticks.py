"""Filters whose nodes are silent at some ticks: which outcomes ticks alone tell."""

from dataclasses import dataclass

import pandas as pd
import pytest

import netkf
from netkf.kernels import Kernels, Record, emit, kernel
from netkf.parts import Delay, Filter, Loss


@kernel
def emit_every_second(record, h, m, run):
    record.ticks[h, 0] += 1.0
    run.sends[0] = record.ticks[h, 0] % 2.0 == 0.0
    emit(record, h, m, run)


def counting_record(filtering, infos, models):
    n = len(models[0].information)
    return Record(node={"ticks": ()}, payload={"xhat": (n,), "root": (n, n)})


@dataclass(frozen=True, eq=False)
class EverySecond(Filter):
    kernels = Kernels(counting_record, emit=emit_every_second, decides=True)


@dataclass(frozen=True, eq=False)
class EveryThird(Loss):
    def delivery_probability(self, sent):
        return 0.0 if sent.number % 3 == 0 else 1.0

    def mean_delivery(self, sent):
        return 2.0 / 3.0


@dataclass(frozen=True, eq=False)
class SlowFirst(Delay):
    is_random = False

    def draw(self, random):
        return 0.0

    def message_delay(self, sent, drawn):
        return 0.5 if sent.number == 0 else 0.0


@pytest.fixture
def silent(ring):
    clock = {"kind": "poisson", "rate": 4.0, "at": "nodes"}
    return ring.replace({"horizon": 5.0, "network.activation": clock, "filter": EverySecond()})


@pytest.mark.parametrize(
    "changes",
    [
        {"network.channel.loss": EveryThird()},
        {"network.channel.delay": SlowFirst()},
        {"network.radio": {"bits_per_second": 2000.0}},
    ],
    ids=["loss", "delay", "radio"],
)
def test_outcomes_that_other_messages_decide_need_simpy(silent, changes):
    """The compiled engine took the number of a tick for that of a message, in silence."""
    scenario = silent.replace(changes)
    assert netkf.simulate(scenario).engine == "simpy"
    with pytest.raises(netkf.EngineError, match="where nodes may be silent at a tick; use engine="):
        netkf.simulate(scenario, engine="compiled")


def test_outcomes_of_ticks_are_the_same_in_both_engines(silent):
    loss = {"kind": "gilbert-elliott", "mean_loss": 0.4, "mean_burst": 3.0}
    scenario = silent.replace({"network.channel.loss": loss})
    one, other = (netkf.simulate(scenario, engine=name) for name in ("simpy", "compiled"))
    pd.testing.assert_frame_equal(one.events, other.events)
    assert one.count("lost") > 5
