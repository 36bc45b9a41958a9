"""Data sets in the format of MR.CLAM, and the scenarios made of them."""

import importlib.util
import math
import shutil

import numpy as np
import pandas as pd
import pytest

import netkf
from netkf.cli.main import main
from netkf.core.errors import ScenarioError
from tests.conftest import ROOT, SCENARIOS

SMALL, MADE = SCENARIOS / "data" / "mrclam_small", SCENARIOS / "blocks" / "mrclam_small"
FILES = {
    "Barcodes.dat": "# Subject #    Barcode #\n 1 \t 5\n 2 \t 14\n 6 \t 72\n 7 \t 27\n",
    "Landmark_Groundtruth.dat": "6 1.5 -2.25 1e-4 2e-4\n7 0 3 0 0\n",
    "Robot1_Groundtruth.dat": "100.0 0 0 3.1\n101.0 1 0 -3.1\n103.0 3 0 -2.9\n",
    "Robot2_Groundtruth.dat": "99.50 2 2 0\n104 2 4 0.5\n",
    "Robot1_Odometry.dat": "100.000 \t 0.50 \t 0.1\n100.200 0.25 0\n100.100 0.75 -0.1 # late\n",
    "Robot2_Odometry.dat": "100.0 0.1 0.2\n100.0 0.2 0.2\n101.5 0.3 1e-3\n",
    "Robot1_Measurement.dat": "100.5 14 2.5 0.25\n100.5 72 1.75 -1\n100.5 72 1.5 -1\n101 34 1 1\n",
    "Robot2_Measurement.dat": "100.50 5 2.4 -0.5\n100.50 5 2.4 -0.5\n102 14 1 0\n101.25 27 3 1\n",
}


@pytest.fixture
def log(tmp_path):
    folder = tmp_path / "log"
    folder.mkdir()
    for name, text in FILES.items():
        (folder / name).write_text(text)
    return folder


@pytest.mark.slow
def test_every_number_is_that_of_the_log(log, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["import", str(log), "--kind", "mrclam", "--out", str(out)]) == 0
    texts = {path.name: path.read_text() for path in out.iterdir()}
    assert texts["odometry.csv"].splitlines() == [
        *("t,node,u0,u1", "100.000,1,0.50,0.1", "100.0,2,0.2,0.2", "100.100,1,0.75,-0.1"),
        *("100.200,1,0.25,0", "101.5,2,0.3,1e-3"),
    ]
    assert texts["truth.csv"].splitlines() == [
        *("t,node,x0,x1,x2", "99.50,2,2,2,0", "100.0,1,0,0,3.1", "101.0,1,1,0,-3.1"),
        *("103.0,1,3,0,-2.9", "104,2,2,4,0.5"),
    ]
    assert texts["landmarks.csv"].splitlines() == [
        *("t,node,to,y0,y1", "100.5,1,6,1.75,-1", "100.5,1,6,1.5,-1", "101.25,2,7,3,1"),
    ]
    assert texts["robots.csv"].splitlines() == [
        *("t,node,to,y0,y1", "100.5,1,2,2.5,0.25", "100.50,2,1,2.4,-0.5"),
    ]
    printed = capsys.readouterr().out
    for note in (
        "Robot1_Odometry.dat: rows that are earlier than the one before were sorted: 1",
        "Robot2_Odometry.dat: rows that repeat a time, whose last row counts: 1",
        "Robot2_Odometry.dat: gaps of more than 0.5 s: 1, the longest 1.5 s after t = 100.0",
        "Robot2_Measurement.dat: rows that repeat a reading: 1",
        "Robot2_Measurement.dat: rows that are earlier than the one before were sorted: 1",
        "barcodes of no other robot or landmark are left out: 14 (1 row), 34 (1 row)",
    ):
        assert note in printed
    scenario = netkf.load(out / "scenario.toml")
    assert (scenario.horizon, scenario.time.origin) == (3.0, 100.0)
    np.testing.assert_allclose(scenario.plant.start_mean, [0, 0, 3.1, 2, 20 / 9, 5 / 90], atol=1e-6)
    run = netkf.simulate(scenario)
    turn = 2.0 * math.pi
    np.testing.assert_allclose(run.x[:, 2], [3.1, turn - 3.1, turn - 3.0, turn - 2.9])
    np.testing.assert_allclose(run.x[:, 4], 2.0 + (np.arange(4) + 0.5) / 2.25)
    assert scenario.plant.input.inputs[0].at(0.15).tolist() == [0.75, -0.1]
    sees = [sensor for sensor in scenario.sensors if sensor.record.path.name == "landmarks.csv"]
    assert [sensor.positions.tolist() for sensor in sees] == [[[1.5, -2.25], [0.0, 3.0]]] * 2


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        (
            "Robot2_Odometry.dat",
            "1 2 3\n\n1 2\n",
            r"Robot2_Odometry.dat: line 3 must have 3 numbers",
        ),
        (
            "Robot1_Groundtruth.dat",
            "# x\n1 2 3 4_0\n",
            r"Robot1_Groundtruth.dat: line 2 must have 4",
        ),
        ("Robot1_Measurement.dat", "1 2 nan 4\n", r"Robot1_Measurement.dat: line 1 must have 4"),
        ("Robot1_Odometry.dat", "# nothing\n", r"Robot1_Odometry.dat: has no rows"),
        ("Barcodes.dat", "1 5\n2 5\n", r"Barcodes.dat: line 2 repeats a barcode"),
        ("Landmark_Groundtruth.dat", None, r"Landmark_Groundtruth.dat: cannot be read"),
        (
            "Robot2_Groundtruth.dat",
            "200 1 1 1\n",
            "true poses of all robots for a second.*robot 2 from 200 on, robot 1 until 103",
        ),
        ("Robot2_Groundtruth.dat", None, 'cannot be read .* kind = "unknown" for a log without'),
    ],
)
def test_a_bad_line_is_refused_with_its_file_and_number(log, tmp_path, name, text, message):
    (log / name).unlink() if text is None else (log / name).write_text(text)
    with pytest.raises(ScenarioError, match=message):
        netkf.import_log(log, "mrclam", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_robot_may_see_nothing_and_stamps_may_be_written_in_any_way(log, tmp_path):
    (log / "Robot2_Measurement.dat").write_text("# nothing\n")
    (log / "Robot1_Groundtruth.dat").write_text("+1.e2 0 0 3.1\n103. 3 0 -2.9\n")
    (log / "Robot2_Groundtruth.dat").write_text(".5 2 2 0\n104 2 4 0.5\n")
    netkf.import_log(log, "mrclam", tmp_path / "out")
    scenario = netkf.load(tmp_path / "out" / "scenario.toml")
    assert (scenario.horizon, scenario.time.origin) == (3.0, 100)
    assert [one.nodes for one in scenario.declared_sensors] == [(1,), (1,)]


def test_a_log_of_one_robot_runs(log, tmp_path):
    for file in log.glob("Robot2_*"):
        file.unlink()
    netkf.import_log(log, "mrclam", tmp_path / "out")
    assert netkf.simulate(netkf.load(tmp_path / "out" / "scenario.toml")).nodes == (1,)


def test_readings_in_other_units_are_told(tmp_path):
    log = tmp_path / "log"
    shutil.copytree(SMALL, log)
    for robot, (far, turned) in {1: (1000.0, 1.0), 2: (1.0, 180.0 / math.pi)}.items():
        path = log / f"Robot{robot}_Measurement.dat"
        rows = pd.read_csv(path, comment="#", header=None, sep=r"\s+")
        rows[2], rows[3] = rows[2] * far, rows[3] * turned
        rows.to_csv(path, sep=" ", header=False, index=False)
    _, notes = netkf.import_log(log, "mrclam", tmp_path / "out")
    told = [note for note in notes if "differ from the true poses by" in note]
    assert [note[: note.index(" differ")] for note in told] == [
        f"{file}: {what} by robot {robot}"
        for file in ("landmarks.csv", "robots.csv")
        for robot, what in ((1, "distances (m)"), (2, "directions (rad)"))
    ]


def test_nothing_is_overwritten_and_a_log_must_be_one(log, tmp_path, capsys):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "truth.csv").write_text("mine")
    with pytest.raises(ScenarioError, match=r"truth.csv: is there already"):
        netkf.import_log(log, "mrclam", tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["truth.csv"]
    with pytest.raises(ScenarioError, match="kind: must be one of csv, ulb, mercator, mrclam"):
        netkf.import_log(log, "rosbag", tmp_path / "other")
    assert main(["import", str(tmp_path), "--kind", "mrclam", "--out", str(tmp_path / "x")]) == 2
    assert "must be a folder with Robot1_Odometry.dat" in capsys.readouterr().err


def test_the_small_set_is_that_of_its_script_and_the_scenario_that_of_the_set(tmp_path):
    path = ROOT / "analysis" / "mrclam_small.py"
    spec = importlib.util.spec_from_file_location("mrclam_small", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.make(tmp_path / "mrclam_small")
    for file in (tmp_path / "mrclam_small").iterdir():
        pair = [
            pd.read_csv(folder / file.name, comment="#", header=None, sep=r"\s+")
            for folder in (tmp_path / "mrclam_small", SMALL)
        ]
        # The last digit may be rounded otherwise elsewhere.
        np.testing.assert_allclose(*pair, rtol=0, atol=1.1e-3)
    files, notes = netkf.import_log(SMALL, "mrclam", tmp_path / "made")
    assert len(notes) == 4
    for file in files:
        assert file.read_text() == (MADE / file.name).read_text(), file.name


@pytest.mark.slow
def test_robots_that_tell_each_other_come_close_to_the_central_filter():
    changes = {"horizon": 9.0}
    scenario = netkf.load(MADE / "scenario.toml", changes)
    central = scenario.replace({"filter": {"kind": "central"}})
    alone = scenario.replace(
        {
            "filter.kind": "block-intersection",
            "network.channel.delay": {"kind": "constant", "seconds": 0.3},
        }
    )
    runs = [netkf.simulate(one) for one in (scenario, central, alone)]
    error = [_rms_of_poses(run) for run in runs]
    # Readings of metres and centimetres apart: 5 to 15 cm, best with all at once.
    assert 0.04 < error[1] < error[0] < error[2] < 0.2
    # P is what the errors are like, in all coordinates of all robots.
    assert 0.5 < runs[1].states.nees[20:].mean() / 15.0 < 1.6
    assert 0.4 < runs[0].states.nees[20:].mean() / 3.0 < 1.6


def _rms_of_poses(run):
    blocks = [run.block("pose", node) for node in range(1, 6)]
    squares = [np.sum((block.x - block.xhat)[:, :2] ** 2, axis=1) for block in blocks]
    return float(np.sqrt(np.mean(squares)))
