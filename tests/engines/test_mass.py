"""Push-sum by running sums keeps its mass, however many messages are lost one way or late."""

from pathlib import Path

import numpy as np
import pytest

import netkf
from netkf.engines.compiled.engine import CompiledEngine
from netkf.scenario.reading import from_table
from netkf.theory.errors import error_law
from tests.engines.agreement import assert_agree
from tests.engines.linearity import engine_covariance
from tests.engines.test_batches import assert_alone
from tests.theory.test_replay import close


def scenario(rounds, loss, delay, **more):
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
    return from_table({**table, **more}, Path())


@pytest.mark.one_in(2)
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
    # The total of a link grows with the rounds, and with it the size of its last digit.
    assert abs(end - start) < max(1e-12 * start, np.spacing(rounds / start))


ASYMMETRIC = {"loss": {"kind": "bernoulli", "delivery": 0.7}, "symmetric": False}


def in_slots(**settings):
    table = {
        "format": 1,
        "name": "mass in slots",
        "horizon": 81.0,
        "probe": 10.0,
        "seed": 4,
        "plant": {
            "kind": "linear",
            "F": [[0.9, 0.1], [-0.1, 0.9]],
            "Q": [[0.1, 0.0], [0.0, 0.1]],
            "cov": [[1.0, 0.0], [0.0, 1.0]],
            "period": 1.0,
        },
        "sensors": [
            {"nodes": [0, 4], "H": [[1.0, 0.0]], "R": [[0.1]]},
            {"nodes": [2], "H": [[0.0, 1.0]], "R": [[0.2]]},
        ],
        "network": {
            "graph": {"kind": "grid", "rows": 2, "columns": 3},
            "activation": {"kind": "broadcast"},
            "channel": ASYMMETRIC,
        },
        "filter": {"kind": "push-sum", "gamma": 2, "delta": 5.1, **settings},
    }
    return from_table(table, Path())


def test_running_sums_in_slots_lose_nothing_to_one_way_losses():
    """The ordinary exchange does; P is then what all sensors together are worth."""
    running, ordinary = in_slots(running_sums=True), in_slots()
    runs = [netkf.simulate(one) for one in (running, ordinary)]
    for name, exact in (("weight", 1.0), ("number", 6.0)):
        start, end = runs[0].sums[name]
        assert start == exact
        assert abs(end - start) < 1e-12 * start
    limit = netkf.theory.push_sum_limits(running).P
    off = [abs(run.P[-1] - limit).max() / abs(limit).max() for run in runs]
    assert off[0] < 1e-6 < 1e-2 < off[1]


def test_both_engines_keep_the_same_totals_and_theory_follows_them():
    scenario = in_slots(running_sums=True).replace({"horizon": 12.0, "probe": 1.0})
    fast = assert_agree(scenario)
    scenario = scenario.replace({"probe": [0.0, 1.0, 3.0, 9.0]})
    run = netkf.simulate(scenario)
    np.testing.assert_allclose(error_law(scenario, run).P, run.P, rtol=1e-9, atol=1e-12)
    again = in_slots(running_sums=True).replace({"horizon": 3.0, "probe": [0.0, 1.0, 2.0]})
    exact, run = engine_covariance(again, "simpy")
    close(netkf.theory.error_covariance(again, run), exact, 1e-9)
    assert fast.count("lost") > 50


def test_nodes_that_are_down_offer_nothing():
    """Neither alone, nor beside a run in which the node is up."""
    made = in_slots(running_sums=True).replace(
        {"network.lives": [{"kind": "crashes", "nodes": [1, 3], "mean_up": 4.0, "mean_down": 3.0}]}
    )
    assert_alone(made, CompiledEngine(), 5, range(4), fingerprint=True)
    for start, end in assert_agree(made.replace({"horizon": 12.0}), 2).sums.values():
        assert abs(end - start) < 1e-12 * start


def test_running_sums_go_with_no_stop_rule():
    with pytest.raises(netkf.ScenarioError, match=r"filter\.stop: must be never with running sums"):
        in_slots(running_sums=True, stop="safe")


def beside_a_fast_mode(rate, turn=None, growth=-0.05):
    """A slow mode that node 0 reads beside an independent one that decays at ``rate``, in
    coordinates ``turn`` times those of the modes.
    """
    turn = np.eye(2) if turn is None else turn
    B, cov = turn @ np.diag([1.0, np.sqrt(2.0 * rate)]), turn @ np.diag([10.0, 1.0]) @ turn.T
    plant = {"A": (turn @ np.diag([growth, -rate]) @ np.linalg.inv(turn)).tolist()}
    plant |= {"kind": "diffusion", "B": B.tolist(), "cov": (0.5 * (cov + cov.T)).tolist()}
    sensors = [{"nodes": [0], "H": (np.array([[1.0, 0.0]]) @ np.linalg.inv(turn)).tolist()}]
    sensors[0] |= {"R": [[0.5]], "sampling": {"kind": "periodic", "period": 0.5}}
    more = {"plant": plant, "sensors": sensors, "horizon": 10.0, "probe": 1.0}
    return scenario(2500, 0.8, {"kind": "constant", "seconds": 0.1}, **more)


@pytest.mark.parametrize("growth", [-0.05, 0.0, 0.1])
def test_p_of_a_slow_mode_knows_nothing_of_a_fast_one(growth):
    """Totals fade mode by mode: what is under way weighs the same whatever else the plant does."""
    turn = np.array([[1.0, 0.3], [-0.7, 0.8]])
    slow = [netkf.simulate(beside_a_fast_mode(rate, growth=growth)) for rate in (1.0, 20.0, 1000.0)]
    turned = netkf.simulate(beside_a_fast_mode(20.0, turn, growth))
    back = np.linalg.inv(turn)
    for P in (slow[1].P, slow[2].P, back @ turned.P @ back.T):
        np.testing.assert_allclose(P[..., 0, 0], slow[0].P[..., 0, 0], rtol=1e-9)
    # The fast mode, which nobody reads, has its steady variance.
    np.testing.assert_allclose(slow[2].P[..., 1, 1], 1.0, rtol=1e-9)
    assert slow[2].P[-1, :, 0, 0].max() < 3.0
    for run in (*slow, turned):
        assert abs(run.sums["weight"][1] - 5.0) < 1e-12


@pytest.mark.slow
def test_totals_that_fade_mode_by_mode_are_information_about_the_state():
    """Estimates stay affine in the readings, theory follows P and errors, and engines agree."""
    turn = np.array([[1.0, 0.3], [-0.7, 0.8]])
    for growth in (-0.05, 0.4):
        coupled = beside_a_fast_mode(8.0, turn, growth)
        assert_agree(coupled.replace({"horizon": 3.0}))
        short = coupled.replace({"horizon": 0.8, "probe": [0.3, 0.7]})
        exact, run = engine_covariance(short, "compiled")
        close(netkf.theory.error_covariance(short, run), exact, 1e-9)
        np.testing.assert_allclose(error_law(short, run).P, run.P, rtol=1e-9, atol=1e-12)


def test_of_a_plant_that_stands_still_no_power_of_a_time_overflows():
    """The cells of its table were 1e298 s long: warnings on the terminal."""
    still = scenario(50, 0.7, {"kind": "none"}).replace({"plant.A": [[0.0] * 2] * 2})
    run = netkf.simulate(still)
    assert np.isfinite(run.P).all()
