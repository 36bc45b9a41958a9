"""Which grid of time a scenario takes, what it says of it, and what it refuses."""

import json
import tomllib

import numpy as np
import pytest

import netkf
from netkf.cli.main import main
from netkf.core.errors import ScenarioError
from netkf.core.instants import TimeGrid

TEXT = """format = 1
name = "grid"
horizon = 20.0
probe = 1.0
[plant]
kind = "diffusion"
A = [[-0.1]]
B = [[1.0]]
cov = [[1.0]]
[[sensors]]
nodes = [0]
H = [[1.0]]
R = [[0.1]]
sampling = { kind = "periodic", period = 0.5 }
[network]
graph = { kind = "path", nodes = 3 }
activation = { kind = "periodic", at = "nodes", period = 0.5 }
channel = { delay = { kind = "constant", seconds = 0.3 } }
[filter]
kind = "diffusion"
"""

DELAY, SAMPLING = "network.channel.delay.seconds", "sensors.0.sampling.period"


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "grid.toml"
    file.write_text(TEXT)
    (tmp_path / "ticks.csv").write_text(f"t,node\n0.5,0\n{1 / 3},1\n{2 / 7},2\n")
    return file


@pytest.mark.parametrize(
    ("changes", "grid"),
    [
        ({}, TimeGrid(1e-13)),
        ({"horizon": 1000.0}, TimeGrid(1e-12)),
        ({"horizon": 1000.1}, TimeGrid(1e-11)),
        ({"network.activation.period": 1 / 12}, TimeGrid(1e-13, 3)),
        (
            {"network.activation.period": 1 / 7, "sensors.0.sampling.period": 1 / 3},
            TimeGrid(1e-12, 21),
        ),
        ({"probe": 1 / 3}, TimeGrid(1e-13)),
        ({"network.channel.delay.seconds": 1 / 600}, TimeGrid(1e-13, 3)),
        ({"sensors.0.sampling.period": 1 / 3}, TimeGrid(1e-13, 3)),
        ({"sensors.0.sampling.period": 0.1 + 0.2}, TimeGrid(1e-13)),
        (
            {"network.activation": {"kind": "recorded", "path": "ticks.csv", "at": "nodes"}},
            TimeGrid(1e-12, 21),
        ),
        ({"time.resolution": 1e-3}, TimeGrid(1e-3)),
        ({"time.refine": 12}, TimeGrid(1e-12, 12)),
        ({"horizon": 1e-9, "probe": 1e-9, "network.channel.delay.seconds": 0.0}, None),
    ],
)
def test_the_grid_of_a_scenario(path, changes, grid):
    scenario = netkf.load(path).replace(changes)
    assert grid is None or scenario.time_grid == grid
    assert scenario.horizon * scenario.time_grid.per_second <= 1e15
    assert scenario.plant.time_grid == scenario.time_grid
    assert scenario.diffusion.time_grid == scenario.time_grid


def test_the_grid_of_steps(tmp_path):
    text = TEXT.replace('"diffusion"\nA = [[-0.1]]\nB', '"linear"\nF = [[0.9]]\nperiod = 1.0\nQ')
    text = text.replace("sampling =", "#").replace(
        '"periodic", at = "nodes", period = 0.5', '"broadcast", phase = 0.1'
    )
    text = text.replace('kind = "diffusion"\n', 'kind = "icf"\nsteps = 3\n')
    file = tmp_path / "slots.toml"
    file.write_text(text)
    assert netkf.load(file).time_grid == TimeGrid(1e-13, 3)


def test_runs_say_their_grid(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path.write_text(TEXT.replace("period = 0.5", "period = 0.08333333333333333"))
    assert main(["run", str(path), "--no-plot", "--engine", "simpy", "--out", "out"]) == 0
    table = tomllib.loads((tmp_path / "out/scenario.toml").read_text())["time"]
    manifest = json.loads((tmp_path / "out/manifest.json").read_text())["time"]
    assert table["resolution"] == manifest["resolution"] == 1e-13
    assert table["refine"] == manifest["refine"] == 3
    stored, scenario = netkf.load(tmp_path / "out/scenario.toml"), netkf.load(path)
    assert stored.time_grid == scenario.time_grid
    runs = [netkf.simulate(one, engine="simpy") for one in (stored, scenario)]
    assert runs[0].fingerprint == runs[1].fingerprint


@pytest.mark.parametrize(
    ("changes", "key", "words"),
    [
        ({"horizon": 1e7, DELAY: 1e-9}, "network.channel.delay", "far above"),
        ({"horizon": 1e6, DELAY: 2.5e-9}, "network.channel.delay", "far above"),
        ({"horizon": 1e5, DELAY: 1e-12}, "network.channel.delay", "far above"),
        ({"time.resolution": 1e-20}, "time.resolution", "1.5e+15 ticks"),
        ({"time.resolution": 0.1, SAMPLING: 0.25}, "sensors[0].sampling", "multiple"),
        ({"time.resolution": 1e-3, DELAY: 0.3005}, "delay", "multiple"),
        ({"time.resolution": 2e-3}, "time.resolution", "power of ten"),
        ({"time.resolution": 10.0}, "time.resolution", "power of ten"),
        ({"time.refine": 0}, "time.refine", "integer"),
    ],
)
def test_what_no_grid_holds_is_refused(path, changes, key, words):
    with pytest.raises(ScenarioError) as info:
        netkf.load(path).replace(changes)
    assert key in str(info.value)
    assert words in str(info.value)
    assert "\n" not in str(info.value)


def test_notes_of_a_coarse_grid(path):
    scenario = netkf.load(path)
    assert not [note for note in scenario.notes if note.startswith("time: ")]
    fast = scenario.replace({"time.resolution": 0.1, "plant.A": [[-0.5]]})
    assert "not far below" in "".join(fast.notes)
    assert "network.channel.delay" in "".join(fast.notes)
    fast = scenario.replace({"horizon": 1e6, "plant.A": [[-1e7]]})
    assert "shortest time constant" in "".join(fast.notes)
    rounded = scenario.replace({"network.channel.delay.seconds": 0.12345678901234})
    assert "no whole number of ticks" in "".join(rounded.replace({"horizon": 1e4}).notes)


def test_times_of_samples_end_at_the_horizon(path):
    scenario = netkf.load(path).replace({"horizon": 100 * (1 / 12), "probe": 1 / 3})
    assert len(scenario.times) == 26
    assert scenario.times[-1] == scenario.horizon
    np.testing.assert_allclose(scenario.times, np.arange(26) / 3, atol=1e-13)
    scenario = scenario.replace({SAMPLING: 1 / 12})
    assert scenario.horizon == 25 / 3
    np.testing.assert_array_equal(scenario.times, [k / 3 for k in range(26)])


def test_windows_are_compared_in_ticks(path):
    """A delay and a window of the same number of digits beyond any grid."""
    seconds = 0.30000000012345678
    scenario = netkf.load(path).replace(
        {
            "filter": netkf.parts.Intermittent(window=seconds),
            "network.activation": netkf.parts.OnReadings(),
            "network.channel.delay.seconds": seconds,
        }
    )
    run = netkf.simulate(scenario, engine="simpy")
    assert "late" not in set(run.events["kind"])
    assert (run.events["kind"] == "deliver").sum() == 39
