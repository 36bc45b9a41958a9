"""Sensors that are held out: nobody sees them, and the errors are those of a plain loop."""

import json

import numpy as np
import pandas as pd
import pytest

import netkf
from netkf.cli.main import main
from netkf.scenario.reading import from_table
from netkf.scenario.writing import as_table
from tests.algorithms.test_block_intersection import ROBOTS, load
from tests.conftest import SCENARIOS

ENGINES = "simpy", "compiled"
PLANTS = {
    "slots": {"kind": "linear", "F": [[0.95]], "Q": [[0.3]], "period": 1.0, "cov": [[1.0]]},
    "clocks": {"kind": "diffusion", "A": [[-0.1]], "B": [[0.5]], "cov": [[1.0]]},
}


def scenario(folder, time, held_out=True, **changes):
    sampling = {} if time == "slots" else {"sampling": {"kind": "poisson", "rate": 1.0}}
    sensor = {"H": [[1.0]], "R": [[0.4]], **sampling}
    # The first sensor of node 0 is held out: the second keeps its draws.
    sensors = [{"nodes": [0, 2], "held_out": held_out, **sensor}, {"nodes": [0, 1], **sensor}]
    table = {"format": 1, "name": "held", "horizon": 200.0, "probe": 50.0, "plant": PLANTS[time]}
    table |= {"sensors": sensors, "network": {"graph": {"kind": "path", "nodes": 3}}}
    return from_table({**table, "filter": {"kind": "central"}, **changes}, folder)


@pytest.mark.parametrize("time", ["slots", "clocks"])
def test_filters_do_not_see_them_and_errors_are_as_large_as_they_say(tmp_path, time):
    given = scenario(tmp_path, time)
    table = as_table(given)
    assert [sensor.get("held_out", False) for sensor in table["sensors"]] == [True, False]
    run = netkf.simulate(given, engine="simpy")
    if time == "clocks":  # of node 2, which nothing else concerns
        assert set(run.events.node[run.events.kind == "sense"]) == {0, 1}
    compiled = netkf.simulate(given, engine="compiled")
    np.testing.assert_allclose(compiled.xhat, run.xhat, atol=1e-10)
    rows = netkf.held_out_errors(run)
    assert [row["node"] for row in rows] == [0, 2]
    for row in rows:
        # Of about 200 readings; the standard deviation of a mean of squares is a tenth of it.
        assert row["mean_square"] == pytest.approx(row["expected"], rel=0.45)
        assert row["nis"] == pytest.approx(1.0, abs=0.45)
        assert row["noise"] == pytest.approx(0.4)
        assert row["without_noise"] == row["mean_square"] - row["noise"]


@pytest.mark.parametrize("time", ["slots", "clocks"])
def test_where_all_are_held_out_many_runs_are_as_single_ones(tmp_path, time):
    activation = {"kind": "broadcast" if time == "slots" else "readings"}
    network = {"graph": {"kind": "path", "nodes": 3}, "activation": activation}
    changes = {"network": network, "filter": {"kind": "diffusion"}, "horizon": 8.0, "probe": 2.0}
    given = scenario(tmp_path, time, **changes)
    alone = given.replace({"sensors": as_table(given)["sensors"][:1]})
    simpy, compiled = (netkf.monte_carlo(alone, 3, workers=1, engine=e) for e in ENGINES)
    assert compiled.fingerprint == simpy.fingerprint
    np.testing.assert_allclose(compiled.mean_P, simpy.mean_P, rtol=1e-10)


def test_other_draws_stay_as_they_are(tmp_path):
    local = {"filter": {"kind": "local"}}
    seen, held = (scenario(tmp_path, "slots", held, **local) for held in (False, True))
    both, one = netkf.simulate(seen, engine="simpy"), netkf.simulate(held, engine="simpy")
    np.testing.assert_array_equal(both.x, one.x)
    # Node 1 has the same readings, node 0 one of two, node 2 none.
    np.testing.assert_array_equal(both.xhat[:, 1], one.xhat[:, 1])
    assert (both.P[-1, 0] < one.P[-1, 0]).all()
    assert one.P[-1, 2, 0, 0] == pytest.approx(0.3 / (1.0 - 0.95**2), rel=1e-3)


def test_a_record_against_a_plain_loop(tmp_path, capsys):
    random, t = np.random.default_rng(1), np.round(np.arange(1, 60) * 0.7, 3)
    rows = {"t": t, "node": 0, "y0": random.normal(0.0, 1.0, 59)}
    held = {
        "t": t + 0.3,
        "node": 0,
        "y0": random.normal(0.0, 1.0, 59),
        "y1": random.normal(size=59),
    }
    pd.DataFrame(rows).to_csv(tmp_path / "seen.csv", index=False)
    pd.DataFrame(held).to_csv(tmp_path / "held.csv", index=False)
    record = {"kind": "recorded", "nodes": [0]}
    sensors = [
        {**record, "path": "seen.csv", "H": [[1.0]], "R": [[0.4]]},
        {**record, "path": "held.csv", "H": [[1.0], [2.0]], "R": [[0.4, 0.0], [0.0, 0.5]]}
        | {"held_out": True},
    ]
    plant = {"kind": "unknown", "A": [[-0.1]], "B": [[0.5]], "cov": [[1.0]]}
    table = {"format": 1, "name": "held", "horizon": 30.0, "probe": 10.0, "plant": plant}
    table |= {"sensors": sensors, "network": {"graph": {"kind": "path", "nodes": 2}}}
    given = from_table({**table, "filter": {"kind": "local"}}, tmp_path)
    (row,) = netkf.held_out_errors(netkf.simulate(given, engine="simpy"))
    x, P, now, errors, claimed = 0.0, 1.0, 0.0, [], []
    readings = [(time, y, None) for time, y in zip(t, rows["y0"], strict=True)]
    readings += [(t_, y0, y1) for t_, y0, y1 in zip(held["t"], held["y0"], held["y1"], strict=True)]
    for time, y, second in sorted(r for r in readings if r[0] < 30.0):
        decay = np.exp(-0.1 * (time - now))
        x, P, now = decay * x, decay**2 * P + 0.25 * (1.0 - decay**2) / 0.2, time
        if second is None:
            K = P / (P + 0.4)
            x, P = x + K * (y - x), (1.0 - K) * P
        else:
            errors += [y - x, second - 2.0 * x]
            claimed += [P + 0.4, 4.0 * P + 0.5]
    assert row["readings"] == len(errors)
    assert row["mean_square"] == pytest.approx(np.mean(np.square(errors)), rel=1e-9)
    assert row["expected"] == pytest.approx(np.mean(claimed), rel=1e-9)
    assert row["bias"] == pytest.approx(np.mean(errors), rel=1e-9)
    assert row["noise"] == pytest.approx(0.45)


def test_readings_of_states_that_a_node_does_not_estimate_are_left_out(tmp_path):
    changes = {"sensors__1__held_out": True, "sensors__0__held_out": True}
    rows = netkf.held_out_errors(netkf.simulate(load(ROBOTS, tmp_path, **changes)))
    # Node 1 reads its own block; what it reads of node 2 depends on that of node 2.
    assert [row["node"] for row in rows] == [1]
    both = load(ROBOTS, tmp_path, **changes, filter__estimates="own+neighbours")
    assert [row["node"] for row in netkf.held_out_errors(netkf.simulate(both))] == [1, 2, 3]


def test_the_summary_of_a_run_has_them(tmp_path, capsys):
    path = str(SCENARIOS / "ulb_library.toml")
    out = tmp_path / "run"
    options = ["--set", "horizon=1200.0", "--set", 'filter={kind="local"}', "--no-plot"]
    assert main(["run", path, *options, "--out", str(out)]) == 0
    rows = json.loads((out / "summary.json").read_text())["held_out"]
    assert [row["node"] for row in rows] == [5, 10, 15]
    assert "held out at node 15: mean squared error" in capsys.readouterr().out
    again = netkf.load(out / "scenario.toml")
    assert netkf.held_out_errors(netkf.simulate(again)) == rows
    assert main(["run", path, "--set", "sensors.1.held_out=3"]) == 2
