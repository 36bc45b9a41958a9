"""The five papers and their letters."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable

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
    """Return lines with the title of each paper whose letter begins a part of the ``sources``."""
    joined = "; ".join(sources)
    return [
        line
        for letter, title in PAPERS.items()
        if re.search(rf"(^|[;,] |from ){letter}[ (]", joined)
        for line in textwrap.wrap(f"[{letter} ...]: {title}", 100, subsequent_indent=" " * 13)
    ]
