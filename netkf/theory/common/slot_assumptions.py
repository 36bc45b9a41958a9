"""The assumptions of G (C.1, S.1, D.1) and of R about scenarios in slots."""

from __future__ import annotations

import itertools

import numpy as np

from netkf.algorithms.diffusion import DiffusionFilter
from netkf.algorithms.gossip import Gossip
from netkf.algorithms.intermittent import Intermittent
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import RECORDED, Row, knowledge, of_the_truth, recorded_channel
from netkf.theory.diffusion.assumptions import diffusion_rows
from netkf.theory.gossip.matchings import (
    detecting_walk,
    effective_matching,
    mean_matching,
    primitive,
)
from netkf.theory.intermittent.riccati import contraction_radius, critical_probability, unseen

SHOWN, MOST_HEARD = 12, 8
OFTEN = "readings arrive often enough for a bounded mean (sufficient)"


def slot_rows(scenario: Scenario) -> list[Row]:
    """(assumption, source, holds, evidence) of each."""
    algorithm = scenario.filter.algorithm
    if isinstance(algorithm, DiffusionFilter):
        return list[Row](diffusion_rows(scenario))
    rows = _plant(scenario)
    if isinstance(algorithm, Gossip):
        return [*_matching(scenario), *rows, *_walk(scenario), *_swaps(scenario)]
    if isinstance(algorithm, Intermittent):
        return [*rows, *_readings(scenario), *_arrivals(scenario)]
    return rows


def _plant(scenario: Scenario) -> list[Row]:
    plant = scenario.slot_plant
    least = float(np.linalg.eigvalsh(plant.Q)[0])
    idle = unseen(plant.F.T, plant.Q)
    words = "every mode that does not decay is driven by the noise"
    if idle is not None:
        words = f"the mode with eigenvalue {idle:.6g} is not driven"
    positive = f"least eigenvalue {least:.3g}; sufficient for the uniqueness of the limit law"
    return [
        (
            "(F, Q^1/2) is stabilisable",
            "G S.1, R Theorem 9",
            *of_the_truth(scenario, idle is None, words),
        ),
        (
            "Q is positive definite",
            "G II-A, R Theorem 9",
            *of_the_truth(scenario, least > 0.0, positive),
        ),
        knowledge(scenario, "G (10), R (15)", "same F, Q and R"),
    ]


def _matching(scenario: Scenario) -> list[Row]:
    name = "the mean matching is irreducible and aperiodic"
    try:
        mean = _mean(scenario)
    except TheoryError as error:
        return [(name, "G C.1", None, f"not decided: {error}")]
    irreducible, aperiodic, period = primitive(mean)
    if not irreducible:
        words = "some nodes are never reached from others"
    elif not aperiodic:
        words = (
            f"it has period {period}: tokens visit the two halves of the network in turn, and "
            "filters can blow up though every sensor is observable"
        )
    else:
        words = f"least positive entry {mean[mean > 0.0].min():.3g}"
    return [(name, "G C.1", irreducible and aperiodic, words)]


def _mean(scenario: Scenario) -> FloatArray:
    """Abar, with the losses where they are known: a lost swap leaves both alone."""
    try:
        return effective_matching(scenario)
    except TheoryError:
        return mean_matching(scenario)


def _walk(scenario: Scenario) -> list[Row]:
    name = "some walk on the network detects the state (weak detectability)"
    try:
        walk = detecting_walk(scenario)
    except TheoryError as error:
        return [(name, "G D.1", None, f"not decided: {error}")]
    if walk is None:
        return [
            (
                name,
                "G D.1",
                False,
                "no walk of up to 40 steps has an invertible Gramian; D.1 is "
                "sufficient, not necessary: a mode that decays by itself need not be seen",
            )
        ]
    shown = ", ".join(map(str, walk[:SHOWN])) + (", ..." if len(walk) > SHOWN else "")
    return [(name, "G D.1", True, f"the Gramian of the walk ({shown}) is invertible")]


def _swaps(scenario: Scenario) -> list[Row]:
    channel = scenario.network.channel
    certain = type(channel.loss).__name__ == "NoLoss"
    holds = certain or channel.symmetric
    words = (
        "nothing is lost"
        if certain
        else "both messages of a pair are lost together: a swap or none"
        if holds
        else "one of two messages may be lost: a pair is then copied and the other one is gone, so "
        "tokens are no permutation any more"
    )
    return [("every exchange is a swap", "G (10)", holds, words)]


def _sight(scenario: Scenario) -> dict[int, FloatArray]:
    """For each node, H of all readings that can reach it."""
    near: dict[int, set[int]] = {node: {node} for node in scenario.nodes}
    for i, j in scenario.topology.directions:
        near[j].add(i)
    return {
        node: np.concatenate([scenario.observation(peer)[0] for peer in sorted(peers)])
        for node, peers in near.items()
    }


def _readings(scenario: Scenario) -> list[Row]:
    F = scenario.slot_plant.F
    name = "(F, H) is detectable at every node"
    try:
        sight = _sight(scenario)
    except TheoryError as error:
        return [(name, "R Theorem 9", None, f"not decided: {error}")]
    blind = [node for node, H in sight.items() if unseen(F, H) is not None]
    words = "its own readings and its neighbours' see every mode that does not decay"
    if blind:
        words = f"not at node{'s' if len(blind) > 1 else ''} {', '.join(map(str, blind[:SHOWN]))}"
    return [(name, "R Theorem 9", not blind, words)]


def _arrivals(scenario: Scenario) -> list[Row]:
    loss = scenario.network.channel.loss
    rates = [
        loss.mean_delivery(link, scenario.measured(link)) for link in scenario.topology.directions
    ]
    known = [rate for rate in rates if np.isfinite(rate)]
    least = min(known, default=1.0)
    rows: list[Row] = [
        (
            "arrivals are independent of each other and of the past, and not impossible",
            "R (12), Theorem 9",
            None
            if recorded_channel(scenario.network.channel)
            else loss.independent and len(known) == len(rates) and least > 0.0,
            RECORDED
            if recorded_channel(scenario.network.channel)
            else f"delivery from {least:g}"
            if loss.independent
            else "losses come in bursts",
        )
    ]
    if any(sensor.varying for sensor in scenario.sensors):
        return rows
    if loss.independent and len(known) == len(rates):
        rows.append(_often_enough(scenario))
    return rows


def _often_enough(scenario: Scenario) -> Row:
    F, sensing = scenario.slot_plant.F, set(scenario.sensing)
    worst: tuple[float, int, list[float]] | None = None
    for node, H in _sight(scenario).items():
        own, _ = scenario.observation(node)
        if unseen(F, own) is None or unseen(F, H) is not None:
            continue
        heard = [(i, j) for i, j in scenario.topology.directions if j == node and i in sensing]
        if len(heard) > MOST_HEARD:
            return (OFTEN, "R (32)", None, f"not decided: node {node} hears {len(heard)} sensors")
        radius = contraction_radius(F, _arriving(scenario, own, heard))
        if worst is None or radius > worst[0]:
            worst = radius, node, _deliveries(scenario, heard)
    if worst is None:
        return (OFTEN, "R (32)", True, "every node sees enough by itself")
    radius, node, deliveries = worst
    words = (
        f"node {node}: the best gains multiply mean squares by {radius:.6g} a slot (below 1 is "
        f"sufficient), delivery from {min(deliveries):g}"
    )
    if len(deliveries) == 1:
        lower, upper = critical_probability(F, _sight(scenario)[node])
        words += f", critical probability in [{lower:.6g}, {upper:.6g}] by R (31), (32)"
    words += "; below it P is still stochastically bounded, its mean may not be"
    return (OFTEN, "R (32)", radius < 1.0, words)


def _deliveries(scenario: Scenario, heard: list[tuple[int, int]]) -> list[float]:
    loss = scenario.network.channel.loss
    return [loss.mean_delivery(link, scenario.measured(link)) for link in heard]


def _arriving(
    scenario: Scenario, own: FloatArray, heard: list[tuple[int, int]]
) -> list[tuple[float, FloatArray]]:
    """Every set of readings that may arrive together: its probability and H."""
    found, chances = [], _deliveries(scenario, heard)
    for arrived in itertools.product((False, True), repeat=len(heard)):
        p = np.prod([g if up else 1.0 - g for g, up in zip(chances, arrived, strict=True)])
        parts = [
            scenario.observation(i)[0] for (i, _), up in zip(heard, arrived, strict=True) if up
        ]
        found.append((float(p), np.concatenate([own, *parts])))
    return found
