"""The filter with constant gains: its equations in slots and continuous time, and H Remark 1."""

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg

import netkf
from netkf import theory
from netkf.algorithms.kernels.constant_gains import fill_inverse_transition
from netkf.theory.errors import error_law
from tests.algorithms.test_literature import clocked, heard_by_slot, scenario_of, textbook
from tests.engines.linearity import engine_covariance
from tests.theory.test_replay import close

GAINS = [
    [[0.3], [0.1]],
    [[0.2, 0.1], [0.1, 0.3]],
    [[0.2, 0.1, 0.0], [0.1, 0.3, 0.1]],
    [[0.1, 0.2], [0.0, 0.3]],
    [[0.0], [0.0]],
]
FILTER = {"kind": "constant-gain", "gain": GAINS}


def plain_slots(scenario, run):
    degrees, heard = scenario.topology.degrees, heard_by_slot(scenario, run, 1)

    def step(slot, x, P, readings):
        for i, (y, H, R) in readings.items():
            L = np.array(GAINS[i])
            closed = np.eye(len(x[i])) - L @ H
            x[i], P[i] = x[i] + L @ (y - H @ x[i]), closed @ P[i] @ closed.T + L @ R @ L.T
        up = heard.get(slot, [np.zeros((5, 5))])[0]
        weights = np.array(
            [[up[i, j] / (1.0 + max(degrees[i], degrees[j])) for j in range(5)] for i in range(5)]
        )
        weights += np.diag(1.0 - weights.sum(axis=1))
        return [list(np.tensordot(weights, np.stack(one), 1)) for one in (x, P)]

    found = list(textbook(scenario, run, step))
    return np.stack([x for x, _ in found]), np.stack([P for _, P in found])


@pytest.mark.one_in(2)
@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_the_equations_in_slots(engine, tmp_path):
    for seed in range(3):
        scenario = scenario_of(FILTER, tmp_path, seed)
        run = netkf.simulate(scenario, engine=engine)
        xhat, P = plain_slots(scenario, run)
        np.testing.assert_allclose(run.P, P, rtol=1e-10, atol=1e-11)
        np.testing.assert_allclose(run.xhat, xhat, rtol=1e-10, atol=1e-10)


def test_exact_errors_in_slots_and_of_samples(tmp_path):
    slots = scenario_of(FILTER, tmp_path, 1, horizon=3.0, probe=[0.0, 1.0, 2.0])
    nodes = {"kind": "poisson", "rate": 2.0, "at": "nodes"}
    sampling = {"kind": "periodic", "period": 0.4}
    one = {"kind": "constant-gain", "gain": [[0.3], [0.2]]}
    under = {"horizon": 1.6, "probe": [0.4, 0.9, 1.5]}
    for scenario in (slots, clocked(one, tmp_path, nodes, sampling, **under)):
        exact, run = engine_covariance(scenario, "simpy")
        close(theory.error_covariance(scenario, run), exact, 1e-9)
        close(error_law(scenario, run).P, run.P, 1e-9)
        gap = run.P - theory.error_covariance(scenario, run)
        assert np.linalg.eigvalsh(gap)[..., 0].min() > -1e-12


def steady_gains(ring):
    """L_i of the steady state of H (12), zeros for blind nodes."""
    P = theory.steady_covariance_bound(ring)
    H, R = np.array([[1.0, 0.0]]), 0.25
    return [(p @ H.T / R).tolist() for p in P]


def test_increments_against_the_lyapunov_equation_and_the_engine_s_own_map(ring):
    """P between resets by a plain integration; errors have that covariance."""
    gains = steady_gains(ring)
    alone = {"network.activation.rate": 1e-6, "horizon": 1.0, "probe": [0.25, 1.0]}
    scenario = ring.replace({**alone, "filter": {"kind": "constant-gain", "gain": gains}})
    run = netkf.simulate(scenario)
    assert run.count("tick") == 0
    A, B, H = scenario.plant.A, scenario.plant.B, np.array([[1.0, 0.0]])
    for node in (0, 1):
        L = np.array(gains[node]) if node in scenario.placed_sensors else np.zeros((2, 1))
        closed = A - L @ H
        Q = B @ B.T + 0.25 * L @ L.T

        def change(t, P, closed=closed, Q=Q):
            P = P.reshape(2, 2)
            return (closed @ P + P @ closed.T + Q).reshape(-1)

        first = scenario.initial_estimate(node)[1].reshape(-1)
        solved = scipy.integrate.solve_ivp(change, (0.0, 1.0), first, rtol=1e-11, atol=1e-12)
        np.testing.assert_allclose(run.P[1, node].reshape(-1), solved.y[:, -1], rtol=1e-8)
    by_draws, again = engine_covariance(scenario)
    size = np.linalg.norm(again.P, axis=(2, 3))
    assert (np.linalg.norm(by_draws - again.P, axis=(2, 3)) <= 1e-3 * size).all()


def test_gains_that_vary_beat_constant_ones_on_the_same_ticks(ring):
    """H Remark 1, (15): on a cycle Metropolis weights are those of epsilon = 1/3."""
    short = ring.replace({"horizon": 4.0, "filter.epsilon": 1.0 / 3.0})
    constant = short.replace({"filter": {"kind": "constant-gain", "gain": steady_gains(ring)}})
    best, ours = netkf.simulate(short), netkf.simulate(constant)
    assert ours.count("absorb") == best.count("absorb") > 20
    gap = np.linalg.eigvalsh(ours.P - best.P)[..., 0]
    assert gap.min() > -1e-9
    assert np.trace(ours.P - best.P, axis1=2, axis2=3).max() > 0.05


def test_check_of_increments_says_that_their_exact_errors_are_not_known(ring):
    """It refused the scenario: what is not known was asked for to count the runs to replay."""
    constant = {"kind": "constant-gain", "gain": [[0.3], [0.1]]}
    scenario = ring.replace({"horizon": 1.0, "filter": constant})
    table = netkf.check(scenario, runs=10).table.set_index("promise")
    row = table.loc["errors have the covariance that the equations give them"]
    assert row.verdict == "not promised"


def test_gains_that_do_not_fit_are_refused(tmp_path):
    for gain, words in (
        (GAINS[:3], r"filter\.gain: must be one matrix, or one for each of 5 nodes; got '3"),
        ([[0.1], [0.2]], r"filter\.gain: must be 2 x 2, because node 1 has 2 rows"),
        ([*GAINS[:2], *GAINS[:3]], r"filter\.gain\[2\]: must be 2 x 3, because node 2 has 3"),
    ):
        with pytest.raises(netkf.ScenarioError, match=words):
            scenario_of({"kind": "constant-gain", "gain": gain}, tmp_path)


@pytest.mark.parametrize("n", [1, 2, 3, 5, 8])
def test_inverse_transitions_are_matrix_exponentials(n):
    maps = np.empty((3, n, n))
    for seed in range(5):
        A = np.random.default_rng(seed).standard_normal((n, n))
        for gap in (0.0, 1e-6, 0.3, 4.0):
            fill_inverse_transition(np.zeros(n), A, gap, maps)
            expected = scipy.linalg.expm(-A * gap)
            np.testing.assert_allclose(maps[0], expected, rtol=1e-10, atol=1e-13 * expected.max())
