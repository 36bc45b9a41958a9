"""Many chains of random Riccati equations: compiled loops, stacks and single steps agree."""

import numpy as np
import pytest

from netkf import theory
from netkf.algorithms.kernels import chains

RANDOM = np.random.default_rng(5)
READINGS = [  # of no, one and two rows
    (np.zeros((0, 3)), np.zeros((0, 0))),
    (RANDOM.standard_normal((1, 3)), np.array([[0.7]])),
    (RANDOM.standard_normal((2, 3)), np.array([[0.5, 0.2], [0.2, 0.9]])),
]
F = np.diag([1.3, 0.9, 1.05]) + 0.1 * RANDOM.standard_normal((3, 3))
HALF = RANDOM.standard_normal((3, 3))
Q = HALF @ HALF.T


@pytest.mark.parametrize("fast", [True, False])
@pytest.mark.parametrize("size", [1.0, 1e12])
def test_words_are_steps_one_after_the_other(fast, size, monkeypatch):
    if not fast:
        monkeypatch.setattr(chains, "compiled", lambda function: None)
    words = RANDOM.integers(3, size=(7, 40))
    starts = size * np.array([np.diag(d) for d in RANDOM.uniform(0.5, 2.0, (7, 3))])
    letters = chains.alphabet(READINGS, 3)
    roots = chains.advance(np.sqrt(starts), words, F, HALF, letters)
    for k, word in enumerate(words):
        P = starts[k]
        for m in word:
            P = theory.riccati_step(P, F, Q, *READINGS[m]) if m else theory.lyapunov_step(P, F, Q)
        np.testing.assert_allclose(roots[k] @ roots[k].T, P, rtol=1e-9, atol=1e-12 * size)


def test_loops_are_the_same_interpreted():
    """What the compiler gets is what Python would do."""
    words = RANDOM.integers(3, size=(2, 5)).astype(np.uint8)
    roots = np.repeat(np.eye(3)[None], 2, axis=0)
    letters = chains.alphabet(READINGS, 3)
    low_Q = np.linalg.cholesky(Q)
    expected = chains.advance(roots, words, F, low_Q, letters)
    chains.run_words(roots, words, F, low_Q, *letters)
    np.testing.assert_allclose(roots, expected, rtol=1e-12, atol=1e-14)
