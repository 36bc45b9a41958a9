"""Where the theory of a filter's paper is: ``netkf.theory.<paper>``, as the filter's file says."""

from __future__ import annotations

import importlib
import importlib.util
from types import ModuleType
from typing import Any

from netkf.scenario.scenario import Scenario


def paper_module(scenario: Scenario, name: str) -> ModuleType:
    """The module ``name`` of the paper that speaks about the scenario's filter, which has one."""
    return importlib.import_module(f"netkf.theory.{scenario.hosted.paper}.{name}")


def paper_function(scenario: Scenario, module: str, name: str) -> Any:
    """A function of that module; None where the paper, the module or the function is missing."""
    paper = scenario.hosted.paper
    if not paper or importlib.util.find_spec(f"netkf.theory.{paper}.{module}") is None:
        return None
    return getattr(paper_module(scenario, module), name, None)
