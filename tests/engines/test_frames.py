"""Frames move the origin of the coordinates and nothing else: while states are small enough for
both, errors are those of absolute coordinates, with messages under way and in every filter.
"""

from pathlib import Path

import numpy as np
import pytest

import netkf
from netkf.scenario.reading import from_table
from netkf.scenario.scenario import Scenario

SENSORS = [
    {
        "nodes": [0, 2],
        "H": [[1.0, 0.0]],
        "R": [[0.3]],
        "sampling": {"kind": "poisson", "rate": 3.0},
    },
    {
        "nodes": [3],
        "H": [[0.4, 1.0]],
        "R": [[0.4]],
        "sampling": {"kind": "periodic", "period": 0.4, "jitter": 0.1},
    },
]
INCREMENTS = [{"nodes": [1], "H": [[1.0, 0.5]], "R": [[0.2]]}]
FILTERS = {
    "hybrid": ({"epsilon": 0.3}, "links"),
    "covariance-intersection": ({"epsilon": 0.3}, "nodes"),
    "gossip": ({}, "links"),
    "diffusion": ({}, "directions"),
    "intermittent": ({}, "readings"),
    "push-sum": ({}, "nodes"),
    "local": ({}, None),
    "central": ({}, None),
}


def scenario(kind, sensors, growth=1.1, horizon=14.0):
    settings, at = FILTERS[kind]
    network = {
        "graph": {"kind": "cycle", "nodes": 4},
        "channel": {
            "loss": {"kind": "bernoulli", "delivery": 0.7},
            "delay": {"kind": "exponential", "mean": 0.2},
        },
    }
    if at == "readings":
        network["activation"] = {"kind": "readings"}
    elif at is not None:
        network["activation"] = {"kind": "poisson", "rate": 2.0, "at": at}
    table = {
        "format": 1,
        "name": "frames",
        "horizon": horizon,
        "probe": 0.5,
        "seed": 4,
        "plant": {
            "kind": "diffusion",
            "A": [[growth, 0.3], [0.0, -0.7]],
            "B": [[0.5, 0.0], [0.0, 0.4]],
            "mean": [1.0, 2.0],
            "cov": [[1.0, 0.1], [0.1, 0.6]],
        },
        "sensors": sensors,
        "network": network,
        "filter": {"kind": kind, **settings},
    }
    return from_table(table, Path())


@pytest.mark.one_in(4)
@pytest.mark.parametrize("mixed", [False, True], ids=["samples", "with increments"])
@pytest.mark.parametrize("kind", FILTERS)
def test_frames_change_no_error(kind, mixed, monkeypatch):
    if mixed and kind in ("intermittent", "push-sum"):
        pytest.skip("increment sensors mean nothing to it")
    sensors = [*SENSORS, *(INCREMENTS if mixed else [])]
    run = netkf.simulate(scenario(kind, sensors), engine="simpy")
    assert run.exact_errors
    monkeypatch.setattr(Scenario, "exact_errors", False)
    plain = netkf.simulate(scenario(kind, sensors), engine="simpy")
    assert not plain.exact_errors
    assert plain.fingerprint == run.fingerprint
    np.testing.assert_allclose(run.P, plain.P, rtol=1e-9)
    size = np.abs(plain.x).max(axis=1)  # e^15: 9 digits are left of the differences
    assert size[-1] > 1e5
    off = np.abs(run.error - plain.error).max(axis=(1, 2))
    assert (off <= 1e-9 * size + 1e-9 * np.abs(plain.error).max()).all()
    assert (off[: len(off) // 2] <= 1e-8).all()
    np.testing.assert_allclose(run.x, plain.x, rtol=1e-9)
    np.testing.assert_allclose(run.xhat, plain.xhat, rtol=1e-9, atol=1e-6)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("kind", ["covariance-intersection", "push-sum"])
def test_frames_move_messages_beside_modes_that_decay_fast(kind):
    """An offset pulled back over a delay must not grow with a mode that nobody misses."""
    made = scenario(kind, SENSORS, growth=0.4, horizon=60.0)
    network = {"graph": {"kind": "cycle", "nodes": 4}}
    network["activation"] = {"kind": "poisson", "rate": 1.0, "at": "nodes"}
    network["channel"] = {
        "loss": {"kind": "bernoulli", "delivery": 0.5},
        "delay": {"kind": "constant", "seconds": 1.5},
    }
    made = made.replace({"network": network, "plant.A": [[0.4, 5.0], [0.0, -60.0]]})
    runs = [netkf.simulate(made, engine=engine) for engine in ("compiled", "simpy")]
    for run in runs:
        assert run.status == "complete"
        assert np.abs(run.x[-1]).max() > 1e8
        assert np.abs(run.error).max() < 20.0
    np.testing.assert_allclose(runs[0].error, runs[1].error, rtol=0.0, atol=1e-9)


@pytest.mark.slow
def test_errors_so_large_that_they_round_each_other_are_known():
    """Blind nodes below the threshold: errors of 1e20 leave rounding where a sensor takes them."""
    run = netkf.simulate(scenario("hybrid", SENSORS, horizon=300.0), engine="simpy")
    assert 10.0 < run.rounding_from < 200.0
    early = run.times < run.rounding_from
    least = np.linalg.eigvalsh(run.P[early])[..., 0]
    assert (4e-16 * np.abs(run.error[early]).max() < np.sqrt(least)).all()


@pytest.mark.one_in(3)
@pytest.mark.parametrize("kind", ["intermittent", "diffusion", "central"])
def test_errors_keep_their_size_however_far_the_plant_goes(kind):
    run = netkf.simulate(scenario(kind, SENSORS, horizon=300.0), engine="simpy")
    assert run.status == "complete"
    assert np.abs(run.x[-1]).max() > 1e120
    nees = np.einsum("tna,tnab,tnb->tn", run.error, np.linalg.inv(run.P), run.error)
    assert nees[200:].mean() < 4.0
    if kind == "central":  # one filter that all nodes show: 400 samples, correlated over about 1 s
        assert 1.6 < nees[200:, 0].mean() < 2.4
