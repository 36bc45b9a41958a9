"""Limits of the push-sum filter for gamma to infinity: paper P Lemma 4 and Theorem 4."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, symmetric
from netkf.scenario.scenario import Scenario
from netkf.theory.push_sum.covariance import covariance_of_steps
from netkf.theory.push_sum.estimation_steps import EstimationSteps, estimation_steps
from netkf.theory.push_sum.limits import consensus_gain_bound


class LargeGamma(NamedTuple):
    """Limits for gamma to infinity: nodes average until they agree in every slot.

    noise      : (N n, N n) covariance of the transformed noise, P Lemma 4: zero but for the first
                 block, that of the direction in which all nodes agree
    covariance : (n, n) of the steady error of every node, P Theorem 4: P_inf of the central filter
                 if the filters know the plant and the sensors
    """

    noise: FloatArray
    covariance: FloatArray


def large_gamma_limits(scenario: Scenario) -> LargeGamma:
    """Return the limits for ever more averaging steps in a slot (gamma to infinity): the covariance
    (N n, N n) of the noise that averaging leaves, paper P Lemma 4, and that of the steady errors
    (n, n), which is the same at all nodes, paper P Theorem 4.

    The scenario's own gamma is ignored. Raises TheoryError where they do not hold: a graph that is
    not connected, links that are held over the steps or fail in one direction, a delta at or below
    half of rho(L).
    """
    steps = estimation_steps(scenario)
    _require_averaging(scenario, steps)
    N, n, _ = steps.closed.shape
    # v' (x) I of the noise at all nodes, v = (1, .., 1) / sqrt(N): the rest is averaged away.
    block = steps.noise.reshape(N, n, N, n).sum(axis=(0, 2)) / N
    noise = np.zeros((N * n, N * n))
    noise[:n, :n] = symmetric(block)
    return LargeGamma(noise, _steady_mean(steps, block / N))


def push_sum_noise(scenario: Scenario, gammas: Sequence[int]) -> FloatArray:
    """Return the covariance (len(gammas), N n, N n) of the transformed noise of paper P (29),
    exactly.

    ``(T' (x) I) E[(M (x) I) cov(h) (M (x) I)'] (T (x) I)``, where (x) is the Kronecker product, M
    (N, N) the random product of gamma averaging steps, h (N n,) the stacked noises of the plant and
    the sensors, and ``T = (v W)`` of paper P (75) with v = (1, .., 1) / sqrt(N) and W any
    orthonormal complement. Paper P Lemma 4 says what it tends to. Raises TheoryError as
    ``large_gamma_limits`` does.
    """
    steps = estimation_steps(scenario)
    _require_averaging(scenario, steps)
    N, n, _ = steps.closed.shape
    # The orthogonal factor of (v, e_1, ..): its first column is v up to a sign.
    first = np.column_stack([np.ones(N), np.eye(N)[:, : N - 1]])
    T = np.linalg.qr(first)[0]
    transform = np.kron(T * np.sign(T[0, 0]), np.eye(n))
    covariances = []
    for gamma in gammas:
        moment = steps.with_gamma(gamma).averaging.second_moment(steps.noise)
        covariances.append(symmetric(transform.T @ moment @ transform))
    return np.array(covariances)


def push_sum_covariances(scenario: Scenario, gammas: Sequence[int]) -> FloatArray:
    """Return the exact steady error covariances (G, N, n, n) of all nodes for each of G ``gammas``.

    Gamma is the number of averaging steps in a slot. The gains are those that the filters reach
    after a long time; nan where the errors of a gamma grow without limit in mean square. With
    gamma they tend to P_inf, the covariance of the central filter (push-sum paper, Theorem 4).
    Raises TheoryError if such gains do not exist or the links are not drawn independently.
    """
    steps = estimation_steps(scenario)
    N, n, _ = steps.closed.shape
    covariances = np.full((len(gammas), N, n, n), np.nan)
    for k, gamma in enumerate(gammas):
        try:
            covariances[k] = covariance_of_steps(steps.with_gamma(gamma))
        except TheoryError:
            continue
    return covariances


def _require_averaging(scenario: Scenario, steps: EstimationSteps) -> None:
    """Raise TheoryError unless averaging converges to the mean, as P Theorem 4 assumes."""
    law = steps.averaging
    if law.held and not law.deterministic:
        raise TheoryError('P Theorem 4 needs links = "fresh": a draw that is held cuts the network')
    if not np.array_equal(law.hears.min(axis=1), law.both):
        raise TheoryError("P Theorem 4 needs failures of both directions together")
    if law.nodes > 1 and not law.both.min(initial=1.0) > 0.0:
        raise TheoryError("P Theorem 4 needs links that are up with a positive probability")
    half = 0.5 * consensus_gain_bound(scenario).radius
    if not law.delta > half:
        raise TheoryError(f"averaging diverges: delta must be above rho(L)/2 = {half:.6g}")


def _steady_mean(steps: EstimationSteps, noise: FloatArray) -> FloatArray:
    """Return X (n, n), X = A_C X A_C' + noise, with A_C the mean closed loop."""
    central = steps.closed.mean(axis=0)
    return symmetric(np.asarray(scipy.linalg.solve_discrete_lyapunov(central, noise)))
