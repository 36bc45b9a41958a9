"""Assumptions of R on a scenario in slots."""

from __future__ import annotations

import itertools

import numpy as np

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.linalg.spectra import contracts
from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import AssumptionRow, lacks_channel_law, no_channel_law
from netkf.theory.common.plant_assumptions import slot_plant_rows, start_rows
from netkf.theory.intermittent.riccati import (
    contraction_radius,
    critical_probability,
    undetectable_slot_mode,
)

# Subsets of the senders are enumerated: 2^8 are quick.
MAX_LISTED, MAX_HEARD = 12, 8
BOUNDED_MEAN = "readings arrive often enough for a bounded mean (sufficient)"


def slot_rows(scenario: Scenario) -> list[AssumptionRow]:
    """Return the assumptions of the paper on intermittent observations as rows of the table."""
    return [
        *slot_plant_rows(scenario),
        *_detectability_rows(scenario),
        *_arrival_rows(scenario),
        *start_rows(scenario, "G (10)"),
    ]


def _reachable_readings(scenario: Scenario) -> dict[int, FloatArray]:
    """Return by node the stacked H (p, n) of all readings that can reach it."""
    # Readings travel one link only: R relays nothing.
    neighbours: dict[int, set[int]] = {node: {node} for node in scenario.nodes}
    for i, j in scenario.topology.directions:
        neighbours[j].add(i)
    return {
        node: np.concatenate([scenario.observation_matrices(peer)[0] for peer in sorted(peers)])
        for node, peers in neighbours.items()
    }


def _detectability_rows(scenario: Scenario) -> list[AssumptionRow]:
    F = scenario.linear_plant.F
    name = "(F, H) is detectable at every node"
    try:
        reachable = _reachable_readings(scenario)
    except TheoryError as error:
        return [(name, "R Theorem 9", None, f"not decided: {error}")]
    failing = [node for node, H in reachable.items() if undetectable_slot_mode(F, H) is not None]
    evidence = "its own readings and its neighbours' see every mode that does not decay"
    if failing:
        several, listed = "s" if len(failing) > 1 else "", ", ".join(map(str, failing[:MAX_LISTED]))
        evidence = f"not at node{several} {listed}"
    return [(name, "R Theorem 9", not failing, evidence)]


def _arrival_rows(scenario: Scenario) -> list[AssumptionRow]:
    channel = scenario.network.channel
    # R (12) needs independent arrivals of positive probability.
    rates = [scenario.mean_delivery(link) for link in scenario.topology.directions]
    smallest = min(rates, default=1.0)
    holds: bool | None = channel.independent and smallest > 0.0
    evidence = f"delivery from {smallest:g}" if channel.independent else "losses come in bursts"
    if lacks_channel_law(scenario):
        # A recording has no probabilities: the assumption is neither true nor false.
        holds, evidence = None, no_channel_law(scenario)
    name = "arrivals are independent of each other and of the past, and not impossible"
    rows: list[AssumptionRow] = [(name, "R (12), Theorem 9", holds, evidence)]
    if any(sensor.varying for sensor in scenario.sensors):
        return rows
    if channel.independent and not np.isnan(rates).any():
        rows.append(_bounded_mean_row(scenario))
    return rows


def _bounded_mean_row(scenario: Scenario) -> AssumptionRow:
    F, sensing = scenario.linear_plant.F, set(scenario.sensing_nodes)
    least_sufficient: tuple[float, int, list[float]] | None = None
    for node, H in _reachable_readings(scenario).items():
        own_H, _ = scenario.observation_matrices(node)
        # Nodes that need no message, and those that no message can help, say nothing about (32).
        if undetectable_slot_mode(F, own_H) is None or undetectable_slot_mode(F, H) is not None:
            continue
        heard = [(i, j) for i, j in scenario.topology.directions if j == node and i in sensing]
        if len(heard) > MAX_HEARD:
            evidence = f"not decided: node {node} hears {len(heard)} sensors"
            return (BOUNDED_MEAN, "R (32)", None, evidence)
        radius = contraction_radius(F, _arrival_sets(scenario, own_H, heard))
        if least_sufficient is None or radius > least_sufficient[0]:
            least_sufficient = radius, node, _deliveries(scenario, heard)
    if least_sufficient is None:
        return (BOUNDED_MEAN, "R (32)", True, "every node sees enough by itself")
    radius, node, deliveries = least_sufficient
    evidence = (
        f"node {node}: the best gains multiply mean squares by {radius:.6g} a slot (below 1 is "
        f"sufficient), delivery from {min(deliveries):g}"
    )
    if len(deliveries) == 1:
        lower, upper = critical_probability(F, _reachable_readings(scenario)[node])
        evidence += f", critical probability in [{lower:.6g}, {upper:.6g}] by R (31), (32)"
    evidence += "; below it P is still stochastically bounded, its mean may not be"
    return (BOUNDED_MEAN, "R (32)", contracts(radius), evidence)


def _deliveries(scenario: Scenario, heard: list[tuple[int, int]]) -> list[float]:
    return [scenario.mean_delivery(link) for link in heard]


def _arrival_sets(
    scenario: Scenario, own_H: FloatArray, heard: list[tuple[int, int]]
) -> list[tuple[float, FloatArray]]:
    """Return each set of readings that may reach a node: probability and H (p, n)."""
    sets, probabilities = [], _deliveries(scenario, heard)
    # All 2^k outcomes of the k links, which fail independently.
    for arrived in itertools.product((False, True), repeat=len(heard)):
        p = np.prod([g if up else 1.0 - g for g, up in zip(probabilities, arrived, strict=True)])
        arrived_H = [
            scenario.observation_matrices(i)[0]
            for (i, _), up in zip(heard, arrived, strict=True)
            if up
        ]
        sets.append((float(p), np.concatenate([own_H, *arrived_H])))
    return sets
