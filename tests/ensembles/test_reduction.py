"""Statistics of batches against numpy, sample by sample: NEES, averages, blur, moments."""

import numpy as np
import pytest

from netkf.ensembles.reduction import reduce_batch
from netkf.trace.batch import COMPLETE, DIVERGED, RunBatch
from netkf.trace.schema import KINDS

TIMES = np.arange(7) * 0.5


def batch(seed, runs, filters, n, exact=False):
    """Random samples; a P is singular, a run diverges, a state is huge, a filter has no P."""
    random = np.random.default_rng(seed)
    shape = runs, len(TIMES), filters
    root = random.standard_normal((*shape, n, n)) + 2.0 * np.eye(n)
    P = root @ np.swapaxes(root, -1, -2)
    error, x = random.standard_normal((*shape, n)), random.standard_normal((*shape[:2], n))
    lengths, status = np.full(runs, len(TIMES)), np.full(runs, COMPLETE)
    P[1, 3, 0] = 0.0
    lengths[2], status[2], error[2, 4] = 5, DIVERGED, np.nan
    error[2, 5:], P[2, 5:], x[2, 5:] = np.nan, np.nan, np.nan
    x[3, 5:], error[3, 5:] = 1e20, 1e20
    P[4] = np.nan
    counts, replicas = np.zeros((runs, len(KINDS)), dtype=np.int64), range(runs)
    return RunBatch(
        replicas, TIMES, x, x[:, :, None] - error, P, error, lengths, counts, status, {}, exact
    )


def plain(given, r):
    """Columns (kept, F, 2 u + 1), averages (F, 3) and rounding_from of run ``r``."""
    stop, kept = given.lengths[r], given.lengths[r] - given.diverged[r]
    P, e, n = given.P[r], given.error[r], given.error.shape[3]
    sizes = np.abs(e[:stop] if given.exact_errors else given.x[r, :stop, None]).max(axis=(1, 2))
    variance = np.diagonal(P[:stop], axis1=2, axis2=3).min(axis=(1, 2))
    squares = (e[:stop] ** 2).mean(axis=(1, 2))
    variance = np.where(np.isnan(P[:stop]).all(axis=(1, 2, 3)), squares, variance)
    deviation = np.sqrt(np.maximum(variance, 0.0))
    blurs = (deviation > 0.0) & (4.0 * np.finfo(float).eps * sizes > 0.01 * deviation)
    blurred = TIMES[np.argmax(blurs)] if blurs.any() else np.inf
    i, j = np.triu_indices(n)
    nees = np.full(e.shape[:2], np.nan)
    for t, f in np.ndindex(kept, e.shape[1]):
        if np.isfinite(P[t, f]).all() and np.linalg.matrix_rank(P[t, f]) == n:
            nees[t, f] = e[t, f] @ np.linalg.solve(P[t, f], e[t, f])
    columns = np.concatenate([P[..., i, j], e[..., i] * e[..., j], nees[..., None]], axis=-1)[:kept]
    clear = np.flatnonzero((TIMES[:kept] > 0.0) & (TIMES[:kept] < blurred))
    traces = clear if given.diverged[r] else np.arange(1, kept)
    averages = [
        (e[clear] ** 2).sum(axis=-1).mean(axis=0),
        np.trace(P[traces], axis1=2, axis2=3).mean(axis=0),
        nees[clear].mean(axis=0),
    ]
    return columns, np.stack(averages, axis=-1), blurred


@pytest.mark.parametrize(("runs", "filters", "n"), [(9, 1, 1), (12, 3, 2), (7, 11, 4), (20, 2, 3)])
@pytest.mark.parametrize("exact", [False, True])
def test_statistics_of_a_batch_are_those_of_its_samples_one_by_one(runs, filters, n, exact):
    given = batch(runs, runs, filters, n, exact)
    pieces = [slice(0, 4), slice(4, 6), slice(6, runs)]
    found = reduce_batch(given, pieces)
    expected = [plain(given, r) for r in range(runs)]
    np.testing.assert_array_equal(found.rounding_from, [blurred for *_, blurred in expected])
    for averages, (_, mine, _) in zip(found.averages, expected, strict=True):
        np.testing.assert_allclose(averages, mine, rtol=1e-10)
    for moments, piece in zip(found.samples, pieces, strict=True):
        for t in range(len(TIMES)):
            some = [c[t].reshape(-1) for c, *_ in expected[piece] if t < len(c)]
            assert moments.size[t] == len(some)
            mean = np.mean(some, axis=0)
            np.testing.assert_allclose(moments.mean[t], mean, rtol=1e-9)
            deviations = ((np.array(some) - mean) ** 2).sum(axis=0)
            np.testing.assert_allclose(moments.M2[t], deviations, rtol=1e-7, atol=1e-9)


def test_a_run_has_the_same_bits_beside_one_whose_P_is_singular():
    given = batch(1, 9, 3, 2)
    other = batch(1, 9, 3, 2)
    other.P[1:5] = np.eye(2)
    pieces = [slice(r, r + 1) for r in range(9)]
    one, two = reduce_batch(given, pieces), reduce_batch(other, pieces)
    for r in (0, 5, 6, 7, 8):
        np.testing.assert_array_equal(one.averages[r], two.averages[r])
        np.testing.assert_array_equal(one.samples[r].mean, two.samples[r].mean)
    together = reduce_batch(given, [slice(0, 9)]), reduce_batch(other, [slice(0, 9)])
    for r in (0, 5, 6, 7, 8):
        np.testing.assert_array_equal(together[0].averages[r], one.averages[r])
        np.testing.assert_array_equal(together[1].averages[r], one.averages[r])
