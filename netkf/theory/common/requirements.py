"""The checks that functions of ``netkf.theory`` are called with a scenario that they are about."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import wraps
from typing import Any

import numpy as np

from netkf.core.errors import ScenarioError, TheoryError
from netkf.network.graphs import Topology
from netkf.runs.failures import explain_failures
from netkf.scenario.scenario import Scenario
from netkf.theory.common.blocks import have_one_view, scenario_of_view

OF_BLOCKS = ("assumptions", "central_covariance", "error_covariance")
"""Functions that are given a scenario as it is, whatever blocks of the state nodes estimate."""
WITH_TIME = (
    *("assumptions", "constant_gain_bound", "covariance_bound", "error_covariance"),
    *("information_level", "leader_agreement", "mean_matching"),
)
"""Functions that are given a scenario as it is; all others are about steady states and limits,
which are those of the plant after all its changes.
"""


def guard_functions(functions: dict[str, Any]) -> dict[str, Any]:
    """Return ``functions`` by name: whose first argument is a Scenario refuses anything else, and
    none fails because numpy is told to raise at underflow.
    """
    wrapped = {}
    for name, function in functions.items():
        if inspect.isfunction(function):
            first = next(iter(inspect.signature(function).parameters.values()), None)
            # Modules postpone the evaluation of annotations (PEP 563), so that they are strings.
            of_scenario = first is not None and first.annotation == "Scenario"
            safe = _check_first_argument(name, function) if of_scenario else function
            wrapped[name] = np.errstate(under="ignore")(safe)
            # Pickle finds a function by these two names: the wrapper replaces the original there.
            wrapped[name].__module__, wrapped[name].__qualname__ = "netkf.theory", name
    return wrapped


def topology_of(graph: object) -> Topology:
    """Return the graph of a scenario, or a graph; raises TheoryError for anything else."""
    topology = graph.topology if isinstance(graph, Scenario) else graph
    if not isinstance(topology, Topology):
        message = "graph must be a netkf.Scenario or its topology"
        raise TheoryError(f"{message}, got a {type(graph).__name__}")
    return topology


def scenario_of_estimates(scenario: Scenario) -> Scenario:
    """Return a scenario whose nodes estimate the whole state, that of the blocks of all nodes;
    raises TheoryError if there is none (:func:`have_one_view`).
    """
    if scenario.views is None:
        return scenario
    if have_one_view(scenario):
        return scenario_of_view(scenario)
    known = "; of these are known theory.central_covariance and theory.error_covariance"
    what = "blocks beside others that are not drawn or that links follow"
    if len(set(scenario.estimated)) > 1:
        what = "different blocks of the state"
    reason = f"not known of nodes that estimate {what}"
    raise TheoryError(reason + (known if scenario.is_linear else ""))


def _check_first_argument(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """Return ``function`` with a check of its first argument, a Scenario, and of its flags."""
    signature = inspect.signature(function)
    others = [key for key, one in signature.parameters.items() if one.default is one.empty][1:]
    flags = {key for key, entry in signature.parameters.items() if entry.annotation == "bool"}

    @wraps(function)
    def checked(scenario: Any, *args: Any, **kwargs: Any) -> Any:
        """Call the function with a scenario; raises ScenarioError for anything else."""
        if not isinstance(scenario, Scenario):
            call = ", ".join(["netkf.load(path)", *others])
            remedy = f"load it first: netkf.theory.{name}({call})"
            raise ScenarioError("", f"theory.{name} takes a netkf.Scenario", scenario, remedy)
        if name not in OF_BLOCKS:
            scenario = scenario_of_estimates(scenario)
        given = signature.bind(scenario, *args, **kwargs).arguments
        for key in flags & given.keys():
            if not isinstance(given[key], (bool, np.bool_)):
                raise TheoryError(f"{key} must be True or False, got {given[key]!r}")
        with explain_failures(scenario):
            return function(scenario if name in WITH_TIME else scenario.last_piece, *args, **kwargs)

    return checked
