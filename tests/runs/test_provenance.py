"""What manifests say about how a run came about."""

import json

import numpy as np
import pandas as pd
import pytest

import netkf
from netkf.cli.main import main
from netkf.runs.provenance import PACKAGES
from netkf.runs.run import run_to_directory, save
from tests.conftest import SCENARIOS

RING = str(SCENARIOS / "poisson_ring.toml")


def manifest(folder):
    return json.loads((folder / "manifest.json").read_text())


def test_a_manifest_lists_what_decides_the_last_bit(ring, tmp_path):
    run_to_directory(ring, tmp_path / "out")
    found = manifest(tmp_path / "out")
    assert {"netkf", "python", *PACKAGES} <= found["versions"].keys()
    assert found["versions"]["numpy"] == np.__version__
    assert found["machine"]["architecture"]
    assert found["machine"]["vector_instructions"]


@pytest.mark.parametrize("after", ["5.0\n", None])
def test_a_table_that_was_edited_meanwhile_is_kept_as_it_was_read(ring, tmp_path, after):
    """The run directory had the table of the time of saving, of another run than that in it."""
    (tmp_path / "u.csv").write_text("t,u0\n0,1.0\n")
    recorded = {"kind": "recorded", "path": tmp_path / "u.csv", "G": [[1.0]] * ring.plant.n}
    scenario = ring.replace({"plant.input": recorded, "horizon": 1.0})
    if after is None:
        (tmp_path / "u.csv").unlink()
    else:
        (tmp_path / "u.csv").write_text(f"t,u0\n0,{after}")
    run = netkf.simulate(scenario)
    save(run, scenario, tmp_path / "out")
    again = netkf.simulate(netkf.load(tmp_path / "out" / "scenario.toml"))
    np.testing.assert_array_equal(again.xhat, run.xhat)
    # Another one that is made of it, as points of a sweep are.
    other = netkf.simulate(scenario.replace({"filter.epsilon": 0.1}))
    np.testing.assert_array_equal(other.x, run.x)


def test_what_the_engine_counted_is_kept(ring, tmp_path):
    run = netkf.simulate(ring)
    run.stats.update(processes=3, events=9)
    save(run, ring, tmp_path / "out")
    assert manifest(tmp_path / "out")["simpy"] == {"processes": 3, "events": 9}


def test_one_replica_of_an_ensemble(ring, tmp_path, capsys):
    out = tmp_path / "out"
    short = [RING, "--set", "horizon=2.0", "--no-plot"]
    assert main(["run", *short, "--replica", "3", "--out", str(out)]) == 0
    run = netkf.simulate(netkf.load(RING, {"horizon": 2.0}), replica=3)
    found = manifest(out)
    assert (found["seed"], found["replica"]) == (run.seed, 3)
    assert found["fingerprint"] == run.fingerprint
    pd.testing.assert_frame_equal(pd.read_parquet(out / "states.parquet"), run.states)
    capsys.readouterr()
    for arguments, words in (
        (["--replica", "3", "--runs", "2"], "--replica: is for a single run"),
        (["--resume", "--replica", "4", "--out", str(out)], "holds another replica"),
    ):
        assert main(["run", *short, *arguments]) == 2
        assert words in capsys.readouterr().err
    assert main(["run", *short, "--resume", "--replica", "3", "--out", str(out)]) == 0
    with pytest.raises(SystemExit):
        main(["run", *short, "--replica", "-1"])


@pytest.mark.parametrize("name", ["simpy", "processes"])
def test_names_of_the_reference_engine(ring, name):
    run = netkf.simulate(ring, engine=name)
    assert netkf.first_difference(run, netkf.simulate(ring)) is None
