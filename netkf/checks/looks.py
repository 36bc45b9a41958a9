"""Verdicts that stay valid however often one looks at them, and forecasts of the runs they need.

Look number k spends ``2^-k`` of what the confidence leaves, so that the intervals of all looks hold
together, whenever one stops.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from netkf.checks.evidence import BROKEN, UNDECIDED, Evidence

MAX_LOOKED_RUNS = 20_000
"""Runs after which a check until all is decided ends by default."""
MIN_GROWTH, MAX_GROWTH = 1.5, 6.0
"""Factors by which the runs grow from one look to the next."""
MARGIN = 1.1
"""Factor on the forecast: the next look spends less of the level, and has wider intervals."""


def level_of_look(level: float, look: int) -> float:
    """Return the part of ``level`` that look number ``look`` = 1, 2, ... may spend."""
    return float(level * 2.0**-look)


def is_decided(rows: Sequence[Evidence]) -> bool:
    """Return True if more runs would decide no further row."""
    return not any(row.verdict == UNDECIDED and row.needed is not None for row in rows)


def next_runs(rows: Sequence[Evidence], runs: int, most: int) -> int:
    """Return the number of runs at which to look again, as the row that needs most of them asks."""
    needed = [row.needed for row in rows if row.verdict == UNDECIDED and row.needed is not None]
    wanted = MARGIN * max(needed, default=runs)
    growth = min(max(wanted, MIN_GROWTH * runs), MAX_GROWTH * runs)
    return min(most, math.ceil(growth))


def keep_decisions(before: Sequence[Evidence], rows: Sequence[Evidence]) -> tuple[Evidence, ...]:
    """Return the rows of a look, where those that are undecided now keep an earlier decision.

    The interval of an earlier look is as valid as that of the present one. A promise that was
    broken at any look stays broken.
    """
    known = {(row.promise, row.source): row for row in before}
    kept = []
    for row in rows:
        old = known.get((row.promise, row.source), row)
        undecided = row.verdict == UNDECIDED and old.verdict != UNDECIDED
        kept.append(old if undecided or old.verdict == BROKEN else row)
    return tuple(kept)
