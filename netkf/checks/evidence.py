"""Verdicts on promises, derived from the interval of a margin; and bounds on rounding errors."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import ArrayLike, FloatArray

HOLDS, BROKEN, UNDECIDED, NOT_PROMISED = "holds", "broken", "undecided", "not promised"
VERDICTS = (HOLDS, UNDECIDED, NOT_PROMISED, BROKEN)
MAX_RUNS = 1e9
"""Number of runs beyond which ``Evidence.needed`` is None."""
FORECAST_MARGIN = 1.1
"""Safety factor on the forecast number of runs, which decides a row only on average."""
GAUSSIAN = "noises are Gaussian"
"""Name of the assumption of tests that treat squared errors as chi-square variables."""


@dataclass(frozen=True)
class Evidence:
    """The verdict on one promise.

    margin, low, high : distance of the promise from being broken (negative if it is broken), and
        its confidence interval, simultaneous for all comparisons of the row
    tolerance : distance below 0 that the interval may reach for the verdict ``holds``
    verdict   : broken if the whole interval is below 0, holds if it stays above ``-tolerance``,
        undecided if it is too wide or not a number, not promised if an assumption fails
    needed    : estimated number of runs that would decide an undecided promise, or None
    seen, expected : measured and promised value of the comparison with the largest deviation; nan
        if the promise does not equate two values. A broken row always has both: by default its
        distance from the promise, and 0
    off       : their distance (relative for covariances and rates)
    detectable : error that would have been detected with probability 0.9
    runs_needed : ``needed``
    replica   : number of a run that alone shows the promise to be broken, else None
    group     : name of the rows that one mistake can break together
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
    seen: float = math.nan
    expected: float = math.nan
    off: float = math.nan
    detectable: float = math.nan
    runs_needed: int | None = None
    replica: int | None = None
    group: str = ""


class Finding(NamedTuple):
    """The result of a test: a margin (value, low, high), a tolerated distance below 0, a message.

    early   : the promise is about a limit and the horizon is too short to tell
    blurred : rounding of a large state has left no errors to judge by
    horizon : estimated seconds until the limit is reached, nan if unknown
    most_runs : number of runs beyond which further runs do not narrow the interval
    forecast : function of a factor on the runs that returns the upper limit of the distance from
        the promise, if the distance measured now is sampling error; by default it shrinks as
        1 / sqrt(runs)
    seen, expected, off, detectable, replica : see :class:`Evidence`; ``off`` is by default how far
        the margin is below 0
    """

    margin: tuple[float, float, float]
    tolerance: float
    message: str
    early: bool = False
    blurred: bool = False
    horizon: float = math.nan
    seen: float = math.nan
    expected: float = math.nan
    off: float = math.nan
    detectable: float = math.nan
    replica: int | None = None
    most_runs: float = math.inf
    forecast: Callable[[float], float] | None = None


@dataclass(frozen=True)
class Promise:
    """A statement with its source (paper, number), the assumptions that it needs, and its test.

    ``needs`` are substrings of names or sources in the table of assumptions. A test takes the
    samples of all runs and a level; the interval of its Finding misses the truth with at most that
    probability. ``exact`` tests compare paths, not laws, and use none of the level. ``group`` names
    the rows that one mistake can break together (:data:`FOLLOWS`); by default EQUATIONS for exact
    tests, ERRORS for those marked by :func:`error_test`, and LAWS for others. Rows of the group
    COMPUTED look at no run, so that no run can break them.
    """

    statement: str
    source: str
    needs: tuple[str, ...]
    test: Callable[[Any, float], Finding]
    exact: bool = False
    group: str = ""

    @property
    def kind(self) -> str:
        """The group of rows to which the promise belongs."""
        if self.group or self.exact:
            return self.group or EQUATIONS
        return ERRORS if self.test in ERROR_TESTS else LAWS


BASE, EQUATIONS, ERRORS, LAWS, COMPUTED = "base", "equations", "errors", "laws", "computed"
START, PLANT, SENSORS = "start", "plant", "sensors"
CLOCKS, SAMPLING, LOSSES, DELAYS, MATCHINGS = "clocks", "sampling", "losses", "delays", "matchings"
NOISES = (START, PLANT, SENSORS)
NETWORK = (CLOCKS, SAMPLING, LOSSES, DELAYS, MATCHINGS)
EVENTS, STATES, STARTS = "events", "states", "starts"
ENGINES, FILES = "engines", "files"
FOLLOWS = {
    ENGINES: (EVENTS, STATES, STARTS),
    FILES: (EVENTS, STATES, STARTS),
    EQUATIONS: (EVENTS, STARTS),
    ERRORS: (EVENTS, STATES, STARTS, EQUATIONS, *NOISES),
    LAWS: (EVENTS, STARTS, EQUATIONS, *NOISES, *NETWORK),
    BASE: (EQUATIONS, ERRORS, LAWS),
}
"""Groups of rows on whose promises those of a group rely: all on what is recorded of runs, the law
of the errors on the filter's equations and on noises, laws of P on the network too; and that a
user's class is the filter from which it derives on all that is promised of that filter.
"""
ERROR_TESTS: set[Callable[[Any, float], Finding]] = set()
"""Tests marked by :func:`error_test`."""


def error_test(test: Callable[[Any, float], Finding]) -> Callable[[Any, float], Finding]:
    """Mark a test as one of the law of errors given the events, and return it."""
    ERROR_TESTS.add(test)
    return test


GAUSSIAN_TESTS: set[Callable[[Any, float], Finding]] = set()
"""Tests marked by :func:`gaussian_test`."""


def gaussian_test(test: Callable[[Any, float], Finding]) -> Callable[[Any, float], Finding]:
    """Mark a test of the law of errors that needs Gaussian noises, and return it."""
    GAUSSIAN_TESTS.add(test)
    return error_test(test)


class Assumption(NamedTuple):
    """A row of the table of assumptions; ``holds`` is None if it is not known."""

    assumption: str
    source: str
    holds: bool | None
    evidence: str


def judge(
    promises: Sequence[Promise],
    samples: Any,
    assumptions: Sequence[Assumption],
    runs: int,
    level: float,
) -> list[Evidence]:
    """Return the evidence for each promise from the ``samples`` of ``runs`` runs that the tests
    take. With probability 1 - ``level`` all intervals contain the truth: tests that are not exact
    share it equally (Bonferroni). A promise with a failing assumption is not tested.
    """
    # Those of a paper and of its tests may be the same.
    assumptions = list(dict.fromkeys(assumptions))
    failing = [
        [row for row in assumptions if _is_needed(promise, row) and not row.holds]
        for promise in promises
    ]
    # Bonferroni: the statistical tests share the level, exact ones and void promises need none.
    statistical = sum(not p.exact and not rows for p, rows in zip(promises, failing, strict=True))
    evidence = []
    for promise, rows in zip(promises, failing, strict=True):
        if rows:
            reason = "; ".join(
                f"it assumes that {row.assumption} [{row.source}]: {row.evidence}" for row in rows
            )
            nothing = Finding((math.nan,) * 3, math.nan, "")
            evidence.append(_judge(promise, nothing, runs, reason))
        else:
            finding = _run_test(promise, samples, level / max(statistical, 1))
            evidence.append(_judge(promise, finding, runs))
    return evidence


def fold_followers(rows: Sequence[Evidence]) -> list[Evidence]:
    """Return the ``rows`` of a verdict with one broken row for each mistake: the first of its
    group, unless that relies on another with a broken row (FOLLOWS). Others name what they follow.
    """
    first: dict[str, Evidence] = {}
    for row in rows:
        if row.verdict == BROKEN:
            first.setdefault(row.group, row)

    def find_root(group: str) -> Evidence:
        """Return the broken row from which those of a ``group`` follow."""
        for other in FOLLOWS.get(group, ()):
            # The base says no more than rows about the filter, unless these follow from its parts.
            if other in first and (group != BASE or find_root(other).group == other):
                return find_root(other)
        return first[group]

    folded = []
    for row in rows:
        root = find_root(row.group) if row.verdict == BROKEN else row
        if root is not row:
            reason = f'follows from the broken row "{root.promise}"'
            folded.append(
                dataclasses.replace(row, verdict=NOT_PROMISED, assumptions=reason, replica=None)
            )
        else:
            folded.append(row)
    return folded


def _run_test(promise: Promise, samples: Any, level: float) -> Finding:
    try:
        return promise.test(samples, level)
    except TheoryError as error:
        return find_unknown(f"not computed: {error}")
    except np.linalg.LinAlgError as error:
        return find_unknown(f"not judged, its numbers are too large or singular: {error}")


def _is_needed(promise: Promise, row: Assumption) -> bool:
    needs = (*promise.needs, GAUSSIAN) if promise.test in GAUSSIAN_TESTS else promise.needs
    return any(need in f"{row.assumption} [{row.source}]" for need in needs)


def _judge(promise: Promise, finding: Finding, runs: int, void: str = "") -> Evidence:
    margin, low, high = finding.margin
    verdict, needed, message = (NOT_PROMISED, None, "") if void else _decide(finding, runs)
    off = finding.off
    if math.isnan(off) and (low < high or verdict == BROKEN):
        off = max(0.0, -margin)
    seen, expected = finding.seen, finding.expected
    if verdict == BROKEN and (math.isnan(seen) or math.isnan(expected)):
        seen, expected = off, 0.0
    return Evidence(
        promise=promise.statement,
        source=promise.source,
        assumptions=void or "hold",
        margin=margin,
        low=low,
        high=high,
        tolerance=finding.tolerance,
        verdict=verdict,
        needed=needed,
        evidence=message,
        seen=seen,
        expected=expected,
        off=off,
        detectable=finding.detectable,
        runs_needed=needed,
        replica=finding.replica if verdict == BROKEN else None,
        group=promise.kind,
    )


def _decide(finding: Finding, runs: int) -> tuple[str, int | None, str]:
    (_, low, high), message = finding.margin, finding.message
    if finding.blurred:
        return UNDECIDED, None, message
    if finding.early:
        known = math.isfinite(finding.horizon)
        advice = f"one of about {finding.horizon:.3g} s would do" if known else "lengthen it"
        return UNDECIDED, None, f"{message}; not reached in this horizon, {advice}"
    if math.isnan(low) or math.isnan(high):
        return UNDECIDED, None, f"not judged, its test gives no number (nan): {message}"
    if high < 0.0:
        return BROKEN, None, message
    if low >= -finding.tolerance:
        return HOLDS, None, message
    most, runs_used = finding.most_runs, min(runs, finding.most_runs)
    forecast_runs = FORECAST_MARGIN * runs_used * _factor_needed(finding, MAX_RUNS / runs_used)
    if forecast_runs > most:
        few = f"exact covariances are those of {most:,} runs at most, too few to decide it"
        message = f"{message}; {few}"
    needed = math.ceil(forecast_runs) if forecast_runs < min(MAX_RUNS, most) else None
    return UNDECIDED, needed, message


def _factor_needed(finding: Finding, max_factor: float) -> float:
    """Return the factor on the runs that is expected to decide a promise; inf if too large."""
    low, tolerance = finding.margin[1], finding.tolerance
    if not tolerance > 0.0:
        return math.inf
    if finding.forecast is None:
        return (low / tolerance) ** 2
    if not finding.forecast(max_factor) <= tolerance:
        return math.inf
    lower, upper = 1.0, max_factor
    while upper > 1.01 * lower:
        middle = math.sqrt(lower * upper)
        lower, upper = (lower, middle) if finding.forecast(middle) <= tolerance else (middle, upper)
    return upper


def find_identity(deviation: float, allowed: float, message: str) -> Finding:
    """Return the finding on equal values: broken if ``deviation`` exceeds what is ``allowed``."""
    margin = allowed - deviation
    text = f"largest relative deviation {deviation:.1e}, rounding explains {allowed:.0e}; {message}"
    finding = Finding((margin, margin, margin), 0.0, text)
    return finding._replace(seen=deviation, expected=0.0, off=deviation, detectable=allowed)


def find_unknown(reason: str, tolerance: float = 0.0) -> Finding:
    """Return the finding of a test that has nothing to compare: undecided, with the reason."""
    return Finding((math.nan,) * 3, tolerance, reason, blurred=True)


def find_nothing(tolerance: float) -> Finding:
    """Return the undecided finding of a test whose errors are all blurred by rounding."""
    large = "the state is so large that rounding blurs the errors wherever they are looked at"
    return find_unknown(f"{large}; shorten the horizon", tolerance)


EPS = float(np.finfo(np.float64).eps)  # 2.2e-16
OPERATIONS = 1e3
"""Number of relative errors EPS that may accumulate in one computed entry."""


def allowed_deviation(size: FloatArray, terms: ArrayLike, base: float) -> FloatArray:
    """Return what rounding explains: ``base`` of the ``size``, or rounding of their ``terms``."""
    largest = np.maximum(np.broadcast_to(terms, np.shape(size)), size)
    return np.asarray(np.maximum(base * np.asarray(size), OPERATIONS * EPS * largest))


def compare_identities(
    gap: FloatArray, size: FloatArray, terms: ArrayLike, base: float, message: str
) -> Finding:
    """Return the finding on values of R runs that should be equal up to rounding, and the first run
    where they are not: the pair whose deviation ``gap`` (R, ...) is largest relative to
    :func:`allowed_deviation` of ``size``, ``terms``, ``base`` decides.
    """
    deviations = np.nan_to_num(np.abs(np.asarray(gap, dtype=np.float64)), nan=np.inf).reshape(-1)
    scale = np.broadcast_to(size, np.shape(gap)).reshape(-1)
    largest = np.maximum(np.broadcast_to(terms, np.shape(gap)).reshape(-1), scale)
    if not len(deviations):
        return find_identity(0.0, base, message)
    limit = allowed_deviation(scale, largest, base)
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(deviations > 0.0, deviations / limit, 0.0)
    worst_index = int(np.argmax(relative))
    # Relative to the size of the result or, if that is 0, of the terms.
    unit = float(scale[worst_index] or largest[worst_index] or 1.0)
    wrong = np.flatnonzero(deviations > limit)
    return find_identity(
        float(deviations[worst_index]) / unit, float(limit[worst_index]) / unit, message
    )._replace(replica=int(wrong[0] * len(gap) // len(deviations)) if len(wrong) else None)


def largest_terms(P: FloatArray, start: FloatArray, information: float = 0.0) -> FloatArray:
    """Return the sizes (R, K, N) of the largest terms of which P was computed: traces so far,
    ``start``, and P^2 times the ``information`` H' R^-1 H.
    """
    traces = np.nan_to_num(np.trace(P, axis1=-2, axis2=-1), nan=0.0, posinf=0.0)
    first = float(np.trace(start, axis1=-2, axis2=-1).max())
    until = np.maximum.accumulate(traces.max(axis=2, initial=first), axis=1)
    return np.asarray(np.maximum(until[..., None], information * traces**2))
