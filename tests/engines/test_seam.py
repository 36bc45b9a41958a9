"""What every engine promises: order, randomness, time."""

import random
import subprocess
import sys

import numpy as np
import pytest

import netkf
from netkf.engines.simpy.engine import SimpyEngine
from netkf.trace.schema import CODES
from tests.conftest import SCENARIOS

GRID = {"kind": "grid", "rows": 3, "columns": 3}


def same(one, other):
    assert netkf.first_difference(one, other) is None
    assert one.fingerprint == other.fingerprint
    for name in ("x", "xhat", "P"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def alike(one, other):
    """The same events, and states but for rounding: filters may move alone or many in lanes."""
    assert netkf.first_difference(one, other) is None
    assert one.fingerprint == other.fingerprint
    np.testing.assert_array_equal(one.x, other.x)
    close(one.xhat, other.xhat)
    close(one.P, other.P)


def close(one, other):
    np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-13 * np.abs(other).max())


def busy(ring):
    """Ties, delays, losses and jitter at once."""
    return ring.replace(
        {
            "horizon": 4.0,
            "network.activation": {"kind": "periodic", "period": 0.25},
            "network.channel.delay": {"kind": "uniform", "low": 0.0, "high": 0.4},
            "network.channel.symmetric": False,
        }
    )


def test_same_seed_same_bits(ring):
    same(netkf.simulate(ring), netkf.simulate(ring))
    other = netkf.simulate(ring, replica=1)
    assert other.fingerprint != netkf.simulate(ring).fingerprint


SLOTS = ("push_sum_planar", "gossip_ring", "diffusion_regression", "nonlinear/range_tracking")


@pytest.mark.parametrize("name", SLOTS)
def test_the_truth_in_slots_has_the_same_bits_in_both_engines(name):
    """Sums have one order: with frames or without, linear or not."""
    scenario = netkf.load(SCENARIOS / f"{name}.toml")
    period = scenario.plant.period
    scenario = scenario.replace({"horizon": 40 * period, "probe": period})
    one, other = (netkf.simulate(scenario, engine=engine) for engine in ("simpy", "compiled"))
    np.testing.assert_array_equal(one.x, other.x)


def test_same_bits_in_another_process(ring, tmp_path):
    code = (
        "import netkf, sys; s = netkf.load(sys.argv[1]); r = netkf.simulate(s);"
        "print(r.fingerprint, r.P.tobytes().hex()[-64:], r.xhat.tobytes().hex()[-64:])"
    )
    file = netkf.scenario.__path__[0] + "/../../scenarios/poisson_ring.toml"
    printed = subprocess.run(
        [sys.executable, "-c", code, file], check=True, capture_output=True, text=True
    ).stdout.split()
    run = netkf.simulate(ring)
    assert printed[0] == run.fingerprint
    assert printed[1:] == [a.tobytes().hex()[-64:] for a in (run.P, run.xhat)]


@pytest.mark.one_in(2)
@pytest.mark.parametrize("seed", range(5))
def test_order_in_which_processes_start_does_not_matter(ring, seed):
    def shuffled(processes):
        return random.Random(seed).sample(processes, len(processes))

    scenario = busy(ring)
    plain = netkf.simulate(scenario, engine=SimpyEngine())
    same(plain, netkf.simulate(scenario, engine=SimpyEngine(shuffled)))


def test_simultaneous_events_have_their_order(ring):
    log = netkf.simulate(busy(ring)).log
    assert (np.diff(log["t"]) >= 0.0).all()
    ranks = {CODES[k]: r for r, k in enumerate(("sense", "tick", "deliver", "absorb"))}
    for rows in np.split(log, np.flatnonzero(np.diff(log["t"])) + 1):
        order = [ranks[k] for k in rows["kind"].tolist() if k in ranks]
        # A message without delay is delivered in the same breath as it is sent.
        kept = [r for r in order if r != ranks[CODES["deliver"]]]
        assert kept == sorted(kept)
        absorbed = rows[rows["kind"] == CODES["absorb"]]["node"]
        assert len(set(absorbed.tolist())) == len(absorbed)


def test_a_message_is_known_by_its_link_and_number(ring):
    log = netkf.simulate(busy(ring)).log
    sent = log[log["kind"] == CODES["send"]]
    for link in {(int(r["node"]), int(r["peer"])) for r in sent}:
        mine = sent[(sent["node"] == link[0]) & (sent["peer"] == link[1])]["message"]
        assert mine.tolist() == list(range(len(mine)))
    lost = log[log["kind"] == CODES["lost"]]
    got = log[log["kind"] == CODES["deliver"]]
    keys = [(int(r["node"]), int(r["peer"]), int(r["message"])) for r in lost]
    keys += [(int(r["peer"]), int(r["node"]), int(r["message"])) for r in got]
    assert len(set(keys)) == len(keys) <= len(sent)
    assert 0 < len(lost) < len(sent)


def test_truth_does_not_depend_on_network_filter_or_losses(ring):
    base = netkf.simulate(ring)
    for changes in (
        {"network.activation.rate": 9.0},
        {"network.channel.loss.delivery": 0.1},
        {"filter": {"kind": "central"}},
        {"network.graph": {"kind": "complete", "nodes": 6}, "filter.epsilon": 0.1},
        {"filter.model": {"R": [[2.0]]}},
    ):
        np.testing.assert_array_equal(netkf.simulate(ring.replace(changes)).x, base.x)


def test_readings_do_not_depend_on_the_network(ring):
    """A node that nobody talks to estimates the same whatever the others do."""
    alone = [[0, 1], [1, 2], [2, 3], [3, 4], [4, 5]]
    edges = {"kind": "edges", "edges": alone, "nodes": 6}
    rates = [[i, j, 1e-9] for i, j in alone]
    quiet = ring.replace(
        {"network.graph": edges, "network.activation": {"kind": "poisson", "rates": rates}}
    )
    local = netkf.simulate(ring.replace({"filter": {"kind": "local"}}))
    close(netkf.simulate(quiet).xhat, local.xhat)


def test_a_new_node_shifts_no_other_stream(ring):
    edges = [[0, 1], [1, 2], [2, 3], [3, 4], [4, 5], [5, 0]]
    graph = {"kind": "edges", "edges": edges}
    wider = {"kind": "edges", "edges": [*edges, [5, 99]]}
    small, large = (
        netkf.simulate(ring.replace({"network.graph": g})).events for g in (graph, wider)
    )
    mine = large[(large.node != 99) & (large.peer != 99)]
    for kind in ("tick", "send", "lost", "sense"):
        one, other = (e[e.kind == kind][["t", "node", "peer", "message"]] for e in (small, mine))
        np.testing.assert_array_equal(one.to_numpy(), other.to_numpy())


def test_rates_scale_the_same_gaps(ring):
    slow, fast = (
        netkf.simulate(ring.replace({"network.activation.rate": rate, "horizon": h})).events
        for rate, h in ((1.0, 16.0), (4.0, 4.0))
    )
    times = [
        e[(e.kind == "tick") & (e.node == 0) & (e.peer == 1)].t.to_numpy() for e in (slow, fast)
    ]
    np.testing.assert_allclose(times[0], 4.0 * times[1], rtol=1e-12)


def test_erlang_of_shape_one_is_the_poisson_clock(ring):
    erlang = {"kind": "renewal", "distribution": "gamma", "shape": 1.0, "rate": 2.0}
    alike(netkf.simulate(ring), netkf.simulate(ring.replace({"network.activation": erlang})))


def test_recorded_ticks_and_losses_replay_a_run(ring, tmp_path):
    run = netkf.simulate(ring)
    events = run.events
    events[events.kind == "tick"][["t", "node", "peer"]].to_csv(tmp_path / "ticks.csv", index=False)
    lost = events[events.kind == "lost"][["node", "peer", "message"]].assign(delivered=0)
    lost.columns = ["sender", "receiver", "message", "delivered"]
    lost.to_csv(tmp_path / "lost.csv", index=False)
    replay = ring.replace(
        {
            "network.activation": {"kind": "recorded", "path": tmp_path / "ticks.csv"},
            "network.channel.loss": {"kind": "recorded", "path": tmp_path / "lost.csv"},
        }
    )
    alike(run, netkf.simulate(replay))


def test_horizon_is_half_open(build):
    clock = {"kind": "periodic", "period": 0.5}
    scenario = build(
        horizon=2.0,
        network={"graph": {"kind": "path", "nodes": 2}, "activation": clock},
    )
    run = netkf.simulate(scenario)
    ticks = run.log[run.log["kind"] == CODES["tick"]]["t"]
    assert ticks.tolist() == [0.5, 1.0, 1.5]  # none at 0, none at the horizon
    assert run.times[-1] == 2.0
    longer = netkf.simulate(scenario.replace({"horizon": 3.0}))
    assert not np.array_equal(longer.P[4], run.P[4])  # the tick at 2.0 is inside now
    np.testing.assert_array_equal(longer.x[:5], run.x)


def test_one_node_is_the_kalman_bucy_filter(build):
    """Whatever the filter's name: local, central and a hybrid without links coincide."""
    graph = {"graph": {"kind": "complete", "nodes": 1}}
    runs = [
        netkf.simulate(build(network=graph, filter={"kind": kind})) for kind in ("local", "central")
    ]
    hybrid = {"kind": "hybrid", "epsilon": 0.5}
    clocks = {**graph, "activation": {"kind": "poisson", "rate": 1.0}}
    runs.append(netkf.simulate(build(network=clocks, filter=hybrid)))
    for run in runs[1:]:
        close(run.xhat, runs[0].xhat)
        close(run.P, runs[0].P)
    closed = netkf.theory.riccati_flow([[1.0]], [[-0.5]], [[1.0]], [[2.0]], 3.0)
    np.testing.assert_allclose(runs[0].P[-1, 0], closed, rtol=1e-12)


def test_growth_beyond_numbers_is_reported(build):
    scenario = build(
        horizon=600.0,
        probe=10.0,
        plant={"kind": "diffusion", "A": [[2.0]], "B": [[1.0]], "cov": [[1.0]]},
        filter={"kind": "local"},
    )
    run = netkf.simulate(scenario)
    assert run.status == "diverged"
    assert run.events.kind.iloc[-1] == "diverged"
    assert run.events.node.iloc[-1] == 1
