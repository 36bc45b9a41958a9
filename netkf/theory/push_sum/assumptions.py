"""Assumptions and theorems of P on a scenario with the push-sum filter."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from netkf.core.errors import TheoryError
from netkf.linalg.spectra import contracts
from netkf.network.matchings import Broadcast
from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import AssumptionRow, true_model_row
from netkf.theory.common.plant_assumptions import connected_row, judge_driven, judge_observed
from netkf.theory.common.random_links import both_or_none
from netkf.theory.push_sum.averaging import Averaging
from netkf.theory.push_sum.certified_gamma import Moment, minimum_gamma
from netkf.theory.push_sum.disconnection import disconnection_probability
from netkf.theory.push_sum.estimation_steps import averaging_law, estimation_steps
from netkf.theory.push_sum.limits import consensus_gain_bound, push_sum_filter
from netkf.theory.push_sum.mean_square import mean_radius, push_sum_radius

HEAVY_TAIL_RADIUS = 0.885  # above it mean squares over runs have no useful interval


def slot_rows(scenario: Scenario) -> list[AssumptionRow]:
    """Return the assumptions of the push-sum paper as rows of the table."""
    (F, Q), source = scenario.slot_belief, "P Assumption 2"
    driven = judge_driven(F, Q, "; P_inf needs only those that do not decay")
    rows: list[AssumptionRow] = [("(F, Q^1/2) is controllable", source, *driven)]
    if not any(sensor.varying for sensor in scenario.sensors):
        seen = judge_observed(scenario, F, "; a mode that decays does no harm")
        rows.append(("(F, H) is observable, all sensors together", source, *seen))
    return [
        *rows,
        true_model_row(scenario, "P (7), (8)", "same F, Q and R"),
        *_link_rows(scenario),
        *_gain_rows(scenario),
        _stop_row(scenario),
        *_moment_rows(scenario),
    ]


def _link_rows(scenario: Scenario) -> list[AssumptionRow]:
    law: Averaging | None  # with which probabilities links are up; None if there is no such law
    try:
        law, reason = averaging_law(scenario), ""
    except TheoryError as error:
        law, reason = None, str(error)
    return [
        connected_row(scenario, "P Assumption 1"),
        _fresh_links_row(scenario, law, reason),
        _joint_failure_row(scenario, law),
        _connection_row(scenario),
    ]


def _fresh_links_row(scenario: Scenario, law: Averaging | None, reason: str) -> AssumptionRow:
    """Return the row that links fail anew in each step; ``reason`` says why ``law`` is None."""
    name, source = "links fail anew in each averaging step", "P Assumption 3"
    filter_ = push_sum_filter(scenario)
    if law is None:
        return name, source, None, reason
    if filter_.links == "held" and filter_.gamma > 1:
        evidence = (
            "one draw holds for all steps of a slot: nodes that are cut off stay so, and Theorems "
            "4 to 6 do not apply"
        )
        return name, source, False, evidence
    return name, source, True, "each link, slot and step anew"


def _joint_failure_row(scenario: Scenario, law: Averaging | None) -> AssumptionRow:
    joint = both_or_none(scenario) if law is None else None
    if law is not None:
        # Both directions have one probability, and each is up exactly if both are.
        joint = bool(np.array_equal(law.hears[:, 0], law.hears[:, 1])) and bool(
            np.allclose(law.both, law.hears[:, 0])
        )
    evidence = (
        "one fate for both"
        if joint
        else "not known: outcomes of the two directions may differ"
        if joint is None
        else "mass is lost or copied, so that the numbers N^(i) are random in the limit"
    )
    return "both directions of a link fail together", "P Assumption 3", joint, evidence


def _connection_row(scenario: Scenario) -> AssumptionRow:
    name, source = "p_d < 1: the network is whole at times", "P Assumption 3"
    try:
        cut = disconnection_probability(scenario)
    except TheoryError as error:
        return name, source, None, str(error)
    interval = f"[{cut.low:.4g}, {cut.high:.4g}]"
    evidence = f"p_d = {float(cut):.6g}" if cut.exact else f"p_d in {interval}"
    return name, source, cut < 1.0, evidence


def _gain_rows(scenario: Scenario) -> list[AssumptionRow]:
    # One step multiplies disagreement by I - L / delta, of norm below 1 for delta > rho(L) / 2.
    delta, bound = push_sum_filter(scenario).delta, consensus_gain_bound(scenario)
    local = f"nodes can tell from degrees that rho(L) <= {min(bound.local, bound.nodes)}"
    return [
        (
            "delta > rho(L)",
            "P Theorems 3 to 6",
            delta > bound.radius,
            f"delta {delta:g}, rho(L) {bound.radius:.6g}; {local}. Sufficient; often not the best",
        ),
        (
            "delta > rho(L)/2: averaging contracts",
            "derived",
            delta > 0.5 * bound.radius,
            f"delta / rho(L) = {delta / bound.radius if bound.radius else math.inf:.4g}",
        ),
    ]


def _stop_row(scenario: Scenario) -> AssumptionRow:
    filter_ = push_sum_filter(scenario)
    lossless = isinstance(scenario.network.activation, Broadcast) and all(
        scenario.mean_delivery(direction) == 1.0
        for i, j in scenario.topology.links
        for direction in ((i, j), (j, i))
    )
    # P step 2.3 stops when masses no longer move, which also happens when all links are down.
    safe = filter_.stop != "paper" or filter_.asymptotic or lossless
    evidence = {
        "never": "mass is exchanged for ever",
        "safe": "gains freeze only after all own links were up and nothing moved",
        "paper": "nothing fails",
    }[filter_.stop]
    if not safe:
        evidence = "it fires when all links of a node fail in one slot, and its gain stays wrong"
    elif filter_.asymptotic:
        evidence = "the gains are the asymptotic ones from the start"
    return "no gain is frozen before its time", "P step 2.3", safe, evidence


def _moment_rows(scenario: Scenario) -> list[AssumptionRow]:
    return [
        _exact_row(
            ("the estimates become unbiased", "P (30), derived"),
            lambda: mean_radius(estimation_steps(scenario)),
        ),
        _certified_row(scenario, "mean", "P Theorem 5"),
        _exact_row(
            ("the errors stay bounded in the mean square", "P Lemma 10, derived"),
            lambda: push_sum_radius(scenario),
            heavy=True,
        ),
        _certified_row(scenario, "mean-square", "P Theorem 6"),
    ]


def _exact_row(
    name: tuple[str, str], measure: Callable[[], float], heavy: bool = False
) -> AssumptionRow:
    try:
        radius = measure()
    except TheoryError as error:
        return *name, None, f"not decided: {error}"
    evidence = f"exact radius {radius:.6g} at the asymptotic gains; necessary and sufficient"
    stable = contracts(radius)
    if heavy and not stable:
        evidence += "; single paths may still stay bounded in probability"
    elif heavy and radius > HEAVY_TAIL_RADIUS:
        evidence += f"; above {HEAVY_TAIL_RADIUS} averages over runs have heavy tails "
        evidence += "and no valid interval"
    return *name, stable, evidence


def _certified_row(scenario: Scenario, moment: Moment, source: str) -> AssumptionRow:
    gamma = push_sum_filter(scenario).gamma
    name = f"gamma is certified for the {moment.replace('-', ' ')}"
    try:
        certified_gamma = minimum_gamma(scenario, moment)
    except TheoryError as error:
        return name, source, False, str(error)
    evidence = (
        f"gamma {gamma}, certified from {certified_gamma:,} on; sufficient, by far not necessary"
    )
    return name, source, gamma >= certified_gamma, evidence
