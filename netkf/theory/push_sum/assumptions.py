"""The assumptions and theorems of P about a scenario with the push-sum filter."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from netkf.core.errors import TheoryError
from netkf.network.matchings import Broadcast
from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import AssumptionRow, true_model_row
from netkf.theory.numerics.matrices import unobservable_mode
from netkf.theory.push_sum.averaging import Averaging
from netkf.theory.push_sum.certified_gamma import Moment, minimum_gamma
from netkf.theory.push_sum.disconnection import disconnection_probability
from netkf.theory.push_sum.estimation_steps import averaging_law, estimation_steps
from netkf.theory.push_sum.limits import consensus_gain_bound, push_sum_filter
from netkf.theory.push_sum.mean_square import mean_radius, push_sum_radius

HEAVY = 0.885


def slot_rows(scenario: Scenario) -> list[AssumptionRow]:
    """(assumption, source, holds, evidence) of each."""
    return [
        *_plant(scenario),
        *_links(scenario),
        *_gain(scenario),
        _stop(scenario),
        *_moments(scenario),
    ]


def _plant(scenario: Scenario) -> list[AssumptionRow]:
    F, Q = scenario.slot_belief
    idle = unobservable_mode(F.T, Q)
    rows: list[AssumptionRow] = [
        (
            "(F, Q^1/2) is controllable",
            "P Assumption 2",
            idle is None,
            "every mode is driven by the noise"
            if idle is None
            else f"the mode with eigenvalue {idle:.6g} is not driven; P_inf needs only "
            "those that do not decay",
        )
    ]
    if not any(sensor.varying for sensor in scenario.sensors):
        rows.append(_sight(scenario))
    return [*rows, true_model_row(scenario, "P (7), (8)", "same F, Q and R")]


def _sight(scenario: Scenario) -> AssumptionRow:
    F, _ = scenario.slot_belief
    informations = [model.information for model in scenario.slot_models]
    hidden = unobservable_mode(F, np.sum(informations, axis=0))
    alone = sum(unobservable_mode(F, G) is None for G in informations)
    words = f"every mode is seen; {alone} of {len(informations)} nodes see all alone"
    if hidden is not None:
        words = (
            f"the mode with eigenvalue {hidden:.6g} is not seen; a mode that decays does no harm"
        )
    return "(F, H) is observable, all sensors together", "P Assumption 2", hidden is None, words


def _links(scenario: Scenario) -> list[AssumptionRow]:
    topology, channel = scenario.topology, scenario.network.channel
    parts = len(topology.components)
    filter_ = push_sum_filter(scenario)
    rows: list[AssumptionRow] = [
        (
            "the graph is undirected and connected",
            "P Assumption 1",
            parts == 1 and not topology.directed,
            f"{len(topology.nodes)} nodes, {len(topology.links)} links, {parts} part"
            + ("" if parts == 1 else "s"),
        )
    ]
    held = filter_.links == "held" and filter_.gamma > 1
    law: Averaging | None
    independent: bool | None
    try:
        law, independent, words = averaging_law(scenario), not held, "each link, slot and step anew"
    except TheoryError as error:
        law, independent, words = None, None, str(error)
    if held and law is not None:
        words = (
            "one draw holds for all steps of a slot: nodes that are cut off stay so, and Theorems "
            "4 to 6 do not apply"
        )
    rows.append(("links fail anew in each averaging step", "P Assumption 3", independent, words))
    together = channel.symmetric
    if law is not None:
        together = bool(np.array_equal(law.hears[:, 0], law.hears[:, 1])) and bool(
            np.allclose(law.both, law.hears[:, 0])
        )
    words = (
        "one fate for both"
        if together
        else ("mass is lost or copied, so that the numbers N^(i) are random in the limit")
    )
    rows.append(("both directions of a link fail together", "P Assumption 3", together, words))
    try:
        cut = disconnection_probability(scenario)
    except TheoryError as error:
        return [
            *rows,
            ("p_d < 1: the network is whole at times", "P Assumption 3", None, str(error)),
        ]
    words = f"p_d = {float(cut):.6g}" if cut.exact else f"p_d in [{cut.low:.4g}, {cut.high:.4g}]"
    return [*rows, ("p_d < 1: the network is whole at times", "P Assumption 3", cut < 1.0, words)]


def _gain(scenario: Scenario) -> list[AssumptionRow]:
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


def _stop(scenario: Scenario) -> AssumptionRow:
    filter_, loss = push_sum_filter(scenario), scenario.network.channel.loss
    lossless = isinstance(scenario.network.activation, Broadcast) and all(
        loss.mean_delivery(way, scenario.table_probability(way)) == 1.0
        for i, j in scenario.topology.links
        for way in ((i, j), (j, i))
    )
    safe = filter_.stop != "paper" or filter_.asymptotic or lossless
    words = {
        "never": "mass is exchanged for ever",
        "safe": "gains freeze only after all own links were up and nothing moved",
        "paper": "nothing fails",
    }[filter_.stop]
    if not safe:
        words = "it fires when all links of a node fail in one slot, and its gain stays wrong"
    elif filter_.asymptotic:
        words = "the gains are the asymptotic ones from the start"
    return "no gain is frozen before its time", "P step 2.3", safe, words


def _moments(scenario: Scenario) -> list[AssumptionRow]:
    return [
        _exact(
            ("the estimates become unbiased", "P (30), derived"),
            lambda: mean_radius(estimation_steps(scenario)),
        ),
        _certified(scenario, "mean", "P Theorem 5"),
        _exact(
            ("the errors stay bounded in the mean square", "P Lemma 10, derived"),
            lambda: push_sum_radius(scenario),
            heavy=True,
        ),
        _certified(scenario, "mean-square", "P Theorem 6"),
    ]


def _exact(
    name: tuple[str, str], measure: Callable[[], float], heavy: bool = False
) -> AssumptionRow:
    try:
        found = measure()
    except TheoryError as error:
        return *name, None, f"not decided: {error}"
    words = f"exact radius {found:.6g} at the asymptotic gains; necessary and sufficient"
    if heavy and found >= 1.0:
        words += "; single paths may still stay bounded in probability"
    elif heavy and found > HEAVY:
        words += f"; above {HEAVY} averages over runs have heavy tails and no honest interval"
    return *name, found < 1.0, words


def _certified(scenario: Scenario, moment: Moment, source: str) -> AssumptionRow:
    gamma = push_sum_filter(scenario).gamma
    name = f"gamma is certified for the {moment.replace('-', ' ')}"
    try:
        least = minimum_gamma(scenario, moment)
    except TheoryError as error:
        return name, source, False, str(error)
    words = f"gamma {gamma}, certified from {least:,} on; sufficient, by far not necessary"
    return name, source, gamma >= least, words
