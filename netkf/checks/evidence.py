"""What a promise comes to: a margin with its interval, and a verdict."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

HOLDS, BROKEN, UNDECIDED, NOT_PROMISED = "holds", "broken", "undecided", "not promised"
MOST_RUNS = 1e9
VERDICTS = (HOLDS, UNDECIDED, NOT_PROMISED, BROKEN)


@dataclass(frozen=True)
class Evidence:
    """One promise held against simulation.

    margin, low, high : how far the promise is from being broken, negative where it is, with an
        interval that covers all comparisons of the row at once
    tolerance : how far below 0 the interval may reach for the verdict ``holds``
    verdict   : broken where the whole interval is below 0, holds where it stays above
        ``-tolerance``, undecided where it is too wide, not promised where an assumption fails
    needed    : about how many runs an undecided promise takes
    """

    promise: str
    source: str
    assumptions: str
    margin: float
    low: float
    high: float
    tolerance: float
    verdict: str
    needed: int | None
    evidence: str


class Finding(NamedTuple):
    """A margin (value, low, high), how much below 0 is tolerable, and words about it; ``early``
    where the promise is about a limit and the horizon is too short to tell; ``blurred`` where
    rounding of a large state has left no errors to judge by.
    """

    margin: tuple[float, float, float]
    tolerance: float
    words: str
    early: bool = False
    blurred: bool = False


@dataclass(frozen=True)
class Promise:
    """Words, source (paper, number), what it needs of the table of assumptions, and its test.

    A test takes what was seen of all runs and a level, and returns a Finding whose interval misses
    with at most that probability. ``exact`` tests compare paths, not laws, and spend no level.
    """

    words: str
    source: str
    needs: tuple[str, ...]
    test: Callable[[Any, float], Finding]
    exact: bool = False


class Row(NamedTuple):
    """A row of the table of assumptions."""

    assumption: str
    source: str
    holds: bool | None
    evidence: str


def judge(
    promises: Sequence[Promise], seen: Any, assumptions: Sequence[Row], runs: int, level: float
) -> list[Evidence]:
    """Evidence for each promise; all intervals together miss with at most ``level``."""
    failing = [[row for row in assumptions if _needed(p, row) and not row.holds] for p in promises]
    statistical = sum(not p.exact and not rows for p, rows in zip(promises, failing, strict=True))
    found = []
    for promise, rows in zip(promises, failing, strict=True):
        if rows:
            why = "; ".join(f"{row.assumption} [{row.source}]: {row.evidence}" for row in rows)
            found.append(_not_promised(promise, why))
        else:
            finding = promise.test(seen, level / max(statistical, 1))
            found.append(_weighed(promise, finding, runs))
    return found


def _needed(promise: Promise, row: Row) -> bool:
    return any(need in f"{row.assumption} [{row.source}]" for need in promise.needs)


def _weighed(promise: Promise, finding: Finding, runs: int) -> Evidence:
    (margin, low, high), tolerance, words, early, blurred = finding
    needed = None
    if blurred:
        verdict = UNDECIDED
    elif early:
        verdict, words = UNDECIDED, f"{words}; the horizon is too short to tell, lengthen it"
    elif not high >= 0.0:  # also where nothing but nan was seen
        verdict = BROKEN
    elif low >= -tolerance:
        verdict = HOLDS
    else:
        verdict = UNDECIDED
        # Where the promise holds, what is seen below 0 is chance and shrinks as 1 / sqrt(runs).
        wanted = 1.1 * runs * (-low / tolerance) ** 2 if tolerance > 0.0 else math.inf
        needed = math.ceil(wanted) if wanted < MOST_RUNS else None
    return Evidence(
        promise.words,
        promise.source,
        "hold",
        margin,
        low,
        high,
        tolerance,
        verdict,
        needed,
        words,
    )


def _not_promised(promise: Promise, why: str) -> Evidence:
    nan = math.nan
    return Evidence(promise.words, promise.source, why, nan, nan, nan, nan, NOT_PROMISED, None, "")


def left_out(seen: Any) -> str:
    """Words about the times at which some errors of ``seen.runs.e`` (R, K, N, n) are left out."""
    lost = np.isnan(seen.runs.e).any(axis=(0, 2, 3))
    times = ", ".join(time for time, none in zip(seen.moments, lost, strict=True) if none)
    return f"; errors that rounding blurs are left out ({times})" if times else ""


def rounded_away(tolerance: float) -> Finding:
    """Where errors have lost their digits at every sample that a promise is about."""
    nan = math.nan
    words = (
        "the state is so large that rounding blurs the errors wherever they are looked at; shorten "
        "the horizon"
    )
    return Finding((nan, nan, nan), tolerance, words, blurred=True)


def identity(deviation: float, allowed: float, words: str) -> Finding:
    """From the largest relative deviation of paths that should be equal but for rounding."""
    margin = allowed - deviation
    text = f"largest relative deviation {deviation:.1e}, rounding explains {allowed:.0e}; {words}"
    return Finding((margin, margin, margin), 0.0, text)
