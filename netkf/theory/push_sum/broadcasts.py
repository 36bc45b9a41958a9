"""The remarks of P on its broadcasts: nominal degrees (Remark 1) and a leader (Remark 3)."""

from __future__ import annotations

import itertools
from typing import Literal

import numpy as np

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import ArrayLike, FloatArray
from netkf.network.graphs import Topology
from netkf.scenario.scenario import Scenario
from netkf.theory.common.requirements import topology_of
from netkf.theory.numerics.matrices import as_integer, as_numbers
from netkf.theory.push_sum.estimation_steps import averaging_law

MAX_NODES = 12  # of a network whose informed sets are enumerated
Degrees = Literal["nominal", "last"]


def mass_totals(
    graph: Scenario | Topology, up: ArrayLike, degrees: Degrees = "nominal"
) -> FloatArray:
    """Return the total mass (T + 1,) of all nodes after 0 .. T slots of push-sum exchanges, from a
    total of 1.

    ``up`` (T, E) says which links of the graph, in its order, are up in each slot, in both
    directions. Every node starts with 1/N. ``degrees`` "nominal" divides by the degree in the whole
    graph and replaces what does not arrive by a node's own share, paper P (3)-(5) corrected: the
    total stays 1. "last" divides by the degree that a node saw in the slot before, the latest one
    that it can know when it sends, as paper P (14) would need: then mass is lost or made where
    links change, which is what paper P Remark 1 says cannot be synchronised. Raises TheoryError for
    wrong arguments.
    """
    topology = topology_of(graph)
    links = np.array([[topology.index[a], topology.index[b]] for a, b in topology.links])
    present, N = as_numbers("up", up) != 0.0, len(topology.nodes)
    if present.ndim != 2 or present.shape[1] != len(links):
        raise TheoryError(f"up must have one column for each of {len(links)} links")
    if degrees not in ("nominal", "last"):
        raise TheoryError(f'degrees must be "nominal" or "last", got {degrees!r}')
    nominal = np.bincount(links.reshape(-1), minlength=N) + 1.0
    # ``nominal`` and ``last_degrees`` are degrees plus 1: a node keeps one share itself.
    z, last_degrees, totals = np.full(N, 1.0 / N), nominal, [1.0]
    for row in present:
        open_, closed = links[row], links[~row]
        share = z / (nominal if degrees == "nominal" else last_degrees)
        z = share.copy()
        np.add.at(z, open_[:, 0], share[open_[:, 1]])
        np.add.at(z, open_[:, 1], share[open_[:, 0]])
        if degrees == "nominal":
            np.add.at(z, closed.reshape(-1), share[closed.reshape(-1)])
        last_degrees = np.bincount(open_.reshape(-1), minlength=N) + 1.0
        totals.append(float(z.sum()))
    return np.array(totals)


def leader_agreement(scenario: Scenario, slots: int, leader: int | None = None) -> FloatArray:
    """Return the probability (slots + 1,) that all nodes know the leader, from slot 0 on.

    Paper P Remark 3: every node broadcasts the largest id that it has heard of (max-consensus), and
    the node whose id wins starts with w = 1; it is the largest one, or ``leader``. Links fail with
    the probabilities of the channel, afresh in each slot. Exact, over all sets of nodes that may
    know. Raises TheoryError for more than 12 nodes and for links that are not drawn independently.
    """
    # The law of the links: which nodes hear each other in a step.
    averaging, slots = averaging_law(scenario), as_integer("slots", slots, 0)
    if averaging.nodes > MAX_NODES:
        raise TheoryError(
            f"sets of nodes are enumerated, and {averaging.nodes} nodes have too many"
        )
    chosen = max(scenario.nodes) if leader is None else leader
    if chosen not in scenario.nodes:
        raise TheoryError(f"the leader {leader!r} is not a node")
    # missed[i, j] is the probability that i does not hear j in a slot. Sets of informed nodes are
    # bit masks, so that their law is an array of 2^N probabilities.
    missed = np.ones((averaging.nodes, averaging.nodes))
    for (i, j), (first_hears, second_hears) in zip(
        averaging.links.tolist(), averaging.hears.tolist(), strict=True
    ):
        missed[i, j], missed[j, i] = 1.0 - first_hears, 1.0 - second_hears
    law_of_informed = np.zeros(2**averaging.nodes)
    law_of_informed[1 << scenario.topology.index[chosen]] = 1.0
    agreement = [law_of_informed[-1]]
    for _ in range(slots):
        law_of_informed = _spread(law_of_informed, missed)
        agreement.append(law_of_informed[-1])
    return np.array(agreement)


def _spread(law: FloatArray, missed: FloatArray) -> FloatArray:
    """Return the law (2^N,) of the set (bit mask) of informed nodes one slot later."""
    N, next_law = len(missed), np.zeros_like(law)
    for informed in np.flatnonzero(law).tolist():
        members = [k for k in range(N) if informed >> k & 1]
        others = [k for k in range(N) if not informed >> k & 1]
        # A link from an informed node serves only one uninformed node: these are independent.
        stays = {k: float(np.prod(missed[k, members])) for k in others}
        frontier = [k for k in others if stays[k] < 1.0]
        for outcome in itertools.product((False, True), repeat=len(frontier)):
            p = law[informed]
            next_set = informed
            for k, heard in zip(frontier, outcome, strict=True):
                p *= 1.0 - stays[k] if heard else stays[k]
                next_set |= heard << k
            next_law[next_set] += p
    return next_law
