"""Assumptions under which errors under the stochastic event trigger are as large as P says."""

from __future__ import annotations

from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import AssumptionRow
from netkf.theory.common.plant_assumptions import model_and_start_rows
from netkf.theory.stochastic_trigger.errors import UNHEARD, all_hear_all, start_alike

SOURCE = "Han et al. 2015"
HEARD = "every node hears every other, without losses"


def slot_rows(scenario: Scenario) -> list[AssumptionRow]:
    """Return the assumptions, as rows of the table, about the model, the network and the first
    covariances.
    """
    heard = all_hear_all(scenario)
    evidence = "silence is a decision" if heard else UNHEARD
    alike = start_alike(scenario)
    start = "with the same mean and covariance"
    if not alike:
        start = "silence is about the sender's prediction, which is not the hearer's"
    return model_and_start_rows(
        scenario,
        SOURCE,
        (HEARD, SOURCE, heard, evidence),
        ("all filters have one estimate from the start", SOURCE, alike, start),
    )
