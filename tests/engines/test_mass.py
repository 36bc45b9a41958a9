"""Push-sum by running sums keeps its mass, however many messages are lost one way or late."""

from pathlib import Path

import pytest

import netkf
from netkf.scenario.reading import from_table


def scenario(rounds, loss, delay):
    nodes, rate = 5, 50.0
    horizon = rounds / (nodes * rate)
    table = {
        "format": 1,
        "name": "mass",
        "horizon": horizon,
        "probe": horizon / 20.0,
        "plant": {
            "kind": "diffusion",
            "A": [[0.0, 1.0], [-1.0, -0.3]],
            "B": [[0.0], [1.0]],
            "cov": [[1.0, 0.0], [0.0, 1.0]],
        },
        "sensors": [
            {
                "nodes": [0, 2],
                "H": [[1.0, 0.0]],
                "R": [[0.1]],
                "sampling": {"kind": "poisson", "rate": 2.0},
            }
        ],
        "network": {
            "graph": {"kind": "cycle", "nodes": nodes},
            "activation": {"kind": "poisson", "rate": rate, "at": "nodes"},
            "channel": {"loss": {"kind": "bernoulli", "delivery": loss}, "delay": delay},
        },
        "filter": {"kind": "push-sum"},
    }
    return from_table(table, Path())


@pytest.mark.parametrize(
    ("engine", "rounds"),
    [
        ("simpy", 3_000),
        ("compiled", 60_000),
        pytest.param("compiled", 1_000_000, marks=pytest.mark.slow),
    ],
)
def test_mass_in_nodes_and_under_way_stays(engine, rounds):
    made = scenario(rounds, 0.7, {"kind": "exponential", "mean": 0.01})
    run = netkf.simulate(made, engine=engine)
    assert run.status == "complete"
    assert run.count("transmit") > 0.95 * rounds
    assert run.count("lost") > 0.2 * run.count("send")
    start, end = run.sums["weight"]
    assert start == 5.0
    assert abs(end - start) < 1e-12 * start
