"""Random Riccati recursions of many chains side by side, in square-root form.

In each slot a mode m selects one of several readings for a chain: ``f_m(P) = F P F' + Q - F P H_m'
(H_m P H_m' + R_m)^-1 H_m P F'``, R (17) of paper R (Kar, Sinopoli and Moura: intermittent
observations) and G (11) of paper G (Kar and Moura: gossip); a reading of no rows is ``f_0``, R
(16). P is the covariance of the one-step prediction. The theory and the checks of both papers draw
or enumerate sequences of modes and need the covariances they lead to.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from netkf.algorithms.kernels.estimates import rotate, transform_root
from netkf.algorithms.kernels.square_root import lower_triangular
from netkf.linalg.arrays import FloatArray, as_kernel_array
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import ONE
from netkf.linalg.small import copy_matrix

FEW = 4096  # slots of all chains together, below which threads cost more than they save


class ReadingModes(NamedTuple):
    """Readings of M modes: ``H`` (M, p, n), whitened so that each row has noise of variance 1, of
    which the first ``rows[m]`` count, ``rows`` (M,).
    """

    H: FloatArray
    rows: np.ndarray


def reading_modes(readings: Sequence[tuple[FloatArray, FloatArray]], n: int) -> ReadingModes:
    """Return the modes of M readings ``(H, R)``, (p, n) and (p, p), each with its own p >= 0, for
    ``n`` states; rows are padded to the largest p.
    """
    rows = np.array([len(H) for H, _ in readings], dtype=np.int64)
    whitened = np.zeros((len(readings), rows.max(initial=0), n))
    for m, (H, R) in enumerate(readings):
        if len(H):
            whitened[m, : len(H)] = np.linalg.solve(np.linalg.cholesky(R), H)
    return ReadingModes(whitened, rows)


def move_roots(
    roots: FloatArray, sequences: np.ndarray, F: FloatArray, root_Q: FloatArray, modes: ReadingModes
) -> FloatArray:
    """Return the lower triangular roots (K, n, n) of K chains after T slots with the modes
    ``sequences`` (K, T), indices in ``modes``, from any ``roots`` (K, n, n) before, triangular or
    not; F and ``root_Q``, any root of Q, are (n, n).

    Uses all cores if there is enough to do.
    """
    lows, F, low_Q = _as_kernels_take(roots, F, root_Q)
    # One byte per mode where it suffices, an eighth of an int64: there may be millions of them.
    mode_type = np.uint8 if len(modes.rows) < 256 else np.int64
    sequences = np.ascontiguousarray(sequences, dtype=mode_type)
    no_paths = np.empty((len(lows), 0, *F.shape))
    # More threads than chains or cores would only wait.
    workers = min(os.cpu_count() or 1, len(roots))
    if sequences.size < FEW or workers < 2:
        run_sequences(lows, sequences, F, low_Q, *modes, no_paths)
        return lows
    # Threads own contiguous blocks of chains, as views of one array, so nothing is copied back.
    cuts = np.linspace(0, len(roots), workers + 1).astype(int)
    with ThreadPoolExecutor(workers) as pool:
        jobs = [
            pool.submit(run_sequences, lows[a:b], sequences[a:b], F, low_Q, *modes, no_paths[a:b])
            for a, b in itertools.pairwise(cuts)
        ]
        for job in jobs:
            # Without result() an exception in a worker would be lost.
            job.result()
    return lows


def trace_paths(
    roots: FloatArray, sequences: np.ndarray, F: FloatArray, root_Q: FloatArray, modes: ReadingModes
) -> Iterator[FloatArray]:
    """Yield for each of K chains the lower triangular roots (T, n, n) after each mode of its
    sequence, a row of ``sequences`` (K, T) of indices in ``modes``, from ``roots`` (K, n, n) on; F
    and ``root_Q`` are (n, n). One path at a time is in memory.

    Axes: T slots.
    """
    lows, F, low_Q = _as_kernels_take(roots, F, root_Q)
    for low, sequence in zip(lows, sequences, strict=True):
        path = np.empty((1, len(sequence), *low.shape))
        run_sequences(low[None], sequence[None], F, low_Q, *modes, path)
        yield path[0]


def _as_kernels_take(
    roots: FloatArray, F: FloatArray, root_Q: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return lower triangular roots of the same covariances, and F, C-contiguous."""
    lows, low_Q = (np.ascontiguousarray(lower_triangular(root)) for root in (roots, root_Q))
    return lows, as_kernel_array(F), low_Q


@kernel(allocates=True)
def run_sequences(
    roots: FloatArray,
    sequences: np.ndarray,
    F: FloatArray,
    root_Q: FloatArray,
    H: FloatArray,
    rows: np.ndarray,
    paths: FloatArray,
) -> None:
    """Move the lower triangular roots (K, n, n) of K chains in place along their mode ``sequences``
    (K, T): update with the reading of the mode, then predict. Store the root after each step in
    ``paths`` (K, T, n, n), unless that has no slots (K, 0, n, n).

    F and ``root_Q``, lower triangular too, are (n, n); H (M, p, n) and ``rows`` (M,) are those of
    ``ReadingModes``. Axes: M modes, T slots.
    """
    n = len(F)
    size, row, gains, scratch = F[0], np.empty(n), np.empty(n), (np.empty((n, n)), np.empty((n, n)))
    for chain in range(sequences.shape[0]):
        for step in range(sequences.shape[1]):
            m = sequences[chain, step]
            for r in range(rows[m]):
                for j in range(n):
                    total = 0.0
                    for i in range(j, n):
                        total += H[m, r, i] * roots[chain, i, j]
                    row[j] = total
                rotate(ONE, size, roots, chain, row, gains)
            transform_root(ONE, size, roots, chain, F, root_Q, scratch)
            if paths.shape[1] > 0:
                copy_matrix(paths[chain, step], roots[chain])
