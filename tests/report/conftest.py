"""Directories that pages are made of, each written once."""

import pytest

import netkf
from netkf.ensembles.directory import EnsembleOptions, runs_to_directory
from netkf.ensembles.pools import PoolOptions
from netkf.runs.documents import write_sealed
from netkf.runs.run import run_to_directory
from netkf.studies.sweep import plan_sweep, sweep_to_directory
from tests.conftest import SCENARIOS

EVIL = "</script><script>window.pwned=1</script><img src=x onerror='window.pwned=1'>&lt;b&gt;"
"""A text that would run if it were not escaped."""


def stored(folder, name, changes):
    scenario = netkf.load(SCENARIOS / f"{name}.toml", changes)
    return run_to_directory(scenario, folder / name).directory


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("report")


@pytest.fixture(scope="session")
def ring(folder):
    """A run under link clocks with losses, and a bound."""
    return stored(folder, "poisson_ring", {})


@pytest.fixture(scope="session")
def delayed(folder):
    """Messages that travel."""
    return stored(folder, "delayed_links", {"horizon": 8.0})


@pytest.fixture(scope="session")
def slots(folder):
    """Broadcasts in slots, samples that know of the whole slot."""
    return stored(folder, "push_sum_planar", {"horizon": 5.0})


@pytest.fixture(scope="session")
def library(folder):
    """Broadcasts under clocks, without ground truth."""
    return stored(folder, "ulb_library", {"horizon": 600.0})


@pytest.fixture(scope="session")
def gossip(folder):
    """Slots in which pairs of nodes swap what they know; samples are predictions."""
    return stored(folder, "gossip_ring", {"horizon": 40.0})


@pytest.fixture(scope="session")
def readings(folder):
    """Slots in which messages carry readings, which nobody passes on."""
    return stored(folder, "intermittent_random10", {"horizon": 12.0})


@pytest.fixture(scope="session")
def ensembles(folder):
    """Two ensembles of different link rates."""
    found = []
    for rate in (1.0, 4.0):
        changes = {"horizon": 6.0, "network.activation.rate": rate}
        scenario = netkf.load(SCENARIOS / "poisson_ring.toml", changes)
        target = folder / f"rate{rate:g}"
        runs_to_directory(scenario, 12, target, EnsembleOptions(trace="full", pool=PoolOptions(1)))
        found.append(target)
    return found


@pytest.fixture(scope="session")
def sweep(folder):
    scenario = netkf.load(SCENARIOS / "poisson_ring.toml", {"horizon": 2.0})
    vary = {"network.activation.rate": [1.0, 3.0]}
    return sweep_to_directory(plan_sweep(scenario, vary, 3), folder / "sweep").directory


def write_verdict(directory, promise):
    """Write a verdict with one broken and one kept promise beside the files of a directory."""
    row = {"source": "H Theorem 2", "assumptions": "hold", "evidence": "600 samples"}
    numbers = {"seen": 1.25, "expected": 1.0, "off": 0.25, "detectable": 0.1}
    row |= numbers | {"low": -0.3, "high": -0.2}
    rows = [
        {**row, "promise": "P is below the bound", "verdict": "holds"},
        {**row, "promise": promise, "verdict": "broken"},
    ]
    document = {"scenario": "test", "runs": 50, "seed": 1, "confidence": 0.99, "rows": rows}
    write_sealed(directory / "verdict.json", document)
