"""Verdicts that stay valid under repeated looks at growing samples, and forecasts of their runs.

Look number k = 1, 2, ... may spend ``2^-k`` of the error probability 1 - confidence (alpha
spending), so that the intervals of all looks hold jointly, whenever one stops.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from netkf.checks.evidence import BROKEN, UNDECIDED, Evidence

MAX_LOOKED_RUNS = 20_000
"""Default limit on the runs of a check with ``until = "decided"``."""
MIN_GROWTH, MAX_GROWTH = 1.5, 6.0
"""Limits of the factor by which the runs grow from one look to the next."""
MARGIN = 1.1
"""Factor on the forecast number of runs: the next look has a smaller level and wider intervals."""


def level_of_look(level: float, look: int) -> float:
    """Return the part of ``level`` that look number ``look`` = 1, 2, ... may spend."""
    return float(level * 2.0**-look)


def is_decided(rows: Sequence[Evidence]) -> bool:
    """Return True if more runs would decide no further row."""
    return not any(row.verdict == UNDECIDED and row.needed is not None for row in rows)


def next_runs(rows: Sequence[Evidence], runs: int, max_runs: int) -> int:
    """Return the runs of the next look, as forecast, MIN_GROWTH to MAX_GROWTH times ``runs``."""
    needed = [row.needed for row in rows if row.verdict == UNDECIDED and row.needed is not None]
    forecast = MARGIN * max(needed, default=runs)
    growth = min(max(forecast, MIN_GROWTH * runs), MAX_GROWTH * runs)
    return min(max_runs, math.ceil(growth))


def keep_decisions(earlier: Sequence[Evidence], rows: Sequence[Evidence]) -> tuple[Evidence, ...]:
    """Return the new ``rows``, undecided ones with an ``earlier`` decision: all intervals hold."""
    earlier_rows = {(row.promise, row.source): row for row in earlier}
    decisions = []
    for row in rows:
        old = earlier_rows.get((row.promise, row.source), row)
        undecided = row.verdict == UNDECIDED and old.verdict != UNDECIDED
        decisions.append(old if undecided or old.verdict == BROKEN else row)
    return tuple(decisions)
