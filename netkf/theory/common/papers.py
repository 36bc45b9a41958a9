"""Lookup of modules of ``netkf.theory.<paper>`` by the paper that the filter's class names."""

from __future__ import annotations

import importlib
import importlib.util
from types import ModuleType
from typing import Any

from netkf.scenario.scenario import Scenario


def paper_module(scenario: Scenario, name: str) -> ModuleType:
    """Import module ``name`` of the paper of the scenario's filter, which must name one."""
    return importlib.import_module(f"netkf.theory.{scenario.node_filter.paper}.{name}")


def paper_function(scenario: Scenario, module: str, name: str) -> Any:
    """Return the function ``name`` of a ``module`` of the paper of the scenario's filter, or None
    if paper, module or function is missing.
    """
    paper = scenario.node_filter.paper
    if not paper or importlib.util.find_spec(f"netkf.theory.{paper}.{module}") is None:
        return None
    return getattr(paper_module(scenario, module), name, None)
