"""The hand-written kernels do netkf's jobs: means over runs agree within intervals.

Of two samples with independent seeds; each node's mean square error and mean trace of P over the
samples after time 0.
"""

from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core import config
from numba.core.caching import FunctionCache
from numba.core.dispatcher import Dispatcher

import netkf
from netkf.linalg.linking import linked_once
from tests.benchmarks import by_hand, cases, jobs, peers

STANDARD_ERRORS, SHARE = 4.5, 1e-5
JOBS = "pairs", "broadcasts", "gossip", "push_sum", "diffusion", "intermittent"
CODE = Path(__file__).parent / "__pycache__" / "slower"
"""Where benchmarks do not find it."""


@pytest.fixture
def slower(monkeypatch):
    """The same loops, which compile in less time: helpers are called where they would be copied,
    and LLVM works at its first level. These tests ask for results, and not for times.
    """
    monkeypatch.setattr(config, "OPT", type(config.OPT)(1))
    for name, kernel in list(vars(by_hand).items()):
        if isinstance(kernel, Dispatcher):
            options = {**kernel.targetoptions, "forceinline": False}
            monkeypatch.setattr(by_hand, name, numba.jit(**options)(kernel.py_func))
    with pytest.MonkeyPatch.context() as patch:  # netkf's own code stays where it is
        patch.setattr(config, "CACHE_DIR", str(CODE))
        for name in JOBS:  # no code is kept of what is linked into others
            kernel = getattr(by_hand, name)
            kernel._cache = FunctionCache(kernel.py_func)


def averages(results):
    """(R, N, 2): mean square error and mean trace of P of each run and node."""
    errors = (results.errors[:, 1:] ** 2).sum(axis=3).mean(axis=1)
    traces = np.trace(results.P[:, 1:], axis1=3, axis2=4).mean(axis=1)
    return np.stack([errors, traces], axis=2)


def agree(case, runs, results):
    ensemble = netkf.monte_carlo(case, runs, seed=5, workers=1)
    expected, se = (part[:-1, :2] for part in (ensemble.average, ensemble.se_average))
    each = averages(results)
    mean, other = each.mean(axis=0), each.std(axis=0) / np.sqrt(len(each))
    close = STANDARD_ERRORS * np.sqrt(se**2 + other**2) + SHARE * expected
    assert (np.abs(mean - expected) <= close).all()
    assert (se + other < 0.2 * expected).all(), "runs enough to tell"
    assert (results.P[:, 0] == results.P[0, 0]).all(), "the start"


def hybrid():
    return cases.load("poisson_ring").replace({"horizon": 10.0, "probe": 1.0}), 400


def gossip():
    return cases.load("gossip_ring").replace({"horizon": 60.0, "probe": 3.0}), 300


def push_sum():
    return cases.load("push_sum_planar").replace({"horizon": 10.0, "probe": 0.5}), 200


def diffusion():
    return cases.load("diffusion_regression").replace({"horizon": 60.0, "probe": 4.0}), 200


def intermittent():
    # P of the scenario itself has no variance.
    changes = {"network.channel.loss.delivery": 0.9, "horizon": 40.0}
    return cases.load("intermittent_scalar").replace(changes), 400


def intersection():
    losses = {
        "network.channel.loss": {"kind": "gilbert-elliott", "mean_loss": 0.5, "mean_burst": 4}
    }
    changes = {"probe": 0.5, "horizon": 4.0, "network.activation.period": 0.3, **losses}
    return cases.radio(12).replace(changes), 100


def pairs(**changes):
    return cases.ring(**changes).replace({"horizon": 10.0, "probe": 1.0}), 400


def bursts():
    return pairs(loss=cases.BURSTS, clock=cases.LATTICE)


def swaps():
    return pairs(filter={"kind": "gossip"}, clock=cases.ERLANG)


def intersecting_pairs():
    return pairs(filter={"kind": "covariance-intersection", "epsilon": 0.3})


def running_sums():
    return cases.load("push_sum_continuous").replace({"horizon": 8.0}), 500


MAKE = [
    *(hybrid, bursts, swaps, intersecting_pairs),
    *(gossip, push_sum, diffusion, intermittent),
    *(pytest.param(make, marks=pytest.mark.slow) for make in (intersection, running_sums)),
]


@pytest.mark.parametrize("make", MAKE)
@pytest.mark.usefixtures("slower")
@pytest.mark.slow
def test_means_over_runs_agree(make):
    case, runs = make()
    call, results = jobs.prepared(case, 4 * runs)
    with linked_once():
        call()
    agree(case, runs, results)


@pytest.mark.slow
@pytest.mark.usefixtures("slower")
def test_nodes_that_hear_nothing_have_the_covariances_of_a_local_filter():
    case = cases.load("poisson_ring").replace({"network.channel.loss.delivery": 0.0})
    call, results = jobs.prepared(case, 1)
    with linked_once():
        call()
    local = netkf.simulate(case.replace({"filter": {"kind": "local", "cov": np.eye(2).tolist()}}))
    size = np.abs(local.P).max(axis=(2, 3), keepdims=True)
    np.testing.assert_allclose(results.P[0] / size, local.P / size, rtol=0, atol=2e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "case", [cases.planar(12, 5.0), cases.diffusion(10).replace({"horizon": 100.0, "probe": 5.0})]
)
def test_means_over_runs_agree_in_higher_dimensions(case):
    call, results = jobs.prepared(case, 1000)
    call()
    agree(case, 300, results)


@pytest.mark.slow
def test_batched_numpy_agrees_too():
    case, runs = gossip()
    job = (*jobs.in_slots(case), len(case.times))
    agree(case, runs, jobs.Results(*peers.batched_gossip(job, 2 * runs)))
