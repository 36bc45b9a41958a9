"""Shared by all tests: where the scenarios are and how to build one from plain values."""

import gc
import math
import os
import signal
import sys
import zlib
from pathlib import Path

# Dozens of tests start processes. Without bytecode on disk each of them would compile all modules
# of netkf anew, half of what starting it takes; compiled kernels are kept beside it anyway.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# ruff: noqa: E402
import pytest
from hypothesis import settings

import netkf
from netkf.ensembles import pools
from netkf.linalg import compiling
from netkf.scenario.reading import from_table

# The same examples each time; `--hypothesis-profile default` looks for new ones.
settings.register_profile("fixed", derandomize=True)
settings.load_profile("fixed")

ROOT = Path(__file__).parent.parent
SCENARIOS = ROOT / "scenarios"
LONGEST = (
    # In pairs that compile little or nothing in common: who needs the same kernel waits for it.
    "checks/test_check.py",  # compiles most kernels, while the next ones need few
    "testing/test_plants.py",
    "benchmarks/test_by_hand.py",
    "engines/test_triggers.py",  # slots
    "engines/test_clocked.py",  # clocks
    "engines/test_compiled.py",
    "theory/test_replay.py",
    "testing/test_filters.py",
    "checks/test_false_alarms.py",
    "runs/test_run.py",
    "plants/test_blocks.py",
    "figures/test_figures.py",
    "theory/test_mean_square.py",
    "testing/test_scenarios.py",
    "theory/test_cases.py",
    "test_documentation.py",
    "plants/test_dynamics.py",
    "algorithms/test_literature.py",
    "report/test_page.py",
    "report/test_browser.py",
    "checks/test_clocked.py",
    "checks/parts/test_parts.py",
    "algorithms/test_constant_gain.py",
    "engines/test_sample_path.py",
    "algorithms/test_belief_propagation.py",
    "checks/test_rounding.py",
    "ensembles/test_ensembles.py",
    "ensembles/test_workers.py",
    "ensembles/test_cluster.py",
    "ensembles/test_resume.py",
    "algorithms/test_track_fusion.py",
    "runs/test_directory_lock.py",
    "runs/test_labels.py",
    "studies/test_studies.py",
    "studies/test_blocks.py",
    "plants/test_truth.py",
    "theory/test_blocks.py",
    "theory/test_changes.py",
    "theory/test_bounds.py",
    "algorithms/test_root_flow.py",
    "algorithms/test_block_intersection.py",
    "checks/test_looks.py",
    "engines/test_batches.py",
    "plants/test_nonlinear.py",
    "scenario/test_malformed.py",
    "scenario/test_imports.py",
    "engines/test_visits.py",
    "linalg/test_portable.py",
    "test_process.py",
    "test_cli.py",
)
"""Files of more than ten seconds. They run first: a long one at the end would run alone."""


WINGS = {
    "core": (
        *("core", "linalg", "rng", "plants", "network", "algorithms", "trace", "scenario"),
        *("engines", "runs", "ensembles"),
    ),
    "theory": ("theory", "checks", "testing", "laws"),
    "tools": ("studies", "logs", "neighbours", "figures", "report", "cli"),
}
"""The rooms of each wing, in netkf/ and in tests/: the core knows neither theory nor tools."""
CORE_TESTS = (
    *("core/test_csv_values.py", "core/test_interrupts.py", "core/test_memory.py"),
    *("rng/test_streams.py", "network/test_graphs.py", "scenario/test_compatibility.py"),
    *("runs/test_files.py",),
)
"""Tests of the core that take seconds; tests/test_rooms.py runs them without the other wings."""


def scenario_files():
    return sorted(SCENARIOS.glob("*.toml"))


def pytest_configure(config):
    """A shell ignores Ctrl-C for what it runs in the background; tests send it."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # pytest-xdist would order files by the number of their tests.
    config.option.loadscopereorder = False


@pytest.hookimpl(tryfirst=True)  # before pytest leaves out what is slow
def pytest_collection_modifyitems(items):
    """Long files first, then the others as they are found. Of a test that is marked ``one_in(k)``,
    one in k cases stays and the others are slow. Which ones depends on their names alone, so that
    tests with the same parameters keep different ones.
    """
    cases = {}
    for item in items:
        marker = item.get_closest_marker("one_in")
        if marker and not item.get_closest_marker("slow"):
            cases.setdefault((item.path, item.originalname, marker.args[0]), []).append(item)
    for (_, _, k), of_test in cases.items():
        of_test.sort(key=lambda item: zlib.crc32(item.nodeid.encode()))
        for item in of_test[math.ceil(len(of_test) / k) :]:
            item.add_marker(pytest.mark.slow)
    places = {ROOT / "tests" / name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.path, len(places)))


def pytest_collection_finish():
    """Modules and tests stay: the garbage collector need not look at them again and again, nor at
    what a test makes every 700 objects.
    """
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)


ANNOUNCE = compiling.announce


@pytest.fixture(scope="session", autouse=True)
def _nothing_to_announce():
    """Whether code is kept from before must not decide what a test sees on stderr."""
    compiling.announce = lambda: None


SAVING = pools.SAVING


@pytest.fixture(scope="session", autouse=True)
def _no_processes_unless_asked():
    """Tests run side by side on all cores: worker processes, which take seconds to start, would
    only wait for each other. Tests about them ask for workers, or set the limit themselves.
    """
    pools.SAVING = math.inf


@pytest.fixture
def ring():
    return netkf.load(SCENARIOS / "poisson_ring.toml")


@pytest.fixture
def build(tmp_path):
    """A scenario from tables; tables that are missing get small defaults."""

    def make(**tables):
        table = {
            "format": 1,
            "name": "test",
            "horizon": 3.0,
            "probe": 0.5,
            "plant": {"kind": "diffusion", "A": [[-0.5]], "B": [[1.0]], "cov": [[1.0]]},
            "sensors": [{"nodes": [0], "H": [[1.0]], "R": [[0.5]]}],
            "network": {
                "graph": {"kind": "path", "nodes": 2},
                "activation": {"kind": "poisson", "rate": 2.0},
            },
            "filter": {"kind": "hybrid", "epsilon": 0.5},
        }
        return from_table({**table, **tables}, tmp_path)

    return make


def with_slow(names, slow):
    """Return parameters ``names``, of which those in ``slow`` are marked so."""
    return [pytest.param(n, marks=pytest.mark.slow) if n in slow else n for n in names]
