"""Rows of the table of assumptions, and verdicts where data come from records.

A record is one outcome and does not show the law that it came from: the verdict is then None.
"""

from __future__ import annotations

import math
from functools import lru_cache

from netkf.core.errors import TheoryError
from netkf.network.recorded import RecordedDelay, RecordedLoss
from netkf.runs.labels import forgetting
from netkf.scenario.model import EVERY_READING, HEALTHY
from netkf.scenario.scenario import Scenario
from netkf.theory.common.faults import fault_evidence

AssumptionRow = tuple[str, str, bool | None, str]
"""assumption, source, holds (None: not known), evidence."""

UNKNOWN_LAW = "the state or readings are recorded: their law is not known"
FOLLOWS_DATA = "not linear in the state: gains, P and errors follow the data"
LIVES = "nodes are down at times (network.lives)"
CONSISTENCY = "netkf consistency compares P with the errors of many runs"
MEMORY = "nodes keep what they know"
TRUE_MODEL = "the filters know the plant and the sensors"


def nonlinear_rows(scenario: Scenario) -> list[AssumptionRow]:
    """Return a row for each of dynamics and readings that are not linear, and departures."""
    parts = {"dynamics": scenario.plant.linear, "readings": scenario.has_linear_sensors}
    rows: list[AssumptionRow] = [
        (f"{part} are linear in the state", "all papers", False, f"{part} are {FOLLOWS_DATA}")
        for part, is_linear in parts.items()
        if not is_linear
    ]
    details = {EVERY_READING: _refused_spread, HEALTHY: fault_evidence}
    return rows + [
        (name, "all papers", False, evidence + (details[name](scenario) if name in details else ""))
        for name, evidence in scenario.departures
    ]


def _refused_spread(scenario: Scenario) -> str:
    gate = scenario.filter.gate
    if gate is None or gate.then != "ignore":
        return ""
    sizes = sorted(
        {len(scenario.noise_covariance(k, believed=True)) for k in range(len(scenario.sensors))}
    )
    spreads = ", ".join(f"{gate.refused_spread(p):.4g} for p = {p}" for p in sizes)
    return (
        f"; after a healthy one that is ignored the error covariance is P + (g - 1) K S K', "
        f"g = {spreads}"
    )


def life_rows(scenario: Scenario) -> list[AssumptionRow]:
    """Return rows on nodes that are down at times; [] without ``network.lives``."""
    rows: list[AssumptionRow] = []
    if scenario.network.lives:
        evidence = f"{LIVES}: equations hold along the events, bounds on the law of arrivals do not"
        rows.append(("nodes are up all the time", "all papers", False, evidence))
    if scenario.forgetful_nodes:
        rows.append((MEMORY, "all papers", False, forgetting(scenario)))
    return rows


def require_linear(scenario: Scenario, accepted: tuple[str, ...] = ()) -> None:
    """Raise TheoryError for what is not linear, or departs and is not ``accepted``."""
    for assumption, *_, evidence in nonlinear_rows(scenario):
        if assumption not in accepted:
            raise TheoryError(evidence)


def require_every_reading(scenario: Scenario) -> None:
    """Raise TheoryError if nodes are down at times, and do not read then."""
    if scenario.network.lives:
        raise TheoryError(f"{LIVES}: what they read then is missing")


def no_channel_law(scenario: Scenario) -> str:
    """Return why it is not known how often messages arrive, where :func:`lacks_channel_law`."""
    if scenario.network_changes and not scenario.links_move:
        reason = "nodes are down at times, or messages wait for each other"
    elif scenario.network_changes or _is_recorded(scenario):
        reason = "losses or delays are recorded, or nodes move"
    else:
        return "how often messages arrive is not known beforehand"
    return f"{reason}: what arrives has no known law"


@lru_cache(maxsize=8)
def lacks_channel_law(scenario: Scenario) -> bool:
    """Return True if outcomes are recorded, nodes move or are down, or the loss has no law."""
    unstated = (math.isnan(scenario.mean_delivery(link)) for link in scenario.topology.directions)
    return _is_recorded(scenario) or scenario.network_changes or any(unstated)


def _is_recorded(scenario: Scenario) -> bool:
    channel = scenario.network.channel
    return isinstance(channel.loss, RecordedLoss) or isinstance(channel.delay, RecordedDelay)


def true_model_row(scenario: Scenario, source: str, matrices: str) -> AssumptionRow:
    """Return the row of ``source`` that the filters' model is the true one; None for records."""
    if not scenario.is_random:
        return TRUE_MODEL, source, None, UNKNOWN_LAW
    same = scenario.filters_know_the_truth
    wrong = "filter.model differs from the truth"
    if len(scenario.plant.changes) and not scenario.filter.model.schedule:
        wrong = "filters do not know that the plant changes, and keep its first matrices"
    return TRUE_MODEL, source, same, matrices if same else wrong


def judge_plant(scenario: Scenario, holds: bool, evidence: str) -> tuple[bool | None, str]:
    """Return ``holds`` and ``evidence`` about the plant; None where the state is recorded."""
    if scenario.plant.is_random:
        return holds, evidence
    return None, f"assumed, not known: {evidence}"
