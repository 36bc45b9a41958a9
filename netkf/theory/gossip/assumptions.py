"""Assumptions of G on a scenario in slots: C.1, S.1, D.1."""

from __future__ import annotations

from netkf.core.errors import TheoryError
from netkf.core.printable import list_some
from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import AssumptionRow
from netkf.theory.common.plant_assumptions import slot_plant_rows, start_rows
from netkf.theory.common.random_links import all_messages_arrive, both_or_none
from netkf.theory.gossip.matchings import detecting_walk, mean_swaps, period_of

MAX_LISTED = 12  # matchings that a row names


def slot_rows(scenario: Scenario) -> list[AssumptionRow]:
    """Return the assumptions of the gossip paper as rows of the table."""
    return [
        *_matching_rows(scenario),
        *slot_plant_rows(scenario),
        *_walk_rows(scenario),
        *_swap_rows(scenario),
        *start_rows(scenario, "G (10)"),
    ]


def _matching_rows(scenario: Scenario) -> list[AssumptionRow]:
    name = "the mean matching is irreducible and aperiodic"
    try:
        mean = mean_swaps(scenario)
    except TheoryError as error:
        return [(name, "G C.1", None, f"not decided: {error}")]
    # Irreducible and aperiodic together mean that some power of the matrix is positive (C.1).
    period = period_of(mean)
    if not period:
        evidence = "some nodes are never reached from others"
    elif period > 1:
        evidence = (
            f"it has period {period}: tokens visit the two halves of the network in turn, and "
            "filters can blow up though every sensor is observable"
        )
    else:
        evidence = f"least positive entry {mean[mean > 0.0].min():.3g}"
    return [(name, "G C.1", period == 1, evidence)]


def _walk_rows(scenario: Scenario) -> list[AssumptionRow]:
    name = "some walk on the network detects the state (weak detectability)"
    try:
        walk = detecting_walk(scenario)
    except TheoryError as error:
        return [(name, "G D.1", None, f"not decided: {error}")]
    evidence = (
        "no walk of up to 40 steps has an invertible Gramian; D.1 is sufficient, not necessary: a "
        "mode that decays by itself need not be seen"
    )
    if walk is not None:
        evidence = f"the Gramian of the walk ({list_some(walk, MAX_LISTED)}) is invertible"
    return [(name, "G D.1", walk is not None, evidence)]


def _swap_rows(scenario: Scenario) -> list[AssumptionRow]:
    # A swap needs both messages: if one is lost, its pair exists twice and the other is gone.
    holds = both_or_none(scenario)
    evidence = (
        "not known: outcomes of the two messages of a pair may differ"
        if holds is None
        else "one of two messages may be lost: a pair is then copied and the other one is gone, so "
        "tokens are no permutation any more"
        if not holds
        else "nothing is lost"
        if all_messages_arrive(scenario)
        else "both messages of a pair are lost together: a swap or none"
    )
    return [("every exchange is a swap", "G (10)", holds, evidence)]
