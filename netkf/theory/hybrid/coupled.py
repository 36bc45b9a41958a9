"""The coupled Riccati equations H(12) of a scenario, as arrays.

d P_i = A P_i + P_i A' + Q - P_i G_i P_i + sum_j c_ij (T P_j T' + q - P_i)

``c_ij`` is the rate at which messages from j arrive at i times the weight they get. Sensors that
sample add terms and jumps of their own, see theory/hybrid/samples.py. A message that
took a fixed time d is predicted first, ``T = exp(A d)`` and ``q`` the noise of d seconds, and
P_j is then the one from d seconds ago; without delay ``T = I``, ``q = 0``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
import scipy.sparse.linalg

from netkf.algorithms.kernels.riccati import riccati_step, riccati_table
from netkf.algorithms.registry import overridden
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.network.clocks import LinkClock
from netkf.scenario.registry import spoken
from netkf.scenario.scenario import Scenario
from netkf.theory.common.observations import increment_observations
from netkf.theory.hybrid.samples import (
    PoissonSamples,
    SampleJump,
    poisson_samples,
    randomly_sampled_sensors,
    sample_jumps,
    sampling_clock,
    transmits_at_samples,
)


class Coupled(NamedTuple):
    """A (n, n), Q (n, n), G (N, n, n) of increments, coupling (N, N) sparse, T (n, n), q (n, n),
    delay (s), start (N, n, n), ``samples`` by Poisson clocks, ``jumps`` at known times.
    """

    A: FloatArray
    Q: FloatArray
    G: FloatArray
    coupling: scipy.sparse.csr_array
    T: FloatArray
    q: FloatArray
    delay: float
    start: FloatArray
    samples: tuple[PoissonSamples, ...] = ()
    jumps: tuple[SampleJump, ...] = ()

    @property
    def talks(self) -> bool:
        """Whether any message ever arrives."""
        sent = any(jump.weights is not None and jump.weights.any() for jump in self.jumps)
        return bool(self.coupling.nnz or any(s.heard.nnz for s in self.samples) or sent)

    def restrict(self, node: int) -> Coupled:
        """The equation of one node, alone."""
        return self._replace(
            G=self.G[node : node + 1],
            start=self.start[node : node + 1],
            coupling=scipy.sparse.csr_array((1, 1)),
            samples=tuple(s.restrict(node) for s in self.samples),
            jumps=tuple(
                SampleJump(jump.time, {0: jump.observations[node]}, None)
                for jump in self.jumps
                if node in jump.observations
            ),
        )

    def faster(self, factor: float) -> Coupled:
        """With clocks of links, directions or nodes that tick so many times as often."""
        return self._replace(coupling=factor * self.coupling)


def not_promised(scenario: Scenario) -> str | None:
    """Why H Theorem 2 does not speak about the scenario, in words; None where it does."""
    algorithm, network = scenario.filter.algorithm, scenario.network
    if not scenario.slotted and not algorithm.talks:
        return _samples_not_promised(scenario)
    name = type(algorithm).__name__
    if scenario.hosted.paper != "hybrid":
        return f"H(12) is about the hybrid filter in continuous time, not about {spoken(algorithm)}"
    own = overridden(algorithm)  # built-in resets by intersection give no larger P
    if own:
        return f"not promised: H(12) is about the hybrid filter, and {name} defines {own[0]} itself"
    assert isinstance(network.activation, LinkClock)
    if not transmits_at_samples(scenario) and not network.activation.memoryless:
        return (
            f"not promised: the clocks of the {network.activation.at} are not Poisson processes, "
            "and for other clocks of the same rate the mean covariance can lie above H(12)"
        )
    if network.channel.delay.fixed is None:
        return "not promised: H(12) holds for no delay or a fixed one, and the delay is random"
    bursts = "not promised: losses depend on earlier ones, so arrivals are not Poisson processes"
    return _samples_not_promised(scenario) if network.channel.loss.independent else bursts


def _samples_not_promised(scenario: Scenario) -> str | None:
    for node, place in randomly_sampled_sensors(scenario):
        clock = sampling_clock(scenario.sensors[place.entry])
        if clock is not None and not clock.memoryless:
            return (
                f"not promised: when node {node} samples is random and no Poisson process, and for "
                "other clocks of the same rate the mean covariance can lie above the bound"
            )
    return None


def promised(scenario: Scenario) -> None:
    """Raise TheoryError with the reason where H Theorem 2 does not apply."""
    reason = not_promised(scenario)
    if reason is not None:
        raise TheoryError(reason)


def informations(scenario: Scenario) -> FloatArray:
    """(N, n, n): ``G_i`` of the increments as the filters believe it; a pooled filter's is the same
    at all nodes.
    """
    seen = [one.H.T @ np.linalg.solve(one.R, one.H) for one in increment_observations(scenario)]
    if scenario.filter.algorithm.pooled:
        seen = seen * len(scenario.nodes)
    return np.stack(seen)


def coupling(scenario: Scenario) -> scipy.sparse.csr_array:
    """(N, N) sparse: entry (i, j) is the rate of messages from j that reach i times weight."""
    index, size = scenario.topology.index, len(scenario.nodes)
    rates = {} if transmits_at_samples(scenario) else scenario.effective_rates()
    heard = {pair: rate for pair, rate in rates.items() if rate > 0.0}
    values = np.array([rate * scenario.weight(i, j) for (j, i), rate in heard.items()])
    places = np.array([(index[i], index[j]) for j, i in heard], dtype=np.int64).reshape(-1, 2)
    entries = scipy.sparse.coo_array((values, (places[:, 0], places[:, 1])), shape=(size, size))
    matrix = scipy.sparse.csr_array(entries)
    matrix.eliminate_zeros()
    return matrix


def coupled(scenario: Scenario) -> Coupled:
    """The equations of a scenario; raises TheoryError where H(12) does not apply."""
    promised(scenario)
    A, Q = scenario.belief
    n = scenario.plant.n
    delay = scenario.network.channel.delay.fixed or 0.0
    if not scenario.filter.algorithm.talks:
        delay = 0.0
    T, q = np.eye(n), np.zeros((n, n))
    if delay > 0.0:
        table = riccati_table(A, Q, np.zeros((n, n)), delay)
        q, _ = riccati_step(table, q, np.zeros(n), delay)
        T = np.column_stack([riccati_step(table, q, e, delay)[1] for e in np.eye(n)])
    start = np.stack([scenario.start(node)[1] for node in scenario.nodes])
    return Coupled(
        A,
        Q,
        informations(scenario),
        coupling(scenario),
        T,
        q,
        delay,
        start,
        poisson_samples(scenario),
        sample_jumps(scenario),
    )


def balanced(scenario: Scenario) -> bool | None:
    """Whether both directions of each link arrive at one rate, so that the limit is S of H(13);
    None where the rates are not known beforehand.
    """
    if not np.isfinite(list(scenario.effective_rates().values())).all():
        return None
    return _symmetric(coupling(scenario))


def _symmetric(c: scipy.sparse.csr_array) -> bool:
    apart, size = abs(c - c.T), abs(c.T)
    return bool((apart - RATE_TOLERANCE * size).max() <= SAME_RATE)


def left_weights(scenario: Scenario) -> FloatArray:
    """(N,): the weights with which the nodes' information enters when links tick ever faster.

    The left null vector of the coupling, scaled to sum 1: 1/N where both directions of a link
    arrive at one rate. Raises TheoryError where some node is never heard.
    """
    algorithm = scenario.filter.algorithm
    if len(scenario.nodes) == 1:
        return np.ones(1)
    if not algorithm.talks:
        raise TheoryError(f"the {spoken(algorithm)} filter does not talk, links mean nothing to it")
    if balanced(scenario) is None:
        raise TheoryError("how often messages arrive is not known beforehand (a recorded table?)")
    c = coupling(scenario)
    if not c.nnz:
        raise TheoryError("no message ever arrives")
    heard = _heard_by_all(c)
    if heard is None:
        raise TheoryError("the messages that arrive do not join all nodes")
    w = np.zeros(c.shape[0])
    w[heard] = _stationary(scipy.sparse.csr_array(c[heard][:, heard]))
    return w


def _heard_by_all(c: scipy.sparse.csr_array) -> np.ndarray | None:
    """Places of the nodes whose messages reach all others, sooner or later and over others; None
    where no node's do.

    They are the one strongly connected part that hears nobody outside; with two such parts the
    coupling has two left null vectors.
    """
    count, part = scipy.sparse.csgraph.connected_components(c, connection="strong")
    hears, heard = c.nonzero()
    outside = part[hears] != part[heard]
    closed = np.setdiff1d(np.arange(count), part[hears[outside]])
    return np.flatnonzero(part == closed[0]) if len(closed) == 1 else None


def _stationary(c: scipy.sparse.csr_array) -> FloatArray:
    """(M,) w with ``w (D - C) = 0`` and sum 1 for strongly connected nodes, D the row sums of C."""
    size = c.shape[0]
    if size == 1 or _symmetric(c):
        return np.full(size, 1.0 / size)
    leaving = np.asarray(c.sum(axis=1)).reshape(-1)
    transposed = scipy.sparse.csc_array(scipy.sparse.diags_array(leaving) - c).T
    # The weight of the first node is set to 1, the others follow from their own equations.
    rest = scipy.sparse.csc_array(scipy.sparse.csr_array(transposed)[1:])
    w = np.ones(size)
    w[1:] = scipy.sparse.linalg.spsolve(rest[:, 1:], -rest[:, [0]].toarray().reshape(-1))
    w = np.maximum(w, 0.0) / np.maximum(w, 0.0).sum()
    if not np.abs(transposed @ w).max() <= RESIDUAL_WEIGHTS * leaving.max():
        raise TheoryError("the messages that arrive do not join all nodes")
    return np.asarray(w)


RATE_TOLERANCE, SAME_RATE = 1e-12, 1e-8  # of rates that are equal: relative, absolute
RESIDUAL_WEIGHTS = 1e-9
