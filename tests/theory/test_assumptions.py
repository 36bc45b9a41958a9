"""Rows of assumptions under clocks, and "not known" for what a record does not show."""

import dataclasses
import math

import pytest

import netkf
from netkf import parts, theory
from netkf.network import channels
from netkf.scenario.reading import from_table
from tests.conftest import SCENARIOS

PATH = {"kind": "path", "nodes": 2}


def holds(scenario):
    table = theory.assumptions(scenario)
    return dict(zip(table.assumption, table.holds, strict=True))


@pytest.mark.parametrize("at", ["links", "directions", "nodes"])
def test_clocks_are_named_by_what_has_them(build, at):
    activation = {"kind": "poisson", "rate": 2.0, "at": at}
    rows = holds(build(network={"graph": PATH, "activation": activation}))
    assert rows[f"the rates of all {at} are positive"]
    assert rows[f"the {at[:-1]} clocks are independent Poisson processes"]


@pytest.mark.parametrize("unit", [1.0, 1e-6, 1e6])
@pytest.mark.parametrize("share", [0.25, 1.0, 2.0])
def test_a_start_that_is_too_sure_is_so_in_any_unit(build, unit, share):
    variance = unit * unit
    plant = {"A": [[-0.1]], "B": [[unit]], "cov": [[variance]]}
    sensor = {"nodes": [0], "H": [[1.0 / unit]], "R": [[1.0]]}
    scenario = build(
        plant={"kind": "diffusion", **plant},
        sensors=[{**sensor, "sampling": {"kind": "poisson", "rate": 1.0}}],
        filter={"kind": "hybrid", "epsilon": 0.5, "cov": [[share * variance]]},
    )
    row = "P_i(0) >= E[(x(0) - xhat_i(0))(x(0) - xhat_i(0))']"
    assert holds(scenario)[row] is (share >= 1.0)


def test_sampling_has_a_row(build):
    name = "sensors sample by Poisson clocks or at known times"
    for sampling, expected in (
        ({"kind": "poisson", "rate": 2.0}, True),
        ({"kind": "periodic", "period": 0.5}, True),
        ({"kind": "periodic", "period": 0.5, "jitter": 0.1}, False),
    ):
        sensors = [{"nodes": [0], "H": [[1.0]], "R": [[0.5]], "sampling": sampling}]
        rows = holds(build(sensors=sensors))
        assert rows[name] is expected


def test_records_leave_their_law_unknown(build, tmp_path):
    (tmp_path / "y.csv").write_text("t,node,y0\n0.5,0,1.0\n1.1,0,0.3\n")
    (tmp_path / "ticks.csv").write_text("t,node,peer\n0.7,0,1\n")
    (tmp_path / "lost.csv").write_text("sender,receiver,message,delivered\n0,1,0,1\n")
    (tmp_path / "delays.csv").write_text("sender,receiver,message,seconds\n0,1,0,0.1\n")
    scenario = build(
        plant={"kind": "unknown", "A": [[-0.5]], "B": [[1.0]], "mean": [0.0], "cov": [[1.0]]},
        sensors=[{"nodes": [0], "kind": "recorded", "path": "y.csv", "H": [[1.0]], "R": [[0.5]]}],
        network={
            "graph": PATH,
            "activation": {"kind": "recorded", "path": "ticks.csv"},
            "channel": {
                "loss": {"kind": "recorded", "path": "lost.csv"},
                "delay": {"kind": "recorded", "path": "delays.csv"},
            },
        },
    )
    rows = holds(scenario)
    known = {name for name, value in rows.items() if value is not None}
    assert known <= {
        "the graph is undirected and connected",
        "Pi is doubly stochastic, 0 < epsilon <= 1/max degree",
        "sensors sample by Poisson clocks or at known times",
    }


class NoLoss(channels.NoLoss):
    """A loss of its own that bears the name of the lossless one."""

    deterministic = False

    def delivery_probability(self, sent):
        return 0.5


def test_only_the_channel_without_losses_makes_every_exchange_a_swap():
    scenario = netkf.load(SCENARIOS / "gossip_ring.toml")
    assert holds(scenario)["every exchange is a swap"]
    channel = channels.Channel(loss=NoLoss(), symmetric=False)
    network = dataclasses.replace(scenario.network, channel=channel)
    assert not holds(dataclasses.replace(scenario, network=network))["every exchange is a swap"]


LATE = {"kind": "uniform", "low": 0.0, "high": 0.9}
PAIRS = {
    "nothing is lost": ({"loss": {"kind": "bernoulli", "delivery": 1.0}, "symmetric": False}, True),
    "all are late": ({"delay": {"kind": "constant", "seconds": 0.9}, "symmetric": False}, True),
    "one is late": ({"delay": LATE, "symmetric": False}, False),
    "both are late": ({"delay": LATE}, True),
    "one is lost": ({"loss": {"kind": "per-link"}}, False),
    "one is lost at times": ({"loss": {"kind": "scheduled", "path": "times.csv"}}, None),
    "both are lost": ({"loss": {"kind": "gilbert-elliott", "to_bad": 0.2, "to_good": 0.4}}, True),
}


@pytest.mark.parametrize("kind", ["gossip", "push-sum"])
@pytest.mark.parametrize("case", PAIRS)
def test_both_messages_of_an_exchange_arrive_or_none(case, kind, tmp_path):
    rows = ["sender,receiver,delivery_probability", "0,1,0.3", "1,0,0.9", "1,2,0.5", "2,1,0.5"]
    (tmp_path / "links.csv").write_text("\n".join(rows))
    (tmp_path / "times.csv").write_text("from,until,sender,receiver,delivery\n0,5,0,1,0.5")
    channel, expected = PAIRS[case]
    pairwise, sizes = kind == "gossip", {} if kind == "gossip" else {"gamma": 1, "delta": 4.0}
    slots = {"kind": "matching", "protocol": "one-edge"} if pairwise else {"kind": "broadcast"}
    graph = {"kind": "csv", "path": "links.csv"}
    table = {
        **{"format": 1, "name": "pairs", "horizon": 9.0, "probe": 1.0},
        "plant": {"kind": "linear", "F": [[0.9]], "Q": [[1.0]], "period": 1.0},
        "sensors": [{"nodes": [0], "H": [[1.0]], "R": [[1.0]]}],
        "network": {"graph": graph, "activation": slots, "channel": channel},
        "filter": {"kind": kind, **sizes},
    }
    found = holds(from_table(table, tmp_path))
    name = "every exchange is a swap" if pairwise else "both directions of a link fail together"
    assert found[name] is expected


@dataclasses.dataclass(frozen=True, eq=False)
class Fades(parts.Loss):
    """Says nothing of the mean: message 0 is no measure for those that follow."""

    def delivery_probability(self, sent):
        return 1.0 if sent.time < 1.0 else 0.2


@dataclasses.dataclass(frozen=True, eq=False)
class Unsaid(parts.Loss):
    """Says that the mean is unknown, of the links of node 0 or of all."""

    of_node_0: bool = parts.setting(parts.boolean, default=False)

    def delivery_probability(self, sent):
        return 0.7

    def mean_delivery(self, sent):
        return math.nan if not self.of_node_0 or 0 in sent.link else 0.7


@dataclasses.dataclass(frozen=True, eq=False)
class Moody(parts.Loss):
    """Has states, and says nothing of their law."""

    stateful = True

    def next_state(self, link, bad, random):
        return random.random() < 0.3

    def delivery_probability(self, sent):
        return 0.1 if sent.bad else 1.0


@dataclasses.dataclass(frozen=True, eq=False)
class Weather(parts.Loss):
    """Has one delivery for all messages of a run, and says nothing of its law."""

    def conditions(self, random, horizon):
        return random.random()

    def delivery_probability(self, sent):
        return sent.conditions


@pytest.mark.parametrize(
    "loss", [Fades(), Unsaid(), Unsaid(of_node_0=True), Moody(), Weather()], ids=repr
)
def test_what_a_loss_does_not_say_theory_does_not_know(loss):
    """It took message 0 for all, and nan for a link that carries nothing."""
    for name in ("poisson_ring", "intermittent_scalar", "diffusion_regression", "push_sum_planar"):
        scenario = netkf.load(SCENARIOS / f"{name}.toml").replace({"network.channel.loss": loss})
        table = theory.assumptions(scenario)
        arrives = table.assumption.str.contains("arriv|arrive|p_d|fail anew|unbiased|mean square$")
        assert arrives.any()
        allowed = (False, None) if not loss.independent else (None,)
        certified = table.assumption.str.contains("certified|averaging")
        assert all(held in allowed for held in table.holds[arrives & ~certified]), table
        if name == "poisson_ring":
            with pytest.raises(netkf.TheoryError, match="arrive is not known beforehand"):
                theory.covariance_bound(scenario, [1.0])
            verdict = netkf.check(scenario.replace({"horizon": 4.0}), runs=10, workers=1)
            rows = verdict.table.set_index("promise").verdict
            assert bool(verdict)
            assert rows[rows.index.str.contains("lost as often|Riccati")].eq("not promised").all()
