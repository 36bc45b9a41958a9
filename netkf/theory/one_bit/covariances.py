"""Covariances of the sign-of-innovations filter, which depend on who heard whose bits."""

from __future__ import annotations

import math

import numpy as np

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import ArrayLike, FloatArray, symmetric
from netkf.scenario.scenario import Scenario
from netkf.theory.intermittent.riccati import check_system, lyapunov_step
from netkf.theory.numerics.matrices import as_numbers
from netkf.trace.run import Run
from netkf.trace.schema import rows_of


def one_bit_update(P: ArrayLike, H: ArrayLike, R: ArrayLike) -> FloatArray:
    """Return P (n, n) after the signs of the innovations of a reading's p rows, one after the other
    once their noises are decorrelated, ``P - (2 / pi) P h' h P / (h P h' + 1)`` for each row h.

    P (n, n) is the covariance before them, H is (p, n), R (p, p). A bit is worth 2 / pi of its
    reading (Ribeiro, Giannakis and Roumeliotis 2006, equation 22). Raises TheoryError if shapes or
    definiteness are wrong.
    """
    # P is checked in the place of Q; F is not used.
    _, result, H_, R_ = check_system(np.eye(len(np.atleast_2d(as_numbers("P", P)))), P, H, R)
    # Whitened rows have independent noises of variance 1: they are used one after the other.
    for h in np.linalg.solve(np.linalg.cholesky(R_), H_):
        Ph = result @ h
        result = result - 2.0 / math.pi / (h @ Ph + 1.0) * np.outer(Ph, Ph)
    return symmetric(result)


def bit_covariances(scenario: Scenario, run: Run) -> FloatArray:
    """Return P (T, N, n, n) of a run by the bits that arrived; TheoryError if not all are known."""
    unheard = [node for node in scenario.sensing_nodes if not scenario.topology.receivers(node)]
    if unheard:
        raise TheoryError(f"nobody hears node {unheard[0]}: the log does not show its bits")
    if scenario.topology.radius is not None:
        raise TheoryError("the log does not show the bits of a node with nobody in range")
    nodes, index, plant = scenario.nodes, scenario.topology.index, scenario.slot_plant
    sensors = [scenario.observation_matrices(node, believed=True) for node in nodes]
    used = _used_bits(scenario, run)
    P, covariances, slot = [np.asarray(scenario.initial_estimate(node)[1]) for node in nodes], [], 0
    for until in plant.slots_of(run.times).tolist():
        while slot < until:
            F, Q = scenario.slot_belief_from(slot)
            slot += 1
            P = [lyapunov_step(one, F, Q) for one in P]
            for receiver, sender in used.get(slot, ()):
                k = index[receiver]
                P[k] = one_bit_update(P[k], *sensors[index[sender]])
        covariances.append(np.stack(P))
    return np.stack(covariances)


def _used_bits(scenario: Scenario, run: Run) -> dict[int, list[tuple[int, int]]]:
    """Return by slot the pairs (receiver, sender) of used bits; a sender uses its own."""
    bits: dict[int, set[tuple[int, int]]] = {}
    rows = rows_of(run.log, "deliver")
    slots = scenario.slot_plant.slots_of(rows["t"])
    for slot, node, peer in zip(slots, rows["node"].tolist(), rows["peer"].tolist(), strict=True):
        bits.setdefault(int(slot), set()).add((node, peer))
    rows = rows_of(run.log, "send")
    slots = scenario.slot_plant.slots_of(rows["t"])
    for slot, node in zip(slots, rows["node"].tolist(), strict=True):
        bits.setdefault(int(slot), set()).add((node, node))
    return {slot: sorted(pairs) for slot, pairs in bits.items()}
