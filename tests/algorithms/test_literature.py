"""Filters of the literature in slots: the textbook of each, in both engines; what must coincide."""

import numpy as np
import pytest

import netkf
from netkf import theory
from netkf.rng.streams import Streams
from netkf.scenario.reading import from_table
from netkf.theory.errors import error_law
from netkf.trace.schema import CODES
from tests import reference
from tests.engines.linearity import engine_covariance
from tests.theory.test_replay import close

GRAPH = {"kind": "edges", "edges": [[0, 1], [1, 2], [2, 3], [3, 4], [0, 2]]}
LOSSY = {"loss": {"kind": "bernoulli", "delivery": 0.7}, "symmetric": False}
GIVEN = np.array(
    [
        [0.5, 0.3, 0.1, 0.0, 0.0],
        [0.2, 0.6, 0.0, 0.0, 0.0],
        [0.3, 0.1, 0.5, 0.4, 0.0],
        [0.0, 0.0, 0.4, 0.3, 0.9],
        [0.0, 0.0, 0.0, 0.3, 0.1],
    ]
)
FILTERS = {
    "hcmci": {"kind": "hcmci", "steps": 3},
    "hcmci-omega": {"kind": "hcmci", "steps": 2, "novelty_weight": 2.5},
    "ci": {"kind": "hcmci", "consensus": "information", "steps": 2},
    "cm": {"kind": "hcmci", "consensus": "measurements", "steps": 2},
    "icf": {"kind": "icf", "steps": 3},
    "kcf": {"kind": "kcf", "epsilon": 0.3},
    "kcf-own": {"kind": "kcf", "epsilon": 0.6, "share_readings": False},
    "diffusion-kalman": {"kind": "diffusion-kalman"},
    "diffusion-kalman-given": {"kind": "diffusion-kalman", "weights": GIVEN.tolist()},
}


def scenario_of(algorithm, folder, seed=0, n=2, **more):
    """A random plant with two kinds of sensors on five nodes; node 4 is blind."""
    random = np.random.default_rng([seed, n])
    F, root = random.standard_normal((n, n)), random.standard_normal((n, n))
    F *= 0.98 / np.abs(np.linalg.eigvals(F)).max()
    one, two = random.standard_normal((1, n)), random.standard_normal((2, n))
    table = {
        "format": 1,
        "name": "literature",
        "seed": seed,
        "horizon": 7.0,
        "probe": [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0],
        "plant": {
            "kind": "linear",
            "F": F.tolist(),
            "Q": (0.1 * root @ root.T + 0.05 * np.eye(n)).tolist(),
            "cov": (2.0 * np.eye(n)).tolist(),
            "period": 1.0,
        },
        "sensors": [
            {"nodes": [0, 2], "H": one.tolist(), "R": [[0.3]]},
            {"nodes": [1, 2, 3], "H": two.tolist(), "R": [[0.5, 0.1], [0.1, 0.4]]},
        ],
        "network": {"graph": GRAPH, "activation": {"kind": "broadcast"}, "channel": LOSSY},
        "filter": algorithm,
    }
    return from_table({**table, **more}, folder)


def heard_by_slot(scenario, run, steps):
    """(N, N) of each step of each slot, 1 where the message of j reached i; by numbers of messages,
    of which every direction has one a step.
    """
    N, found, sent = len(scenario.nodes), {}, {}
    # A direction without readings to send has no message in the first of two exchanges.
    columns = ("kind", "t", "node", "peer")
    for kind, t, node, peer in zip(*(run.log[c].tolist() for c in columns), strict=True):
        if kind == CODES["send"]:
            slot = int(t)
            place = sent.setdefault((node, peer), {})
            silent = steps == 2 and not scenario.filter.algorithm.analysis.tells_estimates(0)
            place[slot] = (
                place.get(slot, int(silent and node not in scenario.placed_sensors) - 1) + 1
            )
        if kind == CODES["deliver"]:
            slot = int(t)
            step = sent[peer, node][slot]
            found.setdefault(slot, np.zeros((steps, N, N)))[step, node, peer] = 1.0
    return found


def textbook(scenario, run, step):
    """xhat and P of all nodes in each slot by plain formulas, from readings and arrivals."""
    streams, nodes = Streams(run.seed, run.replica), range(len(scenario.nodes))
    paths = {
        i: [
            (scenario.slot_path(streams, i, place), scenario.sensors[place.entry])
            for place in places
        ]
        for i, places in scenario.placed_sensors.items()
    }
    F, Q = scenario.plant.F, scenario.plant.Q
    x, P = [np.zeros(len(F)) for _ in nodes], [scenario.plant.cov for _ in nodes]
    yield np.stack(x), np.stack(P)
    for slot in range(1, len(run.times)):
        x, P = [F @ one for one in x], [F @ C @ F.T + Q for C in P]
        readings = {}
        for i, some in paths.items():
            y = np.concatenate([path.reading(slot, run.x[slot]) for path, _ in some])
            H = np.concatenate([sensor.H for _, sensor in some])
            R = np.zeros((len(y), len(y)))
            at = 0
            for _, sensor in some:
                R[at : at + len(sensor.R), at : at + len(sensor.R)] = sensor.R
                at += len(sensor.R)
            readings[i] = y, H, R
        x, P = step(slot, x, P, readings)
        yield np.stack(x), np.stack(P)


def expected_states(scenario, run, name):
    settings, N = FILTERS[name], len(scenario.nodes)
    steps = 2 if name.startswith("diffusion") else settings.get("steps", 1)
    heard = heard_by_slot(scenario, run, steps)
    degrees, weights = scenario.topology.degrees, np.zeros((N, N))
    for i, j in scenario.topology.directions:
        weights[j, i] = 1.0 / (1.0 + max(degrees[i], degrees[j]))
    if name == "diffusion-kalman-given":
        weights = GIVEN.T

    def step(slot, x, P, readings):
        up = heard.get(slot, np.zeros((steps, N, N)))
        if settings["kind"] == "hcmci":
            variant, omega = settings.get("consensus", "hybrid"), settings.get("novelty_weight", N)
            return reference.hcmci(x, P, readings, weights, up, variant, omega)
        if settings["kind"] == "icf":
            return reference.icf(x, P, readings, weights, up)
        if settings["kind"] == "kcf":
            share = settings.get("share_readings", True)
            return reference.kcf(x, P, readings, up, settings["epsilon"], share)
        return reference.diffusion_kalman(x, P, readings, weights, up)

    found = list(textbook(scenario, run, step))
    return np.stack([x for x, _ in found]), np.stack([P for _, P in found])


@pytest.mark.one_in(4)
@pytest.mark.parametrize("engine", ["simpy", "compiled"])
@pytest.mark.parametrize("name", FILTERS)
def test_the_textbook(name, engine, tmp_path):
    for seed in range(2):
        for n in (1, 2, 4):
            scenario = scenario_of(FILTERS[name], tmp_path, seed, n)
            run = netkf.simulate(scenario, engine=engine)
            xhat, P = expected_states(scenario, run, name)
            assert run.count("lost") > 10
            np.testing.assert_allclose(run.P, P, rtol=1e-10, atol=1e-11)
            np.testing.assert_allclose(run.xhat, xhat, rtol=1e-10, atol=1e-10)


@pytest.mark.one_in(12)
@pytest.mark.parametrize("name", FILTERS)
def test_both_engines_make_the_same_run_and_theory_follows_it(name, tmp_path):
    """Exact covariances of the errors against the engine's own linear map."""
    settings = {"horizon": 3.0, "probe": [0.0, 1.0, 2.0]}
    scenario = scenario_of(FILTERS[name], tmp_path, 1, **settings)
    fast, slow = (netkf.simulate(scenario, engine=engine) for engine in ("compiled", "simpy"))
    assert netkf.first_difference(fast, slow) is None
    np.testing.assert_allclose(fast.P, slow.P, rtol=1e-12, atol=1e-13)
    exact, _ = engine_covariance(scenario)
    close(theory.error_covariance(scenario, fast), exact, 1e-9)
    close(error_law(scenario, fast).P, fast.P, 1e-9)


def states(algorithm, folder, **more):
    run = netkf.simulate(scenario_of(algorithm, folder, **more))
    return run.xhat, run.P


def assert_same(one, other, folder, tolerance=1e-10, **more):
    for a, b in zip(states(one, folder, **more), states(other, folder, **more), strict=True):
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance)


SURE = {"graph": GRAPH, "activation": {"kind": "broadcast"}}
ALL = {**SURE, "graph": {"kind": "complete", "nodes": 5}}
CENTRAL = {"kind": "central"}


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(
    "algorithm",
    [
        {"kind": "hcmci"},
        {"kind": "hcmci", "consensus": "measurements"},
        {"kind": "icf"},
    ],
    ids=["hcmci", "cm", "icf"],
)
def test_many_steps_are_the_central_filter(algorithm, seed, tmp_path):
    assert_same({**algorithm, "steps": 150}, CENTRAL, tmp_path, 1e-8, seed=seed, network=SURE)


def test_one_step_among_all_is_the_central_filter(tmp_path):
    """Metropolis weights are then 1/N."""
    assert_same({"kind": "icf"}, CENTRAL, tmp_path, network=ALL)
    assert_same({"kind": "diffusion-kalman"}, CENTRAL, tmp_path, network=ALL)
    assert_same({"kind": "kcf", "epsilon": 0.7}, CENTRAL, tmp_path, network=ALL)


def test_filters_that_coincide(tmp_path):
    hybrid = {"kind": "hcmci", "steps": 3}
    assert_same(hybrid, {"kind": "icf", "steps": 3}, tmp_path)
    information = {"kind": "hcmci", "steps": 3, "consensus": "information"}
    assert_same({**hybrid, "novelty_weight": 1.0}, information, tmp_path)
    alone = {"kind": "kcf", "epsilon": 0.0, "share_readings": False}
    assert_same(alone, {"kind": "local"}, tmp_path)
    around = {"kind": "diffusion-kalman", "weights": np.eye(5).tolist()}
    network = {**SURE}  # losses of two exchanges differ from those of one
    assert_same(around, {"kind": "kcf", "epsilon": 0.0}, tmp_path, network=network)


def test_consensus_on_information_never_claims_too_much(tmp_path):
    """P >= exact Cov at every node and slot; with novelty weight N that is not so."""
    below = []
    for seed in range(4):
        for steps in (1, 4):
            algorithm = {"kind": "hcmci", "consensus": "information", "steps": steps}
            scenario = scenario_of(algorithm, tmp_path, seed, 3)
            run = netkf.simulate(scenario)
            gap = run.P - theory.error_covariance(scenario, run)
            assert np.linalg.eigvalsh(gap)[..., 0].min() > -1e-12
            scenario = scenario_of({"kind": "hcmci", "steps": steps}, tmp_path, seed, 3)
            run = netkf.simulate(scenario)
            gap = run.P - theory.error_covariance(scenario, run)
            below.append(np.linalg.eigvalsh(gap)[..., 0].min())
    assert max(below) < -1e-3


def test_wide_starts_and_precise_sensors_keep_their_digits(tmp_path):
    """Variances of 1e12 beside sensors of 1e-9, against the central filter."""
    sensors = [
        {"nodes": [0], "H": [[1.0, 0.3]], "R": [[1e-9]]},
        {"nodes": [3], "H": [[0.2, 1.0]], "R": [[1e-6]]},
    ]
    plant = {"kind": "linear", "F": [[0.9, 0.1], [0.0, 0.8]], "Q": [[1.0, 0.0], [0.0, 1.0]]}
    plant |= {"period": 1.0, "cov": [[1e12, 0.0], [0.0, 1e12]]}
    more = {"sensors": sensors, "plant": plant, "network": ALL}
    (xhat, P), (x, central) = (states(f, tmp_path, **more) for f in ({"kind": "icf"}, CENTRAL))
    np.testing.assert_allclose(P[1:], central[1:], rtol=1e-6)
    assert np.linalg.eigvalsh(P).min() > 0.0
    np.testing.assert_allclose(xhat[1:], x[1:], rtol=1e-8)


def test_the_optimism_of_the_kcf_shows_and_breaks_no_promise(tmp_path):
    """A strong pull towards blind neighbours, which P leaves out."""
    scenario = scenario_of({"kind": "kcf", "epsilon": 2.0}, tmp_path, 1)
    found = netkf.consistency(scenario, 10, confidence=0.999, workers=1)
    assert found
    assert max(row.expected for row in found.rows) > 1.3 * 2
    verdicts = [row.verdict for row in found.rows]
    assert "as expected: P is overconfident" in verdicts
    assert not any(verdict.endswith("is not known") for verdict in verdicts)
    verdict = netkf.check(scenario.replace({"horizon": 12.0}), 10, confidence=0.999, workers=1)
    assert verdict
    promises = set(verdict.table["promise"])
    assert "P follows the equations along the events of each run" in promises
    assert "P is at least the covariance of the error, given the events" not in promises


def test_check_promises_consistency_where_no_reading_counts_twice(tmp_path):
    bound = "P is at least the covariance of the error, given the events"
    for settings, expected in (({"consensus": "information"}, "holds"), ({}, "not promised")):
        algorithm = {"kind": "hcmci", "steps": 2, **settings}
        scenario = scenario_of(algorithm, tmp_path, horizon=12.0)
        table = netkf.check(scenario, 10, confidence=0.999, workers=1).table.set_index("promise")
        assert table.loc[bound, "verdict"] == expected
        assert (
            table.loc["P follows the equations along the events of each run", "verdict"] == "holds"
        )


# Under clocks.

ROTATION = {"kind": "diffusion", "A": [[-0.1, 0.8], [-0.8, -0.1]], "B": [[0.4, 0.0], [0.1, 0.3]]}
ROTATION |= {"cov": [[2.0, 0.0], [0.0, 2.0]]}
SAMPLED = [
    {"nodes": [0, 2], "H": [[1.0, 0.2]], "R": [[0.3]]},
    {"nodes": [1], "H": [[0.1, 1.0]], "R": [[0.4]]},
]


def clocked(algorithm, folder, activation, sampling, **more):
    sensors = [{**sensor, "sampling": sampling} for sensor in SAMPLED]
    network = {"graph": {"kind": "cycle", "nodes": 4}, "activation": activation}
    settings = {"plant": ROTATION, "sensors": sensors, "network": network, "horizon": 6.0}
    return scenario_of(algorithm, folder, **{**settings, **more})


@pytest.mark.one_in(2)
@pytest.mark.parametrize("channel", [{}, {"delay": {"kind": "constant", "seconds": 0.3}, **LOSSY}])
@pytest.mark.parametrize("at", ["links", "nodes"])
def test_consensus_on_information_under_clocks_is_covariance_intersection(at, channel, tmp_path):
    """On a cycle all Metropolis weights are 1/3."""
    activation = {"kind": "poisson", "rate": 2.0, "at": at}
    network = {"graph": {"kind": "cycle", "nodes": 4}, "activation": activation, "channel": channel}
    filters = [
        {"kind": "hcmci", "consensus": "information"},
        {"kind": "covariance-intersection", "epsilon": 1.0 / 3.0},
    ]
    settings = {"probe": 0.5, "network": network}
    sampling = {"kind": "poisson", "rate": 2.0}
    ours, other = (clocked(f, tmp_path, activation, sampling, **settings) for f in filters)
    expected = netkf.simulate(other, engine="compiled")
    for engine in ("simpy", "compiled"):
        run = netkf.simulate(ours, engine=engine)
        np.testing.assert_allclose(run.P, expected.P, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(run.xhat, expected.xhat, rtol=1e-10, atol=1e-10)
    gap = run.P - theory.error_covariance(ours, run)
    assert np.linalg.eigvalsh(gap)[..., 0].min() > -1e-10


def test_the_kcf_under_synchronous_clocks_is_that_in_slots(tmp_path):
    """Samples and broadcasts at every second, over the exact discretisation."""
    each = {"kind": "periodic", "period": 1.0}
    kcf = {"kind": "kcf", "epsilon": 0.4}
    times = [1.0, 2.0, 3.0, 4.0, 5.0]
    run = netkf.simulate(clocked(kcf, tmp_path, {**each, "at": "nodes"}, each, probe=times))
    A, B = np.array(ROTATION["A"]), np.array(ROTATION["B"])
    F, Q = discretised(A, B @ B.T, 1.0)
    plant = {
        "kind": "linear",
        "F": F.tolist(),
        "Q": Q.tolist(),
        "cov": ROTATION["cov"],
        "period": 1.0,
    }
    network = {"graph": {"kind": "cycle", "nodes": 4}, "activation": {"kind": "broadcast"}}
    slots = scenario_of(kcf, tmp_path, plant=plant, sensors=SAMPLED, network=network, probe=times)
    np.testing.assert_allclose(run.P, netkf.simulate(slots).P, rtol=1e-10, atol=1e-12)


def discretised(A, Q, gap):
    """F and Q over a gap by the plain integral, with Simpson's rule."""
    count = 2000
    s = np.linspace(0.0, gap, count + 1)
    steps = np.linalg.matrix_power
    small = reference.exponential(A * (gap / count))
    powers = [steps(small, 0)]
    for _ in range(count):
        powers.append(small @ powers[-1])
    values = np.array([F @ Q @ F.T for F in powers])
    weights = np.ones(count + 1)
    weights[1:-1:2], weights[2:-1:2] = 4.0, 2.0
    return powers[-1], np.tensordot(weights, values, 1) * (s[1] - s[0]) / 3.0


@pytest.mark.parametrize("at", ["nodes", "readings"])
def test_exact_errors_of_the_kcf_under_clocks(at, tmp_path):
    activation = (
        {"kind": "readings"} if at == "readings" else {"kind": "poisson", "rate": 2.0, "at": at}
    )
    network = {"graph": {"kind": "cycle", "nodes": 4}, "activation": activation}
    network["channel"] = (
        {"delay": {"kind": "uniform", "low": 0.0, "high": 0.4}} if at == "nodes" else {}
    )
    sampling = {"kind": "periodic", "period": 0.4}
    settings = {"horizon": 1.6, "probe": [0.4, 0.9, 1.5], "network": network}
    scenario = clocked({"kind": "kcf", "epsilon": 0.5}, tmp_path, activation, sampling, **settings)
    exact, run = engine_covariance(scenario, "simpy")
    assert run.count("absorb") > 3
    close(theory.error_covariance(scenario, run), exact, 1e-9)
    close(error_law(scenario, run).P, run.P, 1e-9)


def test_what_does_not_go_together_is_refused_by_name(tmp_path):
    nodes, each = (
        {"kind": "poisson", "rate": 2.0, "at": "nodes"},
        {"kind": "periodic", "period": 0.5},
    )
    for algorithm, words in (
        ({"kind": "hcmci"}, r"filter\.consensus: must be information in continuous time"),
        ({"kind": "icf"}, r"filter\.kind: .*icf"),
        ({"kind": "diffusion-kalman"}, r"filter\.kind: .*diffusion-kalman"),
    ):
        with pytest.raises(netkf.ScenarioError, match=words):
            clocked(algorithm, tmp_path, nodes, each)
    wrong = {"kind": "hcmci", "consensus": "information", "novelty_weight": 2.0}
    with pytest.raises(netkf.ScenarioError, match=r"filter\.novelty_weight: has no meaning"):
        scenario_of(wrong, tmp_path)
    with pytest.raises(netkf.ScenarioError, match=r"filter\.weights: column 0"):
        scenario_of({"kind": "diffusion-kalman", "weights": (2.0 * np.eye(5)).tolist()}, tmp_path)
    kcf = clocked({"kind": "kcf"}, tmp_path, nodes, each)
    assert netkf.simulate(kcf).engine == "compiled"
