"""Two small runs that all tests of this room look at."""

import pytest

import netkf
from tests.conftest import SCENARIOS

NAMED = {
    "network.graph": {
        "kind": "edges",
        "nodes": ["gate", "roof", "lab"],
        "edges": [["gate", "roof"], ["roof", "lab"]],
        "positions": [[0.0, 0.0], [3.0, 0.0], [3.0, 4.0]],
    },
    "network.channel.delay": {"kind": "uniform", "low": 0.01, "high": 0.05},
    "network.channel.symmetric": False,
    "network.lives": [{"kind": "duty", "nodes": ["lab"], "period": 4.0, "up": 3.0}],
    "sensors.0.nodes": ["gate", "lab"],
    "sensors.0.sampling": {"kind": "periodic", "period": 0.25},
    "horizon": 10.0,
}
"""Three nodes with names and places, delays and a node that sleeps."""


@pytest.fixture(scope="session")
def run():
    scenario = netkf.load(SCENARIOS / "poisson_ring.toml", NAMED)
    return netkf.simulate(scenario, seed=3, engine="simpy")


@pytest.fixture(scope="session")
def slot_run():
    scenario = netkf.load(SCENARIOS / "push_sum_planar.toml", {"horizon": 3.0})
    return netkf.simulate(scenario, engine="simpy")
