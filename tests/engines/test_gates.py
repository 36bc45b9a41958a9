"""Gates refuse readings that are too far from what a filter expects."""

import dataclasses

import numpy as np
import pytest
import scipy.integrate
import scipy.stats

import netkf
from netkf.algorithms.gates import Gate
from netkf.trace.schema import CODES

SLOTS = """
format = 1
name = "gate"
horizon = {horizon}
probe = 1.0
[plant]
kind = "linear"
period = 1.0
F = [[0.9, 0.3], [0.0, 0.8]]
Q = [[0.2, 0.0], [0.0, 0.3]]
cov = [[1.0, 0.0], [0.0, 1.0]]
[[sensors]]
nodes = [0, 1]
H = [[1.0, 0.0], [0.0, 1.0]]
R = [[0.5, 0.1], [0.1, 0.4]]
[[sensors]]
nodes = [1]
H = [[1.0, 1.0]]
R = [[0.2]]
[network]
graph = {{ kind = "path", nodes = 2 }}
[filter]
kind = "local"
gate = {{ {gate} }}
"""
CLOCKS = SLOTS.replace('kind = "linear"\nperiod = 1.0\nF', 'kind = "diffusion"\nA')
CLOCKS = CLOCKS.replace("A = [[0.9, 0.3], [0.0, 0.8]]", "A = [[-0.1, 0.3], [0.0, -0.2]]")
CLOCKS = CLOCKS.replace("Q = [[0.2, 0.0], [0.0, 0.3]]", "B = [[0.5, 0.0], [0.0, 0.6]]")
CLOCKS = CLOCKS.replace("\nR =", '\nsampling = {{ kind = "periodic", period = 0.5 }}\nR =')


@pytest.fixture
def scenario_of(tmp_path):
    def make(text, gate, horizon=200.0):
        path = tmp_path / "gate.toml"
        path.write_text(text.format(gate=gate, horizon=horizon))
        return netkf.load(path)

    return make


@pytest.mark.parametrize("then", ["ignore", "inflate"])
def test_slots_are_the_plain_recursion(scenario_of, tmp_path, then):
    # The readings are recorded, so that the filter can be written plainly beside them.
    rng = np.random.default_rng(5)
    y = rng.normal(size=(40, 3)) * 2.0
    for name, columns in (("a", (0, 1)), ("b", (2,))):
        lines = ["t,node," + ",".join(f"y{k}" for k in range(len(columns)))]
        lines += [
            ",".join(map(repr, [float(k), 1, *y[k, list(columns)].tolist()])) for k in range(40)
        ]
        (tmp_path / f"{name}.csv").write_text("\n".join(lines) + "\n")
    text = SLOTS.replace("nodes = [0, 1]", "nodes = [1]", 1)
    first, second = text.split("[[sensors]]")[1:3]
    text = text.replace(first, f'\nkind = "recorded"\npath = "a.csv"{first}')
    text = text.replace(second, f'\nkind = "recorded"\npath = "b.csv"{second}')
    run = netkf.simulate(scenario_of(text, f'probability = 0.9, then = "{then}"', 40.0), seed=1)
    F, Q = np.array([[0.9, 0.3], [0.0, 0.8]]), np.diag([0.2, 0.3])
    H1, R1 = np.eye(2), np.array([[0.5, 0.1], [0.1, 0.4]])
    H2, R2 = np.array([[1.0, 1.0]]), np.array([[0.2]])
    x, P, refused = np.zeros(2), np.eye(2), []
    found = {0: (x, P)}
    for k in range(1, 40):
        x, P = F @ x, F @ P @ F.T + Q
        taken = []
        for z, H, R in ((y[k, :2], H1, R1), (y[k, 2:], H2, R2)):
            limit, e = scipy.stats.chi2.ppf(0.9, len(z)), z - H @ x
            factor = 1.0
            if e @ np.linalg.solve(H @ P @ H.T + R, e) > limit:
                refused.append(k)
                factor = np.inf
                if then == "inflate":
                    # By bisection on the definition.
                    low, high = 1.0, 1e9
                    for _ in range(200):
                        factor = 0.5 * (low + high)
                        far = e @ np.linalg.solve(H @ P @ H.T + factor * R, e) > limit
                        low, high = (factor, high) if far else (low, factor)
            if np.isfinite(factor):
                taken.append((z, H, factor * R))
        for z, H, R in taken:
            S = H @ P @ H.T + R
            K = np.linalg.solve(S, H @ P).T
            x, P = x + K @ (z - H @ x), P - K @ S @ K.T
        found[k] = x, P
    for t, xhat, P in zip(run.times[:40], run.xhat[:40, 1], run.P[:40, 1], strict=True):
        expected = found[round(float(t))]
        np.testing.assert_allclose(xhat, expected[0], rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(P, expected[1], rtol=1e-7, atol=1e-9)
    rows = run.log[run.log["kind"] == CODES["refuse"]]
    assert rows["t"].tolist() == list(map(float, refused))
    assert len(rows) > 5


@pytest.mark.parametrize("text", [SLOTS, CLOCKS], ids=["slots", "clocks"])
@pytest.mark.slow
def test_a_healthy_reading_is_refused_as_often_as_theory_says(scenario_of, text):
    # Refused readings that are inflated leave the filter nearly consistent: the share is at least
    # that of a consistent one, and near to it.
    run = netkf.simulate(scenario_of(text, "probability = 0.99", 2000.0), seed=3)
    readings = {0: 1, 1: 2}
    log = run.log
    refused = (log["kind"] == CODES["refuse"]).sum()
    sense = log[log["kind"] == CODES["sense"]]
    taken = sum(int((sense["node"] == n).sum()) * c for n, c in readings.items())
    share, deviation = refused / taken, np.sqrt(0.01 * 0.99 / taken)
    assert 0.01 - 4.5 * deviation < share < 0.01 * 1.35 + 4.5 * deviation


def test_error_after_a_refused_reading():
    # One update of a scalar filter: P = 1, H = 1, R = .5, gate .8, by numbers and by the integral.
    gate, P, R = Gate(probability=0.8), 1.0, 0.5
    S, c = P + R, gate.limit(1)
    tail = scipy.integrate.quad(lambda z: z * z * scipy.stats.norm.pdf(z), np.sqrt(c), np.inf)[0]
    assert gate.refused_spread(1) == pytest.approx(2.0 * tail / 0.2, rel=1e-9)
    rng = np.random.default_rng(1)
    e = rng.normal(size=400_000)
    z = e + np.sqrt(R) * rng.normal(size=len(e))
    refused = z * z > c * S
    K = P / S
    expected = P + (gate.refused_spread(1) - 1.0) * K * S * K
    spread = np.sqrt(2.0 / refused.sum()) * expected
    assert e[refused].var() == pytest.approx(expected, abs=5.0 * spread)
    # Readings that are taken leave P as it is.
    left = (e - K * z)[~refused]
    assert left.var() == pytest.approx(P - K * S * K, abs=5.0 * np.sqrt(2.0 / len(left)))


def test_a_fault_fires_the_gate_and_a_wide_gate_changes_nothing(scenario_of):
    wide = scenario_of(CLOCKS, "probability = 0.999999999999", 50.0)
    without = dataclasses.replace(wide, filter=dataclasses.replace(wide.filter, gate=None))
    runs = [netkf.simulate(one, seed=2, engine="simpy") for one in (wide, without)]
    assert runs[0].fingerprint == runs[1].fingerprint
    assert np.array_equal(runs[0].P, runs[1].P)


def test_theory_and_check_say_what_is_not_promised(scenario_of):
    scenario = scenario_of(SLOTS, "probability = 0.95", 20.0)
    with pytest.raises(netkf.TheoryError, match=r"refuses a healthy reading .* probability 0\.05"):
        netkf.theory.error_covariance(scenario, netkf.simulate(scenario, seed=1))
    table = netkf.check(scenario, runs=10, seed=1).table
    assert "broken" not in set(table["verdict"])
    assert table["assumptions"].str.contains("every reading is used").any()
    assert netkf.load(write(scenario)).filter.gate == scenario.filter.gate


def write(scenario):
    from netkf.scenario.writing import as_table, to_toml

    path = scenario._folder / "again.toml"
    path.write_text(to_toml(as_table(scenario)))
    return path


@pytest.mark.parametrize("then", ["ignore", "inflate"])
def test_readings_of_others_pass_the_gate_too(scenario_of, tmp_path, then):
    """A node hears the reading of the other in the same slot, after it has used its own, with the R
    that the other's gate has given to it.
    """
    rng = np.random.default_rng(8)
    y = rng.normal(size=(40, 2)) * 2.0
    rows = [f"{k}.0,{i},{float(y[k, i])!r}" for k in range(40) for i in (0, 1)]
    (tmp_path / "y.csv").write_text("\n".join(["t,node,y0", *rows]) + "\n")
    start, network = SLOTS.index("[[sensors]]"), SLOTS.index("[network]")
    sensor = '[[sensors]]\nkind = "recorded"\npath = "y.csv"\nH = [[1.0, 0.5]]\nR = [[0.5]]\n'
    text = SLOTS[:start] + sensor + SLOTS[network:]
    text = text.replace('"local"', '"intermittent"').replace(
        "[filter]", 'activation = {{ kind = "broadcast" }}\n[filter]'
    )
    run = netkf.simulate(scenario_of(text, f'probability = 0.9, then = "{then}"', 40.0), seed=1)
    F, Q = np.array([[0.9, 0.3], [0.0, 0.8]]), np.diag([0.2, 0.3])
    H, limit = np.array([[1.0, 0.5]]), scipy.stats.chi2.ppf(0.9, 1)
    nodes, found, refused = [(np.zeros(2), np.eye(2))] * 2, [], []

    def use(k, i, j, R):
        """Let node i use the reading of node j, sent with R; return the R it is used with."""
        (x, P), z = nodes[i], (y[k, j] - H @ nodes[i][0])[0]
        expected = (H @ P @ H.T)[0, 0]
        if z * z / (expected + R) > limit:
            refused.append((k, i, j))
            # The R with which z^2 / S is the limit.
            R = z * z / limit - expected if then == "inflate" else np.inf
        if np.isfinite(R):
            K = P @ H.T / (expected + R)
            nodes[i] = x + K[:, 0] * z, P - K @ H @ P
        return R

    for k in range(40):
        found.append([*nodes])
        sent = [use(k, i, i, 0.5) for i in (0, 1)]
        for i in (0, 1):
            if np.isfinite(sent[1 - i]):
                use(k, i, 1 - i, sent[1 - i])
        nodes = [(F @ x, F @ P @ F.T + Q) for x, P in nodes]
    for k, both in enumerate(found):
        for i, (x, P) in enumerate(both):
            np.testing.assert_allclose(run.xhat[k, i], x, rtol=1e-7, atol=1e-9)
            np.testing.assert_allclose(run.P[k, i], P, rtol=1e-7, atol=1e-9)
    rows = run.log[run.log["kind"] == CODES["refuse"]]
    told = [(int(row["t"]), row["node"], row["peer"] if row["peer"] >= 0 else row["node"])
            for row in rows]  # fmt: skip
    assert sorted(told) == sorted(refused)
    assert any(i != j for _, i, j in refused)
