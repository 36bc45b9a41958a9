"""What the push-sum filter of P comes to: limits of its mass, its gains, its averaging."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from netkf.algorithms.push_sum import PushSum
from netkf.core.arrays import FloatArray, symmetric
from netkf.core.errors import TheoryError
from netkf.network.graphs import Topology
from netkf.network.matchings import Broadcast
from netkf.scenario.scenario import Scenario
from netkf.theory.averaging import Averaging
from netkf.theory.coupled import own_steps
from netkf.theory.intermittent import steady_covariance


class PushSumLimits(NamedTuple):
    """What steps 2 and 3 come to, in the order of the nodes.

    mass      : (N, n, n) of C~, P (16)
    number    : (N,) of n~, P (17)
    weight    : (N,) of w, P (18)
    G         : (n, n) of every G^(i), the sum of all H_i' R_i^-1 H_i, P (10)
    N         : of every N^(i), P (11)
    P         : (n, n) of every P^(i): P_inf of P (12), the filtered covariance of the Kalman filter
                that gets all readings
    gains     : K^(i) = N P_inf H_i' R_i^-1, (n, p_i) each, P (13)
    """

    mass: FloatArray
    number: FloatArray
    weight: FloatArray
    G: FloatArray
    N: int
    P: FloatArray
    gains: tuple[FloatArray, ...]


def push_sum_limits(scenario: Scenario) -> PushSumLimits:
    """P Theorem 1, and Theorem 2 (in probability) when links fail in both directions together.

    With what the filters believe of the plant and the sensors. Raises TheoryError where the graph
    is not connected, where P_inf does not exist and for scenarios without the push-sum filter.
    """
    push_sum_filter(scenario)
    parts = len(scenario.topology.components)
    if parts > 1:
        raise TheoryError(f"the graph must be connected, it has {parts} parts")
    models, degrees = scenario.slot_models, scenario.topology.degrees
    share = np.array([degrees[node] + 1.0 for node in scenario.nodes])
    share /= share.sum()
    each = [np.linalg.solve(m.R, m.H).T for m in models]
    G = symmetric(sum((e @ m.H for e, m in zip(each, models, strict=True)), start=0.0 * models[0].F))
    P, N = _filtered(scenario, G), len(models)
    gains = tuple(N * P @ e for e in each)
    return PushSumLimits(share[:, None, None] * G, share * N, share, G, N, P, gains)


def _filtered(scenario: Scenario, G: FloatArray) -> FloatArray:
    """P_inf (n, n) of P (12) from the prediction covariance."""
    model = scenario.pooled_slot_model
    predicted = steady_covariance(model.F, model.Q, model.H, model.R)
    return symmetric(np.linalg.solve(np.eye(len(G)) + predicted @ G, predicted))


def push_sum_filter(scenario: Scenario) -> PushSum:
    """The filter of the scenario; raises TheoryError where it is not the push-sum filter."""
    algorithm = scenario.filter.algorithm
    name = type(algorithm).__name__
    if not isinstance(algorithm, PushSum):
        raise TheoryError(f"this is about the push-sum filter, and the scenario's is {name}")
    own = own_steps(algorithm, PushSum)
    if own:
        raise TheoryError(f"this is about the push-sum filter, and {name} defines {own[0]} itself")
    return algorithm


@dataclass(frozen=True, eq=False)
class EstimationSteps:
    """Steps 4 and 5 of P Fig. 1 at the asymptotic gains: ``e+ = (M (x) I)(diag(A_i) e + h)``, P (25).

    averaging : the law of M
    closed    : (N, n, n) A_i = (I - K_i H_i) F
    process   : (N, n, n) I - K_i H_i, how the plant's noise enters h, P (27)
    own       : (N, n, n) K_i R_i K_i', the sensors' part of its covariance
    Q         : (n, n) of the plant
    limits    : what the gains are made of
    """

    averaging: Averaging
    closed: FloatArray
    process: FloatArray
    own: FloatArray
    Q: FloatArray
    limits: PushSumLimits

    @cached_property
    def noise(self) -> FloatArray:
        """(N n, N n) covariance of h."""
        N, n, _ = self.closed.shape
        whole = np.einsum("iab,bc,jdc->iajd", self.process, self.Q, self.process, optimize=True)
        each = np.arange(N)
        whole[each, :, each] += self.own
        return symmetric(whole.reshape(N * n, N * n))


def estimation_steps(scenario: Scenario, averaging: Averaging | None = None) -> EstimationSteps:
    """Steps 4 and 5 of a scenario, with its own links or others.

    The filters' Q and R may differ from the truth, their F may not. Raises TheoryError where
    asymptotic gains do not exist or the law of the links is not one of independent draws.
    """
    limits = push_sum_limits(scenario)
    F, _ = scenario.slot_belief
    plant = scenario.slot_plant
    if not np.array_equal(F, plant.F):
        raise TheoryError("the filters' F differs from the plant's: the error follows the state")
    truth = [scenario.observation(node) for node in scenario.nodes]
    process = np.stack([np.eye(len(F)) - K @ H for K, (H, _) in zip(limits.gains, truth, strict=True)])
    own = np.stack([K @ R @ K.T for K, (_, R) in zip(limits.gains, truth, strict=True)])
    law = averaging_law(scenario) if averaging is None else averaging
    return EstimationSteps(law, process @ F, process, own, plant.Q, limits)


def averaging_law(scenario: Scenario, delivery: float | None = None) -> Averaging:
    """The links of step 5 as the channel makes them, or all with one ``delivery`` probability.

    Raises TheoryError for recorded links, for losses that depend on the past and for delays by
    which messages may come late.
    """
    algorithm, topology = push_sum_filter(scenario), scenario.topology
    network, channel = scenario.network, scenario.network.channel
    if not isinstance(network.activation, Broadcast):
        raise TheoryError("recorded links are one outcome, not a law: no mean square is known")
    late = channel.delay.fixed is None or channel.delay.fixed >= scenario.phase_length
    if late:
        raise TheoryError("messages may come late, which the radius does not count: shorten delays")
    links = np.array([[topology.index[i], topology.index[j]] for i, j in topology.links], dtype=int)
    links = links.reshape(-1, 2)
    if delivery is None:
        if not channel.loss.independent:
            name = type(channel.loss).__name__
            raise TheoryError(f"the draws of {name} depend on each other: no mean square is known")
        chance = scenario.measured, channel.loss.mean_delivery
        hears = [[chance[1](way, chance[0](way)) for way in ((j, i), (i, j))] for i, j in topology.links]
    else:
        if not 0.0 <= delivery <= 1.0:
            raise TheoryError(f"delivery must lie in [0, 1], got {delivery!r}")
        hears = [[delivery, delivery]] * len(links)
    probabilities = np.array(hears, dtype=float).reshape(-1, 2)
    both = probabilities.min(axis=1) if channel.symmetric else probabilities.prod(axis=1)
    held = algorithm.links == "held"
    return Averaging(
        len(topology.nodes), links, probabilities, both, algorithm.delta, algorithm.gamma, held
    )


class GainBound(NamedTuple):
    """Three values that bound the consensus gain delta from below, the sharpest first.

    radius : rho(L) of the Laplacian; above it P Theorems 3 to 6 speak, above half of it averaging
             contracts
    local  : largest sum over a link of its ends' degrees, at least rho(L); nodes can find it alone
    nodes  : N, at least rho(L)
    """

    radius: float
    local: int
    nodes: int


def consensus_gain_bound(graph: Scenario | Topology) -> GainBound:
    """rho(L) and what bounds it from above. The largest degree of a node, or that plus one as P
    has it, lies *below* rho(L) on every graph with a link. Raises TheoryError for directed graphs.
    """
    topology = graph.topology if isinstance(graph, Scenario) else graph
    if topology.directed:
        raise TheoryError("the graph must be undirected")
    N, degrees = len(topology.nodes), topology.degrees
    laplacian = np.diag([float(degrees[node]) for node in topology.nodes])
    for i, j in topology.links:
        a, b = topology.index[i], topology.index[j]
        laplacian[a, b] = laplacian[b, a] = -1.0
    local = max((degrees[i] + degrees[j] for i, j in topology.links), default=0)
    return GainBound(float(np.linalg.eigvalsh(laplacian)[-1]), local, N)
