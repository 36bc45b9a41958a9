"""The scenario of a recorded network against its raw record."""

import numpy as np
import pandas as pd
import pytest

import netkf
from netkf.runs.run import run_to_directory
from tests.conftest import SCENARIOS

DATA = SCENARIOS / "data" / "ulb_library"
HELD_OUT = {5, 10, 15}
MINUTES = 40


@pytest.fixture(scope="module")
def library():
    return netkf.load(SCENARIOS / "ulb_library.toml", {"horizon": 60.0 * MINUTES})


@pytest.fixture(scope="module")
def run(library):
    return netkf.simulate(library)


def test_exactly_what_was_reported_arrives(run):
    reports = pd.read_csv(DATA / "heard.csv.gz")
    minute = ((reports.t_s + 10.0) // 60.0).astype(int) - 1
    reported = set(zip(reports.sender, reports.receiver, minute, strict=True))
    arrived = run.events[run.events.kind == "deliver"]
    got = set(zip(arrived.peer, arrived.node, (arrived.t // 60.0).astype(int), strict=True))
    assert got == {row for row in reported if 0 <= row[2] < MINUTES}
    assert len(arrived) == len(got)


def test_motes_that_are_held_out_take_no_samples(library, run):
    raw = pd.read_csv(DATA / "readings.csv")
    raw = raw[(raw.t_s < library.horizon) & ~raw.node.isin(HELD_OUT)]
    sensed = run.events[run.events.kind == "sense"]
    assert sorted(zip(sensed.t, sensed.node, strict=True)) == sorted(
        zip(raw.t_s, raw.node, strict=True)
    )
    assert set(raw.node).isdisjoint(HELD_OUT)
    assert np.isfinite(run.xhat).all()
    assert np.isnan(run.x).all()


def test_push_sum_survives_a_node_that_hears_next_to_nothing(library, tmp_path):
    """Mote 8's reports are missing: it gives weight away until rounding would make it negative."""
    scenario = library.replace({"filter": {"kind": "push-sum"}})
    done = run_to_directory(scenario, tmp_path / "out")
    assert done.status == "complete"
    assert abs(done.summary["conserved"]["weight"]["drift"]) < 1e-12
