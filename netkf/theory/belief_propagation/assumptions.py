"""Assumptions under which P of belief propagation is the covariance of the error."""

from __future__ import annotations

from netkf.algorithms.belief_propagation import is_forest
from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import AssumptionRow
from netkf.theory.common.plant_assumptions import model_and_start_rows

SOURCE = "Weiss and Freeman 2001"
TREE = "the graph has no loops"


def slot_rows(scenario: Scenario) -> list[AssumptionRow]:
    """Return the assumptions, as rows of the table, about the model, the graph and the first
    covariances.
    """
    return model_and_start_rows(scenario, SOURCE, *weight_rows(scenario))


def weight_rows(scenario: Scenario) -> list[AssumptionRow]:
    """Return the row about loops of the graph."""
    tree = is_forest(scenario)
    evidence = "every reading arrives on one way" if tree else "readings return and count again"
    return [(TREE, SOURCE, tree, evidence)]
