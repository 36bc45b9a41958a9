"""The coupled Riccati equations H(12) of a scenario, as arrays.

    dP_i/dt = A P_i + P_i A' + Q - P_i G_i P_i + sum_j c_ij (T P_j T' + q - P_i)

``c_ij`` is the rate at which messages from j arrive at i, times their weight. A message with a
fixed delay of d seconds is predicted over them, ``T = exp(A d)`` and ``q`` the noise of d seconds,
and P_j is that of d seconds ago; without delay ``T = I`` and ``q = 0``. Sensors that sample add
terms and jumps, see theory/hybrid/samples.py.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import scipy

from netkf.algorithms.kernels.riccati import state_units
from netkf.algorithms.registry import overridden
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, square_root
from netkf.network.clocks import LinkClock
from netkf.network.spectra import connected_parts
from netkf.plants.transitions import Transitions
from netkf.scenario.registry import kind_name
from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import (
    lacks_channel_law,
    life_rows,
    no_channel_law,
    nonlinear_rows,
)
from netkf.theory.common.observations import increment_observations
from netkf.theory.hybrid import dense
from netkf.theory.hybrid.dense import FullMatrix, SparseOrFull, full_matrix, matrix_of, solve_or_nan
from netkf.theory.hybrid.samples import (
    PoissonSamples,
    SampleJump,
    poisson_samples,
    randomly_sampled_sensors,
    sample_jumps,
    sampling_clock,
    transmits_at_samples,
)

EQUAL_RATES = 1e-8  # difference of rates that count as equal, as a share of the largest rate
RESIDUAL_TOLERANCE = 1e-9  # of the left null vector, relative


class CoupledRiccati(NamedTuple):
    """Coefficients of H(12) for N nodes of n states, or for the one filter that they share.

    A, Q     : (n, n) drift and noise that the filters assume
    G        : (N, n, n) information of increments per second
    coupling : (N, N) sparse, or a FullMatrix if small, c_ij per second
    T, q     : (n, n) prediction over the delay
    delay    : seconds
    start    : (N, n, n) P at 0
    samples  : sensors with Poisson clocks
    jumps    : samples at known times
    """

    A: FloatArray
    Q: FloatArray
    G: FloatArray
    coupling: SparseOrFull
    T: FloatArray
    q: FloatArray
    delay: float
    start: FloatArray
    samples: tuple[PoissonSamples, ...] = ()
    jumps: tuple[SampleJump, ...] = ()

    @property
    def talks(self) -> bool:
        """True if any message ever arrives."""
        sent = any(jump.weights is not None and jump.weights.any() for jump in self.jumps)
        return bool(self.coupling.nnz or any(s.heard.nnz for s in self.samples) or sent)

    @property
    def information(self) -> FloatArray:
        """The information (n, n) of all increments per second and of one sample of each sensor."""
        total = self.G.sum(axis=0)
        for group in self.samples:
            total += np.einsum("kpi,kpj->ij", group.H, np.linalg.solve(group.R, group.H))
        return np.asarray(total)

    def restrict(self, node: int) -> CoupledRiccati:
        """Return the equation of the node with index ``node`` without the others, with N = 1."""
        return self._replace(
            G=self.G[node : node + 1],
            start=self.start[node : node + 1],
            coupling=full_matrix(1, 1),
            samples=tuple(s.restrict(node) for s in self.samples),
            jumps=tuple(
                SampleJump(jump.time, {0: jump.observations[node]}, None)
                for jump in self.jumps
                if node in jump.observations
            ),
        )

    def in_natural_units(self) -> tuple[CoupledRiccati, FloatArray]:
        """Return the equations of states in natural units, and these (n,); without jumps."""
        units = state_units(self.A, self.Q, self.information)
        covariance, drift = np.outer(units, units), np.outer(1.0 / units, units)
        scaled = self._replace(
            A=self.A * drift,
            Q=self.Q / covariance,
            G=self.G * covariance,
            T=self.T * drift,
            q=self.q / covariance,
            start=self.start / covariance,
            samples=tuple(group._replace(H=group.H * units) for group in self.samples),
        )
        return scaled, units

    def scale_rates(self, factor: float) -> CoupledRiccati:
        """Return the equations with all link rates multiplied by ``factor``."""
        return self._replace(coupling=factor * self.coupling)


def concerns_hybrid_paper(scenario: Scenario) -> bool:
    """Return True if H is about the filter: its own ones, and under clocks silent ones."""
    if not scenario.slotted and not scenario.filter.algorithm.timing.talks:
        return True
    return scenario.node_filter.analysis.paper == "hybrid"


def reason_without_bound(scenario: Scenario) -> str | None:
    """Return why H Theorem 2, that H(12) bounds the mean of P, does not apply; None if it does."""
    algorithm, network = scenario.filter.algorithm, scenario.network
    if not scenario.slotted and not algorithm.timing.talks:
        return _reason_of_samples(scenario)
    name = type(algorithm).__name__
    if not concerns_hybrid_paper(scenario):
        return (
            f"Tanwani's H(12) is about the hybrid filter in continuous time, not "
            f"about {kind_name(algorithm)}"
        )
    overridden_names = overridden(algorithm)  # built-in resets by intersection give no larger P
    if overridden_names:
        definition = f"{name} defines {overridden_names[0]} itself"
        return f"not promised: Tanwani's H(12) is about the hybrid filter, and {definition}"
    assert isinstance(network.activation, LinkClock)
    if not transmits_at_samples(scenario) and not network.activation.memoryless:
        return (
            f"not promised: the clocks of the {network.activation.at} are not Poisson processes, "
            "and for other clocks of the same rate the mean covariance can lie above Tanwani's "
            "H(12)"
        )
    if network.channel.delay.fixed is None:
        return "not promised: Tanwani's H(12) holds for no or fixed delays, and the delay is random"
    dependent = "not promised: losses depend on earlier ones, so arrivals are not Poisson processes"
    lacks_law = lacks_channel_law(scenario)
    if lacks_law:
        dependent = f"not promised: {no_channel_law(scenario)}"
    independent = network.channel.independent and not lacks_law
    return _reason_of_samples(scenario) if independent else dependent


def _reason_of_samples(scenario: Scenario) -> str | None:
    """Return why the bound does not cover sensors that sample, or None if it does."""
    for *_, evidence in nonlinear_rows(scenario) or life_rows(scenario):
        return f"not promised: {evidence}"
    for node, placed_sensor in randomly_sampled_sensors(scenario):
        clock = sampling_clock(scenario.sensors[placed_sensor.entry])
        if clock is None or not clock.memoryless:
            return (
                f"not promised: when node {node} samples is random and no Poisson process, and for "
                "other clocks of the same rate the mean covariance can lie above the bound"
            )
    return None


def require_bound(scenario: Scenario) -> None:
    """Raise TheoryError with the reason if paper H Theorem 2 does not apply to a scenario."""
    reason = reason_without_bound(scenario)
    if reason is not None:
        raise TheoryError(reason)


def increment_informations(scenario: Scenario) -> FloatArray:
    """Return ``H_i' R_i^-1 H_i`` (N, n, n) of increments; (1, n, n) of a pooled filter."""
    informations = [o.H.T @ np.linalg.solve(o.R, o.H) for o in increment_observations(scenario)]
    return np.stack(informations)


def at_nodes(scenario: Scenario, P: FloatArray) -> FloatArray:
    """Return the covariances (..., N, n, n) of the nodes, of those that H(12) gives."""
    # All nodes have that of a pooled filter.
    pooled = scenario.filter.algorithm.timing.pooled
    return np.repeat(P, len(scenario.nodes), axis=-3) if pooled else P


@lru_cache(maxsize=4)
def coupling(scenario: Scenario) -> SparseOrFull:
    """Return c (N, N): rates (1/s) of arrivals from j at i times weights; one object. The one
    filter of all nodes has c = 0 (1, 1).
    """
    index, size = scenario.topology.index, len(scenario.nodes)
    if scenario.filter.algorithm.timing.pooled:
        return full_matrix(1, 1)
    rates = {} if transmits_at_samples(scenario) else scenario.effective_rates()
    # Losses thin the Poisson process of arrivals: the effective rate counts what arrives.
    heard = {pair: rate for pair, rate in rates.items() if rate > 0.0}
    values = [rate * scenario.weight(i, j) for (j, i), rate in heard.items()]
    places = [index[i] for _, i in heard], [index[j] for j, _ in heard]
    n = scenario.plant.n
    return matrix_of(values, places, size, size * n * (n + 1) // 2 <= dense.MAX_UNKNOWNS)


def coupled_riccati(scenario: Scenario) -> CoupledRiccati:
    """Return the equations H(12) of a scenario; raises TheoryError if they do not apply."""
    require_bound(scenario)
    A, Q = scenario.belief
    n = scenario.plant.n
    delay = scenario.network.channel.delay.fixed or 0.0
    if not scenario.filter.algorithm.timing.talks:
        delay = 0.0
    T, q = np.eye(n), np.zeros((n, n))
    if delay > 0.0:
        T, q = Transitions(A, square_root(Q)).law(delay)
    G, spread = increment_informations(scenario), scenario.initial_estimate(scenario.nodes[0])[1]
    start = np.broadcast_to(spread, G.shape).copy()
    if isinstance(scenario.filter.cov, tuple) and len(G) > 1:
        start = np.stack([scenario.initial_estimate(node)[1] for node in scenario.nodes])
    return CoupledRiccati(
        A,
        Q,
        G=G,
        coupling=coupling(scenario),
        T=T,
        q=q,
        delay=delay,
        start=start,
        samples=poisson_samples(scenario),
        jumps=sample_jumps(scenario),
    )


def has_balanced_rates(scenario: Scenario) -> bool | None:
    """Return True if both directions of each link have one rate, H (13); None if unknown."""
    if not np.isfinite(list(scenario.effective_rates().values())).all():
        return None
    return _is_symmetric(coupling(scenario))


def _is_symmetric(c: SparseOrFull) -> bool:
    difference, size = abs(c - c.T), abs(c.T)
    return bool(difference.max() <= EQUAL_RATES * size.max())


def left_weights(scenario: Scenario) -> FloatArray:
    """Return the left null vector (N,) of ``D - c``, weights of information for ever faster links;
    raises TheoryError if messages do not connect all nodes.
    """
    algorithm = scenario.filter.algorithm
    if len(scenario.nodes) == 1:
        return np.ones(1)
    if not algorithm.timing.talks:
        raise TheoryError(
            f"the {kind_name(algorithm)} filter does not talk, links mean nothing to it"
        )
    if has_balanced_rates(scenario) is None:
        raise TheoryError("how often messages arrive is not known beforehand")
    # The coupling has the left null vector w of its Laplacian D - C: w_j = share of node j's
    # information in the common estimate.
    c = coupling(scenario)
    if not c.nnz:
        raise TheoryError("no message ever arrives")
    heard = _heard_by_all(c)
    if heard is None:
        raise TheoryError("the messages that arrive do not join all nodes")
    w = np.zeros(c.shape[0])
    w[heard] = _stationary(c[heard][:, heard])
    return w


def _heard_by_all(c: SparseOrFull) -> np.ndarray | None:
    """Return the nodes (K,) heard by all others by way of the rates c, or None."""
    # Row i of c has the senders that node i receives from.
    count, part = connected_parts(c, "strong")
    hears, heard = c.nonzero()
    outside = part[hears] != part[heard]
    # Components without arrivals from other components.
    closed = np.setdiff1d(np.arange(count), part[hears[outside]])
    return np.flatnonzero(part == closed[0]) if len(closed) == 1 else None


def _stationary(c: SparseOrFull) -> FloatArray:
    """Return the weights w (M,) of fast links, ``w (D - c) = 0``; raises TheoryError."""
    size = c.shape[0]
    if size == 1 or _is_symmetric(c):
        return np.full(size, 1.0 / size)
    leaving = np.asarray(c.sum(axis=1)).reshape(-1)
    # The weight of the first node is set to 1, the others follow from their own equations.
    w = np.ones(size)
    transposed: Any
    if isinstance(c, FullMatrix):
        transposed = np.diag(leaving) - c.toarray().T
        w[1:] = solve_or_nan(transposed[1:, 1:], -transposed[1:, 0])
    else:
        transposed = scipy.sparse.csc_array(scipy.sparse.diags_array(leaving) - c).T
        equations = scipy.sparse.csc_array(scipy.sparse.csr_array(transposed)[1:])
        right = -equations[:, [0]].toarray().reshape(-1)
        w[1:] = scipy.sparse.linalg.spsolve(equations[:, 1:], right)
    w = np.maximum(w, 0.0) / np.maximum(w, 0.0).sum()
    if not np.abs(transposed @ w).max() <= RESIDUAL_TOLERANCE * leaving.max():
        raise TheoryError("the messages that arrive do not join all nodes")
    return np.asarray(w)
