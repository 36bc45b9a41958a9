"""Steady errors of fused tracks by Lyapunov equations, Bar-Shalom and Campo 1986.

Tracks of steady Kalman filters have ``P_ij = C_i (F P_ij F' + Q) C_j'`` for i and j apart, with
``C_i = I - K_i H_i``. What a node shows depends on whom it hears in a slot, which is independent of
all errors: the mean is over all sets of neighbours.
"""

from __future__ import annotations

import itertools
import math
from itertools import combinations_with_replacement

import numpy as np

from netkf.algorithms.track_fusion import best_combination
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, square_root
from netkf.linalg.spectra import contracts, growth_factor
from netkf.network.matchings import Broadcast
from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import lacks_channel_law, no_channel_law
from netkf.theory.common.random_links import arrival_of
from netkf.theory.intermittent.riccati import steady_gain

MAX_NEIGHBOURS = 10
"""Neighbours whose messages may be lost, all sets of which are looked at."""


def tracks_in_slots(scenario: Scenario) -> tuple[float, FloatArray | None]:
    """Return the largest spectral radius of ``C F (x) C F``, C = I - K H, and the steady
    covariances (N, n, n) of what nodes show, None unless it is below 1. Raises TheoryError.
    """
    if not isinstance(scenario.network.activation, Broadcast):
        raise TheoryError("the exchanges are recorded: one outcome, not a law")
    if lacks_channel_law(scenario):
        raise TheoryError(no_channel_law(scenario))
    if not scenario.filters_know_the_truth:
        raise TheoryError("the filters' model is not the true one")
    joint, radius = steady_tracks(scenario)
    if joint is None:
        return radius, None
    nodes = range(len(scenario.nodes))
    return radius, np.stack([_mean_reported_covariance(scenario, joint, i) for i in nodes])


def steady_tracks(scenario: Scenario) -> tuple[FloatArray | None, float]:
    """Return the joint covariances (N, N, n, n) of the errors of steady tracks, None unless the
    radius is below 1, and the radius.
    """
    (F, Q), n = scenario.slot_belief, scenario.plant.n
    closed, noises = [], []
    for node in scenario.nodes:
        H, R = scenario.observation_matrices(node)
        K = steady_gain(F, Q, H, R)
        closed.append(np.eye(n) - K @ H)
        noises.append(K @ R @ K.T)
    radius = max(growth_factor(C @ F) for C in closed) ** 2
    if not contracts(radius):
        return None, radius
    joint = np.zeros((len(closed), len(closed), n, n))
    for (i, C), (j, D) in combinations_with_replacement(enumerate(closed), 2):
        # P_ij = C_i (F P_ij F' + Q) C_j' + [i = j] K R K', solved by vectorisation.
        driven = C @ Q @ D.T + (noises[i] if i == j else 0.0)
        block = np.linalg.solve(np.eye(n * n) - np.kron(C @ F, D @ F), driven.reshape(-1))
        joint[i, j] = block.reshape(n, n)
        joint[j, i] = block.reshape(n, n).T
    return joint, radius


def _mean_reported_covariance(scenario: Scenario, joint: FloatArray, i: int) -> FloatArray:
    """Return the mean covariance (n, n) of what node i reports; raises TheoryError."""
    node, topology = scenario.nodes[i], scenario.topology
    arrivals = {topology.index[j]: arrival_of(scenario, (j, node)) for j in topology.senders(node)}
    certain = [j for j, p in arrivals.items() if p == 1.0]
    unsure = [j for j, p in arrivals.items() if 0.0 < p < 1.0]
    if len(unsure) > MAX_NEIGHBOURS:
        raise TheoryError(
            f"node {node} hears {len(unsure)} nodes with losses; at most "
            f"{MAX_NEIGHBOURS} are looked at, in all combinations"
        )
    total: FloatArray = np.zeros_like(joint[i, i])
    # E[P] over who is heard: best combinations are no linear function of the outcomes.
    for heard in itertools.product((True, False), repeat=len(unsure)):
        outcomes = list(zip(unsure, heard, strict=True))
        probability = math.prod(arrivals[j] if up else 1.0 - arrivals[j] for j, up in outcomes)
        order = [i, *certain, *(j for j, is_heard in outcomes if is_heard)]
        own: FloatArray = joint[i, i]
        if len(order) > 1:
            root = best_combination(joint, order, square_root(own))[1]
            own = np.asarray(root @ root.T)
        total += probability * own
    return total
