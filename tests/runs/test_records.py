"""What ``netkf run`` says about the tables of a scenario: unused rows, messages beyond them."""

import json

import pytest

import netkf
from netkf.cli.main import main
from netkf.runs.run import save

CLOCKED = """
format = 1
name = "logged"
horizon = 4.0
probe = 1.0
plant = { kind = "diffusion", A = [[-0.2]], B = [[1.0]], cov = [[1.0]] }
[[sensors]]
kind = "recorded"
nodes = [0]
path = "readings.csv"
H = [[1.0]]
R = [[0.5]]
[[sensors]]
nodes = [2]
H = [[1.0]]
R = [[0.5]]
sampling = { kind = "recorded", path = "samples.csv" }
[network]
graph = { kind = "edges", edges = [[0, 1], [1, 2]] }
activation = { kind = "recorded", path = "ticks.csv", at = "nodes" }
channel.loss = { kind = "recorded", path = "lost.csv", after = "lose" }
channel.delay = { kind = "recorded", path = "late.csv" }
[filter]
kind = "hybrid"
epsilon = 0.3
"""
TABLES = {
    "readings": "t,node,y0\n0.5,0,1\n1.5,0,2\n4.5,0,3\n0.5,1,9\n",
    "samples": "t,node\n0.7,2\n1.9,2\n4,2\n",
    # Node 1 broadcasts to 0 and 2 three times, node 0 to 1 twice; the last row is at the horizon.
    "ticks": "t,node\n0.5,1\n1,1\n1.5,0\n2.5,0\n3,1\n4,0\n",
    "lost": "sender,receiver,message,delivered\n1,0,0,1\n1,0,1,0\n1,2,0,1\n0,1,0,1\n0,1,2,1\n",
    "late": "sender,receiver,message,seconds\n1,0,0,0.25\n1,0,2,0.5\n2,1,0,1\n",
}
USED = {
    "network.activation": {"path": "ticks.csv", "rows": 6, "used": 5, "merged": 0, "unused": 1},
    # Sent: 1 to 0 three, 1 to 2 three, 0 to 1 two. Listed of these: 2, 1 and 1.
    "network.channel.loss": {
        "path": "lost.csv",
        "rows": 5,
        "used": 4,
        "merged": 0,
        "unused": 1,
        "beyond": 4,
        "after": "lose",
    },
    "network.channel.delay": {
        "path": "late.csv",
        "rows": 3,
        "used": 2,
        "merged": 0,
        "unused": 1,
        "beyond": 6,
        "after": "deliver",
    },
    "sensors[0]": {"path": "readings.csv", "rows": 4, "used": 2, "merged": 0, "unused": 2},
    "sensors[1].sampling": {"path": "samples.csv", "rows": 3, "used": 2, "merged": 0, "unused": 1},
}
NOTES = [
    "note: network.activation: 1 of 6 rows were not used (ticks.csv)",
    "note: network.channel.loss: 1 of 5 rows were not used (lost.csv)",
    "note: network.channel.loss: 4 messages are not listed and were lost (lost.csv)",
    "note: network.channel.delay: 1 of 3 rows were not used (late.csv)",
    "note: network.channel.delay: 6 messages are not listed and took no time unless lost "
    "(late.csv)",
    "note: sensors[0]: 2 of 4 rows were not used (readings.csv)",
    "note: sensors[1].sampling: 1 of 3 rows were not used (samples.csv)",
]


@pytest.fixture
def logged(tmp_path):
    for name, text in TABLES.items():
        (tmp_path / f"{name}.csv").write_text(text)
    path = tmp_path / "logged.toml"
    path.write_text(CLOCKED)
    return path


def records(folder):
    return json.loads((folder / "summary.json").read_text()).get("records")


def test_a_run_says_what_it_used_of_its_records(logged, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["run", str(logged), "--out", str(out), "--no-plot"]) == 0
    shown = capsys.readouterr()
    assert [line for line in shown.out.splitlines() if ".csv)" in line] == NOTES
    assert ".csv" not in shown.err  # nothing is told twice
    assert records(out) == USED


def test_a_saved_run_says_the_same(logged, tmp_path):
    scenario = netkf.load(logged)
    assert records(save(netkf.simulate(scenario), scenario, tmp_path / "saved")) == USED


def test_several_runs_leave_out_what_differs_between_them(logged, tmp_path, capsys):
    out = tmp_path / "out"
    many = ["run", str(logged), "--runs", "2", "--workers", "1", "--no-plot", "--out", str(out)]
    assert main(many) == 0
    assert [line for line in capsys.readouterr().out.splitlines() if ".csv)" in line] == [
        note for note in NOTES if "channel" not in note
    ]
    assert records(out) == {key: use for key, use in USED.items() if "channel" not in key}


def test_a_record_that_starts_again_and_one_that_must_not_end(logged, tmp_path, capsys):
    arguments = ["run", str(logged), "--no-plot", "--set", "network.channel.loss.after=repeat"]
    assert main([*arguments, "--out", str(tmp_path / "repeat")]) == 0
    words = "network.channel.loss: 4 messages are not listed and followed the record from its start"
    assert words in capsys.readouterr().out
    arguments[-1] = "network.channel.delay.after=refuse"
    assert main([*arguments, "--out", str(tmp_path / "refuse")]) == 2
    told = capsys.readouterr().err
    assert len(told.splitlines()) == 1
    assert "network.channel.delay.path: late.csv must list every message that is sent" in told
    assert records(tmp_path / "refuse") is None  # it did not reach the horizon


def test_runs_without_records_have_no_such_key(ring, tmp_path, capsys):
    path = tmp_path / "ring"
    save(netkf.simulate(ring.replace({"horizon": 2.0})), ring.replace({"horizon": 2.0}), path)
    assert records(path) is None
