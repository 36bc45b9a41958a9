"""Gates refuse readings that are too far from what a filter expects."""

import dataclasses

import numpy as np
import pytest
import scipy.integrate
import scipy.stats

import netkf
from netkf.algorithms.gates import Gate
from netkf.engines.compiled.engine import CompiledEngine
from netkf.trace.schema import CODES
from tests.algorithms.test_block_intersection import ROBOTS, load
from tests.conftest import SCENARIOS
from tests.engines.agreement import assert_agree
from tests.engines.test_batches import assert_alone

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


# In slots and under clocks: a network of three nodes that lose messages, one with a bad sensor.
FILTERS = {
    "slots": {
        "local": 'kind = "local"',
        "central": 'kind = "central"',
        "hcmci": 'kind = "hcmci"',
        "diffusion": 'kind = "diffusion"',
        "constant-gain": 'kind = "constant-gain"\ngain = [{gain}, {wide}, {gain}]',
    },
    "clocks": {
        "central": 'kind = "central"',
        "gossip": 'kind = "gossip"',
        "hybrid": 'kind = "hybrid"\nepsilon = 0.1',
        "hcmci": 'kind = "hcmci"\nconsensus = "information"',
    },
}
GAINS = {"gain": "[[0.3, 0.1], [0.0, 0.3]]", "wide": "[[0.3, 0.1, 0.1], [0.0, 0.3, 0.2]]"}
LOSS = 'channel = {{ loss = {{ kind = "bernoulli", delivery = 0.7 }} }}\n'
OUTLIERS = 'fault = {{ kind = "outliers", probability = 0.3, sigma = 20.0 }}\nnodes = [1]'


def network_of(time, name):
    """The text of a scenario with a filter in ``time``, with a bad sensor at node 1."""
    activation = '{{ kind = "broadcast" }}'
    if time == "clocks":
        activation = '{{ kind = "poisson", rate = 1.0 }}'
    text = {"slots": SLOTS, "clocks": CLOCKS}[time].replace("nodes = 2 }}", "nodes = 3 }}")
    text = text.replace("nodes = [0, 1]", "nodes = [0, 1, 2]").replace("nodes = [1]", OUTLIERS)
    if name not in ("local", "central"):
        text = text.replace("[filter]", f"activation = {activation}\n{LOSS}[filter]")
    return text.replace('kind = "local"', FILTERS[time][name].format(**GAINS))


@pytest.mark.one_in(4)
@pytest.mark.parametrize("then", ["ignore", "inflate"])
@pytest.mark.parametrize(
    ("time", "name"), [(time, name) for time, names in FILTERS.items() for name in names]
)
def test_both_engines_refuse_the_same_readings(scenario_of, time, name, then):
    text = network_of(time, name)
    run = assert_agree(scenario_of(text, f'probability = 0.95, then = "{then}"', 12.0))
    assert run.count("refuse") > 3


@pytest.mark.parametrize("time", FILTERS)
def test_refusals_of_a_filter_that_all_share_name_who_read(scenario_of, time):
    run = assert_agree(scenario_of(network_of(time, "central"), "probability = 0.99", 12.0))
    nodes = run.log["node"][run.log["kind"] == CODES["refuse"]]
    assert np.bincount(nodes, minlength=3).argmax() == 1  # whose sensor is bad
    assert len(nodes) > 3


@pytest.mark.parametrize("time", FILTERS)
def test_batches_hold_the_single_runs(scenario_of, time):
    """Nine runs are more than a block of lanes holds, and each refuses other readings."""
    text = network_of(time, {"slots": "constant-gain", "clocks": "hybrid"}[time])
    then = {"slots": "ignore", "clocks": "inflate"}[time]
    scenario = scenario_of(text, f'probability = 0.95, then = "{then}"', 6.0)
    count = {"slots": 9, "clocks": 3}[time]
    assert_alone(scenario, CompiledEngine(), 5, range(2, 2 + count), fingerprint=True)


@pytest.mark.parametrize("time", FILTERS)
def test_a_gate_that_never_fires_changes_no_bit(scenario_of, time):
    text = network_of(time, "hcmci").replace(OUTLIERS, "nodes = [1]")
    wide = scenario_of(text, "probability = 0.999999999999", 12.0)
    without = dataclasses.replace(wide, filter=dataclasses.replace(wide.filter, gate=None))
    runs = [netkf.simulate(one, engine="compiled") for one in (wide, without)]
    assert runs[0].fingerprint == runs[1].fingerprint
    assert np.array_equal(runs[0].P, runs[1].P)
    assert np.array_equal(runs[0].xhat, runs[1].xhat)


LATE = 'channel = {{ delay = {{ kind = "uniform", low = 0.0, high = 0.6 }} }}\n'
LIVES = '[[network.lives]]\nnodes = [0, 1]\nkind = "crashes"\nmean_up = 5.0\nmean_down = 3.0\n'


def test_messages_that_are_late_and_nodes_that_are_down(scenario_of):
    text = network_of("slots", "hcmci").replace(LOSS, LATE + LIVES)
    text = text.replace('"broadcast"', '"broadcast", phase = 0.3')
    scenario = scenario_of(text, 'probability = 0.9, then = "ignore"', 15.0)
    run = assert_agree(scenario)
    assert_alone(scenario, CompiledEngine(), 5, range(2, 5), fingerprint=True)
    assert min(run.count(kind) for kind in ("refuse", "crash", "late")) > 3


@pytest.mark.parametrize("low", [0.0, 0.1])
def test_readings_in_messages_that_took_time_pass(scenario_of, low):
    text = network_of("clocks", "gossip").replace(LOSS, LATE if low else "")
    text = text.replace("low = 0.0", "low = 0.1").replace(
        'kind = "gossip"', 'kind = "intermittent"'
    )
    text = text.replace('kind = "poisson", rate = 1.0', 'kind = "readings"')
    log = netkf.simulate(scenario_of(text, "probability = 0.9", 15.0), engine="simpy").log
    peers = log["peer"][log["kind"] == CODES["refuse"]]
    assert (peers == -1).sum() > 3
    assert (peers >= 0).any() == (low == 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("then", ["ignore", "inflate"])
@pytest.mark.parametrize("name", ["range_tracking", "formation"])
def test_nonlinear_readings_pass_the_gate_once_they_are_linearised(name, then):
    folder = {"range_tracking": "nonlinear", "formation": "blocks"}[name]
    scenario = netkf.load(SCENARIOS / folder / f"{name}.toml").replace({"horizon": 15.0})
    scenario = scenario.replace({"filter.gate": {"probability": 0.7, "then": then}})
    assert assert_agree(scenario).count("refuse") > 10


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_gains_stay_with_their_rows(scenario_of, tmp_path, engine):
    """Of two sensors the gate refuses either: the other keeps its column of a constant gain."""
    rng = np.random.default_rng(7)
    y, horizon = rng.normal(size=(31, 2)) * 2.0, 30
    start, network = SLOTS.index("[[sensors]]"), SLOTS.index("[network]")
    sensors, H = "", np.array([[1.0, 0.0], [1.0, 1.0]])
    for k, row in enumerate(H.tolist()):
        lines = [f"{t}.0,1,{float(y[t, k])!r}" for t in range(horizon + 1)]
        (tmp_path / f"y{k}.csv").write_text("\n".join(["t,node,y0", *lines]) + "\n")
        sensors += f'[[sensors]]\nkind = "recorded"\npath = "y{k}.csv"\nH = [{row}]\nR = [[0.5]]\n'
    text = SLOTS[:start] + sensors + SLOTS[network:]
    L = np.array([[0.4, 0.05], [0.1, 0.3]])
    text = text.replace('"local"', f'"constant-gain"\ngain = {L.tolist()}')
    text = text.replace("[filter]", 'activation = {{ kind = "broadcast" }}\n[filter]', 1)
    text = text.replace('kind = "path", nodes = 2', 'kind = "edges", edges = [], nodes = 2')
    run = netkf.simulate(scenario_of(text, "probability = 0.8", float(horizon)), engine=engine)
    F, Q = np.array([[0.9, 0.3], [0.0, 0.8]]), np.diag([0.2, 0.3])
    x, P, limit, refusals = np.zeros(2), np.eye(2), scipy.stats.chi2.ppf(0.8, 1), []
    for k in range(1, horizon):
        x, P = F @ x, F @ P @ F.T + Q
        z = y[k] - H @ x
        taken = z**2 / (np.sum(H @ P * H, axis=1) + 0.5) <= limit
        x = x + L[:, taken] @ z[taken]
        if taken.any():
            # As if all had been taken, which this filter says of itself.
            A = np.eye(2) - L @ H
            P = A @ P @ A.T + 0.5 * L @ L.T
        refusals += [k] * int((~taken).sum())
        np.testing.assert_allclose(run.xhat[k, 1], x, rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(run.P[k, 1], P, rtol=1e-9, atol=1e-11)
    assert run.log[run.log["kind"] == CODES["refuse"]]["t"].tolist() == refusals
    assert len(set(refusals)) < len(refusals) < 2 * horizon - 10


TRIGGERED = {"kind": "event-triggered", "trigger": "stochastic", "Y": 0.5, "inner": {"kind": "icf"}}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"filter": {"kind": "intermittent"}}, "readings that messages bring"),
        ({"filter": TRIGGERED}, "readings that a trigger weighs with the noise they had"),
        ({"filter.linearise": "ukf"}, "nonlinear readings at sigma points"),
    ],
)
def test_what_the_compiled_engine_leaves_to_simpy(changes, words):
    file = {"filter": "intermittent_scalar.toml"}.get(next(iter(changes)))
    scenario = netkf.load(SCENARIOS / (file or "nonlinear/range_tracking.toml"))
    gate = {"probability": 0.9, "then": "inflate"}
    scenario = scenario.replace({**changes, "horizon": 2.0}).replace({"filter.gate": gate})
    with pytest.raises(netkf.EngineError, match=f"cannot run a gate on {words}; use engine="):
        netkf.simulate(scenario, engine="compiled")
    assert netkf.simulate(scenario).engine == "simpy"


def test_readings_of_pairs_in_messages_pass(tmp_path):
    """Nodes estimate blocks of their own, so that their H has other columns than the receiver's."""
    scenario = load(ROBOTS, tmp_path).replace({"filter.kind": "block-intersection", "horizon": 4.0})
    gated = scenario.replace({"filter.gate": {"probability": 0.999999999999}})
    run, other = (netkf.simulate(one, engine="simpy") for one in (scenario, gated))
    assert run.fingerprint == other.fingerprint
    np.testing.assert_array_equal(run.xhat, other.xhat)


@pytest.mark.parametrize("then", ["ignore", "inflate"])
@pytest.mark.parametrize("sensor", ["recorded", "range-bearing"])
@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_each_row_of_a_table_passes_by_itself_in_slots(tmp_path, engine, sensor, then):
    # Several readings of one slot are those of as many sensors with one each; the plant is driven,
    # so that readings are of states that are counted from its response.
    rng = np.random.default_rng(6)
    rows = [[f"{k}.0,1", rng.normal(2.0, 1.5, 2).tolist()] for k in range(12) for _ in range(3)]
    rows[4][1][1] = rows[9][1][0] = ""
    tables = {"all": rows, **{f"row{m}": rows[m::3] for m in range(3)}}
    for name, some in tables.items():
        lines = [f"{stamp},{y[0]},{y[1]}" for stamp, y in some]
        (tmp_path / f"{name}.csv").write_text("\n".join(["t,node,y0,y1", *lines]) + "\n")
    head, tail = SLOTS.partition("[[sensors]]")[0], SLOTS.partition("[network]")[2]
    head += 'input = {{ kind = "constant", value = 0.3, G = [[1.0], [0.0]] }}\n'
    H = "H = [[1.0, 0.0], [0.0, 1.0]]" if sensor == "recorded" else "positions = [[4.0, 4.0]]"

    def simulate(names):
        one = f'[[sensors]]\nkind = "{sensor}"\nnodes = [1]\n{H}\nR = [[0.5, 0.1], [0.1, 0.4]]\n'
        text = head + "".join(f'{one}path = "{name}.csv"\n' for name in names) + "[network]" + tail
        path = tmp_path / "rows.toml"
        gate = f'probability = 0.8, then = "{then}"'
        path.write_text(text.format(gate=gate, horizon=12.0))
        return netkf.simulate(netkf.load(path), engine=engine)

    together, apart = simulate(["all"]), simulate(["row0", "row1", "row2"])
    np.testing.assert_allclose(together.xhat, apart.xhat, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(together.P, apart.P, rtol=1e-9, atol=1e-12)
    assert together.fingerprint == apart.fingerprint
    assert 5 < together.count("refuse") < 30


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_two_readings_of_a_state_that_is_all_but_unknown(scenario_of, tmp_path, engine):
    """P is 1e20 times R, so that S is singular to rounding: the readings must fit each other."""
    text = SLOTS.replace("[[0.2, 0.0], [0.0, 0.3]]", "[[1e20, 0.0], [0.0, 1e20]]")
    one = '[[sensors]]\nkind = "recorded"\nnodes = [1]\npath = "both.csv"\n'
    one += "H = [[1.0, 0.0], [2.0, 0.0]]\nR = [[1.0, 0.0], [0.0, 1.0]]\n"
    text = text.split("[[sensors]]", maxsplit=1)[0] + one + "[network]" + text.split("[network]")[1]
    # The rest of (y, 2 y + d) is d^2 / 5: beyond the quantile 4.61 of .9 for d = 7, not for d = 4.
    rows = ["t,node,y0,y1", "1,1,1e9,2000000004", "2,1,-3e9,-5999999993", "3,1,5e8,1e9"]
    (tmp_path / "both.csv").write_text("\n".join(rows) + "\n")
    run = netkf.simulate(scenario_of(text, "probability = 0.9", 5.0), engine=engine)
    assert run.log["t"][run.log["kind"] == CODES["refuse"]].tolist() == [2.0]


ANCHORS = """
format = 1
name = "anchors"
horizon = 4.0
probe = 1.0
[plant]
kind = "unknown"
{plant}
mean = [3.0, 4.0]
cov = [[1.0, 0.0], [0.0, 1.0]]
[[sensors]]
kind = "range"
path = "y.csv"
nodes = [0, 1]
R = [[1.0]]
positions = [[0.0, 0.0], [6.0, 0.0]]
[network]
graph = {{ kind = "path", nodes = 2 }}
activation = {{ kind = "{activation}" }}
[filter]
kind = "local"
"""
TIMES = {
    "slots": (
        "F = [[0.9, 0.0], [0.0, 0.9]]\nQ = [[1.0, 0.0], [0.0, 1.0]]\nperiod = 1.0",
        "broadcast",
    ),
    "clocks": ("A = [[-0.1, 0.0], [0.0, -0.1]]\nB = [[1.0, 0.0], [0.0, 1.0]]", "readings"),
}


@pytest.mark.parametrize("kind", ["local", "central"])
@pytest.mark.parametrize("time", TIMES)
def test_a_reading_at_sigma_points_is_judged_by_itself(tmp_path, time, kind):
    """Healthy ones of the same instant are used as if the outliers were not in the table, and what
    is inflated has the R with which its NIS is the limit.
    """
    plant, activation = TIMES[time]
    (tmp_path / "s.toml").write_text(ANCHORS.format(plant=plant, activation=activation))
    healthy = ["1.0,0,5.0,1", "1.0,1,5.0,1", "2.0,0,5,1", "3.0,0,5.0,1", "3.0,0,5.1,1"]
    bad = {"1.0,0,60,1": 1, "2.0,1,40,1": 4}

    def simulate(rows, gate=None):
        (tmp_path / "y.csv").write_text("\n".join(["t,node,y0,R0", *rows]) + "\n")
        changes = {"filter.kind": kind, "filter.linearise": "ckf"}
        changes |= {} if gate is None else {"filter.gate": {"probability": 0.99, "then": gate}}
        return netkf.simulate(netkf.load(tmp_path / "s.toml", changes))

    rows = list(healthy)
    for row, place in bad.items():
        rows.insert(place, row)
    gated, clean = simulate(rows, "ignore"), simulate(healthy)
    assert gated.count("refuse") == len(bad)
    np.testing.assert_allclose(gated.xhat, clean.xhat, rtol=1e-12)
    np.testing.assert_allclose(gated.P, clean.P, rtol=1e-12)
    # Before the first reading the state has this law, in both models of time.
    mean, variance = simulate([]).xhat[1, 0], simulate([]).P[1, 0, 0, 0]
    steps = np.sqrt(2.0 * variance) * np.vstack([np.eye(2), -np.eye(2)])
    expected = np.hypot(*(mean + steps).T)
    limit = scipy.stats.chi2.ppf(0.99, 1)
    noise = float((60.0 - expected.mean()) ** 2 / limit - expected.var())
    inflated, wider = simulate(["1.0,0,60,1"], "inflate"), simulate([f"1.0,0,60,{noise!r}"])
    np.testing.assert_allclose(inflated.xhat, wider.xhat, rtol=1e-9)
    np.testing.assert_allclose(inflated.P, wider.P, rtol=1e-9)
