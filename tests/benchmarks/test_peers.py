"""What the benchmarks compare does the same work: numbers of events, and results."""

import numpy as np
import pytest

import netkf
from netkf.algorithms.kernels.chains import move_roots, reading_modes
from tests.benchmarks import cases, peers


@pytest.fixture(scope="module")
def small():
    return cases.planar(18, 2.0, 8).replace({"probe": 2.0})


@pytest.mark.parametrize("job", [peers.filterpy_job, peers.stone_soup_job])
def test_a_job_by_hand_makes_the_covariances_of_a_run(small, job):
    pytest.importorskip("filterpy" if job is peers.filterpy_job else "stonesoup")
    # Readings at ticks are not readings in continuous time: sensors too poor to matter.
    poor = {"nodes": [0, 3], "H": [[1.0, 0, 0, 0], [0, 0, 1.0, 0]], "R": [[1e9, 0], [0, 1e9]]}
    case = small.replace({"sensors": [poor]})
    run = netkf.simulate(case)
    ticks = peers.with_laws(case, peers.ticks_of(run))
    made, _, P = job(case, ticks)
    assert made == (run.events.kind == "tick").sum() > 100
    last = dict.fromkeys(case.nodes, 0.0)
    for tick in ticks:
        last.update(dict.fromkeys(tick.link, tick.t))
    for k, node in enumerate(case.nodes):  # a run goes on to its horizon
        F, Q = peers.discrete(case.diffusion, case.horizon - last[node])
        np.testing.assert_allclose(F @ P[k] @ F.T + Q, run.P[-1, k], rtol=0, atol=1e-5)


def test_both_jobs_by_hand_have_the_same_ticks_and_states(small):
    pytest.importorskip("filterpy")
    pytest.importorskip("stonesoup")
    ticks = peers.with_laws(small, peers.clocks(small, 200))
    theirs, others = peers.filterpy_job(small, ticks), peers.stone_soup_job(small, ticks)
    assert theirs[0] == others[0] == 200
    for a, b in zip(theirs[1:], others[1:], strict=True):
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
