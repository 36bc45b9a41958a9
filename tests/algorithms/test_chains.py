"""Many chains of random Riccati equations: kernels and single steps agree."""

import numpy as np
import pytest

from netkf import theory
from netkf.algorithms.kernels import chains
from tests import reference

RANDOM = np.random.default_rng(5)
READINGS = [  # of no, one and two rows
    (np.zeros((0, 3)), np.zeros((0, 0))),
    (RANDOM.standard_normal((1, 3)), np.array([[0.7]])),
    (RANDOM.standard_normal((2, 3)), np.array([[0.5, 0.2], [0.2, 0.9]])),
]
F = np.diag([1.3, 0.9, 1.05]) + 0.1 * RANDOM.standard_normal((3, 3))
HALF = RANDOM.standard_normal((3, 3))
Q = HALF @ HALF.T


@pytest.mark.parametrize("size", [1.0, 1e12])
def test_words_are_steps_one_after_the_other(size):
    sequences = RANDOM.integers(3, size=(7, 40))
    starts = size * np.array([np.diag(d) for d in RANDOM.uniform(0.5, 2.0, (7, 3))])
    modes = chains.reading_modes(READINGS, 3)
    roots = chains.move_roots(np.sqrt(starts), sequences, F, HALF, modes)
    for k, sequence in enumerate(sequences):
        P = starts[k]
        for m in sequence:
            P = theory.riccati_step(P, F, Q, *READINGS[m]) if m else theory.lyapunov_step(P, F, Q)
        np.testing.assert_allclose(roots[k] @ roots[k].T, P, rtol=1e-9, atol=1e-12 * size)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("n", [1, 2, 4, 6])
def test_the_kernel_is_the_formula(seed, n):
    random = np.random.default_rng(seed)
    readings = []
    for p in range(n + 1):
        noise = random.normal(size=(p, p))
        readings.append((random.normal(size=(p, n)), noise @ noise.T + 0.1 * np.eye(p)))
    A, half = random.normal(size=(n, n)) / np.sqrt(n), random.normal(size=(n, n))
    sequences, start = random.integers(n + 1, size=(5, 12)), np.eye(n)
    roots = chains.move_roots(
        np.broadcast_to(start, (5, n, n)), sequences, A, half, chains.reading_modes(readings, n)
    )
    for root, modes in zip(roots, sequences, strict=True):
        expected = reference.switched_riccati(start, modes, A, half @ half.T, readings)
        scale = np.abs(expected).max()
        np.testing.assert_allclose(root @ root.T, expected, rtol=0, atol=1e-10 * scale)
