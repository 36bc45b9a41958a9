"""The invariant law mu^Abar of the switched Riccati recursion, paper G Theorem 8, drawn exactly."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.algorithms.kernels.chains import move_roots, reading_modes
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, IntArray, square_root
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.theory.gossip.matchings import effective_matching, period_of
from netkf.theory.intermittent.riccati import couple_from_the_past
from netkf.theory.numerics.matrices import as_integer

MAX_SAMPLES_AT_ONCE = 2000  # bounds the memory of the arrays
FAR_START_DEVIATIONS = 1e3  # standard deviations of the upper start, in units of sqrt(tr Q + 1)


class SwitchedSamples(NamedTuple):
    """Independent draws of the switched chain of paper G (20) in its steady state.

    P    : (S, n, n) covariances, whose law is mu^Abar
    node : (S,) ids of the nodes whose reading each covariance took last. The covariances with
           ``node == i`` have the law of the covariance at sensor i, which differs from mu^Abar
           (derived)
    """

    P: FloatArray
    node: IntArray


def switched_samples(scenario: Scenario, samples: int, seed: int) -> SwitchedSamples:
    """Return ``samples`` independent draws, covariances (samples, n, n) and nodes (samples,), from
    the law mu^Abar to which the covariances of a gossip filter tend, paper G Theorem 8: that of the
    switched chain, a covariance whose node moves by the mean matching Abar.

    Coupling from the past: the chain of nodes is drawn backwards from the uniform law, and the
    Riccati recursion runs through ever longer pasts until a start at 0 and one at a huge covariance
    end within 1e-9 of each other. The scenario enters by Abar alone, the mean of its swaps that
    succeed (G Remark 9): two protocols with one Abar give the same draws. Raises TheoryError if
    Abar is not known or not irreducible, or if the recursion does not forget its start.
    """
    matching = effective_matching(scenario)
    if not period_of(matching):
        raise TheoryError("G C.1 fails: Abar is not irreducible, so that nodes have different laws")
    samples, seed = as_integer("samples", samples, 1), as_integer("seed", seed, 0, np.inf)
    F, Q = scenario.slot_belief
    n, N = len(F), len(scenario.nodes)
    modes = reading_modes([(model.H, model.R) for model in scenario.slot_models], n)
    random, root_Q = Streams(seed).generator("switched chain"), square_root(Q)
    # Abar is symmetric, so the reversed chain has the same transition probabilities.
    rows = np.cumsum(matching, axis=1)
    size = float(np.sqrt(np.trace(Q) + 1.0))
    starts = np.stack([np.zeros((n, n)), FAR_START_DEVIATIONS * size * np.eye(n)])
    kind = np.uint8 if N < 256 else np.int64
    P, last = np.empty((samples, n, n)), np.empty(samples, dtype=np.int64)
    for first in range(0, samples, MAX_SAMPLES_AT_ONCE):
        part = slice(first, min(first + MAX_SAMPLES_AT_ONCE, samples))
        P[part], last[part] = couple_from_the_past(
            lambda following, T: _draw_before(rows, following, T, random),
            lambda roots, drawn: move_roots(roots, drawn, F, root_Q, modes),
            starts,
            np.zeros((part.stop - first, 0), dtype=kind),
        )
    return SwitchedSamples(P, np.array(scenario.nodes)[last])


def _draw_before(
    rows: FloatArray, following: np.ndarray, slots: int, random: np.random.Generator
) -> np.ndarray:
    """Return positions (K, slots) of K chains drawn backwards from ``following`` (K, S)."""
    count, N = len(following), len(rows)
    positions = np.empty((count, slots), dtype=following.dtype)
    node = following[:, 0] if following.shape[1] else None
    for t in range(slots - 1, -1, -1):
        uniforms = random.random(count)
        if node is None:
            node = np.minimum((uniforms * N).astype(np.int64), N - 1)
        else:
            node = np.minimum((uniforms[:, None] >= rows[node]).sum(axis=1), N - 1)
        positions[:, t] = node
    return positions
