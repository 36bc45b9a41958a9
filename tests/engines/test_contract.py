"""What a filter may do in every model of time, on the SimPy engine, by filters that keep books."""

import numpy as np
import pytest

import netkf
from netkf.scenario.reading import from_table
from tests.engines.ledgers import DEGREE, DISORDER, EMITTED, HEARD, MASS, NODE

NODES = (0, 1, 2, 3, 4)
DEGREES = (2, 2, 3, 2, 1)
EYE, NONE = np.eye(6).tolist(), np.zeros((6, 6)).tolist()
SLOTS = {"kind": "linear", "F": EYE, "Q": NONE, "period": 1.0, "cov": EYE}
CLOCKS = {"kind": "diffusion", "A": NONE, "B": NONE, "cov": EYE}
POISSON = {"kind": "poisson", "rate": 2.0}
ACTIVATIONS = {
    "broadcast": (SLOTS, "Ledger", {"kind": "broadcast"}),
    "matching": (SLOTS, "PairLedger", {"kind": "matching", "protocol": "maximal"}),
    "links": (CLOCKS, "Ledger", POISSON),
    "directions": (CLOCKS, "Ledger", {**POISSON, "at": "directions"}),
    "nodes": (CLOCKS, "Ledger", {**POISSON, "at": "nodes"}),
    "readings": (CLOCKS, "Ledger", {"kind": "readings"}),
}


def simulated(name, folder, **settings):
    plant, cls, activation = ACTIVATIONS[name]
    sensor = {"nodes": list(NODES), "H": [[1.0] + [0.0] * 5], "R": [[1.0]]}
    if plant is CLOCKS:
        sensor["sampling"] = POISSON
    edges = [[0, 1], [1, 2], [2, 0], [2, 3], [3, 4]]
    table = {
        "format": 1,
        "name": "ledger",
        "horizon": 12.0,
        "probe": 1.0,
        "plant": plant,
        "sensors": [sensor],
        "network": {"graph": {"kind": "edges", "edges": edges}, "activation": activation},
        "filter": {"kind": f"tests.engines.ledgers:{cls}", **settings},
    }
    return netkf.simulate(from_table(table, folder), engine="simpy")


def last(run, name):
    """The ledgers at the end; in slots those of the last slot whose exchanges the trace
    shows, since the one at the horizon makes a sample only.
    """
    return run.xhat[-2 if name in ("broadcast", "matching") else -1]


def sent(run, name):
    """How often each node transmitted, by the trace."""
    events = run.events
    if name in ("nodes", "readings"):
        events = events[events.kind == "transmit"]
        return [int((events.node == node).sum()) for node in NODES]
    events = events[events.kind == "send"]
    each = DEGREES if name == "broadcast" else [1] * 5
    return [int((events.node == node).sum()) / each[node] for node in NODES]


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_a_node_knows_itself_and_remembers_what_it_sent(name, tmp_path):
    run = simulated(name, tmp_path)
    assert run.status == "complete"
    np.testing.assert_array_equal(run.xhat[:, :, NODE], np.tile(NODES, (len(run.xhat), 1)))
    np.testing.assert_array_equal(run.xhat[:, :, DEGREE], np.tile(DEGREES, (len(run.xhat), 1)))
    assert last(run, name)[:, EMITTED].tolist() == sent(run, name)
    assert last(run, name)[:, EMITTED].min() > 3
    heard = [int(((run.events.kind == "deliver") & (run.events.node == i)).sum()) for i in NODES]
    assert last(run, name)[:, HEARD].tolist() == heard
    assert not run.xhat[:, :, DISORDER].any()


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_mass_leaves_a_node_that_sends_it(name, tmp_path):
    """No message is lost or takes time: what nodes hold stays fifteen."""
    run = simulated(name, tmp_path)
    mass = run.xhat[:, :, MASS]
    np.testing.assert_allclose(mass.sum(axis=1), 15.0, rtol=1e-14)
    assert np.abs(np.diff(mass, axis=0)).max() > 0.1
    assert (mass > 0.0).all()


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_a_node_may_send_nothing(name, tmp_path):
    """Others hear nothing of it, the trace shows no message, and its clock ticks all the same."""
    run = simulated(name, tmp_path, silent=True)
    silent, events = [1, 3], run.events
    out = events[events.kind.isin(["send", "transmit"])]
    assert len(out) > 0
    assert not out.node.isin(silent).any()
    assert not events[events.kind == "deliver"].peer.isin(silent).any()
    assert not run.xhat[:, silent, EMITTED].any()
    assert last(run, name)[[0, 2, 4], EMITTED].tolist() == [sent(run, name)[k] for k in (0, 2, 4)]
    assert (last(run, name)[silent, HEARD] > 0).any()
    np.testing.assert_allclose(run.xhat[:, :, MASS].sum(axis=1), 15.0, rtol=1e-14)
    if name in ("links", "directions", "nodes"):
        assert events[events.kind == "tick"].node.isin(silent).any()


def test_an_exchange_says_which_step_it_is(tmp_path):
    eye = np.eye(2).tolist()
    table = {
        "format": 1,
        "name": "steps",
        "horizon": 5.0,
        "probe": 1.0,
        "plant": {"kind": "linear", "F": eye, "Q": eye, "period": 1.0, "cov": eye},
        "sensors": [{"nodes": [0], "H": [[1.0, 0.0]], "R": [[1.0]]}],
        "network": {"graph": {"kind": "path", "nodes": 3}, "activation": {"kind": "broadcast"}},
        "filter": {"kind": "tests.engines.ledgers:Steps"},
    }
    run = netkf.simulate(from_table(table, tmp_path), engine="simpy")
    np.testing.assert_array_equal(run.xhat[:, :, 0], np.outer([0, 4, 8, 12, 16, 20], [1, 1, 1]))
    assert (run.xhat[:, :, 1] == 1.0).all()
