"""Paths drawn from sample to sample, with their laws worked out exactly from unit normals."""

from itertools import pairwise

import numpy as np
import pytest
import scipy.linalg

from netkf.plants import truth
from netkf.plants.diffusion import Diffusion
from netkf.plants.transitions import Transitions
from tests.plants.test_path import COV, A, B, covariance_of

DEFECTIVE = np.array([[0.4, 1.0], [0.0, 0.4]])
PLANTS = {
    "oscillator": (A, B),
    "defective": (DEFECTIVE, np.array([[0.0], [1.0]])),
    "integrators": (np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [0.5]])),
    "unstable": (np.array([[1.5, 0.2], [0.1, -4.0]]), np.array([[1.0, 0.0], [0.5, 0.1]])),
    "correlated": (np.zeros((2, 2)), np.array([[1.0], [2.0]])),
    "quiet": (A, np.zeros((2, 1))),
}


def noise_covariance(A, B, gap):
    """Van Loan, doubled up from gaps over which it is well conditioned."""
    n, halvings = len(A), max(0, int(np.ceil(np.log2(max(gap * np.abs(A).max(), 1e-9)))))
    unit = gap / 2**halvings
    E = scipy.linalg.expm(np.block([[-A, B @ B.T], [np.zeros((n, n)), A.T]]) * unit)
    F = E[n:, n:].T
    Q = F @ E[:n, n:]
    for _ in range(halvings):
        Q, F = Q + F @ Q @ F.T, F @ F
    return Q


def joint_covariance(A, B, times, cov=COV):
    """Cov of x at several times, all at once."""
    expm = scipy.linalg.expm

    def at(t):
        return expm(A * t) @ cov @ expm(A * t).T + noise_covariance(A, B, t)

    return np.block(
        [
            [expm(A * max(t - s, 0.0)) @ at(min(s, t)) @ expm(A * max(s - t, 0.0)).T for s in times]
            for t in times
        ]
    )


def make(A, B, samples, probes, random, probing, horizon=9.0, frames=False, **changes):
    plant = Diffusion(A, B, **{"mean": np.zeros(len(A)), "cov": COV, **changes})
    return plant.sampled_truth(
        random, probing, np.array(samples), np.array(probes), horizon, frames
    )


@pytest.mark.parametrize("kind", PLANTS)
@pytest.mark.parametrize(
    ("samples", "probes"),
    [
        ([0.3, 0.8, 2.0], []),
        ([0.3, 0.8, 2.0], [0.0, 0.1, 0.3, 1.0]),  # at the start, before, at and between samples
        ([0.3, 2.0], [0.5, 0.50001, 1.0, 1.9, 2.5, 3.0]),  # several in one gap, and after the last
        ([], [0.2, 1.0]),
        ([1e-9, 2e-9], [1.5e-9]),
    ],
)
def test_samples_and_probes_have_their_exact_joint_law(kind, samples, probes):
    A, B = PLANTS[kind]
    times = sorted({*samples, *probes})

    def compute(random, probing):
        path = make(A, B, samples, probes, random, probing)
        return np.concatenate([path.absolute(t) for t in times])

    exact = joint_covariance(A, B, times)
    np.testing.assert_allclose(
        covariance_of(compute, 2), exact, rtol=0, atol=1e-12 * np.abs(exact).max()
    )


@pytest.mark.parametrize("kind", PLANTS)
def test_increments_over_short_gaps_keep_their_relative_law(kind):
    """Covariances of 1e-27 over a gap of 1e-9 s are right to twelve digits, entry by entry."""
    A, B = PLANTS[kind]
    for gap in (1e-9, 1e-4, 0.1, 7.0, 1e3):
        if kind in ("unstable", "defective") and gap > 100.0:
            continue
        L = Transitions(A, B).laws(np.array([gap]))[1][0]
        exact = noise_covariance(A, B, gap)
        if kind == "integrators":
            exact = 0.25 * np.array([[gap**3 / 3, gap**2 / 2], [gap**2 / 2, gap]])
        scale = np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
        assert (np.abs(L @ L.T - exact) <= 1e-11 * scale).all()
        assert (np.diag(L) >= 0.0).all()
        assert not np.triu(L, 1).any()


def test_bridges_leave_what_the_gap_adds_as_it_is():
    """x at the end from x at the probe and the second part of the noise is x at the end."""
    for matrices in PLANTS.values():
        moves = Transitions(*matrices)
        before, after = np.array([0.1, 1e-9, 0.5]), np.array([0.4, 0.5, 1e-9])
        Phi, L = moves.laws(after)
        first, whole = moves.laws(before)[1], moves.laws(before + after)[1]
        D = moves.bridges(before, after)
        parts = np.concatenate([Phi @ first, L], axis=2)
        np.testing.assert_allclose(whole @ D, parts, rtol=0, atol=1e-9 * np.abs(parts).max())


def test_neither_probes_nor_later_samples_move_the_samples():
    samples = [0.3, 0.8, 2.0]

    def path(samples, probes, frames=False):
        seeds = np.random.default_rng(1), np.random.default_rng(2)
        return make(*PLANTS["unstable"], samples, probes, *seeds, frames=frames)

    plain = path(samples, [])
    for other in (path(samples, [0.1, 0.3, 0.31, 1.0]), path([*samples, 2.5], [])):
        for t in samples:
            np.testing.assert_array_equal(other.absolute(t), plain.absolute(t))
    early = path([*samples, 7.0], [0.5], frames=True)
    np.testing.assert_array_equal(early.local(2.0), plain.absolute(2.0))


def test_blocks_do_not_show(monkeypatch):
    samples, probes = np.arange(1, 40) * 0.3, np.arange(0, 60) * 0.17

    def states():
        seeds = np.random.default_rng(1), np.random.default_rng(2)
        path = make(*PLANTS["unstable"], samples, probes, *seeds, horizon=20.0, frames=True)
        return path.states(np.concatenate([samples, probes]))

    whole = states()
    monkeypatch.setattr(truth, "BLOCK", 1)
    for one, other in zip(states(), whole, strict=True):
        np.testing.assert_array_equal(one, other)


def test_samples_at_multiples_of_a_period_are_a_plant_in_slots():
    """Cov x[k+1] = F Cov x[k] F' + Q with F = e^{A T} and the Q of Van Loan."""
    T, count = 0.7, 6
    times = T * np.arange(1, count + 1)

    def compute(random, probing):
        path = make(A, B, times, [], random, probing)
        return np.concatenate([path.local(t) for t in times])

    found = covariance_of(compute, 2)
    F, Q, cov = scipy.linalg.expm(A * T), noise_covariance(A, B, T), COV
    for k in range(count):
        cov = F @ cov @ F.T + Q
        here = slice(2 * k, 2 * k + 2)
        np.testing.assert_allclose(found[here, here], cov, rtol=1e-12)
        if k:
            before = slice(2 * k - 2, 2 * k)
            np.testing.assert_allclose(found[here, before], F @ found[before, before], atol=1e-12)


@pytest.mark.parametrize(
    ("samples", "probes"),
    [([0.13, 0.55], [0.2, 0.81]), ([0.4, 0.43, 0.47], [0.41, 0.45, 0.5]), ([0.31], [0.31, 0.32])],
)
def test_samples_cut_into_the_sensing_grid_have_their_exact_law(samples, probes, monkeypatch):
    """Samples and probes in one step are cut one after the other, from streams of their own."""
    from netkf.plants import paths

    monkeypatch.setattr(paths, "BLOCK", 1)
    plant = Diffusion(A, B, mean=[0.0, 0.0], cov=COV, sensing_period=0.2)
    times = sorted({*samples, *probes, 1.0})

    def compute(random, probing, sampling):
        path = plant.path(random, probing, np.array(probes), sampling, np.array(samples))
        return np.concatenate([path.state(t) for t in times])

    exact = joint_covariance(A, B, times)
    np.testing.assert_allclose(covariance_of(compute, 3), exact, rtol=0, atol=2e-9)

    def sampled(shown):
        seeds = [np.random.default_rng(k) for k in range(3)]
        path = plant.path(seeds[0], seeds[1], np.array(shown), seeds[2], np.array(samples))
        return np.array([path.state(t) for t in samples])

    np.testing.assert_array_equal(sampled(probes), sampled([]))


def test_moments_span_the_cuts_of_other_nodes():
    plant = Diffusion(A, B, mean=[1.0, 0.0], cov=COV, sensing_period=0.2)
    samples = np.array([0.25, 0.27, 0.36])

    def path():
        seeds = [np.random.default_rng(k) for k in range(3)]
        return plant.path(*seeds[:2], np.array([0.31]), seeds[2], samples)

    grid = plant.path(*[np.random.default_rng(k) for k in range(2)], np.empty(0))
    grid.state(0.2)
    np.testing.assert_allclose(path().moments(0.2, 0.4), grid.moments(0.2, 0.4), rtol=1e-9)
    whole, parts = path(), path()
    for start, end in ((0.2, 0.26), (0.26, 0.33), (0.33, 0.4)):
        joined = whole.moments(start, end)
        cuts = [start, *(t for t in (0.25, 0.27, 0.31, 0.36) if start < t < end), end]
        some = [parts.moments(a, b) for a, b in pairwise(cuts)]
        np.testing.assert_allclose(sum(part[0] for part in some), joined[0], rtol=1e-12)
        tilted = sum(
            (a + b - start - end) / (end - start) * part[0] + (b - a) / (end - start) * part[1]
            for a, b, part in zip(cuts[:-1], cuts[1:], some, strict=True)
        )
        np.testing.assert_allclose(tilted, joined[1], rtol=0, atol=1e-14)


def test_recorded_states_are_found_by_their_times():
    times, x = np.array([0.0, 0.5, 1.0]), np.arange(6.0).reshape(3, 2)
    path = truth.RecordedTruth(times, x, 2)
    np.testing.assert_array_equal(path.local(0.5 + 1e-10), x[1])
    np.testing.assert_array_equal(path.absolute(1.0), x[2])
    assert np.isnan(path.local(0.7)).all()
    local, absolute = path.states(np.array([0.5, 0.0]))
    np.testing.assert_array_equal(local, x[[1, 0]])
    np.testing.assert_array_equal(absolute, local)
