"""A recorded truth between its rows, linear or held, against numpy.interp, in slots and without."""

import numpy as np
import pytest

import netkf
from netkf.scenario.reading import from_table
from netkf.scenario.usage import record_usage

TIMES = np.array([0.0, 0.4, 1.1, 1.5, 2.7, 3.0])
STATES = np.array([[1.0, -2.0], [3.0, 0.5], [-1.0, 4.0], [2.0, 2.0], [0.0, -3.0], [5.0, 1.0]])
CONTINUOUS = {
    "kind": "recorded",
    "path": "x.csv",
    "A": [[0.0, 1.0], [0.0, -0.5]],
    "B": [[0.0], [1.0]],
}
SLOTS = {
    "kind": "recorded",
    "path": "x.csv",
    "F": [[1.0, 0.1], [0.0, 0.9]],
    "Q": [[0.1, 0.0], [0.0, 0.1]],
    "period": 0.25,
}
COV = {"cov": [[1.0, 0.0], [0.0, 1.0]]}
SENSOR = {"nodes": [0], "H": [[1.0, 0.0]], "R": [[0.1]]}
LINKS = {"kind": "path", "nodes": 2}


@pytest.fixture
def make(tmp_path):
    rows = "".join(f"{t},{a},{b}\n" for t, (a, b) in zip(TIMES, STATES, strict=True))
    (tmp_path / "x.csv").write_text("t,x0,x1\n" + rows)

    def make(slots, interpolate, **changes):
        plant = {**(SLOTS if slots else CONTINUOUS), **COV}
        if interpolate:
            plant["interpolate"] = interpolate
        clock = {"kind": "broadcast"} if slots else {"kind": "poisson", "rate": 1.0}
        sampling = {} if slots else {"sampling": {"kind": "periodic", "period": 0.35}}
        table = {
            "format": 1,
            "name": "between",
            "horizon": 3.0,
            "probe": 0.25 if slots else 0.3,
            "plant": plant,
            "sensors": [{**SENSOR, **sampling}],
            "network": {"graph": LINKS, "activation": clock},
            "filter": {"kind": "diffusion"} if slots else {"kind": "hybrid", "epsilon": 0.5},
        }
        return from_table({**table, **changes}, tmp_path)

    return make


def expected(times, interpolate):
    if interpolate == "hold":
        return STATES[np.searchsorted(TIMES, times + 1e-12, side="right") - 1]
    return np.stack([np.interp(times, TIMES, column) for column in STATES.T], axis=1)


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
@pytest.mark.parametrize("interpolate", ["linear", "hold"])
@pytest.mark.parametrize("slots", [False, True], ids=["continuous", "slots"])
def test_states_between_rows(make, slots, interpolate, engine):
    run = netkf.simulate(make(slots, interpolate), seed=3, engine=engine)
    x = expected(run.times, interpolate)
    np.testing.assert_allclose(run.x, x, rtol=0, atol=1e-12)
    errors = ((x[:, None] - run.xhat) ** 2).sum(axis=2)
    np.testing.assert_allclose(run.sq_error, errors, rtol=1e-12, atol=1e-12)


def test_readings_are_those_of_the_interpolated_state(make):
    exact = make(
        False,
        "linear",
        sensors=[{**SENSOR, "R": [[1e-12]], "sampling": {"kind": "periodic", "period": 0.35}}],
    )
    run = netkf.simulate(exact.replace({"probe": [0.35, 1.05, 2.8]}), engine="simpy")
    np.testing.assert_allclose(run.xhat[:, 0, 0], expected(run.times, "linear")[:, 0], atol=1e-5)


def test_rows_on_either_side_are_used(make):
    plain = {"sensors": [], "probe": [0.5, 2.0]}
    recorded = [{"kind": "recorded", "path": "y.csv", **SENSOR}]
    for slots in (False, True):
        scenario = make(slots, "linear")
        folder = scenario.plant.path.folder
        (folder / "y.csv").write_text("t,node,y0\n0.25,0,1\n")
        changed = scenario.replace({**plain, "sensors": recorded})
        use = record_usage(changed, None)["plant"]
        assert (use["rows"], use["unused"]) == (6, 2)  # 0.4, 1.1, 1.5 and 2.7
        held = changed.replace({"plant.interpolate": "hold"})
        assert record_usage(held, None)["plant"]["unused"] == 4  # 0.4 and 1.5


def test_without_it_states_exist_at_rows_only_and_the_message_says_what_helps(make):
    for slots in (False, True):
        words = "must be a slot" if slots else 'interpolate = "linear"'
        with pytest.raises(netkf.ScenarioError, match=words):
            make(slots, None)
        with pytest.raises(netkf.ScenarioError, match="has no state"):
            make(slots, "linear", horizon=4.0)
        with pytest.raises(netkf.ScenarioError, match=r"interpolate: must be one of"):
            make(slots, "cubic")
