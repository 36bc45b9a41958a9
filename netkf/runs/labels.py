"""Notes on covariances, shared by `netkf theory`, tables and pictures."""

from __future__ import annotations

import numpy as np

from netkf.algorithms.registry import overridden
from netkf.core.printable import list_some
from netkf.scenario.scenario import Scenario

START_MARGIN = -1e-12
"""The least eigenvalue of P_i(0) less the second moment of the error that counts as none."""


def covariance_bias(scenario: Scenario) -> str:
    """Return "larger" or "smaller" as P is to the covariance of errors by design, or empty."""
    algorithm = scenario.filter.algorithm
    in_slots, in_continuous_time = scenario.node_filter.analysis.P_by_design
    design = in_slots if scenario.slotted else in_continuous_time
    # P_by_design is about the steps of the built-in class, with links and linear readings.
    if overridden(algorithm) or not scenario.topology.links or not scenario.is_linear:
        return ""
    # With a wrong model, or a start that is too sure, P need not be larger.
    wide = scenario.filters_know_the_truth and not (start_note(scenario) or forgetting(scenario))
    return design if design == "smaller" or (design == "larger" and wide) else ""


def covariance_notes(scenario: Scenario) -> tuple[str, ...]:
    """Return notes for users on P, on its bound and on NEES."""
    return tuple(filter(None, (mismatch_note(scenario), nees_note(scenario))))


def nees_note(scenario: Scenario) -> str:
    """Return a note on NEES if P differs from the covariance of errors by design, or empty."""
    sizes, design = np.unique(scenario.sizes).tolist(), covariance_bias(scenario)
    n = f"{sizes[0]}" if len(sizes) == 1 else f"{sizes[0]} .. {sizes[-1]}"
    if design == "smaller":
        return (
            "until others hear of its samples a node counts them as if all nodes had taken them: "
            f"P is too small there, NEES above n = {n} is right, and netkf consistency says what "
            "to expect"
        )
    if design == "larger":
        return (
            "this filter keeps P above the covariance of its error by design: NEES below "
            f"n = {n} is right, and netkf consistency says what to expect"
        )
    return ""


def start_note(scenario: Scenario) -> str:
    """Return a note on filters that begin too sure of the state, or empty."""
    if not scenario.is_random or scenario.start_margin >= START_MARGIN:
        return ""
    return "filters begin with a P below the covariance of their first errors: P may be too small"


def forgetting(scenario: Scenario) -> str:
    """Return what nodes that forget do to P, or empty."""
    if not scenario.forgetful_nodes:
        return ""
    nodes, listed = scenario.forgetful_nodes, list_some(scenario.forgetful_nodes, 5)
    who = f"node {listed} begins" if len(nodes) == 1 else f"nodes {listed} begin"
    return (
        f"{who} again with the mean and covariance of time 0, whatever the state is by then: P may "
        "be too small after that"
    )


def mismatch_note(scenario: Scenario) -> str:
    """Return a note on P and its bound if the filters' model may not be the truth, or empty."""
    reasons = [evidence for _, evidence in scenario.departures]
    names = {"dynamics": scenario.plant.linear, "readings": scenario.has_linear_sensors}
    if not all(names.values()):
        parts = " and ".join(name for name, is_linear in names.items() if not is_linear)
        reasons.append(
            f"{parts} are not linear: filters linearise them at their own estimates, and P need "
            "not be, or bound, the covariance of the error"
        )
    reasons.append(_model_note(scenario))
    return "; ".join(filter(None, reasons))


def _model_note(scenario: Scenario) -> str:
    """Return how what filters know differs from the truth, or empty."""
    if scenario.filters_know_the_truth:
        return "; ".join(filter(None, (start_note(scenario), forgetting(scenario))))
    if not scenario.is_random:
        return "whether P fits the errors depends on the model: the state or readings are recorded"
    if scenario.misses_input:
        return (
            "the filters do not know the input of the plant: errors have a bias that neither P nor "
            "its bound counts"
        )
    return "the filters' model differs from the truth: P and its bound need not bound the errors"
