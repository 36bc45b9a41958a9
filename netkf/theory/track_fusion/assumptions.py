"""Assumptions under which P of track fusion is no smaller than the covariance of the error."""

from __future__ import annotations

from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import AssumptionRow
from netkf.theory.common.plant_assumptions import model_and_start_rows
from netkf.theory.common.random_links import all_messages_arrive


def slot_rows(scenario: Scenario) -> list[AssumptionRow]:
    """Return the assumptions, as rows of the table, about the model and the first covariances."""
    analysis = scenario.node_filter.analysis
    source, rows = analysis.source, model_and_start_rows(scenario, analysis.source)
    if analysis.P_by_design[0] != "equal":
        return rows
    lossless = all_messages_arrive(scenario)
    evidence = "every message arrives in its slot" if lossless else "P depends on who is heard"
    return [*rows, ("no message is lost", source, lossless, evidence)]
