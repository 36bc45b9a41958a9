"""The table of assumptions: those of the theorems, checked on a scenario with evidence."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from netkf.core.printable import count_phrase
from netkf.network.clocks import LinkClock, RecordedClock
from netkf.network.recorded import RecordedDelay, RecordedLoss
from netkf.scenario.registry import name_of
from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import (
    TRUE_MODEL,
    AssumptionRow,
    judge_plant,
    life_rows,
    no_channel_law,
    nonlinear_rows,
    true_model_row,
)
from netkf.theory.common.plant_assumptions import (
    connected_row,
    judge_driven,
    judge_observed,
    model_and_start_rows,
    slot_plant_rows,
    start_rows,
)
from netkf.theory.folders import theory_of
from netkf.theory.hybrid.coupled import concerns_hybrid_paper, has_balanced_rates
from netkf.theory.hybrid.samples import (
    randomly_sampled_sensors,
    sampling_clock,
    transmits_at_samples,
)

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = ["assumption", "source", "holds", "evidence"]
CONSTANT = "the plant does not change"
ANY = "any filter"
"""The source of assumptions that no paper makes for the scenario's filter."""


def assumptions(scenario: Scenario) -> pd.DataFrame:
    """Return a table with a row for each assumption: assumption, source, holds, evidence.

    ``holds`` is None where it is not known. The paper of the scenario's filter decides which
    assumptions there are.
    """
    import pandas as pd

    return pd.DataFrame(assumption_rows(scenario), columns=COLUMNS)


def assumption_rows(scenario: Scenario) -> list[AssumptionRow]:
    """Return a row for each assumption: text, equation, whether it holds, and why; of the last
    piece of a plant that changes, but for the filters' model.
    """
    changes = scenario.plant.changes
    if len(changes):
        first = f"at {changes[0]:g} s" if len(changes) == 1 else f"{len(changes)} times"
        evidence = f"it changes {first}; rows on the plant are of that from {changes[-1]:g} s on"
        rows = [row for row in assumption_rows(scenario.last_piece) if row[0] != TRUE_MODEL]
        known = true_model_row(scenario, ANY, "the same matrices at all times")
        return [(CONSTANT, ANY, False, evidence), known, *rows]
    nonlinear = [*life_rows(scenario), *nonlinear_rows(scenario)]
    if not scenario.plant.linear:
        return [*nonlinear, *start_rows(scenario, ANY)]
    paper = theory_of(scenario)
    if not scenario.slotted:
        rows = _clock_rows(scenario)
    elif paper.slot_rows is not None:
        rows = paper.slot_rows(scenario)
    elif paper.slot_conditions is not None:
        conditions = paper.slot_conditions(scenario)
        rows = model_and_start_rows(scenario, conditions[0][1], *conditions)
    else:
        rows = [*slot_plant_rows(scenario), *start_rows(scenario, "G (10)")]
    return [*nonlinear, *rows]


def _clock_rows(scenario: Scenario) -> list[AssumptionRow]:
    if not concerns_hybrid_paper(scenario):
        # Of what H assumes, this decides about errors of every filter.
        rows = [*_plant_rows(scenario), *start_rows(scenario, ANY)]
        if scenario.filter.algorithm.timing.talks:
            rows = [_reach_row(scenario), *_weight_rows(scenario), *rows]
        return [
            (name, ANY if source.startswith("H ") else source, holds, evidence)
            for name, source, holds, evidence in rows
        ]
    rows = [*_plant_rows(scenario), *_sampling_rows(scenario)]
    if scenario.filter.algorithm.timing.talks:
        network = [*_link_clock_rows(scenario), *_channel_rows(scenario)]
        rows = [connected_row(scenario, "H II-B a"), *_weight_rows(scenario), *rows, *network]
    return [*rows, *start_rows(scenario, "H (9), (10)")]


def _weight_rows(scenario: Scenario) -> list[AssumptionRow]:
    rows = theory_of(scenario).weight_rows
    return [] if rows is None else rows(scenario)


def _reach_row(scenario: Scenario) -> AssumptionRow:
    import networkx

    topology = scenario.topology
    graph = networkx.DiGraph(topology.directions)
    graph.add_nodes_from(topology.nodes)
    parts = networkx.number_strongly_connected_components(graph)
    counts = {"node": len(topology.nodes), "link": len(topology.links)}
    evidence = ", ".join(count_phrase(count, what) for what, count in counts.items())
    evidence += ", directed" if topology.directed else ""
    if parts > 1:
        evidence += f"; {parts} groups of nodes that reach each other both ways"
    return ("every node can hear of every other, over others", ANY, parts == 1, evidence)


def _plant_rows(scenario: Scenario) -> list[AssumptionRow]:
    plant = scenario.diffusion
    observed: tuple[bool | None, str] = None, "H differs from reading to reading"
    if not any(sensor.varying for sensor in scenario.sensors):
        observed = judge_plant(scenario, *judge_observed(scenario, plant.A))
    driven = judge_plant(scenario, *judge_driven(plant.A, plant.Q))
    return [
        ("(A, B) is controllable", "H II-A", *driven),
        ("(A, H) is observable, all sensors together", "H II-A", *observed),
        true_model_row(scenario, "H (4)", "same A, B and R"),
    ]


def _sampling_rows(scenario: Scenario) -> list[AssumptionRow]:
    """Return the row that sensors sample at Poisson or at known times; none without samples."""
    if not scenario.sampled_sensors:
        return []
    name = "sensors sample by Poisson clocks or at known times"
    source = "derived, docs/poisson_samples.md"
    for node, placed_sensor in randomly_sampled_sensors(scenario):
        clock = sampling_clock(scenario.sensors[placed_sensor.entry])
        if clock is None or not clock.memoryless:
            evidence = f"node {node} samples by another random clock: the bound is not promised"
            return [(name, source, False, evidence)]
    return [(name, source, True, "the bound on the mean of P then has them")]


def _link_clock_rows(scenario: Scenario) -> list[AssumptionRow]:
    clock = scenario.network.activation
    assert isinstance(clock, LinkClock)
    if transmits_at_samples(scenario):
        evidence = "nodes transmit when they have sampled, see the row about sensors that sample"
        return [("nodes transmit at independent Poisson processes", "H II-B b", None, evidence)]
    entities, entity_kind = clock.entities(scenario.topology), clock.at
    rates = np.array([clock.mean_rate(entity) for entity in entities])
    # A recorded clock has no rates beforehand: mean_rate is then nan.
    known_rates = rates[np.isfinite(rates)]
    unknown = len(known_rates) < len(rates)
    positive = None if unknown else bool((known_rates > 0.0).all())
    name, record = name_of("activation", clock), isinstance(clock, RecordedClock)
    spread = (
        f"{known_rates.min():g} .. {known_rates.max():g} per second"
        if known_rates.size
        else "no rate known"
    )
    if unknown:
        spread = f"a {name} clock does not tell its rates beforehand"
    elif known_rates.size and np.ptp(known_rates) == 0.0:
        spread = f"{known_rates[0]:g} per second on every {entity_kind[:-1]}"
    return [
        (f"the rates of all {entity_kind} are positive", "H II-B b", positive, spread),
        (
            f"the {entity_kind[:-1]} clocks are independent Poisson processes",
            "H II-B b, Theorem 2",
            None if record else clock.memoryless,
            "exponential gaps"
            if clock.memoryless
            else "a record is one outcome, not a law: H(12) is not promised"
            if record
            else f"the gaps of a {name} clock are not exponential: H(12) is not promised",
        ),
        (
            f"all {entity_kind} have one rate",
            "H Theorem 3",
            None if unknown else not rates.size or bool(np.ptp(rates) == 0.0),
            f"{spread}; the limit does not need it when the rates grow together",
        ),
    ]


def _channel_rows(scenario: Scenario) -> list[AssumptionRow]:
    channel = scenario.network.channel
    # Thinning a Poisson process by independent losses gives a Poisson process of lower rate, and a
    # fixed delay only shifts it; a random delay or dependent losses do neither.
    fixed, symmetric = channel.delay.fixed, has_balanced_rates(scenario)
    is_unknown = isinstance(channel.loss, RecordedLoss) or scenario.network_changes
    return [
        (
            "losses are independent of each other and of the past",
            "H Theorem 2, derived",
            None if is_unknown else channel.independent,
            no_channel_law(scenario)
            if scenario.network_changes
            else "arrivals are Poisson processes of lower rates"
            if channel.independent
            else "losses are recorded or depend on earlier ones: H(12) is not promised",
        ),
        (
            "messages take no time, or one fixed time",
            "H (7), derived",
            None
            if isinstance(channel.delay, RecordedDelay)
            else fixed is not None and not scenario.messages_queue,
            "messages wait for those before them: H(12) is not promised"
            if scenario.messages_queue
            else "random or recorded delay: H(12) is not promised"
            if fixed is None
            else "no delay"
            if fixed == 0.0
            else f"{fixed:g} s; covariances are predicted to their arrival",
        ),
        (
            "both directions of a link arrive at one rate",
            "H (12), (13)",
            symmetric,
            "not known beforehand"
            if symmetric is None
            else "the limit is S"
            if symmetric
            else "the limit is not S but weighs the nodes differently",
        ),
    ]
