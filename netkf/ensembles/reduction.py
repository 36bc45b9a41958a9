"""The values of each run of a batch that ensemble statistics are made of, for all runs at once.

The columns of a few samples (products of errors, NEES) are merged with those of other runs as soon
as they are computed, so that they are still in the nearest cache.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from netkf.ensembles.moments import Moments, join_nodes
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.structs import Size, Struct, sized
from netkf.trace.batch import RunBatch
from netkf.trace.nees import blurred_from, nees_of_runs, without_padding

NUMBERS_AT_ONCE = 512
"""Number of columns, over all samples, of a run that are processed together: 4 KiB."""


class Reduced(NamedTuple):
    """Values of R runs with F filters of n states; u = n (n + 1) / 2.

    samples       : for each piece of the runs the moments (T, F (2 u + 1)) over the runs that have
                    the sample: of the upper triangles of P and of e e', e the error, and of NEES
    averages      : (R, F, 3) mean square error, mean trace of P and mean NEES over the samples
                    after time 0, nan without samples
    rounding_from : (R,) the first sample time in seconds at which rounding blurs the errors, else
                    inf
    spans         : (R, 3) the first sample in averages, and the ends of those of errors and of P
    """

    samples: list[Moments]
    averages: FloatArray
    rounding_from: FloatArray
    spans: np.ndarray


class ReducedSamples(Struct):
    """Samples of R runs for kernels, and what they become; C = 2 u + 1 columns of a filter.

    P, error, nees : (R, T F, n, n), (R, T F, n), (R, T F)
    kept           : (R,) number of samples that are not broken
    spans          : (R, 3) the first sample in averages, and the ends of those of errors and of P
    averages       : (R, F, 3) sums of squared errors, traces of P and NEES
    size, mean, M2 : (K, T), (K, T, F C), (K, T, F C) moments over the runs of each of K pieces
    node_size, node_mean, node_M2 : (D, S), (D, C, S F), (D, C, S F) of nodes of the tree over runs
                     that wait for a neighbour, at S times
    """

    P: FloatArray
    error: FloatArray
    nees: FloatArray
    kept: np.ndarray
    spans: np.ndarray
    averages: FloatArray
    size: FloatArray
    mean: FloatArray
    M2: FloatArray
    node_size: FloatArray
    node_mean: FloatArray
    node_M2: FloatArray


def reduce_batch(batch: RunBatch, pieces: Sequence[slice]) -> Reduced:
    """Return values of the runs of a batch, with moments over the runs of each of ``pieces``:
    adjacent slices that cover all runs, each a node of the binary tree along which runs are merged.
    The last sample of a run that diverged, whose numbers are broken, is left out.
    """
    runs, count, filters, n = batch.error.shape
    kept = batch.lengths - batch.diverged
    P, error = np.ascontiguousarray(batch.P), np.ascontiguousarray(batch.error)
    rounding_from = blurred_from(batch.times, batch.x, P, error, batch.lengths, batch.exact_errors)
    # States that a node does not estimate: error 0 and variance 1 for the NEES, 0 for averages.
    whole_error, whole_P = without_padding(error, P)
    of_nees = whole_error.reshape(runs, -1, n), whole_P.reshape(runs, -1, n, n)
    if whole_error is not error:
        error, P = whole_error, np.where(np.isnan(P) & ~np.isnan(whole_P), 0.0, P)
    flat = error.reshape(runs, -1, n), P.reshape(runs, -1, n, n)
    bounds = np.array([0, *(piece.stop for piece in pieces)])
    columns, depth = n * (n + 1) + 1, int(np.diff(bounds).max()).bit_length() + 1
    at_once = min(count, max(1, NUMBERS_AT_ONCE // (filters * columns)))
    samples = ReducedSamples(
        P=flat[1],
        error=flat[0],
        nees=nees_of_runs(*of_nees, kept * filters),
        kept=kept,
        spans=_averaged_spans(batch, kept, rounding_from),
        averages=np.zeros((runs, filters, 3)),
        size=np.empty((len(pieces), count)),
        mean=np.empty((len(pieces), count, filters * columns)),
        M2=np.empty((len(pieces), count, filters * columns)),
        node_size=np.empty((depth, at_once)),
        node_mean=np.zeros((depth, columns, at_once * filters)),
        node_M2=np.zeros((depth, columns, at_once * filters)),
    )
    reduce_samples(sized(n), samples, bounds)
    begin, of_errors, of_P = samples.spans.T
    counts = np.stack([of_errors - begin, of_P - begin, of_errors - begin], axis=-1)
    with np.errstate(invalid="ignore"):
        averages = samples.averages / counts[:, None]
    parts = zip(samples.size, samples.mean, samples.M2, strict=True)
    return Reduced([Moments(*part) for part in parts], averages, rounding_from, samples.spans)


def _averaged_spans(batch: RunBatch, kept: np.ndarray, rounding_from: FloatArray) -> np.ndarray:
    """Return ``ReducedSamples.spans`` (R, 3), see ``runs.summary.select_averaged_samples``."""
    start = int(np.searchsorted(batch.times, 0.0, side="right"))
    begin = np.where(start < kept, start, 0)
    errors_end = np.clip(np.searchsorted(batch.times, rounding_from), begin, kept)
    # Covariances do not suffer from rounding, but those of a diverging run grow without bound.
    P_end = np.where(batch.diverged & (errors_end > begin), errors_end, kept)
    return np.stack([begin, errors_end, P_end], axis=-1)


@kernel
def reduce_samples(size: Size, s: ReducedSamples, bounds: np.ndarray) -> None:
    """Fill ``s.averages`` with sums over samples, and the moments of K pieces of the runs, of which
    piece k has the runs ``bounds[k]`` to ``bounds[k + 1] - 1``; ``size`` has the length n.
    """
    sizes, mean, M2 = s.node_size, s.node_mean, s.node_M2
    filters, columns = s.averages.shape[1], mean.shape[1]
    for k in range(len(bounds) - 1):
        # A few sample times of all runs at a time.
        for t in range(0, s.size.shape[1], sizes.shape[1]):
            count, depth = min(sizes.shape[1], s.size.shape[1] - t), 0
            for r in range(bounds[k], bounds[k + 1]):
                fill_node(size, s, r, t, count, depth)
                add_sums(size, s, r, t, count)
                depth = join_nodes(sizes, mean, M2, depth + 1, r - bounds[k])
            # Nodes left without a neighbour at the end are merged from right to left.
            join_nodes(sizes, mean, M2, depth, (1 << depth) - 1)
            for q in range(count):
                s.size[k, t + q] = sizes[0, q]
                for f in range(filters):
                    for c in range(columns):
                        s.mean[k, t + q, f * columns + c] = mean[0, c, q * filters + f]
                        s.M2[k, t + q, f * columns + c] = M2[0, c, q * filters + f]


@kernel
def fill_node(size: Size, s: ReducedSamples, r: int, t: int, count: int, node: int) -> None:
    """Set moments of a ``node`` to ``count`` samples from ``t`` on of run ``r``, else zero."""
    n, filters = len(size), s.averages.shape[1]
    P, error, nees, mean, M2 = s.P[r], s.error[r], s.nees[r], s.node_mean[node], s.node_M2[node]
    # Column by column, so that neighbouring samples are neighbours in memory.
    present, first = max(0, min(count, s.kept[r] - t)), t * filters
    for q in range(s.node_size.shape[1]):
        s.node_size[node, q] = 1.0 if q < present else 0.0
    upper, column = n * (n + 1) // 2, 0
    for i in range(n):
        for j in range(i, n):
            for k in range(present * filters):
                mean[column, k] = P[first + k, i, j]
                mean[upper + column, k] = error[first + k, i] * error[first + k, j]
            column += 1
    for k in range(present * filters):
        mean[2 * upper, k] = nees[first + k]
    for c in range(mean.shape[0]):
        for k in range(mean.shape[1]):
            M2[c, k] = 0.0
        for k in range(present * filters, mean.shape[1]):
            mean[c, k] = 0.0


@kernel
def add_sums(size: Size, s: ReducedSamples, r: int, t: int, count: int) -> None:
    """Add ``count`` samples from number ``t`` on of run ``r`` to its sums for averages."""
    P, error, nees, averages = s.P[r], s.error[r], s.nees[r], s.averages
    begin, errors_end, P_end = s.spans[r, 0], s.spans[r, 1], s.spans[r, 2]
    filters = averages.shape[1]
    first, last = max(t, begin), t + count
    for f in range(filters):
        # Local numbers: sums in memory would wait for each other.
        squares, variances, nees_sum = averages[r, f, 0], averages[r, f, 1], averages[r, f, 2]
        for k in range(first * filters + f, min(last, errors_end) * filters, filters):
            for i in range(len(size)):
                squares += error[k, i] * error[k, i]
            nees_sum += nees[k]
        for k in range(first * filters + f, min(last, P_end) * filters, filters):
            for i in range(len(size)):
                variances += P[k, i, i]
        averages[r, f, 0], averages[r, f, 1], averages[r, f, 2] = squares, variances, nees_sum
