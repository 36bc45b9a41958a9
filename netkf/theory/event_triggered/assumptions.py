"""Assumptions under which P of event-triggered consensus on information bounds the error."""

from __future__ import annotations

from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import AssumptionRow
from netkf.theory.common.plant_assumptions import model_and_start_rows
from netkf.theory.common.random_links import all_messages_arrive

SOURCE = "Battistelli et al. 2018"
NO_LOSS = "no message is lost"


def slot_rows(scenario: Scenario) -> list[AssumptionRow]:
    """Return the assumptions, as rows of the table, about the model, the messages and the first
    covariances.
    """
    lossless = all_messages_arrive(scenario)
    evidence = "neighbours have what was sent" if lossless else "a sender does not notice a loss"
    return model_and_start_rows(scenario, SOURCE, (NO_LOSS, SOURCE, lossless, evidence))
