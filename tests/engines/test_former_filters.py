"""Classes of the former contracts go on working, with the numbers they always had."""

import numpy as np
import pytest

import netkf
from netkf.core.errors import ScenarioError
from netkf.scenario.reading import from_table
from netkf.testing import check_filter
from tests.engines import former_filters

RING = {
    "format": 1,
    "name": "ring",
    "horizon": 4.0,
    "probe": 1.0,
    "plant": {
        "kind": "diffusion",
        "A": [[0.0, 1.0], [-1.0, 0.1]],
        "B": [[0.0], [1.0]],
        "cov": [[1.0, 0.0], [0.0, 1.0]],
    },
    "sensors": [{"nodes": [0, 2], "H": [[1.0, 0.0]], "R": [[0.25]]}],
    "network": {
        "graph": {"kind": "cycle", "nodes": 4},
        "activation": {"kind": "poisson", "rate": 3.0},
        "channel": {
            "loss": {"kind": "bernoulli", "delivery": 0.8},
            "delay": {"kind": "constant", "seconds": 0.1},
        },
    },
    "filter": {"kind": "hybrid", "epsilon": 0.3},
}
GOSSIP = {
    "format": 1,
    "name": "three",
    "horizon": 12.0,
    "probe": 1.0,
    "plant": {
        "kind": "linear",
        "F": [[1.1, 0.2], [0.0, 0.95]],
        "Q": [[1.0, 0.0], [0.0, 0.5]],
        "period": 1.0,
        "cov": [[1.0, 0.0], [0.0, 1.0]],
    },
    "sensors": [
        {"nodes": [0], "H": [[1.0, 0.0]], "R": [[0.5]]},
        {"nodes": [2], "H": [[0.3, 1.0]], "R": [[1.0]]},
    ],
    "network": {
        "graph": {"kind": "cycle", "nodes": 3},
        "activation": {"kind": "matching", "protocol": "one-edge", "lazy": 0.2},
    },
    "filter": {"kind": "gossip"},
}


def simulated(table, folder, cls=None, **changes):
    if cls is not None:
        table = {
            **table,
            "filter": {**table["filter"], "kind": f"tests.engines.former_filters:{cls}"},
        }
    return netkf.simulate(from_table(table, folder).replace(changes), engine="simpy")


def test_the_examples_of_the_former_documentation_give_what_they_gave(tmp_path):
    """Node 1 at the end, from the last version with these contracts."""
    run = simulated(RING, tmp_path, "OwnReset")
    P = [[14.3069379360885, 1.5291522792891563], [1.5291522792891563, 12.871263287157971]]
    np.testing.assert_allclose(run.P[-1, 1], P, rtol=1e-12)
    np.testing.assert_array_equal(run.xhat[-1, 1], 0.0)
    run = simulated(GOSSIP, tmp_path, "OwnSwap")
    P = [[5.584687978059472, 2.0974289887230912], [2.0974289887230912, 5.81565903698391]]
    np.testing.assert_allclose(run.P[-1, 1], P, rtol=1e-12)
    np.testing.assert_allclose(
        run.xhat[-1, 1], [-8.992306474193665, -1.0667946434640057], rtol=1e-12
    )


@pytest.mark.parametrize(
    ("table", "cls", "tolerance"),
    [(RING, "SoundReset", 1e-9), (GOSSIP, "SoundSwap", 1e-12)],
    ids=["flow", "slot"],
)
def test_former_filters_agree_with_the_built_in_ones(table, cls, tolerance, tmp_path):
    built_in, former = simulated(table, tmp_path), simulated(table, tmp_path, cls)
    assert former.status == built_in.status == "complete"
    assert former.events.equals(built_in.events)
    np.testing.assert_allclose(former.P, built_in.P, rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(former.xhat, built_in.xhat, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("at", ["directions", "nodes"])
def test_former_flow_filters_run_under_the_clocks_that_came_later(at, tmp_path):
    changes = {"network.activation.at": at}
    built_in = simulated(RING, tmp_path, **changes)
    former = simulated(RING, tmp_path, "SoundReset", **changes)
    assert former.events.equals(built_in.events)
    np.testing.assert_allclose(former.xhat, built_in.xhat, rtol=1e-9, atol=1e-9)


def test_a_former_filter_learns_its_place(tmp_path):
    run = simulated({**GOSSIP, "horizon": 1.0}, tmp_path, "Placed")
    np.testing.assert_array_equal(run.xhat[0], [[0.5, 0.5], [1.5, 1.5], [2.5, 2.5]])


def test_former_filters_are_refused_where_they_cannot_run(tmp_path):
    with pytest.raises(ScenarioError, match=r"filter\.kind: belongs to plants in slots"):
        simulated({**RING, "filter": {"kind": ""}}, tmp_path, "SoundSwap")
    with pytest.raises(ScenarioError, match=r"filter\.kind: belongs to plants in continuous time"):
        simulated({**GOSSIP, "filter": RING["filter"]}, tmp_path, "SoundReset")
    sampled = [{**RING["sensors"][0], "sampling": {"kind": "poisson", "rate": 1.0}}]
    with pytest.raises(ScenarioError, match=r"sensors\[0\].*a FlowFilter, which takes no samples"):
        simulated({**RING, "sensors": sampled}, tmp_path, "SoundReset")
    with pytest.raises(ScenarioError, match=r"must be one that the .* filter runs under"):
        simulated(RING, tmp_path, "SoundReset", **{"network.activation": {"kind": "readings"}})


@pytest.mark.parametrize("cls", ["SoundReset", "SoundSwap", "Placed"])
def test_former_filters_keep_their_contract(cls):
    settings = {"epsilon": 0.3} if cls == "SoundReset" else {}
    check_filter(getattr(former_filters, cls), **settings)
