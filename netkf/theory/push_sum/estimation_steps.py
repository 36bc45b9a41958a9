"""P steps 4 and 5 at the asymptotic gains as one linear system with random coefficients."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, symmetric
from netkf.network.matchings import Broadcast
from netkf.scenario.registry import name_of
from netkf.scenario.scenario import Scenario
from netkf.theory.common.random_links import delivery_of
from netkf.theory.numerics.matrices import as_integer, as_number
from netkf.theory.push_sum.averaging import Averaging
from netkf.theory.push_sum.limits import PushSumLimits, push_sum_filter, push_sum_limits


@dataclass(frozen=True, eq=False)
class EstimationSteps:
    """Dynamics ``e+ = (M (x) I)(diag(A_i) e + h)`` of the stacked errors of all nodes in a slot,
    P (25): every node predicts and updates by its reading (step 4), then estimates are averaged by
    the random matrix M (N, N) of gamma averaging steps (step 5).

    averaging : the law of M
    closed    : (N, n, n) A_i = (I - K_i H_i) F
    process   : (N, n, n) I - K_i H_i, by which the plant's noise enters h, P (27)
    sensor_noise : (N, n, n) K_i R_i K_i', the covariance of the sensors' noise in h
    Q         : (n, n) of the plant
    limits    : the limits of the push-sum masses (steps 2 and 3), from which the gains K_i are
    """

    averaging: Averaging
    closed: FloatArray
    process: FloatArray
    sensor_noise: FloatArray
    Q: FloatArray
    limits: PushSumLimits

    def with_gamma(self, gamma: int) -> EstimationSteps:
        """Return the steps with ``gamma`` averagings in a slot, an integer; else TheoryError."""
        averaging = replace(self.averaging, gamma=as_integer("gamma", gamma, 1))
        return replace(self, averaging=averaging)

    @cached_property
    def scale(self) -> FloatArray:
        """Units (n,) in which P_inf has a unit diagonal, except for states known almost exactly."""
        variances = np.diagonal(self.limits.P)
        return np.sqrt(np.maximum(variances, max(1e-12 * variances.max(), 1e-150)))

    @cached_property
    def scaled(self) -> FloatArray:
        """``closed`` (N, n, n) in the units of ``scale``."""
        return np.asarray(self.closed * (self.scale / self.scale[:, None]))

    @cached_property
    def noise(self) -> FloatArray:
        """Covariance (N n, N n) of h, the noise of a slot before averaging."""
        N, n, _ = self.closed.shape
        # The plant's noise is common to all nodes, the sensors' noises are independent.
        cov = np.einsum("iab,bc,jdc->iajd", self.process, self.Q, self.process, optimize=True)
        nodes = np.arange(N)
        cov[nodes, :, nodes] += self.sensor_noise
        return symmetric(cov.reshape(N * n, N * n))


def estimation_steps(scenario: Scenario, averaging: Averaging | None = None) -> EstimationSteps:
    """Return how errors of push-sum change in a slot at asymptotic gains. Raises TheoryError
    without such gains, for another F than the plant's, and for dependent links.
    """
    limits = push_sum_limits(scenario)
    F, _ = scenario.slot_belief
    plant = scenario.linear_plant
    if not np.array_equal(F, plant.F):
        raise TheoryError("the filters' F differs from the plant's: the error follows the state")
    truth = [scenario.observation_matrices(node) for node in scenario.nodes]
    pairs = list(zip(limits.gains, truth, strict=True))
    # e+ = (I - K H)(F e + w) - K v at each node, before averaging, P (27)
    process = np.stack([np.eye(len(F)) - K @ H for K, (H, _) in pairs])
    sensor_noise = np.stack([K @ R @ K.T for K, (_, R) in pairs])
    law = averaging_law(scenario) if averaging is None else averaging
    return EstimationSteps(law, process @ F, process, sensor_noise, plant.Q, limits)


def averaging_law(scenario: Scenario, delivery: float | None = None) -> Averaging:
    """Return the law of averaging steps with the channel's links, or one ``delivery``. Raises
    TheoryError for recorded links, dependent losses, and late messages.
    """
    algorithm, topology = push_sum_filter(scenario), scenario.topology
    channel = scenario.network.channel
    if not isinstance(scenario.network.activation, Broadcast):
        raise TheoryError("recorded links are one outcome, not a law: no mean square is known")
    delay, step = channel.delay.fixed, scenario.phase_length / algorithm.gamma
    if delay is None or delay >= step:
        raise TheoryError(
            f"messages may come after their step of {step:.3g} s: give a fixed, shorter delay"
        )
    # With symmetric losses both directions share one draw, else they are independent.
    indices = [[topology.index[i], topology.index[j]] for i, j in topology.links]
    hears = _probabilities(scenario, delivery)
    return Averaging(
        nodes=len(topology.nodes),
        links=np.array(indices, dtype=np.int64).reshape(-1, 2),
        hears=hears,
        both=hears.min(axis=1) if channel.symmetric else hears.prod(axis=1),
        delta=algorithm.delta,
        gamma=algorithm.gamma,
        held=algorithm.links == "held",
    )


def _probabilities(scenario: Scenario, delivery: float | None) -> FloatArray:
    """Return the probabilities (E, 2) that each end of a link hears the other."""
    loss, links = scenario.network.channel.loss, scenario.topology.links
    if delivery is not None:
        delivery = as_number("delivery", delivery)
        if not 0.0 <= delivery <= 1.0:
            raise TheoryError(f"delivery must lie in [0, 1], got {delivery!r}")
        return np.full((len(links), 2), delivery)
    if not scenario.network.channel.independent:
        name = name_of("loss", loss)
        raise TheoryError(
            f"the draws of the loss {name!r} depend on each other: no mean square is known"
        )
    # The first end hears the second by the direction (j, i).
    directions = [[(j, i), (i, j)] for i, j in links]
    hears = [[delivery_of(scenario, direction) for direction in pair] for pair in directions]
    return np.array(hears, dtype=np.float64).reshape(-1, 2)
