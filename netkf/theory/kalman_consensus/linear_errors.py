"""The errors of the Kalman-consensus filter in its steady state, as a linear system with jumps.

Its P counts readings and no consensus term. With its own readings alone, or where every message
arrives, P and all gains settle whatever is lost: a node then has the readings of its neighbourhood
in each slot, and the consensus term is ``epsilon / (1 + |P|) P`` times differences of predictions.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, block_diagonal
from netkf.scenario.scenario import Scenario
from netkf.theory.common.jumps import SlotJumps
from netkf.theory.common.random_links import all_messages_arrive, broadcast_directions
from netkf.theory.intermittent.riccati import steady_covariance


def consensus_jumps(scenario: Scenario) -> SlotJumps:
    """Return the errors of Kalman-consensus filters at steady gains as a linear system. Raises
    TheoryError for recorded exchanges, and for shared readings with losses.
    """
    algorithm: Any = scenario.filter.algorithm
    nodes = scenario.nodes
    (F, Q), index = scenario.slot_belief, scenario.topology.index
    heard: list[list[int]] = [[k] for k in range(len(nodes))]
    if algorithm.share_readings:
        if not all_messages_arrive(scenario):
            raise TheoryError(
                "gains follow the readings that arrive; exact steady mean squares of kcf are known "
                "with share_readings = false, or where nothing is lost"
            )
        for sender, receiver in scenario.topology.directions:
            heard[index[receiver]].append(index[sender])
    sensors = [scenario.observation_matrices(node, believed=True) for node in nodes]
    # All readings of the network, and the columns of each node in them.
    rows = np.cumsum([0, *(len(H) for H, _ in sensors)])
    true = block_diagonal([scenario.observation_matrices(node)[1] for node in nodes])
    closed, gains, terms = [], np.zeros((len(nodes), len(F), rows[-1])), []
    for k, senders in enumerate(heard):
        H = np.concatenate([sensors[j][0] for j in senders])
        R = block_diagonal([sensors[j][1] for j in senders])
        # Gains are steady: each node runs the Riccati equation of the readings that it uses.
        P = steady_covariance(F, Q, H, R)
        K = np.linalg.solve(H @ P @ H.T + R, H @ P).T if len(H) else np.zeros((len(F), 0))
        gains[k][:, np.concatenate([np.arange(rows[j], rows[j + 1]) for j in senders])] = K
        closed.append(np.eye(len(F)) - K @ H)
        # The consensus term is gamma P times the differences of predictions.
        terms.append(algorithm.epsilon / (1.0 + np.linalg.norm(P)) * P)
    weights: dict[tuple[int, int], FloatArray] = {
        (i, j): terms[index[j]] for i, j in scenario.topology.directions
    }
    directions = broadcast_directions(scenario, weights)
    stacked_gains = gains.reshape(-1, rows[-1])
    plant, noise = scenario.linear_plant, stacked_gains @ true @ stacked_gains.T
    return SlotJumps(plant.F, plant.Q, np.stack(closed), noise, directions, on_predictions=True)
