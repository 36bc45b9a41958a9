"""Filters whose nodes are silent by what they know: both engines send the same messages."""

import math

import numpy as np
import pytest

import netkf
from netkf.algorithms.kalman_consensus import Kcf
from netkf.algorithms.stochastic_trigger import StochasticTrigger
from netkf.engines.compiled.engine import CompiledEngine
from netkf.scenario.reading import from_table
from netkf.trace.schema import CODES
from tests.algorithms.test_literature import GRAPH, scenario_of
from tests.conftest import with_slow
from tests.engines.agreement import assert_agree

CONSENSUS = {"kind": "event-triggered", "trigger": "consensus", "thresholds": [1.0, 3.0]}
INNER = {
    "intermittent": {"kind": "intermittent"},
    "hcmci": {"kind": "hcmci", "steps": 2},
    "diffusion-kalman": {"kind": "diffusion-kalman"},
    "cross-covariance": {"kind": "track-fusion", "rule": "cross-covariance"},
    "belief-propagation": {"kind": "belief-propagation", "steps": 2},
    "diffusion": {"kind": "diffusion"},
    "gossip": {"kind": "gossip"},
    "push-sum": {"kind": "push-sum", "gamma": 2, "delta": 5.0},
    "push-sum-paper": {
        **{"kind": "push-sum", "gamma": 2, "delta": 5.0, "stop": "paper", "tolerance": 0.01}
    },
    "push-sum-totals": {"kind": "push-sum", "gamma": 2, "delta": 5.0, "running_sums": True},
    "push-sum-asymptotic": {"kind": "push-sum", "gamma": 2, "delta": 5.0, "asymptotic": True},
    "one-bit": {"kind": "one-bit"},
    "consensus": CONSENSUS,
}
"""Push-sum exchanges before and after the reading; diffusion and gossip predict last. All flags of
Kernels are set for one of them, and filters without any are three.
"""

ONE_WAY = {"graph": {"kind": "edges", "edges": [[0, 1], [1, 2], [2, 0], [3, 4], [1, 4]]}}
ONE_WAY["graph"]["directed"] = True
CHANNELS = {
    "sure": {},
    "lossy": {"loss": {"kind": "bernoulli", "delivery": 0.7}, "symmetric": False},
    "bursts": {"loss": {"kind": "gilbert-elliott", "mean_loss": 0.3, "mean_burst": 2.5}},
    # Half an exchange lasts 0.125 s or more: some are in time.
    "late": {"delay": {"kind": "exponential", "mean": 0.1}},
}


def triggered(inner, Y=2.0):
    return {"kind": "event-triggered", "trigger": "stochastic", "inner": inner, "Y": Y}


def filter_of(name):
    return CONSENSUS if name == "consensus" else triggered(INNER[name])


def network_of(name, **channel):
    activation = {"kind": "broadcast"}
    if name == "gossip":
        activation = {"kind": "matching", "protocol": "maximal"}
    return {"graph": GRAPH, "activation": activation, "channel": channel}


def assert_batch(scenario, runs=9):
    """Runs side by side are what they are alone; returns the batch."""
    (batch,) = CompiledEngine().run_many(scenario, 1, range(runs), True)
    for k in (0, runs - 1):
        alone = netkf.simulate(scenario, seed=1, replica=k, engine="compiled")
        for name in ("x", "xhat", "P", "error"):
            np.testing.assert_array_equal(getattr(batch, name)[k], getattr(alone, name))
        for kind, code in CODES.items():
            assert batch.counts[k, code] == alone.count(kind), kind
    assert batch.fingerprint == netkf.simulate(scenario, seed=1, engine="compiled").fingerprint
    return batch


LONG = ("belief-propagation", "cross-covariance", "hcmci", "consensus", "push-sum")
"""Inner filters that take long to compile, and are compiled without a trigger anyway."""


@pytest.mark.one_in(8)
@pytest.mark.parametrize("name", with_slow(INNER, LONG))
def test_both_engines_send_the_same(name, tmp_path):
    """Node 2 has two sensors, node 4 none."""
    for seed, (channel, n) in enumerate(zip(CHANNELS, (2, 5, 1, 2), strict=True)):
        scenario = scenario_of(
            filter_of(name), tmp_path, seed, n, horizon=30.0, probe=1.0,
            network=network_of(name, **CHANNELS[channel]),
        )  # fmt: skip
        run = assert_agree(scenario)
        alone = (
            INNER[name] if name != "consensus" else {"kind": "hcmci", "consensus": "information"}
        )
        every = netkf.simulate(scenario.replace({"filter": alone}))
        # Some are silent, and some send after the first slots.
        late = run.log[(run.log["kind"] == CODES["send"]) & (run.log["t"] > 5.0)]
        assert len(late) > 0
        assert run.count("send") < every.count("send")
        if channel != "late":
            assert_batch(scenario)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["intermittent", "hcmci", "diffusion", "consensus"])
def test_links_of_one_direction(name, tmp_path):
    """Node 3 hears nobody, and nobody hears node 4."""
    network = {**ONE_WAY, "activation": {"kind": "broadcast"}, "channel": CHANNELS["lossy"]}
    scenario = scenario_of(filter_of(name), tmp_path, 1, horizon=25.0, probe=1.0, network=network)
    assert_agree(scenario)
    assert_batch(scenario)


@pytest.mark.slow
@pytest.mark.one_in(16)
@pytest.mark.parametrize("name", with_slow(INNER, {"belief-propagation", "cross-covariance"}))
def test_frames_of_unstable_plants(name, tmp_path):
    """The origin moves, and with it everything that a trigger keeps."""
    F = [[1.4, 0.3], [0.0, 0.9]]
    plant = {"kind": "linear", "F": F, "Q": [[0.2, 0.0], [0.0, 0.1]], "period": 1.0}
    sensors = [{"nodes": [0, 1, 2, 3, 4], "H": [[1.0, 0.2]], "R": [[0.4]]}]
    scenario = scenario_of(
        filter_of(name), tmp_path, 3, horizon=90.0, probe=1.0, plant=plant, sensors=sensors,
        network=network_of(name, loss={"kind": "bernoulli", "delivery": 0.9}),
    )  # fmt: skip
    run = assert_agree(scenario)
    assert run.exact_errors
    assert np.abs(run.x).max() > 1e9
    assert_batch(scenario)


MATRIX = [[2.0, 0.5], [0.5, 1.0]]


@pytest.mark.one_in(3)
@pytest.mark.parametrize("inner", ["intermittent", "kcf", "push-sum"])
def test_triggers_that_are_matrices(inner, tmp_path):
    sensors = [
        {
            "nodes": [0, 1, 3],
            "H": [[1.0, 0.0], [0.3, 1.0]],
            "R": [[0.5, 0.2], [0.2, 0.3]],
        }
    ]
    table = triggered(INNER.get(inner, {"kind": inner}), MATRIX)
    scenario = scenario_of(
        table, tmp_path, 2, horizon=30.0, probe=1.0, sensors=sensors,
        network=network_of(inner, **CHANNELS["lossy"]),
    )  # fmt: skip
    run = assert_agree(scenario)
    assert run.count("send") > 0
    assert_batch(scenario)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", ["hcmci", "gossip"])
def test_readings_that_are_missing(name, tmp_path):
    """Recorded sensors without rows for some slots, on node 2 beside one that always reads."""
    random = np.random.default_rng(7)
    rows = [
        f"{slot},{node},{random.normal():.3f},{random.normal():.3f}"
        for slot in range(1, 30)
        for node in (1, 2, 3)
        if random.random() < 0.6
    ]
    (tmp_path / "read.csv").write_text("\n".join(["t,node,y0,y1", *rows]) + "\n")
    recorded = {"kind": "recorded", "path": "read.csv", "nodes": [1, 2, 3]}
    sensors = [
        {"nodes": [0, 2], "H": [[1.0, 0.5]], "R": [[0.3]]},
        {**recorded, "H": [[1.0, 0.0], [0.3, 1.0]], "R": [[0.5, 0.2], [0.2, 0.3]]},
    ]
    scenario = scenario_of(
        filter_of(name), tmp_path, 2, horizon=30.0, probe=1.0, sensors=sensors,
        network=network_of(name, **CHANNELS["lossy"]),
    )  # fmt: skip
    assert_agree(scenario)
    both = [{**sensor, "nodes": [2]} for sensor in sensors]
    (tmp_path / "read.csv").write_text("t,node,y0,y1\n1,2,0.1,0.2\n")
    with pytest.raises(netkf.ScenarioError, match=r"filter\.Y: must be a number, because some"):
        scenario_of(
            triggered(INNER[name], np.eye(3).tolist()), tmp_path, horizon=30.0, sensors=both,
            network=network_of(name),
        )  # fmt: skip


def test_exchanges_that_are_listed(tmp_path):
    """Who is in no pair is not asked, and draws no number."""
    random = np.random.default_rng(3)
    pairs = [(0, 1), (2, 3), (3, 4), (1, 2)]
    rows = [f"{k},{i},{j}" for k in range(30) for i, j in (pairs[random.integers(4)],)]
    (tmp_path / "pairs.csv").write_text("\n".join(["slot,node,peer", *rows]) + "\n")
    network = {"graph": GRAPH, "activation": {"kind": "recorded", "path": "pairs.csv"}}
    run = assert_agree(
        scenario_of(filter_of("gossip"), tmp_path, 1, network=network, horizon=30.0, probe=1.0)
    )
    assert 0 < run.count("send") < 2 * run.count("tick")
    rows = [
        f"{k},0,{step},{i},{j}"
        for k in range(1, 30)
        for step in range(2)
        for i, j in (*pairs, (0, 2))
        if random.random() < 0.7
    ]
    (tmp_path / "up.csv").write_text("\n".join(["slot,phase,step,node,peer", *rows]) + "\n")
    network["activation"] = {"kind": "recorded", "path": "up.csv"}
    run = assert_agree(
        scenario_of(filter_of("hcmci"), tmp_path, 1, network=network, horizon=30.0, probe=1.0)
    )
    assert run.count("lost") > 0


SCALAR = {
    "plant": {"kind": "linear", "F": [[0.9]], "Q": [[0.5]], "cov": [[1.0]], "period": 1.0},
    "sensors": [{"nodes": [0], "H": [[1.0]], "R": [[0.4]]}],
    "network": {
        "graph": {"kind": "edges", "edges": [[0, 1]]},
        "activation": {"kind": "broadcast"},
    },
}


def test_the_rate_of_han_in_many_runs(tmp_path):
    """1 - (1 + Pi Y)^-1/2 given the past, summed over 256 runs of 200 slots."""
    Y, runs = 2.0, 256
    scenario = scenario_of(
        triggered(INNER["intermittent"], Y), tmp_path, n=1, horizon=201.0, probe=1.0, **SCALAR
    )
    (batch,) = CompiledEngine().run_many(scenario, 5, range(runs), False)
    # Pi from the P of the slot before; the first slot with an exchange sends in any case.
    P = 0.81 * batch.P[:, 1:-2, 1, 0, 0] + 0.5
    p = 1.0 - 1.0 / np.sqrt(1.0 + (P + 0.4) * Y)
    count = int(batch.counts[:, CODES["send"]].sum()) - runs
    # Node 1 has no sensor and sends nothing.
    z = (count - p.sum()) / math.sqrt((p * (1.0 - p)).sum())
    assert 0.3 < p.mean() < 0.8
    assert abs(z) < 4.0
    # It sees coins that fall on silence three times in a hundred too often.
    assert 0.03 * (1.0 - p).sum() > 5.0 * math.sqrt((p * (1.0 - p)).sum())


def test_a_silent_node_with_running_sums_loses_no_mass(tmp_path):
    """A message that is not sent is one that is lost: totals only postpone."""
    scenario = scenario_of(
        filter_of("push-sum-totals"), tmp_path, 1, horizon=40.0, probe=1.0,
        network=network_of("push-sum"),
    )  # fmt: skip
    for engine in ("simpy", "compiled"):
        run = netkf.simulate(scenario, engine=engine)
        assert run.count("send") < 0.9 * 40 * 3 * 2 * len(scenario.topology.links)
        for before, after in run.sums.values():
            assert after == pytest.approx(before, rel=1e-12)


class Empty(Kcf):
    """A filter of one's own with the verbs of another one."""


class Own(Kcf):
    """A filter with a verb in plain Python."""

    def absorb(self, state, messages, exchange):
        return super().absorb(state, messages[:1], exchange)


def test_filters_in_plain_python_inside_are_not_compiled(tmp_path):
    scenario = scenario_of(triggered({"kind": "kcf"}), tmp_path)
    empty = scenario.replace({"filter": StochasticTrigger(Empty(), 1.0)})
    assert_agree(empty)
    own = scenario.replace({"filter": StochasticTrigger(Own(), 1.0)})
    runs = [netkf.simulate(one) for one in (scenario, empty, own)]
    assert [run.engine for run in runs] == ["compiled", "compiled", "simpy"]
    with pytest.raises(netkf.EngineError, match="has no code for the filter"):
        netkf.simulate(own, engine="compiled")


def test_readings_of_which_values_are_missing(tmp_path):
    """News are weighed by the rows that are there, which SimPy alone knows."""
    (tmp_path / "y.csv").write_text("t,node,y0,y1\n0,0,0.5,1.0\n1,0,,0.3\n2,0,0.4,\n3,0,1.0,1.0\n")
    sensor = {"kind": "recorded", "path": "y.csv", "nodes": [0], "H": [[1.0], [0.5]]}
    table = {
        **{"format": 1, "name": "missing", "horizon": 4.0, "probe": 1.0},
        "plant": {"kind": "linear", "F": [[0.9]], "Q": [[0.1]], "period": 1.0, "cov": [[1.0]]},
        "sensors": [sensor | {"R": [[0.2, 0.1], [0.1, 0.3]]}],
        "network": {"graph": {"kind": "path", "nodes": 2}, "activation": {"kind": "broadcast"}},
        "filter": triggered({"kind": "diffusion"}),
    }
    scenario = from_table(table, tmp_path)
    assert netkf.simulate(scenario).engine == "simpy"
    with pytest.raises(netkf.EngineError, match="whose rows or R differ"):
        netkf.simulate(scenario, engine="compiled")
    with pytest.raises(netkf.ScenarioError, match=r"filter\.Y: must be a number"):
        scenario.replace({"filter.Y": [[2.0, 0.0], [0.0, 2.0]]})
