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
