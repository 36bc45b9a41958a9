"""Stacked errors under clocks: P against the engine's, errors against its own linear map."""

import numpy as np
import pytest
import scipy.linalg

import netkf
from netkf import theory
from netkf.scenario.reading import from_table
from netkf.theory.common import clock_columns
from netkf.theory.common.arrivals import with_last_exchanges
from netkf.theory.errors import error_law
from tests.conftest import SCENARIOS
from tests.engines.linearity import engine_covariance, engine_joint

POISSON = {"kind": "poisson", "rate": 2.0}
SAMPLED = [
    {
        "nodes": [0, 2],
        "H": [[1.0, 0.3]],
        "R": [[0.4]],
        "sampling": {"kind": "poisson", "rate": 2.0},
    },
    {
        "nodes": [1],
        "H": [[0.2, 1.0]],
        "R": [[0.2]],
        "sampling": {"kind": "periodic", "period": 0.5, "jitter": 0.2},
    },
    {
        "nodes": [0],
        "H": [[1.0, 0.0], [0.0, 1.0]],
        "R": [[0.3, 0.1], [0.1, 0.6]],
        "sampling": {"kind": "periodic", "period": 0.7},
    },
]
MIXED = [*SAMPLED[:2], {"nodes": [2], "H": [[0.5, 1.0]], "R": [[0.3]]}]
LATE = {
    "loss": {"kind": "bernoulli", "delivery": 0.7},
    "delay": {"kind": "uniform", "low": 0.05, "high": 0.9},
    "symmetric": False,
}
LOSSY = {"loss": {"kind": "bernoulli", "delivery": 0.6}, "symmetric": False}
FILTERS = {
    "hybrid": {"kind": "hybrid", "epsilon": 0.3},
    "intersection": {"kind": "covariance-intersection", "epsilon": 0.3},
    "gossip": {"kind": "gossip"},
    "intermittent": {"kind": "intermittent"},
    "dropping": {"kind": "intermittent", "late": "drop"},
    "window": {"kind": "intermittent", "window": 0.4},
    "diffusion": {"kind": "diffusion"},
    "keeping": {"kind": "diffusion", "on_loss": "keep-own"},
    "push-sum": {"kind": "push-sum"},
    "kcf": {"kind": "kcf"},
    "local": {"kind": "local"},
    "central": {"kind": "central"},
}
CASES = [
    *[("hybrid", at) for at in ("links", "directions", "nodes", "readings")],
    *[("intersection", at) for at in ("links", "directions", "nodes", "readings")],
    ("gossip", "links"),
    *[(name, "readings") for name in ("intermittent", "dropping", "window")],
    *[("diffusion", at) for at in ("nodes", "readings", "directions")],
    ("keeping", "nodes"),
    ("push-sum", "nodes"),
    ("kcf", "nodes"),
    ("local", None),
    ("central", None),
]
SEVERAL_CLOCKS = {"hybrid", "intersection", "diffusion"}
LONG = {"kind": "periodic", "period": 100.0}
UNSTABLE = {"kind": "diffusion", "A": [[0.5, 1.0], [0.0, 0.3]], "B": [[0.8, 0.0], [0.1, 0.5]]}
STARTS = [[0.7, -0.4], [1.5, 0.2], [-2.0, 3.0], [0.0, 0.1]]
SAMPLES_ONLY = {"intermittent", "dropping", "window", "push-sum", "kcf"}


def scenario_of(name, at, channel, sensors, folder, **other):
    network = {"graph": {"kind": "cycle", "nodes": 4}}
    if at == "readings":
        network["activation"] = {"kind": "readings"}
    elif at is not None:
        network["activation"] = {**POISSON, "at": at}
    if at is not None:
        network["channel"] = channel
    plant = {
        "kind": "diffusion",
        "A": [[-0.3, 0.5], [-0.6, 0.1]],
        "B": [[0.8, 0.0], [0.1, 0.5]],
        "cov": [[1.0, 0.2], [0.2, 2.0]],
    }
    table = {
        "format": 1,
        "name": "replayed",
        "horizon": 4.0,
        "probe": [0.3, 1.1, 2.0, 3.3, 3.9],
        "plant": plant,
        "sensors": sensors,
        "network": network,
        "filter": FILTERS[name],
        "seed": 5,
    }
    return from_table({**table, **other}, folder)


def close(found, expected, tolerance):
    size = np.abs(expected).max(axis=(-1, -2), keepdims=True)
    assert (np.abs(found - expected) <= tolerance * size).all()


@pytest.mark.one_in(16)
@pytest.mark.parametrize("channel", [{}, LOSSY, LATE], ids=["sure", "lossy", "late"])
@pytest.mark.parametrize("sensors", [SAMPLED, MIXED], ids=["sampled", "mixed"])
@pytest.mark.parametrize(("name", "at"), CASES, ids=["-".join(map(str, c)) for c in CASES])
def test_covariances_are_those_of_the_run(name, at, sensors, channel, tmp_path):
    if sensors is MIXED and name in SAMPLES_ONLY:
        pytest.skip("samples only")
    scenario = scenario_of(name, at, channel, sensors, tmp_path)
    run = netkf.simulate(scenario, engine="simpy")
    P, stacked = error_law(scenario, run).P, theory.error_covariance(scenario, run, stacked=True)
    close(P, run.P, 1e-9)
    if name not in ("push-sum", "kcf"):  # what a node counts twice it takes for certain
        least = np.linalg.eigvalsh(P - theory.error_covariance(scenario, run))[..., 0]
        assert (least >= -1e-12 * np.abs(P).max()).all()
    assert np.linalg.eigvalsh(stacked).min() > -1e-12


@pytest.mark.one_in(12)
@pytest.mark.parametrize(("name", "at"), CASES, ids=["-".join(map(str, c)) for c in CASES])
def test_errors_are_the_linear_map_of_the_engine(name, at, tmp_path):
    """Filters of one clock each come late; of several some do."""
    channel = {} if at in ("directions", "readings") and name in SEVERAL_CLOCKS else LATE
    scenario = scenario_of(name, at, channel, SAMPLED, tmp_path, horizon=1.6, probe=[0.4, 0.9, 1.5])
    run = netkf.simulate(scenario, engine="simpy")
    law, stacked = (
        error_law(scenario, run),
        theory.error_covariance(scenario, run, stacked=True),
    )
    hosts = law.P.shape[1]  # a pooled filter is every node's
    joint = engine_joint(scenario)
    at_each_time = np.einsum("kiakjb->kiajb", joint).reshape(stacked.shape)
    close(stacked, at_each_time, 1e-9)
    size = 3 * hosts * 2
    close(law.covariance, joint[:, :hosts, :, :, :hosts].reshape(size, size), 1e-9)
    assert not law.mean.any()


def test_filters_with_another_plant_and_other_noises(tmp_path):
    belief = {"A": [[-0.2, 0.4], [-0.6, 0.0]], "B": [[1.0, 0.0], [0.0, 1.0]], "R": [[[0.5]]] * 2}
    scenario = scenario_of("hybrid", "nodes", LATE, SAMPLED[:2], tmp_path)
    scenario = scenario.replace({"filter.model": belief, "horizon": 1.6, "probe": [0.4, 1.5]})
    expected, run = engine_covariance(scenario, "simpy")
    close(theory.error_covariance(scenario, run), expected, 1e-9)
    close(error_law(scenario, run).P, run.P, 1e-9)


@pytest.mark.one_in(3)
@pytest.mark.parametrize(("name", "at"), CASES, ids=["-".join(map(str, c)) for c in CASES])
def test_the_mean_of_errors_is_what_other_starts_add(name, at, tmp_path):
    # Same truth, readings and messages: estimates differ by the mean of their errors only.
    scenario = scenario_of(name, at, LATE, SAMPLED, tmp_path)
    moved = scenario.replace({"filter.mean": STARTS[0] if name == "central" else STARTS})
    run, other = (netkf.simulate(one, engine="simpy") for one in (scenario, moved))
    law = error_law(moved, other)
    shape = len(run.times), law.P.shape[1], 2
    mean = law.mean.reshape(shape)
    hosts = shape[1]
    close(mean, (other.error - run.error)[:, :hosts], 1e-9)
    assert np.abs(mean).max() > 0.1
    close(law.covariance, error_law(scenario, run).covariance, 1e-9)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", ["intermittent", "gossip"])
def test_on_unstable_plants_errors_keep_their_digits_and_their_law(name, tmp_path):
    # The origin moves after 15 seconds.
    scenario = unstable(name, 29.0, tmp_path).replace({"probe": 0.25})
    runs = [netkf.simulate(scenario, engine=engine) for engine in ("simpy", "compiled")]
    exact = theory.error_covariance(scenario, runs[0])
    close(error_law(scenario, runs[0]).P, runs[0].P, 1e-9)
    for run in runs:
        nees = np.einsum("tia,tiab,tib->ti", run.error, np.linalg.inv(exact), run.error)
        assert nees.max() < 45.0  # chi-square of 2 degrees, 464 times
        assert 1.0 < nees.mean() < 3.0


@pytest.mark.parametrize("name", ["hybrid", "kcf"])
def test_of_several_messages_that_arrive_at_once_the_newest_counts(name, tmp_path):
    # Those sent at 0.5, 1.0 and 1.5 all arrive at 1.5, and so on.
    rows = [f"{i},{j},{k},{1.0 - 0.5 * (k % 3):g}" for i in range(4) for j in range(4)
            for k in range(9) if (i - j) % 4 in (1, 3)]  # fmt: skip
    (tmp_path / "d.csv").write_text("\n".join(["sender,receiver,message,seconds", *rows]))
    channel = {"delay": {"kind": "recorded", "path": "d.csv"}, "symmetric": False}
    scenario = scenario_of(name, "nodes", channel, SAMPLED, tmp_path)
    clock = {"kind": "periodic", "period": 0.5, "at": "nodes"}
    scenario = scenario.replace({"network.activation": clock})
    run = netkf.simulate(scenario, engine="simpy")
    close(error_law(scenario, run).P, run.P, 1e-9)


def unstable(name, horizon, folder):
    at = "links" if name == "gossip" else "readings"
    more = {"plant": {**UNSTABLE, "cov": [[1.0, 0.2], [0.2, 2.0]]}, "horizon": horizon}
    sampled = {**SAMPLED[0], "nodes": [0, 1, 2, 3], "sampling": {"kind": "periodic", "period": 0.5}}
    return scenario_of(name, at, LATE, [sampled], folder, probe=horizon / 20.0, **more)


def test_a_move_of_the_origin_moves_messages_under_way_and_no_error(tmp_path, monkeypatch):
    scenario = unstable("gossip", 8.0, tmp_path)
    run, found = netkf.simulate(scenario, engine="simpy"), []
    for large in (2.0, np.inf):
        monkeypatch.setattr(clock_columns, "LARGE", large)
        found.append(theory.error_covariance(scenario, run))
    close(*found, 1e-9)


def test_states_of_1e12_errors_leave_the_digits_of_a_covariance(tmp_path):
    scenario = unstable("intermittent", 60.0, tmp_path)
    run = netkf.simulate(scenario, engine="simpy")
    assert np.abs(run.x[-1]).max() > 1e11
    # A node with all readings that came to it is the Kalman filter of these.
    close(theory.error_covariance(scenario, run), run.P, 1e-6)


def test_the_joint_law_of_a_filter_without_readings_is_the_plants(tmp_path):
    # Errors are then the state itself: E[x(s) x(t)'] = C(s) exp(A (t - s))'.
    sensors = [{"nodes": [0], "H": [[1.0, 0.0]], "R": [[1.0]], "sampling": LONG}]
    scenario = scenario_of("local", None, {}, sensors, tmp_path, probe=[0.4, 1.5])
    run = netkf.simulate(scenario, engine="simpy")
    law = error_law(scenario, run)
    C, A = theory.error_covariance(scenario, run)[:, 2], scenario.diffusion.A
    joint = law.covariance.reshape(2, 4, 2, 2, 4, 2)[:, 2, :, :, 2]
    close(joint[0, :, 1], C[0] @ scipy.linalg.expm(A * 1.1).T, 1e-10)


GROWING = [[9.0, 1.0], [-1.0, 9.0]]
SELDOM = {"kind": "poisson", "rate": 0.02}  # variances pass the largest number before the truth
DIVERGING = [
    (
        "blind_unstable",
        {"plant.A": GROWING, "horizon": 100.0, "probe": 1.0, "network.activation": SELDOM},
    ),
    ("poisson_ring", {"plant.A": GROWING, "horizon": 100.0, "probe": 1.0}),
    ("gossip_ring", {"plant.F": (30.0 * np.eye(4)).tolist()}),
]


@pytest.mark.parametrize(("name", "changes"), DIVERGING, ids=[name for name, _ in DIVERGING])
def test_errors_that_overflow_are_infinite_without_a_warning(name, changes):
    scenario = netkf.load(SCENARIOS / f"{name}.toml").replace(changes)
    run = netkf.simulate(scenario)
    assert run.status == "diverged"
    assert not np.isfinite(theory.error_covariance(scenario, run)).all()


@pytest.mark.parametrize("horizon", [1.0, 9.75, 10.0, 100.0])
def test_a_stored_run_of_any_horizon_has_exact_errors_at_its_end(tmp_path, horizon):
    """The exchanges of the slot at the horizon are those of a run that is longer by a slot: one
    with the same instants, also where a power of ten ends.
    """
    changes = {"horizon": horizon, "probe": 0.25, "filter": {"kind": "kcf"}}
    changes["network.channel.delay"] = {"kind": "exponential", "mean": 0.02}
    scenario = netkf.load(SCENARIOS / "push_sum_planar.toml", changes)
    run = netkf.simulate(scenario)
    stored = netkf.open(netkf.save(run, scenario, tmp_path / "run"))
    longer = with_last_exchanges(stored.scenario, stored)
    assert len(longer.log) > len(run.log)
    assert longer.log[: len(run.log)].tobytes() == run.log.tobytes()
    found = [netkf.theory.error_covariance(one.scenario, one) for one in (run, stored)]
    np.testing.assert_array_equal(*found)
