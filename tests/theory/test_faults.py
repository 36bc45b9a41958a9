"""How likely a gate is to refuse readings of a bad sensor."""

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.stats

import netkf
from netkf.theory.common.faults import refusals
from netkf.trace.schema import CODES

SLOTS = """
format = 1
name = "caught"
horizon = {horizon}
probe = 1.0
[plant]
kind = "linear"
period = 1.0
F = [[0.95]]
Q = [[0.002]]
[[sensors]]
nodes = {nodes}
H = [[1.0]]
R = [[0.5]]
fault = {fault}
[network]
graph = {{ kind = "path", nodes = {count} }}
[filter]
kind = "local"
cov = [[{cov}]]
{gate}
"""
GATE = 'gate = { probability = 0.99, then = "ignore" }'
F, Q, R = 0.95, 0.002, 0.5


def steady():
    """Prediction covariance, from its quadratic equation, and gain of the scalar filter."""
    b = R * (1.0 - F * F) - Q
    P = 0.5 * (-b + np.sqrt(b * b + 4.0 * Q * R))
    return P, P / (P + R)


@pytest.fixture
def scenario_of(tmp_path):
    def make(fault, count=1, horizon=40.0, gate=GATE):
        P, K = steady()
        # The start before slot 0's prediction to slot 1, so that P is steady from slot 1 on.
        text = SLOTS.format(
            nodes=list(range(count)), count=max(count, 2), horizon=horizon, fault=fault,
            gate=gate, cov=(1.0 - K) * P,
        )  # fmt: skip
        (tmp_path / "caught.toml").write_text(text)
        return netkf.load(tmp_path / "caught.toml")

    return make


def of(scenario):
    [(placed, fault)] = scenario.faults[0]
    return refusals(scenario, placed, fault, scenario.filter.gate)


def normal_tail(mean, S):
    """P(z^2 / S > c) of a normal z by its integral."""
    edge = np.sqrt(scipy.stats.chi2.ppf(0.99, 1) * S)
    density = lambda z: np.exp(-((z - mean) ** 2) / (2.0 * S)) / np.sqrt(2.0 * np.pi * S)  # noqa: E731
    return 1.0 - scipy.integrate.quad(density, -edge, edge, epsabs=1e-13)[0]


@pytest.mark.parametrize(
    ("fault", "bias"),
    [
        ('{ kind = "biased", size = 1.5, since = 5.0 }', lambda t: 1.5),
        ('{ kind = "drifting", rate = -0.2, since = 4.5, until = 30.0 }', lambda t: 0.9 - 0.2 * t),
    ],
)  # fmt: skip
def test_probabilities_are_integrals_over_biases_that_the_filter_follows(scenario_of, fault, bias):
    found, (P, K), e = of(scenario_of(fault)), steady(), 0.0
    assert found.times[0] == 5.0
    for t, alone, knowing in zip(*found, strict=True):
        z = bias(t) - e
        assert alone == pytest.approx(normal_tail(z, P + R), abs=1e-9)
        assert knowing == pytest.approx(normal_tail(bias(t), R), abs=1e-9)
        e = F * (e + K * z)


@pytest.mark.slow
def test_first_bad_readings_are_refused_so_often(scenario_of):
    scenario = scenario_of('{ kind = "biased", size = 1.5, since = 5.0 }', count=150, horizon=6.0)
    refused = 0
    for seed in range(8):
        log = netkf.simulate(scenario, seed=seed, engine="simpy").log
        refused += int(((log["kind"] == CODES["refuse"]) & (log["t"] == 5.0)).sum())
    # The nodes share the state, so that they are not quite independent: seven deviations.
    probability = of(scenario).alone[0]
    assert 0.2 < probability < 0.6
    assert abs(refused / 1200 - probability) < 7.0 * np.sqrt(probability * (1 - probability) / 1200)


def test_an_outlier_is_refused_with_the_probability_of_its_spread(scenario_of):
    found, (P, _) = (
        of(scenario_of('{ kind = "outliers", probability = 0.1, sigma = 2.0 }')),
        steady(),
    )
    limit = scipy.stats.chi2.ppf(0.99, 1)
    for value, S in ((found.alone[0], P + R), (found.knowing[0], R)):
        assert value == pytest.approx(scipy.stats.chi2.sf(limit * S / (S + 4.0), 1), rel=1e-9)


def test_of_two_values_that_with_the_most_noise_hides_an_outlier_best(scenario_of):
    outliers = scenario_of('{ kind = "outliers", probability = 0.1, sigma = 2.0 }')
    both = {"sensors.0.H": [[1.0], [1.0]], "sensors.0.R": [[0.1, 0.0], [0.0, 0.9]]}
    limit = scipy.stats.chi2.ppf(0.99, 2)
    expected = scipy.stats.chi2.sf(limit * 0.9 / (0.9 + 4.0), 2)
    assert of(outliers.replace(both)).knowing[0] == pytest.approx(expected, rel=1e-9)


def test_readings_are_looked_at_from_the_first_to_before_the_horizon(scenario_of):
    found = of(scenario_of('{ kind = "biased", size = 1.5 }'))
    assert found.times.tolist() == list(range(1, 40))


CLOCKED = {
    "plant": {"kind": "diffusion", "A": [[-0.05]], "B": [[0.05]]},
    "sensors.0.sampling": {"kind": "periodic", "period": 1.0},
}
PHASE = {"kind": "periodic", "period": 1.0, "phase": 0.5}


@pytest.mark.parametrize(
    ("changes", "known"),
    [
        (CLOCKED, True),
        ({**CLOCKED, "sensors.0.sampling": PHASE}, False),
        ({"plant.schedule": [{"from": 10.0, "F": [[0.9]]}]}, False),
        ({"filter.model.R": [[2.0]]}, False),
        ({"filter.model.Q": [[2.0]]}, False),
    ],
)
def test_what_follows_of_no_steady_consistent_filter_is_not_known(scenario_of, changes, known):
    scenario = scenario_of('{ kind = "biased", size = 1.5, since = 5.0 }').replace(changes)
    assert (of(scenario) is not None) is known


def test_readings_by_a_clock_are_refused_as_those_of_the_slots_that_it_makes(scenario_of):
    A, B = np.array([[-0.1, 0.3], [0.0, -0.2]]), np.array([[0.05], [0.1]])
    # Van Loan: one exponential has both exp(A h) and the noise of h seconds.
    whole = scipy.linalg.expm(0.5 * np.block([[-A, B @ B.T], [np.zeros((2, 2)), A.T]]))
    sensor = {"sensors.0.H": [[1.0, 0.5]], "filter.cov": np.eye(2).tolist()}
    F, Q = whole[2:, 2:].T, whole[2:, 2:].T @ whole[:2, 2:]
    slots = {"kind": "linear", "F": F.tolist(), "Q": (0.5 * (Q + Q.T)).tolist(), "period": 0.5}
    clock = {"sensors.0.sampling": {"kind": "periodic", "period": 0.5}}
    clocked = {"kind": "diffusion", "A": A.tolist(), "B": B.tolist()}
    made = scenario_of('{ kind = "biased", size = 1.5, since = 5.0 }')
    by_slots, by_clock = (
        of(made.replace({**sensor, **more}))
        for more in ({"plant": slots}, {"plant": clocked, **clock})
    )
    assert by_slots.alone[0] > 2.0 * by_slots.alone[-1]
    np.testing.assert_allclose(by_clock, by_slots, rtol=1e-9)


def test_who_knows_the_state_notices_a_drift_before_who_hears_nobody(scenario_of):
    (P, K), e, first = steady(), 0.0, {}
    for t in range(1, 40):
        z = 0.1 * t - e
        for who, tail in (("alone", normal_tail(z, P + R)), ("knows", normal_tail(0.1 * t, R))):
            if tail >= 0.5:
                first.setdefault(who, t)
        e = F * (e + K * z)
    assert first["knows"] < first["alone"]
    rows = netkf.theory.assumptions(scenario_of('{ kind = "drifting", rate = 0.1 }'))
    evidence = rows[rows["assumption"] == "all sensors are healthy"].iloc[0]["evidence"]
    assert f"1/2 from {first['alone']} s on and from {first['knows']} s on" in evidence


@pytest.mark.parametrize(
    ("fault", "gate", "words"),
    [
        ('{ kind = "biased", size = 0.05 }', GATE, "can never tell biased readings from healthy"),
        ('{ kind = "biased", size = 9.0 }', GATE, "first biased reading with probability 1 to 1"),
        (
            '{ kind = "drifting", rate = 0.5 }',
            GATE,
            "least 1/2 from 4 s on and from 4 s on",
        ),
        ('{ kind = "stuck", since = 3.0 }', GATE, "stuck readings is not known beforehand"),
        ('{ kind = "outliers", probability = 0.1, sigma = 9.0 }', GATE, "refuses an outlier with"),
        (
            '{ kind = "biased", size = 9.0, since = 3.1, until = 3.2 }',
            GATE,
            "reading while it is bad (biased)",
        ),
        (
            '{ kind = "outliers", probability = 1.0, sigma = 9.0, since = 3.1, until = 3.2 }',
            GATE,
            "reading while it is bad (outliers)",
        ),
        ('{ kind = "stuck" }', "", "no gate refuses their readings"),
    ],
)
def test_theory_says_whether_the_gate_can_notice(scenario_of, fault, gate, words):
    rows = netkf.theory.assumptions(scenario_of(fault, gate=gate))
    evidence = rows[rows["assumption"] == "all sensors are healthy"].iloc[0]["evidence"]
    assert words in evidence
