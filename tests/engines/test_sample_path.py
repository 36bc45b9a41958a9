"""Cov(x - xhat) of what the engine computes against the exact Sigma, without Monte Carlo."""

import numpy as np
import pytest

from netkf.engines.simpy import nodes
from netkf.theory import error_covariance
from tests.conftest import with_slow

from .linearity import engine_covariance


@pytest.fixture
def ring(ring):
    """A ring of four nodes is enough: a run for each noise takes half the time."""
    return ring.replace({"network.graph.nodes": 4, "sensors.0.nodes": [0, 2]})


STATED = 1e-3  # the docs promise this much at the default sensing period


def deviation(scenario):
    """Largest relative deviation (Frobenius) over sample times and nodes."""
    mine, run = engine_covariance(scenario, "simpy")
    exact = error_covariance(scenario, run)
    size = np.maximum(np.linalg.norm(exact, axis=(-1, -2)), 1e-12)
    return (np.linalg.norm(mine - exact, axis=(-1, -2)) / size).max()


@pytest.mark.slow
def test_default_sensing_period_keeps_what_the_docs_state(ring):
    assert deviation(ring.replace({"horizon": 2.0})) < STATED / 50


@pytest.mark.slow
def test_the_error_has_fourth_order_in_the_sensing_period(ring, monkeypatch):
    # no shorter stretches where P is large
    monkeypatch.setattr(nodes, "interval_end", lambda now, time, length: time)
    clock = {"kind": "periodic", "period": 0.5}  # ticks on the grid: no interval is cut
    short = ring.replace({"horizon": 2.0, "probe": 1.0, "network.activation": clock})
    errors = [deviation(short.replace({"plant.sensing_period": h})) for h in (0.5, 0.25, 0.125)]
    assert 14.0 < errors[0] / errors[1] < 18.0
    assert 14.0 < errors[1] / errors[2] < 18.0


@pytest.mark.slow
def test_first_transient_needs_no_shorter_period(ring):
    wide = [[1e4, 0.0], [0.0, 1e4]]
    changes = {"horizon": 0.6, "probe": 0.1, "plant.cov": wide, "filter.cov": wide}
    assert deviation(ring.replace(changes)) < STATED / 50


@pytest.mark.slow
def test_precise_sensors(ring):
    changes = {"horizon": 1.0, "probe": 0.1, "sensors.0.R": [[0.01]]}
    assert deviation(ring.replace(changes)) < STATED / 50


@pytest.mark.slow
def test_samples_off_the_sensing_grid(ring):
    changes = {"horizon": 2.0, "probe": [0.33, 0.7, 1.1, 1.95], "plant.sensing_period": 0.25}
    assert deviation(ring.replace(changes)) < STATED / 20


@pytest.mark.slow
@pytest.mark.parametrize(
    "delay",
    [
        {"kind": "constant", "seconds": 0.3},
        pytest.param({"kind": "exponential", "mean": 0.2}, marks=pytest.mark.slow),
    ],
)
def test_delays(ring, delay):
    changes = {
        "horizon": 1.5,
        "network.channel.delay": delay,
        "network.channel.symmetric": False,
        "network.activation.rate": 4.0,
    }
    assert deviation(ring.replace(changes)) < STATED / 20


@pytest.mark.slow
def test_filters_that_believe_another_model(ring):
    model = {"A": [[0.0, 1.0], [-1.2, 0.0]], "B": [[0.3], [0.7]], "R": [[1.0]]}
    assert deviation(ring.replace({"horizon": 1.5, "filter.model": model})) < STATED / 20


@pytest.mark.one_in(2)
@pytest.mark.parametrize("kind", ["local", "central"])
def test_baselines(ring, kind):
    short = ring.replace({"horizon": 2.0, "filter": {"kind": kind}})
    assert deviation(short) < STATED / 20


@pytest.mark.slow
def test_several_sensors_on_a_node_and_rows_of_zeros(ring):
    more = [
        {"nodes": [0, 2], "H": [[1.0, 0.0]], "R": [[0.25]]},
        {"nodes": [0, 1], "H": [[0.0, 1.0], [0.0, 0.0]], "R": [[0.5, 0.1], [0.1, 0.3]]},
    ]
    assert deviation(ring.replace({"horizon": 1.0, "sensors": more})) < STATED / 20


@pytest.mark.slow
@pytest.mark.parametrize("seed", with_slow(range(3), (1, 2)))
def test_random_systems_with_large_first_covariances(build, seed):
    random = np.random.default_rng(seed)
    n = 2
    A = random.normal(size=(n, n))
    A -= max(0.0, np.linalg.eigvals(A).real.max() - 0.3) * np.eye(n)
    eye, first = np.eye(n), 10.0 ** random.uniform(2, 4)
    sensors = [
        {"nodes": [k], "H": random.normal(size=(1, n)), "R": [[10.0 ** random.uniform(-3, 1)]]}
        for k in range(2)
    ]
    scenario = build(
        plant={"kind": "diffusion", "A": A, "B": random.normal(size=(n, 1)), "cov": eye},
        sensors=sensors,
        network={
            "graph": {"kind": "path", "nodes": 3},
            "activation": {"kind": "poisson", "rate": 2.0},
        },
        filter={"kind": "hybrid", "epsilon": 0.3, "cov": first * eye},
    )
    end = min(1.0, 12.0 * scenario.diffusion.sensing_period)
    assert deviation(scenario.replace({"horizon": end, "probe": end / 4.0})) < STATED
