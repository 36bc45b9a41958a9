"""Assumptions under which P of consensus plus innovations is the covariance of the error."""

from __future__ import annotations

from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import AssumptionRow
from netkf.theory.common.plant_assumptions import model_and_start_rows
from netkf.theory.common.random_links import all_messages_arrive

SOURCE = "Das and Moura 2017"
NO_LOSS = "no message is lost"


def slot_rows(scenario: Scenario) -> list[AssumptionRow]:
    """Return the assumptions, as rows of the table, about the model, the messages and the first
    covariances.
    """
    lossless = all_messages_arrive(scenario)
    evidence = "every message arrives in its slot" if lossless else "gains are those without losses"
    return model_and_start_rows(scenario, SOURCE, (NO_LOSS, SOURCE, lossless, evidence))
