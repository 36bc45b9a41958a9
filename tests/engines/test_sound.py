"""Which estimates and covariances end a run."""

import numpy as np

from netkf.engines.soundness import sound_mask, stack_estimates


def rotated(values, seed=0):
    Q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(len(values),) * 2))
    return Q @ np.diag(values) @ Q.T


def test_eigenvalues_decide_about_covariances():
    eigenvalues = [
        ([1.0, 1.0, 1.0], True),
        ([1e12, 1.0, 0.0], True),
        ([0.0, 0.0, 0.0], True),
        ([1e-300, 1e-310, 0.0], True),
        ([1e300, 1.0, 1.0], True),
        ([1.0, 1.0, -1e-11], True),
        ([1.0, 1.0, -1e-8], False),
        ([1e8, 1.0, -1.0], False),
        ([-1.0, -1.0, -1.0], False),
        ([1e-200, 1e-200, -1e-205], False),
    ]
    P = np.array([rotated(values, k) for k, (values, _) in enumerate(eigenvalues)])
    found = sound_mask(np.zeros((len(P), 3)), P)
    assert found.tolist() == [expected for _, expected in eigenvalues]
    for one, (_, expected) in zip(P, eigenvalues, strict=True):  # also without the others
        assert sound_mask(np.zeros(3), one) == expected


def test_what_is_not_finite_is_not_sound_unless_it_was_not_given():
    xhat, P = np.zeros((4, 2)), np.array([np.eye(2)] * 4)
    xhat[1, 0], P[2, 0, 0], P[3] = np.inf, np.nan, np.nan
    assert sound_mask(xhat, P).tolist() == [True, False, False, False]
    without = np.array([False, True, False, True])
    assert sound_mask(xhat, P, without).tolist() == [True, False, False, True]


def test_estimates_without_a_covariance_are_stacked():
    pairs = [(np.zeros(2), np.eye(2)), (np.ones(2), None)]
    xhat, P, without = stack_estimates(pairs)
    assert xhat.tolist() == [[0.0, 0.0], [1.0, 1.0]]
    assert without.tolist() == [False, True]
    assert np.isnan(P[1]).all()
