"""Paths at any instants, with their laws worked out exactly from unit normals."""

from itertools import pairwise

import numpy as np
import pytest
import scipy.linalg

import netkf
from netkf.plants import tree, truth
from netkf.plants.diffusion import Diffusion
from netkf.plants.transitions import Transitions, frame_period
from netkf.plants.truth import multiples
from netkf.rng.streams import WIDTH, Streams
from tests.conftest import SCENARIOS
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


def make(A, B, times, seed=1, horizon=9.0, frames=False, **changes):
    plant = Diffusion(A, B, **{"mean": np.zeros(len(A)), "cov": COV, **changes})
    return plant.sampled_truth(Streams(seed).generator("plant"), np.array(times), horizon, frames)


def linear_map(monkeypatch, plant, times, horizon):
    """The states at times as a linear map of all normals, by running the kernels' Python code once
    for each normal: (K n, normals).
    """
    used, place = {}, [-1]

    def draw(size, stream, first, second, ziggurat, out, begin):
        here = used.setdefault((first, second), len(used) * len(size))
        out[begin : begin + len(size)] = [float(here + i == place[0]) for i in range(len(size))]

    for name in ("fill_states", "enter_knot", "move_to_knot", "divide_cell"):
        monkeypatch.setattr(tree, name, getattr(tree, name).__wrapped__)
    monkeypatch.setattr(tree, "draw_normals_of_point", draw)
    cells = tree.Tree(plant.moves, horizon, frame_period(plant.A))
    at = np.unique(
        np.concatenate([[0.0], times, multiples(frame_period(plant.A), horizon, plant.time_grid)])
    )

    def states(start):
        local, offsets = cells.states(at, start, np.zeros((1, WIDTH), dtype=np.uint64), 9)
        frame_times = multiples(frame_period(plant.A), horizon, plant.time_grid)
        x = truth.absolute_states(plant.moves, frame_times, offsets[: len(frame_times)], at, local)
        return x[np.searchsorted(at, times)].ravel()

    columns = [states(column[: plant.n]) for column in np.linalg.cholesky(COV).T]
    while place[0] < len(used) * plant.n:
        place[0] += 1
        columns.append(states(np.zeros(plant.n)))
    return np.array(columns).T


@pytest.mark.one_in(6)
@pytest.mark.parametrize("kind", PLANTS)
@pytest.mark.parametrize(
    "times",
    [
        [0.3, 0.8, 2.0],
        [0.1, 1.0, 7.5],
        [1e-9, 1.5e-9, 2e-9],
        [1.0 / 3.0, 0.5, 0.500001, 6.123456789],
    ],
)
def test_states_at_any_times_have_their_exact_joint_law(kind, times, monkeypatch):
    """Means, variances and covariances of x, whatever the numbers are that are drawn."""
    A, B = PLANTS[kind]
    plant = Diffusion(A, B, mean=np.zeros(2), cov=COV)
    found = linear_map(monkeypatch, plant, np.array(times), 9.0)
    exact = joint_covariance(A, B, times)
    np.testing.assert_allclose(found @ found.T, exact, rtol=0, atol=1e-11 * np.abs(exact).max())


@pytest.mark.parametrize("horizon", [1e-9, 0.02, 3e4])
def test_the_law_for_short_and_long_horizons(horizon, monkeypatch):
    plant = Diffusion([[-1.0 / horizon]], [[1.0]], mean=[0.0], cov=[[2.0 * horizon]])
    times = horizon * np.array([0.1, 0.37, 0.9])
    found = linear_map(monkeypatch, plant, times, horizon)[:, 2:]
    exact = joint_covariance(plant.A, plant.B, times, np.zeros((1, 1)))
    np.testing.assert_allclose(found @ found.T, exact, rtol=1e-9)


def test_paths_of_many_runs_have_the_law():
    """The numbers of the generator themselves: runs, instants and cells are independent."""
    A, B = PLANTS["oscillator"]
    times = np.array([0.25, 0.9, 0.91234567, 3.0])
    exact = joint_covariance(A, B, times)
    root = np.linalg.cholesky(exact)
    plant = Diffusion(A, B, mean=np.zeros(2), cov=COV)
    paths = [
        plant.sampled_truth(Streams(3, run).generator("plant"), times, 9.0) for run in range(4000)
    ]
    z = np.array([np.linalg.solve(root, path.states(times)[1].ravel()) for path in paths])
    # 44 moments of 4000 runs, each within 5 standard errors: once in 40,000 tries.
    assert np.abs(z.mean(axis=0)).max() < 5.0 / np.sqrt(len(z))
    errors = z.T @ z / len(z) - np.eye(len(root))
    assert np.abs(errors).max() < 5.0 * np.sqrt(2.0 / len(z))


def test_streams_are_those_that_the_documentation_names():
    """The state at 1500 s from numpy's normals: a knot at 1000 s, then its cell's half."""
    plant = Diffusion([[-1e-3]], [[1.0]], mean=[2.0], cov=[[1.0]])
    streams = Streams(7, 2)
    found = plant.sampled_truth(streams.generator("plant"), np.array([1500.0]), 9000.0)
    decay, steady = np.exp(-0.5), 500.0
    half, whole = steady * (1.0 - decay**2), steady * (1.0 - decay**4)
    x = 2.0 + streams.generator("plant").standard_normal()
    z, then, w = (
        streams.generator("plant", *ids).standard_normal()
        for ids in ((0,), (1,), (15, 2 + tree.LEVELS))
    )
    knot = decay**2 * x + np.sqrt(whole) * z
    # z of the cell is the sum of the two parts, and w what is orthogonal to it.
    share = np.sqrt(half) / np.sqrt(whole) * np.array([decay, 1.0])
    first = share[0] * then + share[1] * abs(w) * np.sign(w)
    exact = decay * knot + np.sqrt(half) * np.array([first, share[0] * then - share[1] * w])
    assert np.abs(exact - found.absolute(1500.0)).min() < 1e-9


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
        for covariance in (L @ L.T, Transitions(A, B).law(gap)[1]):
            assert (np.abs(covariance - exact) <= 1e-11 * scale).all()
        assert (np.diag(L) >= 0.0).all()
        assert not np.triu(L, 1).any()


def test_units_of_states_do_not_cost_digits():
    """Metres beside a drift of a clock: norms of A are large, and each halving cost a bit."""
    gaps, units = np.array([0.3, 7.0]), np.array([2.0**20, 2.0**-20])
    Phi, L = Transitions(A, B).laws(gaps)
    found = Transitions(A * units[:, None] / units, units[:, None] * B).laws(gaps)
    np.testing.assert_allclose(found[0] / units[:, None] * units, Phi, rtol=1e-13)
    np.testing.assert_allclose(found[1] / units[:, None], L, rtol=1e-13, atol=0.0)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("kind", PLANTS)
def test_a_state_depends_on_its_time_only(kind):
    """Not on other times, before, after or between, nor on frames or on a horizon of that size."""
    times = np.array([0.3, 0.8, 1.0 / 3.0, 2.0, 6.5])
    plain = make(*PLANTS[kind], times)
    for others in ([], [0.1, 0.30000001, 1.0, 7.0], np.random.default_rng(1).random(50) * 9.0):
        for time in times:
            for horizon in (9.0, 8.0):
                for frames in (False, True):
                    other = make(*PLANTS[kind], [time, *others], horizon=horizon, frames=frames)
                    np.testing.assert_array_equal(other.absolute(time), plain.absolute(time))


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


@pytest.mark.parametrize("horizon", [4e-9, 1e-6, 1e-3, 0.05])
def test_sampled_sensors_have_a_truth_up_to_any_horizon(horizon):
    sensor = {"nodes": [0], "H": [[1.0, 0.0]], "R": [[0.25]]}
    sampling = {"kind": "periodic", "period": horizon / 4}
    changes = {"horizon": horizon, "probe": horizon, "sensors": [{**sensor, "sampling": sampling}]}
    scenario = netkf.load(SCENARIOS / "poisson_ring.toml", changes)
    run = netkf.simulate(scenario)
    assert run.status == "complete"
    assert np.isfinite(run.x).all()


def test_blocks_without_effect_on_each_other_are_left_out_to_the_bit(monkeypatch):
    """Of many blocks a state is moved by those of its own; the path is that of full sums."""
    blocks, coupling = [A, DEFECTIVE, [[-0.3]], A], np.zeros((7, 7))
    coupling[6, 1] = 0.4  # a block drives one that is not beside it
    dynamics = scipy.linalg.block_diag(*blocks) + coupling
    noise = scipy.linalg.block_diag(B, [[0.0], [1.0]], [[0.5]], B)

    def states():
        plant = Diffusion(dynamics, noise, mean=np.ones(7), cov=np.eye(7))
        cells = tree.Tree(plant.moves, 9.0, None)
        times, stream = (
            np.array([0.3, 1.0 / 3.0, 0.5, 7.123456789]),
            Streams(1).states("plant", [()]),
        )
        return cells.states(times, np.ones(7), stream, 0)[0], cells._cells

    found, cells = states()
    assert (np.diff(cells.of_v) < 4).sum() > 0.4 * cells.of_v[..., 0].size
    monkeypatch.setattr(tree, "_spans", lambda used: np.full((*used.shape[:2], 2), [0, 7]))
    full, cells = states()
    assert (np.diff(cells.of_v) == 7).all()
    assert found.tobytes() == full.tobytes()
