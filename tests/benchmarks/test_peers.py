"""What the benchmarks compare does the same work: numbers of events, and results."""

import numpy as np
import pytest

import netkf
from netkf.algorithms.kernels.chains import move_roots, reading_modes
from tests.benchmarks import cases, peers


@pytest.fixture(scope="module")
def small():
    return cases.planar(18, 2.0, 8).replace({"probe": 2.0})


JOBS = {"filterpy": peers.filterpy_job, "stonesoup": peers.stone_soup_job}


def counted(events, case, kind):
    """Readings on the sensing grid, or swaps."""
    if kind == "absorb":
        return 2 * sum(event.link is not None for event in events)
    alone = [e for e in events if e.link is None and not e.probe and len(e.nodes) > 2]
    return sum(len(event.nodes) for event in alone)


@pytest.mark.parametrize("package", JOBS)
def test_a_job_by_others_has_the_events_and_covariances_of_a_run(small, package):
    pytest.importorskip(package)
    # These filters take a reading's mean over a gap for a reading at its end: P is up to 4 % off.
    run = netkf.simulate(small)
    events = peers.events_of(small, peers.ticks_of(run))
    for kind in ("sense", "absorb"):
        assert counted(events, small, kind) == (run.events.kind == kind).sum() > 50
    results = JOBS[package](small, events)
    size = np.abs(run.P).max(axis=(2, 3), keepdims=True)
    np.testing.assert_allclose(results.P / size, run.P / size, rtol=0, atol=0.04)


@pytest.mark.parametrize("package", JOBS)
def test_a_job_by_others_has_the_very_covariances_where_readings_say_nothing(small, package):
    pytest.importorskip(package)
    poor = {"nodes": [0, 3], "H": [[1.0, 0, 0, 0], [0, 0, 1.0, 0]], "R": [[1e9, 0], [0, 1e9]]}
    case = small.replace({"sensors": [poor]})
    run = netkf.simulate(case)
    results = JOBS[package](case, peers.events_of(case, peers.ticks_of(run)))
    np.testing.assert_allclose(results.P, run.P, rtol=0, atol=1e-5)


def test_jobs_by_others_have_the_same_states(small):
    for package in JOBS:
        pytest.importorskip(package)
    events = peers.events_of(small, list(peers.clocks(small)))
    theirs, others = (job(small, events) for job in JOBS.values())
    for a, b in zip(theirs, others, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-9)


def test_central_filters_by_others_agree_and_have_netkfs_covariances():
    pytest.importorskip("filterpy")
    pytest.importorskip("simdkalman")
    case = cases.central().replace({"horizon": 5.0})
    readings = peers.series(case, 3)
    means, covs = peers.simdkalman_filter(case, readings)
    for a, b in zip(peers.filterpy_filter(case, readings), (means, covs), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-12)
    P = netkf.simulate(case).P[1:, 0]
    np.testing.assert_allclose(covs, np.broadcast_to(P, covs.shape), rtol=1e-8, atol=1e-12)


def test_the_stacked_system_has_the_bound(small):
    times = [0.5, 2.0]
    stacked = peers.StackedBound(small)
    expected = stacked.solved(times)
    assert stacked.evaluations > 100
    np.testing.assert_allclose(
        netkf.theory.covariance_bound(small, times), expected, rtol=1e-6, atol=1e-7
    )


def test_plain_chains_end_where_compiled_ones_do():
    F, Q, H, R = peers.random_system()
    words = np.random.default_rng(1).random((5, 40)) < 0.6
    roots = np.broadcast_to(np.eye(4), (5, 4, 4))
    ends = move_roots(
        roots, words, F, np.linalg.cholesky(Q), reading_modes([(H[:0], R[:0, :0]), (H, R)], 4)
    )
    plain = peers.plain_chains(roots, words, F, Q, H, R)
    np.testing.assert_allclose(ends @ np.swapaxes(ends, 1, 2), plain, rtol=1e-8)
