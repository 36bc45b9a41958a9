"""Known inputs: what moves a state that filters know moves estimates alike and nothing else; what
they do not know is a bias. Plain recursions with u(t) in them are in test_reference_clocks.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg

import netkf
from netkf.algorithms.traits import Timing
from netkf.core.errors import NetkfError, TheoryError
from netkf.core.fields import SourceFile
from netkf.parts import Filter, Filtering, Local
from netkf.plants.inputs import RecordedInput
from netkf.rng.streams import Streams
from netkf.runs.labels import mismatch_note
from netkf.scenario.reading import from_table
from netkf.scenario.usage import record_usage
from netkf.theory.errors import error_law
from tests.conftest import with_slow
from tests.engines.agreement import assert_agree
from tests.reference import kalman_update, kcf
from tests.scenario.test_preconditions import ALL

INPUT = {
    "kind": "sine",
    "G": [[1.0, 0.0], [0.5, 2.0]],
    "amplitude": [3.0, 40.0],
    "frequency": [0.31, 0.05],
    "phase": 0.4,
}
LINEAR = {"kind": "linear", "F": [[1.02, 0.3], [-0.2, 0.9]], "Q": [[0.2, 0.0], [0.0, 0.1]]}
FLOW = {"kind": "diffusion", "A": [[0.05, 0.4], [-0.5, -0.3]], "B": [[0.5, 0.0], [0.1, 0.4]]}
START = {"mean": [1.0, -1.0], "cov": [[1.0, 0.2], [0.2, 0.8]]}
SAMPLING = {"kind": "periodic", "period": 0.4, "jitter": 0.1}
HYBRID = {"kind": "hybrid", "epsilon": 0.3}
RANGES = [{"kind": "range", "nodes": [0, 2], "positions": [[3.0, -4.0], [60.0, 9.0]], "R": [[0.3]]}]


def scenario(filtering, plant, activation, u=INPUT, horizon=8.0, model=None, **more):
    """Four nodes in a cycle, of which 0 and 2 have a sensor."""
    slotted = "F" in plant
    sensors = [
        {"nodes": [node], "H": H, "R": [[0.3]]} | ({} if slotted else {"sampling": SAMPLING})
        for node, H in ((0, [[1.0, 0.0]]), (2, [[0.4, 1.0]]))
    ]
    channel = {"loss": {"kind": "bernoulli", "delivery": 0.7}}
    if not slotted:
        channel["delay"] = {"kind": "exponential", "mean": 0.2}
    table = {
        "format": 1, "name": "driven", "horizon": horizon, "probe": 1.0, "seed": 7,
        "plant": {**plant, **START, **({"period": 1.0} if slotted else {})},
        "sensors": sensors,
        "network": {"graph": {"kind": "cycle", "nodes": 4}, "channel": channel},
        "filter": filtering if isinstance(filtering, dict) else {"kind": "local"},
        **more,
    }  # fmt: skip
    if u is not None:
        table["plant"]["input"] = u
    if activation is not None:
        table["network"]["activation"] = activation
    if model is not None:
        table["filter"] = {**table["filter"], "model": model}
    return from_table(table, Path())


ACTIVATIONS = {
    "slots": [None, {"kind": "broadcast"}, {"kind": "matching", "protocol": "uniform-maximal"}],
    "clocks": [
        None, {"kind": "poisson", "rate": 2.0},
        *({"kind": "poisson", "rate": 2.0, "at": at} for at in ("directions", "nodes")),
        {"kind": "readings"},
    ],
}  # fmt: skip


def fitting(name, time, **more):
    """A scenario of a filter with the first activation that it takes; None without one."""
    plant = LINEAR if time == "slots" else FLOW
    if name == "belief-propagation" and time == "clocks":
        plant = {**plant, "B": [[0.0], [0.0]]}
    for activation in ACTIVATIONS[time]:
        try:
            return scenario(ALL[name], plant, activation, **more)
        except NetkfError:
            continue
    return None


COMPILED = {("kcf", "slots"), ("push-sum", "slots"), ("hybrid", "clocks"), ("gossip", "clocks")}


@pytest.mark.one_in(5)
@pytest.mark.parametrize("name", with_slow(ALL, {"block-intersection"}))
def test_a_known_input_changes_no_event_no_covariance_and_no_error(name):
    found = {time: fitting(name, time) for time in ACTIVATIONS}
    cases = {time: driven for time, driven in found.items() if driven is not None}
    assert cases
    for time, driven in cases.items():
        assert_input_moves_states_alone(driven, name, time)


def assert_input_moves_states_alone(driven, name, time):
    engine = "compiled" if (name, time) in COMPILED else "simpy"
    run, free = (netkf.simulate(one, engine=engine) for one in (driven, driven.undriven))
    assert run.events.equals(free.events)
    assert np.array_equal(run.P, free.P)
    assert np.array_equal(run.error, free.error)
    response = run.x - free.x
    assert np.abs(response).max() > 10.0
    size = np.abs(run.x).max()
    moved = np.broadcast_to(response[:, None], run.xhat.shape)
    np.testing.assert_allclose(run.xhat - free.xhat, moved, atol=1e-12 * size)
    np.testing.assert_allclose(response, response_of(driven, run.times), atol=1e-10 * size)


def response_of(driven, times):
    """m(t), by a plain recursion in slots or by the trapezoidal rule refined twice."""
    u, plant = driven.plant.input, driven.plant
    if driven.slotted:
        m, found = np.zeros(2), []
        for k in range(len(times)):
            found.append(m)
            m = plant.F @ m + u.G @ u.at(float(k))
        return np.array(found)
    w, phase = 2.0 * np.pi * u.frequency, np.exp(0.4j)
    found = np.zeros((len(times), 2), dtype=complex)
    for j in range(2):
        # x' = A x + g e^{i w t} is solved by (i w - A)^-1 g e^{i w t} but for its value at 0.
        steady = np.linalg.solve(1j * w[j] * np.eye(2) - plant.A, u.G[:, j])
        for k, t in enumerate(times):
            free = scipy.linalg.expm(plant.A * t) @ steady
            found[k] += u.amplitude[j] * phase * (steady * np.exp(1j * w[j] * t) - free)
    return found.imag


@pytest.mark.one_in(3)
@pytest.mark.parametrize("unstable", [False, True])
@pytest.mark.parametrize("model", [None, {"input": False}, {"A": [[0.0, 0.5], [-0.4, -0.2]]}])
@pytest.mark.parametrize("increments", [False, True])
def test_both_engines_make_the_same_run_of_a_driven_plant(unstable, model, increments, tmp_path):
    (tmp_path / "u.csv").write_text("t,u0\n1.3,4.0\n0.55,-2\n3.1,0.5\n3.1,0.5\n40,1\n")
    plant = {**FLOW, "A": [[1.3, 0.2], [0.0, -0.5]]} if unstable else FLOW
    driven = scenario(HYBRID, plant, {"kind": "poisson", "rate": 2.0}, None, model=model)
    sensors = [{"nodes": [0, 2], "H": [[1.0, 0.0]], "R": [[0.3]]}]
    changes = {"plant.input": {"kind": "recorded", "G": [[0.5], [1.0]], "path": "u.csv"}}
    object.__setattr__(driven, "_folder", tmp_path)
    run = assert_agree(driven.replace(changes | ({"sensors": sensors} if increments else {})))
    assert run.exact_errors == (model is None)
    if model is None:
        free = netkf.simulate(run.scenario.undriven, engine="compiled")
        assert np.array_equal(run.error, free.error)


@pytest.mark.parametrize("time", ["slots", "clocks"])
def test_errors_keep_their_digits_however_large_a_known_input_is(time):
    u = {"kind": "constant", "G": [[1.0, 0.0], [0.0, 1.0]], "value": [1e13, -1e13]}
    driven = fitting({"slots": "kcf", "clocks": "hybrid"}[time], time, u=u)
    run, free = (netkf.simulate(one) for one in (driven, driven.undriven))
    assert np.abs(run.x).max() > 1e13
    assert np.array_equal(run.nees, free.nees)
    assert run.rounding_from == np.inf
    assert fitting("kcf", "slots", u=u, model={"input": False}).exact_errors is False


def integrated(A, G, u, m, start):
    """m a second later, by a Runge-Kutta method."""
    solved = scipy.integrate.solve_ivp(
        lambda t, m: A @ m + G @ u.at(t), (start, start + 1), m, "DOP853", rtol=1e-11, atol=1e-11
    )
    return solved.y[:, -1]


@pytest.mark.one_in(3)
@pytest.mark.parametrize("sensing", ["slots", "samples", "increments"])
@pytest.mark.parametrize("model", [{}, {"input": False}, {"schedule": False}])
def test_inputs_of_a_plant_that_changes(sensing, model):
    if sensing == "slots":
        driven, name, M = scenario(ALL["kcf"], LINEAR, {"kind": "broadcast"}), "F", LINEAR["F"]
    else:
        driven, name, M = scenario(HYBRID, FLOW, {"kind": "poisson", "rate": 2.0}), "A", FLOW["A"]
    if sensing == "increments":
        driven = driven.replace({"sensors": [{"nodes": [0, 2], "H": [[1.0, 0.0]], "R": [[0.3]]}]})
    other, G = [[0.5, 0.2], [-0.3, 0.1]], [[0.0, -1.0], [2.0, 1.0]]
    changes = [{"from": 3.0, name: other}, {"from": 6.0, name: M, "G": G}]
    keys = {"plant.schedule": changes} | {f"filter.model.{k}": v for k, v in model.items()}
    driven = driven.replace(keys)
    run = assert_agree(driven)
    free = netkf.simulate(driven.undriven, engine="compiled")
    assert np.array_equal(run.P, free.P)
    assert np.array_equal(run.error, free.error) == (not model)
    u, at, m = driven.plant.input, [0.0, 3.0, 6.0, 8.0], np.zeros(2)
    matrices, gains = [np.array(one) for one in (M, other, M)], [u.G, u.G, np.array(G)]
    expected = [m]
    for matrix, gain, a, b in zip(matrices, gains, at[:-1], at[1:], strict=True):
        for k in range(int(a), int(b)):
            if sensing == "slots":
                m = matrix @ m + gain @ u.at(float(k))
            else:
                m = integrated(matrix, gain, u, m, k)
            expected.append(m)
    np.testing.assert_allclose(run.x - free.x, expected, atol=1e-8)
    means = [error_law(one, r).mean for one, r in ((driven, run), (driven.undriven, free))]
    bias = run.error - free.error
    tolerance = (1e-4 if sensing == "increments" else 1e-9) * np.abs(run.x).max()
    np.testing.assert_allclose((means[0] - means[1]).reshape(bias.shape), bias, atol=tolerance)


def in_slots(folder, filtering, sensors, network=None, u=INPUT, **more):
    """A scenario in slots of a plant of unknown state."""
    table = {
        "format": 1, "name": "replayed", "horizon": 12.0, "probe": 1.0,
        "plant": {**LINEAR, **START, "kind": "unknown", "period": 1.0, "input": u},
        "sensors": sensors, "filter": filtering,
        "network": {"graph": {"kind": "cycle", "nodes": 4}, **(network or {})}, **more,
    }  # fmt: skip
    return from_table(table, folder)


def values(seed, shape):
    """Numbers with few digits."""
    return np.random.default_rng(seed).normal(size=shape).round(6)


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_kcf_replays_recorded_readings_of_a_driven_plant(engine, tmp_path):
    F, Q, G = np.array(LINEAR["F"]), np.array(LINEAR["Q"]), np.array(INPUT["G"])
    y, u = 5.0 * values(1, (13, 2)), 3.0 * values(2, (8, 2))
    nodes, H, R = (0, 2), np.array([[0.4, 1.0]]), np.array([[0.3]])
    rows = [f"{k},{node},{y[k, j]}" for k in range(13) for j, node in enumerate(nodes)]
    (tmp_path / "y.csv").write_text("\n".join(["t,node,y0", *rows]) + "\n")
    # Rows between slots hold until the next; u is 0 before the first one, in slot 0.
    at = [0.5, 2.0, 2.25, 3.9, 4.0, 6.5, 9.75, 11.0]
    rows = [f"{t},{a},{b}" for t, (a, b) in zip(at, u, strict=True)]
    (tmp_path / "u.csv").write_text("\n".join(["t,u0,u1", *rows[::-1]]) + "\n")
    sensor = {"kind": "recorded", "path": "y.csv", "H": H.tolist(), "R": R.tolist()}
    driven = in_slots(
        tmp_path, {"kind": "kcf", "epsilon": 0.1}, [sensor],
        {"activation": {"kind": "broadcast"}},
        {"kind": "recorded", "path": "u.csv", "G": G.tolist()},
    )  # fmt: skip
    run = netkf.simulate(driven, engine=engine)
    x, P = [np.array(START["mean"])] * 4, [np.array(START["cov"])] * 4
    heard = [np.array([[abs(i - j) in (1, 3) for j in range(4)] for i in range(4)])]
    for k in range(13):
        if k:
            held = [row for t, row in zip(at, u, strict=True) if t <= k - 1]
            drive = G @ held[-1] if held else np.zeros(2)
            x, P = [F @ one + drive for one in x], [F @ one @ F.T + Q for one in P]
            readings = {node: (y[k, j : j + 1], H, R) for j, node in enumerate(nodes)}
            x, P = kcf(x, P, readings, heard, 0.1)
        np.testing.assert_allclose(run.xhat[k], x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(run.P[k], P, rtol=1e-9, atol=1e-9)
    use = record_usage(driven, None)["plant.input"]
    assert (use["rows"], use["unused"]) == (8, 1)  # 3.9 is over in slot 4


@pytest.mark.parametrize("wrong", ["A", "input"])
def test_means_of_errors_of_nodes_that_read_increments_by_a_wrong_model(wrong, tmp_path):
    """Without noise errors are their means, but for the steps in which sensors integrate."""
    (tmp_path / "u.csv").write_text("t,u0\n0,1\n0.55,-6\n2.3,4\n")
    sensors = [{"nodes": [0, 2], "H": [[1.0, 0.4]], "R": [[1e-22]]}]
    model = {"B": [[0.5, 0.0], [0.1, 0.4]], "R": [[0.3]]}
    model |= {"A": [[-0.3, 0.8], [0.1, -0.2]]} if wrong == "A" else {"input": False}
    u = RecordedInput(path=SourceFile("u.csv", tmp_path), G=[[1.0], [0.5]])
    clock = {"kind": "periodic", "period": 1.0, "at": "links"}
    filtering = {**HYBRID, "mean": [0.0, 0.0], "cov": [[1.0, 0.0], [0.0, 1.0]]}
    still = {**FLOW, "B": [[0.0, 0.0], [0.0, 0.0]], "sensing_period": 1e-3}
    one = scenario(filtering, still, clock, None, 4.0, model, sensors=sensors)
    one = one.replace({"plant.cov": [[0.0, 0.0], [0.0, 0.0]], "probe": 0.8})
    if wrong == "input":
        one = one.replace({"plant.input": u})
    run = netkf.simulate(one, engine="simpy")
    mean = error_law(one, run).mean.reshape(run.error.shape)
    assert np.abs(mean).max() > 0.5
    np.testing.assert_allclose(run.error, mean, atol=2e-3)


def test_states_between_the_probes_have_the_response_of_their_instant():
    u = {"kind": "constant", "G": [[1.0], [0.5]], "value": 2.0}
    one = scenario(HYBRID, FLOW, ACTIVATIONS["clocks"][1], u)
    streams = Streams(3, 0)
    truth, A = one.continuous_truth(streams, frames=False), np.array(FLOW["A"])
    times = one.sample_times(streams)[0, 0]
    assert not np.isin(times, one.times).all()
    for t in times.tolist():
        # dm = (A m + G u) dt with m(0) = 0.
        m = np.linalg.solve(A, (scipy.linalg.expm(A * t) - np.eye(2)) @ [2.0, 1.0])
        np.testing.assert_allclose(truth.absolute(t) - truth.local(t), m, atol=1e-10)


@pytest.mark.parametrize("linearise", ["ekf", "ckf"])
@pytest.mark.parametrize("recorded", [False, True])
def test_both_engines_read_ranges_of_a_driven_plant(linearise, recorded, tmp_path):
    driven = scenario(
        {**ALL["kcf"], "linearise": linearise}, LINEAR, {"kind": "broadcast"}, sensors=RANGES
    )
    if recorded:
        rows = [f"{k},{node},{10.0 + k + node}" for k in range(1, 9) for node in (0, 2)]
        (tmp_path / "y.csv").write_text("\n".join(["t,node,y0", *rows]) + "\n")
        object.__setattr__(driven, "_folder", tmp_path)
        driven = driven.replace({"sensors.0.path": "y.csv"})
    run = assert_agree(driven)
    assert np.abs(run.x).max() > 10.0


@pytest.mark.parametrize("slotted", [True, False])
@pytest.mark.parametrize("truth", ["drawn", "recorded"])
def test_ranges_of_a_driven_plant_are_linearised_where_its_state_is(slotted, truth, tmp_path):
    anchor, R = np.array([3.0, -4.0]), np.array([[0.2]])
    sensor = {"kind": "range", "nodes": [0], "positions": [anchor.tolist()], "R": R.tolist()}
    if not slotted:
        sensor["sampling"] = {"kind": "periodic", "period": 1.0}
    plant = LINEAR if slotted else FLOW
    driven = scenario({"kind": "local"}, plant, None, sensors=[sensor])
    if truth == "recorded":
        rows = [f"{t},{a},{b}" for t, (a, b) in enumerate(9.0 * values(3, (9, 2)))]
        (tmp_path / "x.csv").write_text("\n".join(["t,x0,x1", *rows]) + "\n")
        object.__setattr__(driven, "_folder", tmp_path)
        driven = driven.replace({"plant.kind": "recorded", "plant.path": "x.csv"})
    run = netkf.simulate(driven, engine="simpy")
    if truth == "drawn":
        free = netkf.simulate(driven.undriven, engine="simpy")
        np.testing.assert_allclose(run.x - free.x, response_of(driven, run.times), atol=1e-9)
    # The noises of the readings are those of the sensor alone.
    streams = netkf.rng.streams.Streams(driven.seed)
    noise = streams.generator("noise", 0, 0).standard_normal(9)
    F, Q = (np.array(LINEAR["F"]), np.array(LINEAR["Q"])) if slotted else flow_step(1.0)
    m = response_of(driven, run.times)
    x, P = np.array(START["mean"]), np.array(START["cov"])
    for k in range(1, 8):
        x, P = F @ x + m[k] - F @ m[k - 1], F @ P @ F.T + Q
        d = x - anchor
        y = np.linalg.norm(run.x[k] - anchor) + np.sqrt(0.2) * noise[k if slotted else k - 1]
        J = (d / np.linalg.norm(d))[None]
        x, P = kalman_update(x, P, np.array([y - np.linalg.norm(d)]) + J @ x, J, R)
        np.testing.assert_allclose(run.xhat[k, 0], x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(run.P[k, 0], P, rtol=1e-9, atol=1e-9)


def flow_step(gap):
    A, B, zero = np.array(FLOW["A"]), np.array(FLOW["B"]), np.zeros((2, 2))
    E = scipy.linalg.expm(np.block([[-A, B @ B.T], [zero, A.T]]) * gap)
    return E[2:, 2:].T, E[2:, 2:].T @ E[:2, 2:]


@dataclass(frozen=True, eq=False)
class Plain(Filter):
    """Takes over what it hears, in Python, and does not say that it moves with a shift."""

    timing = Timing(schedule=("predict", "sense", "exchange"))

    def predict(self, state, gap):
        xhat, root = state.model.predict(state.xhat, state.root, gap)
        return state._replace(xhat=xhat, root=root)

    def absorb(self, state, messages, exchange):
        for message in messages:
            xhat, root = state.model.extrapolate(*message.payload, message.age)
            state = state._replace(xhat=xhat, root=root)
        return state


@dataclass(frozen=True, eq=False)
class Shifted(Plain):
    shift = Filter.shift


@dataclass(frozen=True, eq=False)
class Mute(Plain):
    timing = Timing(talks=False)


@dataclass(frozen=True, eq=False)
class MovedMute(Mute):
    shift = Filter.shift


@dataclass(frozen=True, eq=False)
class Deaf(Plain):
    """Predicts by itself."""

    def predict(self, state, gap):
        return state._replace(xhat=state.model.F @ state.xhat)


@dataclass(frozen=True, eq=False)
class Louder(Local):
    """A filter of kernels with a step of its own."""

    def estimate(self, state):
        return 2.0 * state.xhat, state.P


@pytest.mark.one_in(10)
@pytest.mark.parametrize("model", [None, {"R": [[0.1]]}])
@pytest.mark.parametrize("plant", ["slots", "samples", "increments", "ekf", "ukf"])
def test_a_filter_that_does_not_move_is_told_by_its_model(plant, model):
    if plant in ("slots", "ekf", "ukf"):
        driven = scenario(ALL["kcf"], LINEAR, {"kind": "broadcast"}, model=model)
    else:
        driven = scenario(HYBRID, FLOW, {"kind": "poisson", "rate": 2.0}, model=model)
    if plant == "increments":
        driven = driven.replace({"sensors": [{"nodes": [0, 2], "H": [[1.0, 0.0]], "R": [[0.3]]}]})
    how = {}
    if plant in ("ekf", "ukf"):
        driven, how = driven.replace({"sensors": RANGES}), {"linearise": plant}
    plain, moved = (
        netkf.simulate(
            driven.replace({"filter": Filtering(cls(), model=driven.filter.model, **how)})
        )
        for cls in (Plain, Shifted)
    )
    assert plain.events.equals(moved.events)
    for name in ("x", "xhat", "error", "P"):
        np.testing.assert_allclose(getattr(plain, name), getattr(moved, name), atol=1e-9)


@pytest.mark.parametrize("plant", ["slots", "samples"])
def test_numbers_of_few_bits_are_those_of_absolute_states(plant):
    """One filter is counted from the response to the input, the other is told of it."""
    if plant == "slots":
        driven = scenario(ALL["kcf"], LINEAR, {"kind": "broadcast"})
    else:
        driven = scenario(HYBRID, FLOW, {"kind": "poisson", "rate": 2.0})
    few = {"bits": 5, "range": 2.0}
    plain, moved = (
        netkf.simulate(driven.replace({"filter": Filtering(cls()), "network.quantise": few}))
        for cls in (Plain, Shifted)
    )
    assert plain.events.equals(moved.events)
    assert (plain.events["kind"] == "clip").any()
    for name in ("x", "xhat", "error", "P"):
        np.testing.assert_allclose(getattr(plain, name), getattr(moved, name), atol=1e-9)


def test_filters_that_cannot_be_told_are_refused():
    with pytest.raises(NetkfError, match="must define shift") as refusal:
        scenario({"kind": "local"}, LINEAR, None).replace({"filter": Louder()})
    assert refusal.value.key == "filter.kind"
    deaf = scenario({"kind": "kcf", "epsilon": 0.1}, LINEAR, {"kind": "broadcast"})
    with pytest.raises(netkf.EngineError, match=r"Deaf.predict must call model.predict"):
        netkf.simulate(deaf.replace({"filter": Deaf()}), engine="simpy")


def test_a_log_in_other_units_gives_the_same_run(tmp_path):
    runs = []
    for unit, scale, origin in (("s", 1.0, 0.0), ("ms", 1e3, 0.0), ("us", 1e6, 1e6)):
        rows = [
            f"{t * scale + origin * scale:.0f},{u}" for t, u in ((-3, 9), (-1, 2), (2, 5), (4, -1))
        ]
        rows = rows if origin else ["0,2", *rows[2:]]
        (tmp_path / f"{unit}.csv").write_text("\n".join(["t,u0", *rows]) + "\n")
        driven = scenario({"kind": "local"}, FLOW, None, None)
        object.__setattr__(driven, "_folder", tmp_path)
        u = {"kind": "recorded", "G": [[1.0], [2.0]], "path": f"{unit}.csv"}
        time = {"unit": unit} | ({"origin": 1e6} if origin else {})
        runs.append(netkf.simulate(driven.replace({"time": time, "plant.input": u})))
    for run in runs[1:]:
        assert run.events.equals(runs[0].events)
        assert np.array_equal(run.x, runs[0].x)
    use = [record_usage(run.scenario, None)["plant.input"] for run in runs]
    assert [(one["rows"], one["unused"]) for one in use] == [(3, 0), (3, 0), (4, 1)]


UNKNOWN = {
    "kcf": ("slots", {"input": False}, 1e-9),
    "gossip": ("slots", {"input": False}, 1e-9),
    "diffusion-kalman": ("slots", {"F": [[0.9, 0.3], [-0.2, 0.8]]}, 1e-9),
    "covariance-intersection": ("clocks", {"input": False}, 1e-9),
    "hybrid": ("clocks", {"A": [[0.0, 0.5], [-0.4, -0.2]]}, 1e-9),
    "local": ("increments", {"input": False}, 1e-4),  # gains of increments are of third order
}


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", UNKNOWN)
def test_what_filters_do_not_know_is_the_mean_of_their_errors(name):
    time, model, tolerance = UNKNOWN[name]
    driven = fitting(name, "slots" if time == "slots" else "clocks", model=model)
    if time == "increments":
        driven = driven.replace({"sensors": [{"nodes": [0, 2], "H": [[1.0, 0.0]], "R": [[0.3]]}]})
    free = driven.undriven
    runs = [netkf.simulate(one, engine="simpy") for one in (driven, free)]
    laws = [error_law(one, run) for one, run in zip((driven, free), runs, strict=True)]
    bias, means = runs[0].error - runs[1].error, laws[0].mean - laws[1].mean
    assert np.abs(bias).max() > 1.0
    np.testing.assert_allclose(means.reshape(bias.shape), bias, atol=tolerance * np.abs(bias).max())
    np.testing.assert_allclose(laws[0].covariance, laws[1].covariance, atol=1e-9)


def test_an_unknown_input_shows_where_promises_are_judged():
    driven = fitting("kcf", "slots", model={"input": False})
    told = fitting("kcf", "slots")
    assert driven.undriven.filters_know_the_truth
    assert told.filters_know_the_truth
    rows = netkf.theory.assumptions(driven)
    row = rows[rows["assumption"] == "the filters know the plant and the sensors"]
    assert row["holds"].tolist() == [False]
    with pytest.raises(TheoryError, match="do not know the input of the plant"):
        netkf.theory.steady_error_covariance(driven.replace({"filter.share_readings": False}))
    verdict = netkf.consistency(driven, runs=12)
    for node in verdict.rows:
        assert node.nees > 5.0 * driven.plant.n
        assert abs(node.nees - node.expected) < node.width
        assert "filters do not know the input" in node.verdict
    assert "bias" in mismatch_note(driven)
    assert mismatch_note(told) == ""


def owned(slotted, estimates, filtering):
    """Three nodes in a row, each with a driven pose of its own."""
    u = {"kind": "sine", "G": [[1.0], [2.0]], "amplitude": 5.0, "frequency": 0.1}
    pose = {**(LINEAR if slotted else FLOW), "name": "pose", "nodes": [0, 1, 2], "input": u}
    sampling = {} if slotted else {"sampling": SAMPLING}
    own = {"nodes": [0, 1, 2], "of": "pose", "H": [[1.0, 0.0]], "R": [[0.3]], **sampling}
    pairs = {"kind": "relative", "to": "neighbours", "of": "pose", "H": [[1.0, 0.0]], "R": [[0.2]]}
    talks = filtering["kind"] != "local"
    ticks = {"kind": "broadcast"} if slotted else {"kind": "poisson", "rate": 2.0, "at": "nodes"}
    network = {"graph": {"kind": "path", "nodes": 3}} | ({"activation": ticks} if talks else {})
    table = {
        "format": 1, "name": "owned", "horizon": 8.0, "probe": 1.0, "network": network,
        "plants": [{**pose, "cov": START["cov"], **({"period": 1.0} if slotted else {})}],
        "sensors": [own, *([{"nodes": [0, 1, 2], **pairs, **sampling}] if talks else [])],
        "filter": {**filtering, "estimates": estimates},
    }  # fmt: skip
    return from_table(table, Path())


@pytest.mark.one_in(4)
@pytest.mark.parametrize("slotted", [True, False])
@pytest.mark.parametrize(
    ("kind", "estimates"),
    [
        ("block-intersection", "own"),
        ("block-intersection", "own+neighbours"),
        ("block-cross-covariances", "own"),
        ("block-belief-propagation", "own"),
    ],
)
def test_nodes_know_the_inputs_of_blocks(slotted, kind, estimates):
    driven = owned(slotted, estimates, {"kind": kind})
    run, free = (netkf.simulate(one, engine="simpy") for one in (driven, driven.undriven))
    assert np.abs(run.x - free.x).max() > 10.0
    for name in ("error", "P"):
        assert np.array_equal(getattr(run, name), getattr(free, name), equal_nan=True)
    for k in range(3):
        moved = run.x[:, 2 * k : 2 * k + 2] - run.block("pose", k).xhat
        np.testing.assert_allclose(moved, run.block("pose", k).error, atol=1e-12)


def test_a_filter_of_a_block_is_told_by_its_model():
    driven = owned(True, "own", {"kind": "local"})
    plain, moved = (
        netkf.simulate(driven.replace({"filter": Filtering(cls(), estimates="own")}))
        for cls in (Mute, MovedMute)
    )
    np.testing.assert_allclose(plain.xhat, moved.xhat, atol=1e-11)
    np.testing.assert_allclose(moved.error, netkf.simulate(driven).error, atol=1e-12)
