"""A pattern to copy: every scenario file of a folder, and some changes of it, under pytest.

    pytest scenarios/test_pattern.py

Copy this file beside your scenarios, keep the tests you need, and choose `RUNS`: with more runs
smaller errors are found, and `netkf check` says which.
"""

from pathlib import Path

import numpy as np
import pytest

import netkf
from netkf import testing

FOLDER = Path(__file__).parent
FILES = testing.scenario_files(FOLDER)
RUNS = 20


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_no_promise_is_broken(path):
    testing.assert_promises(path, runs=RUNS)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_run_ends_and_is_the_same_again(path):
    scenario = netkf.load(path)
    run, again = netkf.simulate(scenario), netkf.simulate(scenario)
    assert run.status == "complete"
    assert netkf.first_difference(run, again) is None


@pytest.mark.parametrize("delivery", [0.5, 0.9])
@pytest.mark.parametrize("rate", [1.0, 5.0])
def test_the_mean_covariance_stays_below_the_bound(rate, delivery):
    changes = {"network.activation.rate": rate, "network.channel.loss.delivery": delivery}
    scenario = netkf.load(FOLDER / "poisson_ring.toml", changes)
    ensemble = netkf.monte_carlo(scenario, runs=5 * RUNS, workers=1)
    bound = netkf.theory.covariance_bound(scenario, ensemble.times)
    testing.assert_dominated(ensemble.mean_P, bound, tolerance=0.2)


@pytest.mark.parametrize("kind", ["local", "hybrid", "central"])
def test_errors_are_not_larger_than_a_requirement(kind):
    limits = {"local": 8.0, "hybrid": 4.0, "central": 2.5}
    filtering = {"kind": kind, **({"epsilon": 0.3} if kind == "hybrid" else {})}
    scenario = netkf.load(FOLDER / "poisson_ring.toml", {"filter": filtering})
    ensemble = netkf.monte_carlo(scenario, runs=RUNS, workers=1)
    worst = np.sqrt(ensemble.average[:-1, 0].max())
    assert worst <= limits[kind], f"RMS error {worst:.3g} of the worst node"
