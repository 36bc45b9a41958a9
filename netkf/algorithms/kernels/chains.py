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

from netkf.algorithms.kernels.square_root import lower_triangular, step_root
from netkf.linalg.arrays import FloatArray, as_kernel_array
from netkf.linalg.compiling import kernel

FEW = 4096  # slots of all chains together, below which threads cost more than they save


class ReadingModes(NamedTuple):
    """Readings of M modes: ``H`` (M, p, n) and lower triangular ``root_R`` (M, p, p), of which the
    first ``rows[m]`` rows count, ``rows`` (M,).
    """

    H: FloatArray
    root_R: FloatArray
    rows: np.ndarray


def reading_modes(readings: Sequence[tuple[FloatArray, FloatArray]], n: int) -> ReadingModes:
    """Return the modes of M readings ``(H, R)``, (p, n) and (p, p), each with its own p >= 0, for
    ``n`` states; R is factored and rows are padded to the largest p.
    """
    max_rows = max((len(H) for H, _ in readings), default=0)
    rows = np.array([len(H) for H, _ in readings], dtype=np.int64)
    padded_H, root_R = (
        np.zeros((len(readings), max_rows, n)),
        np.zeros((len(readings), max_rows, max_rows)),
    )
    for m, (H, R) in enumerate(readings):
        # Padding with zero rows keeps one array for all modes; kernels read the first rows[m]
        # only.
        padded_H[m, : len(H)] = H
        if len(H):
            root_R[m, : len(H), : len(H)] = np.linalg.cholesky(R)
    return ReadingModes(padded_H, root_R, rows)


def move_roots(
    roots: FloatArray, sequences: np.ndarray, F: FloatArray, root_Q: FloatArray, modes: ReadingModes
) -> FloatArray:
    """Return the lower triangular roots (K, n, n) of K chains after T slots with the modes
    ``sequences`` (K, T), indices in ``modes``, from any ``roots`` (K, n, n) before, triangular or
    not; F and ``root_Q``, any root of Q, are (n, n).

    Uses all cores if there is enough to do.
    """
    lower_roots = np.ascontiguousarray(lower_triangular(roots))
    F = as_kernel_array(F)
    low_Q = np.ascontiguousarray(lower_triangular(root_Q))
    # One byte per mode where it suffices, an eighth of an int64: there may be millions of them.
    mode_type = np.uint8 if len(modes.rows) < 256 else np.int64
    sequences = np.ascontiguousarray(sequences, dtype=mode_type)
    # More threads than chains or cores would only wait.
    workers = min(os.cpu_count() or 1, len(roots))
    if sequences.size < FEW or workers < 2:
        run_sequences(lower_roots, sequences, F, low_Q, *modes)
        return lower_roots
    # Threads own contiguous blocks of chains, as views of one array, so nothing is copied back.
    cuts = np.linspace(0, len(roots), workers + 1).astype(int)
    with ThreadPoolExecutor(workers) as pool:
        jobs = [
            pool.submit(run_sequences, lower_roots[a:b], sequences[a:b], F, low_Q, *modes)
            for a, b in itertools.pairwise(cuts)
        ]
        for job in jobs:
            # Without result() an exception in a worker would be lost.
            job.result()
    return lower_roots


def trace_path(
    root: FloatArray, sequence: np.ndarray, F: FloatArray, root_Q: FloatArray, modes: ReadingModes
) -> FloatArray:
    """Return the lower triangular roots (T, n, n) of one chain after each mode of its ``sequence``
    (T,), indices in ``modes``, from ``root`` (n, n) on; F and ``root_Q`` are (n, n).

    Axes: T slots.
    """
    return next(trace_paths(root[None], sequence[None], F, root_Q, modes))


def trace_paths(
    roots: FloatArray, sequences: np.ndarray, F: FloatArray, root_Q: FloatArray, modes: ReadingModes
) -> Iterator[FloatArray]:
    """Yield for each of K chains the lower triangular roots (T, n, n) after each mode of its
    sequence, a row of ``sequences`` (K, T) of indices in ``modes``, from ``roots`` (K, n, n) on; F
    and ``root_Q`` are (n, n). One path at a time is in memory.

    Axes: T slots.
    """
    lows = np.ascontiguousarray(lower_triangular(roots))
    F = as_kernel_array(F)
    low_Q = np.ascontiguousarray(lower_triangular(root_Q))
    n = len(F)
    work = np.empty((modes.H.shape[1] + n, 2 * n + modes.H.shape[1]))
    for low, sequence in zip(lows, sequences, strict=True):
        path = np.empty((len(sequence), *low.shape))
        run_path(low[None], sequence, F, low_Q, *modes, work, path)
        yield path


@kernel
def run_path(
    roots: FloatArray,
    sequence: np.ndarray,
    F: FloatArray,
    root_Q: FloatArray,
    H: FloatArray,
    root_R: FloatArray,
    rows: np.ndarray,
    work: FloatArray,
    path: FloatArray,
) -> None:
    """Move one lower triangular root ``roots`` (1, n, n) in place along its mode ``sequence`` (T,);
    store the root after each step in ``path`` (T, n, n).

    F and ``root_Q`` are (n, n); H (M, p, n), ``root_R`` (M, p, p) and ``rows`` (M,) are those of
    ``ReadingModes``; ``work`` (p + n, 2 n + p) is scratch. Axes: M modes, T slots.
    """
    for step in range(len(sequence)):
        step_root(roots, 0, sequence[step], F, root_Q, H, root_R, rows, work)
        for i in range(len(F)):
            for j in range(len(F)):
                path[step, i, j] = roots[0, i, j]


@kernel(allocates=True)
def run_sequences(
    roots: FloatArray,
    sequences: np.ndarray,
    F: FloatArray,
    root_Q: FloatArray,
    H: FloatArray,
    root_R: FloatArray,
    rows: np.ndarray,
) -> None:
    """Move the lower triangular roots (K, n, n) of K chains in place along their mode ``sequences``
    (K, T).

    F and ``root_Q``, lower triangular too, are (n, n); H (M, p, n), ``root_R`` (M, p, p) and
    ``rows`` (M,) are those of ``ReadingModes``. Axes: M modes, T slots.
    """
    # The pre-array [[H S, root_R, 0], [F S, 0, root_Q]] of the largest reading, reused by all
    # steps.
    work = np.empty((H.shape[1] + len(F), 2 * len(F) + H.shape[1]))
    for chain in range(sequences.shape[0]):
        for step in range(sequences.shape[1]):
            step_root(roots, chain, sequences[chain, step], F, root_Q, H, root_R, rows, work)
