"""The five papers and their letters, and lookup of modules of ``netkf.theory.<paper>`` by the paper
that the filter's class names.
"""

from __future__ import annotations

import importlib
import importlib.util
import re
import textwrap
from collections.abc import Iterable
from typing import Any

from netkf.scenario.scenario import Scenario

PAPERS = {
    "H": "Tanwani: Error bounds for locally optimal distributed filters with random communication "
    "graphs",
    "R": "Kar, Sinopoli and Moura: Kalman filtering with intermittent observations: weak "
    "convergence to a stationary distribution",
    "G": "Kar and Moura: Gossip and distributed Kalman filtering: weak consensus under weak "
    "detectability",
    "D": "Xie, Gan and Liu: Stability analysis of distributed Kalman filtering algorithm for "
    "stochastic regression model",
    "P": "Battilotti, Cacace and d'Angelo: Consensus analysis of random sub-graphs for distributed "
    "filtering with link failures",
}
"""The papers behind the letters in the sources of assumptions and promises."""


def paper_legend(sources: Iterable[str]) -> list[str]:
    """Return lines with the title of each paper whose letter begins one of the ``sources`` of the
    rows of a table, or a part of one, such as "G Theorem 8".
    """
    joined = "; ".join(sources)
    return [
        line
        for letter, title in PAPERS.items()
        if re.search(rf"(^|[;,] |from ){letter}[ (]", joined)
        for line in textwrap.wrap(f"[{letter} ...]: {title}", 100, subsequent_indent=" " * 13)
    ]


def paper_function(scenario: Scenario, module: str, name: str) -> Any:
    """Return the function ``name`` of a ``module`` of the paper of the scenario's filter, or None
    if paper, module or function is missing.
    """
    paper = scenario.node_filter.analysis.paper
    if not paper or importlib.util.find_spec(f"netkf.theory.{paper}.{module}") is None:
        return None
    return getattr(importlib.import_module(f"netkf.theory.{paper}.{module}"), name, None)
