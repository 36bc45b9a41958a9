"""Assumptions under which P of track fusion is no smaller than the covariance of the error."""

from __future__ import annotations

from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import AssumptionRow
from netkf.theory.common.plant_assumptions import model_and_start_rows
from netkf.theory.common.random_links import all_messages_arrive

SOURCES = {
    "best intersection": "Julier and Uhlmann 1997",
    "inverse intersection": "Noack et al. 2017",
    "tracks": "Bar-Shalom and Campo 1986",
}


def slot_rows(scenario: Scenario) -> list[AssumptionRow]:
    """Return the assumptions, as rows of the table, about the model and the first covariances."""
    source = SOURCES[scenario.node_filter.analysis.combination]
    rows = model_and_start_rows(scenario, source)
    if scenario.node_filter.analysis.combination != "tracks":
        return rows
    lossless = all_messages_arrive(scenario)
    evidence = "every message arrives in its slot" if lossless else "P depends on who is heard"
    return [*rows, ("no message is lost", source, lossless, evidence)]
