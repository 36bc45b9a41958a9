"""Sensors that are stuck, biased, drifting or have outliers."""

from dataclasses import dataclass

import numpy as np
import pytest
import scipy.linalg

import netkf
from netkf.core.errors import ScenarioError
from netkf.plants.faults import Biased, Drifting, Fault, FaultyReadings, Outliers, Stuck
from netkf.rng.streams import Streams

# Without noise estimates are a linear map of x(0) and of the fault, which is written plainly here.
CLOCKED = """
format = 1
name = "bad-sensors"
horizon = 10.0
probe = 0.25
[plant]
kind = "diffusion"
A = [[-0.1, 1.0], [0.0, -0.3]]
B = [[0.0, 0.0], [0.0, 0.0]]
mean = [2.0, -3.0]
[[sensors]]
nodes = [0, 1]
H = [[1.0, 0.0], [0.0, 1.0]]
R = [[1e-24, 0.0], [0.0, 1e-24]]
sampling = {{ kind = "periodic", period = 0.5 }}
{fault}
[network]
graph = {{ kind = "path", nodes = 2 }}
[filter]
kind = "local"
mean = [0.5, 0.0]
cov = [[1.0, 0.2], [0.2, 2.0]]
[filter.model]
B = [[0.2, 0.0], [0.0, 1.0]]
R = [[0.3, 0.0], [0.0, 0.4]]
"""
A, BB, R = np.array([[-0.1, 1.0], [0.0, -0.3]]), np.diag([0.04, 1.0]), np.diag([0.3, 0.4])
BIG = scipy.linalg.expm(0.25 * np.block([[-A, BB], [np.zeros((2, 2)), A.T]]))
F, Q = BIG[2:, 2:].T, BIG[2:, 2:].T @ BIG[:2, 2:]
FAULTS = {
    "stuck": 'fault = { kind = "stuck", since = 2.0, until = 6.0, nodes = [1] }',
    "value": 'fault = { kind = "stuck", since = 2.25, value = [4.0, -1.0], nodes = [1] }',
    "biased": 'fault = { kind = "biased", since = 2.0, until = 6.0, size = [1, -2], nodes = [1] }',
    "drifting": 'fault = { kind = "drifting", since = 2.25, rate = 0.7, nodes = [1] }',
    "outliers": 'fault = { kind = "outliers", probability = 0.4, sigma = 3.0, nodes = [1] }',
}


@pytest.fixture
def scenario_of(tmp_path):
    def make(fault="", slots=False, more=""):
        text = CLOCKED.format(fault=fault) + more
        if slots:
            plain = lambda M: str(np.asarray(M).tolist())  # noqa: E731
            a, b = text.index("[plant]"), text.index("mean = [2.0")
            plant = f'[plant]\nkind = "linear"\nperiod = 0.25\nF = {plain(F)}\n'
            text = text[:a] + plant + "Q = [[0.0, 0.0], [0.0, 0.0]]\n" + text[b:]
            text = text.replace('sampling = { kind = "periodic", period = 0.5 }\n', "")
            text = text.replace("B = [[0.2, 0.0], [0.0, 1.0]]", f"Q = {plain(Q)}")
        (tmp_path / "bad.toml").write_text(text)
        return netkf.load(tmp_path / "bad.toml")

    return make


def given(kind, k, t, y, random, held):
    """What the sensor of node 1 gives at time t."""
    if kind == "outliers":
        off, noise = random.random() < 0.4, random.standard_normal(2)
        return y + 3.0 * noise * off
    if kind == "stuck" and 2.0 <= t <= 6.0:
        return held.setdefault("y", y)
    if kind == "value" and t >= 2.25:
        return np.array([4.0, -1.0])
    if kind == "biased" and 2.0 <= t <= 6.0:
        return y + np.array([1.0, -2.0])
    return y + 0.7 * (t - 2.25) if kind == "drifting" and t >= 2.25 else y


def plain_estimates(kind, slots, seed):
    random, held = Streams(seed).generator("fault", 1, 0), {}
    truth, x, P = np.array([2.0, -3.0]), np.array([0.5, 0.0]), np.array([[1.0, 0.2], [0.2, 2.0]])
    found = [x]
    for k in range(1, 41):
        truth, x, P = F @ truth, F @ x, F @ P @ F.T + Q
        last = k == 40 and not slots
        if (slots or k % 2 == 0) and not last:
            y = given(kind, k, 0.25 * k, truth, random, held)
            K = P @ np.linalg.inv(P + R)
            x, P = x + K @ (y - x), P - K @ P
        found.append(x)
    return np.array(found)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("engine", ["simpy", "compiled"])
@pytest.mark.parametrize("slots", [False, True], ids=["clocks", "slots"])
@pytest.mark.parametrize("kind", FAULTS)
def test_estimates_are_those_of_the_readings_that_are_given(scenario_of, kind, slots, engine):
    run = netkf.simulate(scenario_of(FAULTS[kind], slots), seed=3, engine=engine)
    right = netkf.simulate(scenario_of("", slots), seed=3, engine=engine)
    # The sensor of node 0 is healthy, and nobody else draws other numbers.
    np.testing.assert_allclose(run.xhat[:, 0], right.xhat[:, 0], rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(run.P, right.P, rtol=1e-12)
    expected = plain_estimates(kind, slots, 3)[: len(run.times)]
    np.testing.assert_allclose(run.xhat[:, 1], expected, rtol=1e-9, atol=1e-9)


CURVED = """
format = 1
name = "bad-ranges"
horizon = 8.0
probe = 0.5
[[plants]]
name = "pose"
kind = "nonlinear"
f = "unicycle"
nodes = [0, 1]
period = 0.5
Q = [[0.01, 0.0, 0.0], [0.0, 0.01, 0.0], [0.0, 0.0, 0.001]]
mean = [1.0, 2.0, 0.1]
cov = [[0.5, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 0.01]]
[plants.input]
kind = "sine"
amplitude = [1.0, 0.3]
frequency = [0.1, 0.2]
[[sensors]]
kind = "range-bearing"
of = "pose"
nodes = [0, 1]
positions = [[9.0, 1.0], [0.0, 7.0]]
R = [[0.1, 0.0], [0.0, 0.01]]
{fault}
[[sensors]]
kind = "relative-range"
of = "pose"
R = [[0.2]]
fault = {{ kind = "outliers", probability = 0.3, sigma = 2.0 }}
[network]
graph = {{ kind = "path", nodes = 2 }}
activation = {{ kind = "broadcast" }}
channel = {{ loss = {{ kind = "bernoulli", delivery = 0.8 }} }}
lives = [{{ kind = "duty", period = 3.0, up = 2.0, nodes = [1] }}]
[filter]
kind = "{filter}"
estimates = "{estimates}"
"""


@pytest.mark.parametrize("kind", FAULTS)
@pytest.mark.parametrize("filter", ["block-intersection own", "diffusion all"])
def test_curved_and_relative_readings_are_given_alike_by_both_engines(tmp_path, kind, filter):
    algorithm, estimates = filter.split()
    text = CURVED.format(fault=FAULTS[kind], filter=algorithm, estimates=estimates)
    (tmp_path / "ranges.toml").write_text(text)
    assert_bad_alike(netkf.load(tmp_path / "ranges.toml"), 0)


def assert_bad_alike(scenario, entry):
    """Both engines have the same run, which the fault of the sensors of an ``entry`` changes."""
    simpy, compiled = (netkf.simulate(scenario, engine=name) for name in ("simpy", "compiled"))
    assert simpy.fingerprint == compiled.fingerprint
    np.testing.assert_allclose(compiled.xhat, simpy.xhat, rtol=1e-9, atol=1e-9)
    healthy = netkf.simulate(scenario.replace({f"sensors.{entry}.fault": None}), engine="compiled")
    assert abs(compiled.xhat - healthy.xhat).max() > 1e-3


RELATIVE = """
format = 1
name = "bad-differences"
horizon = 8.0
probe = 0.5
[[plants]]
name = "pose"
nodes = [0, 1, 2]
{plant}
mean = [1.0, 2.0]
cov = [[0.5, 0.0], [0.0, 0.5]]
[[sensors]]
of = "pose"
nodes = [0, 1]
H = [[1.0, 0.0]]
R = [[0.2]]
{sampling}
[[sensors]]
kind = "relative"
of = "pose"
H = [[1.0, 0.5], [0.0, 1.0]]
R = [[0.2, 0.1], [0.1, 0.3]]
{sampling}
{fault}
[network]
graph = {{ kind = "path", nodes = 3 }}
activation = {{ kind = "{activation}" }}
[filter]
kind = "{filter}"
"""
TIMES = {
    "slots": (
        'kind = "linear"\nperiod = 0.5\nF = [[0.9, 0.1], [0.0, 0.8]]\nQ = [[0.1, 0.0], [0.0, 0.1]]',
        "broadcast",
    ),
    "clocks": (
        'kind = "diffusion"\nA = [[-0.1, 0.1], [0.0, -0.3]]\nB = [[0.3, 0.0], [0.0, 0.3]]',
        "readings",
    ),
}


@pytest.mark.parametrize("time", TIMES)
@pytest.mark.parametrize("filter", ["block-intersection", "partition"])
def test_differences_of_blocks_are_bad_alike_in_both_engines(tmp_path, time, filter):
    sampling = 'sampling = { kind = "periodic", period = 0.5 }' * (time == "clocks")
    values = dict(zip(("plant", "activation"), TIMES[time], strict=True))
    for fault in FAULTS.values():
        text = RELATIVE.format(fault=fault, sampling=sampling, filter=filter, **values)
        (tmp_path / "differences.toml").write_text(text)
        assert_bad_alike(netkf.load(tmp_path / "differences.toml"), 1)


OWN = """
from dataclasses import dataclass
import numpy as np
from netkf.parts import Fault, positive, setting

@dataclass(frozen=True, eq=False)
class Coarse(Fault):
    step: float = setting(positive)

    def begin(self, random):
        return lambda time, y: self.step * np.rint(y / self.step)
"""


@pytest.mark.parametrize("slots", [False, True], ids=["clocks", "slots"])
def test_faults_of_users_run_in_both_engines(scenario_of, tmp_path, monkeypatch, slots):
    (tmp_path / "own_fault.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    fault = 'fault = { kind = "own_fault:Coarse", step = 0.5 }'
    one, other = (
        netkf.simulate(scenario_of(fault, slots), seed=1, engine=engine)
        for engine in ("simpy", "compiled")
    )
    np.testing.assert_allclose(one.xhat, other.xhat, atol=1e-10)
    assert one.fingerprint == other.fingerprint
    assert abs(one.xhat - netkf.simulate(scenario_of("", slots), seed=1).xhat).max() > 0.01


@dataclass(frozen=True, eq=False)
class Gives(Fault):
    def begin(self, random):
        return lambda time, y: Gives.value


@pytest.mark.parametrize(
    "value", [1.0, [1.0], [[1.0], [2.0]], [1.0, np.nan], [1j, 0.0], None, "ab"]
)
def test_what_a_fault_of_a_user_gives_must_be_a_reading(value, monkeypatch):
    monkeypatch.setattr(Gives, "value", value, raising=False)
    path = FaultyReadings(Path(), Gives(), np.random.default_rng(1), float)
    with pytest.raises(ScenarioError, match=r"what Gives.begin returns must give finite numbers"):
        path.reading(3, np.zeros(2))


class Path:
    def reading(self, k, x):
        return x


def test_rates_and_sizes_of_outliers():
    fault = Outliers(probability=0.2, sigma=2.0, since=0.0)
    path = FaultyReadings(Path(), fault, np.random.default_rng(1), float)
    y = np.array([path.reading(k, np.zeros(2)) for k in range(4000)])
    off = (y != 0.0).any(axis=1)
    assert abs(off.mean() - 0.2) < 5.0 * np.sqrt(0.16 / 4000)
    assert abs(y[off].var() / 4.0 - 1.0) < 5.0 * np.sqrt(2.0 / y[off].size)


def test_ends_of_the_bad_time_belong_to_it():
    fault = Biased(size=1.0, since=2.0, until=3.0)
    path = FaultyReadings(Path(), fault, np.random.default_rng(1), lambda k: 0.5 * k)
    y = [float(path.reading(k, np.zeros(1))[0]) for k in range(9)]
    assert y == [0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.0, 0.0]
    assert Drifting(rate=0.5, since=2.0).bias(4.0) == 1.0
    assert Stuck().bias(1.0) is None
    instant = Biased(size=1.0, since=2.0, until=2.0)
    assert [instant.holds(t) for t in (1.9, 2.0, 2.1)] == [False, True, False]


@pytest.mark.parametrize(
    ("fault", "key"),
    [
        ('{ kind = "biased" }', "fault.size"),
        ('{ kind = "biased", size = [1.0] }', "sensors[0].fault.size"),
        ('{ kind = "stuck", value = [1.0, 2.0, 3.0] }', "sensors[0].fault.value"),
        ('{ kind = "biased", size = 1.0, since = 3.0, until = 2.0 }', "fault.until"),
        ('{ kind = "drifting", rate = 1.0, nodes = [5] }', "sensors[0].fault.nodes[0]"),
        ('{ kind = "frozen" }', "fault.kind"),
        ('{ kind = "outliers", probability = 1.5, sigma = 1.0 }', "fault.probability"),
    ],
)
def test_a_wrong_fault_is_refused(scenario_of, fault, key):
    with pytest.raises(ScenarioError) as error:
        scenario_of(f"fault = {fault}")
    assert key in str(error.value)
    assert "\n" not in str(error.value)


def test_what_is_not_drawn_cannot_be_bad(scenario_of):
    scenario = scenario_of(FAULTS["biased"])
    table = {"nodes": [0, 1], "H": [[1.0, 0.0]], "R": [[0.3]]}
    bad = {"kind": "biased", "size": 1.0}
    with pytest.raises(ScenarioError, match=r"sensors\[0\]\.fault: belongs to sensors whose"):
        scenario.replace({"sensors": [table | {"fault": bad}], "filter.model": {}})


def test_theory_and_check_say_what_is_not_promised(scenario_of):
    scenario = scenario_of(FAULTS["biased"])
    rows = netkf.theory.assumptions(scenario)
    row = rows[rows["assumption"] == "all sensors are healthy"].iloc[0]
    assert not row["holds"]
    assert "node 1 are bad" in row["evidence"]
    with pytest.raises(netkf.TheoryError, match="are bad"):
        netkf.theory.error_covariance(scenario, netkf.simulate(scenario))
    with pytest.raises(netkf.TheoryError, match="are bad"):
        netkf.check(scenario, runs=10)
