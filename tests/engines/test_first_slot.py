"""A user's own filter meets the losses that the built-in filter of its kind meets."""

import dataclasses
from dataclasses import dataclass

import numpy as np
import pytest

import netkf
from netkf.algorithms.registry import default_timing
from netkf.algorithms.traits import Timing
from netkf.parts import Filter, Needs, kinds

LOSSY = {"loss": {"kind": "bernoulli", "delivery": 0.6}}
PLANT = {"kind": "linear", "F": [[0.9]], "Q": [[1.0]], "period": 1.0, "cov": [[1.0]]}
SENSOR = {"nodes": [0, 2], "H": [[1.0]], "R": [[0.5]]}
GRAPH = {"kind": "cycle", "nodes": 5}


@dataclass(frozen=True, eq=False)
class Swap(Filter):
    """Gossip, written as users write it."""

    timing = Timing(schedule=("exchange", "sense", "predict"), predicts=True, pairwise=True)

    def absorb(self, state, messages, exchange):
        for message in messages:
            state = state._replace(xhat=message.payload.xhat, root=message.payload.root)
        return state


@dataclass(frozen=True, eq=False)
class Average(Filter):
    """Filtered estimates of all neighbours, as kcf has them."""

    needs = Needs(one_way=True)

    def absorb(self, state, messages, exchange):
        return state


@dataclass(frozen=True, eq=False)
class Predicted(Average):
    """Predictions of all neighbours, as diffusion has them."""

    timing = Timing(schedule=("sense", "predict", "exchange"), predicts=True)


OWN = {"gossip": Swap(), "kcf": Average(), "diffusion": Predicted()}


@pytest.mark.parametrize("kind", OWN)
def test_the_same_messages_are_lost(kind, build):
    pairs = kind == "gossip"
    activation = {"kind": "matching", "protocol": "maximal"} if pairs else {"kind": "broadcast"}
    table = {"kind": kind, **({"epsilon": 0.1} if kind == "kcf" else {})}
    built_in = build(
        plant=PLANT, sensors=[SENSOR], horizon=12.0, probe=1.0, filter=table,
        network={"graph": GRAPH, "activation": activation, "channel": LOSSY},
    )  # fmt: skip
    filtering = dataclasses.replace(built_in.filter, algorithm=OWN[kind])
    own = dataclasses.replace(built_in, filter=filtering)
    runs = [netkf.simulate(one, engine="simpy") for one in (built_in, own)]
    columns = ["t", "kind", "node", "peer", "message"]
    first, second = (run.events[columns].astype(str) for run in runs)
    assert first.equals(second)
    assert (first["kind"] == "lost").sum() > 5
    if pairs:
        np.testing.assert_allclose(runs[0].xhat, runs[1].xhat, atol=1e-12)
        np.testing.assert_allclose(runs[0].P, runs[1].P, atol=1e-12)


def test_own_filters_begin_where_built_in_ones_do():
    for name, cls in kinds()["filter"].items():
        timing = default_timing(cls)
        if timing is None or timing.schedule is None or not timing.talks:
            continue
        own = Timing(predicts=timing.predicts, pairwise=timing.pairwise)
        assert own.first_exchange == timing.first_exchange, name


def test_a_comparison_says_whose_losses_differ(build):
    scenario = build(
        plant=PLANT, sensors=[SENSOR], horizon=6.0, probe=1.0,
        filter={"kind": "kcf", "epsilon": 0.1},
        network={"graph": GRAPH, "activation": {"kind": "broadcast"}, "channel": LOSSY},
    )  # fmt: skip
    compared = [Average(), Predicted(), {"kind": "kcf", "epsilon": 0.1}]
    comparison = netkf.compare_filters(scenario, compared, runs=2, engine="simpy")
    assert comparison.table["same_losses"].tolist() == [True, False, True]
    sure = netkf.compare_filters(
        scenario.replace({"network.channel.loss": {"kind": "none"}}),
        compared,
        runs=2,
        engine="simpy",
    )
    assert sure.table["same_losses"].all()
