"""The node of a run that was most off, and when: overall, and after the filters had started."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from netkf.runs.stored import StoredRun
from netkf.runs.summary import SampleIndices, select_averaged_samples

COME_DOWN, LATE_SHARE = 0.8, 0.25
"""Trace P has a start-up if its mean over the last quarter of the samples is below this share of
its first value."""


class Worst(NamedTuple):
    """The node that was worst over time and its worst sample.

    value, peak : with truth the RMS error over time and the error at ``time``; without it the
    square roots of the mean trace of P and of the trace at ``time``
    """

    node: int
    time: float
    value: float
    peak: float
    by_error: bool


def node_most_off(run: StoredRun, summary: Mapping[str, Any]) -> Worst | None:
    """Return the worst node of a run with the contents of its summary.json: the one with the
    largest RMS error over time, or, without ground truth, with the largest mean trace of P. None
    without a finite number.
    """
    if not len(run.times) or not run.nodes:
        return None
    by_error = run.truth_known
    traces = np.trace(run.P, axis1=2, axis2=3)
    square = run.sq_error if by_error else traces
    used = samples_averaged(run, summary)
    chosen = used.errors if by_error else used.covariances
    if not len(chosen):
        return None
    with np.errstate(all="ignore"):
        means = square[chosen].mean(axis=0)
    if not np.isfinite(means).any():
        return None
    k = int(np.nanargmax(np.where(np.isfinite(means), means, -np.inf)))
    at = int(chosen[np.argmax(square[chosen, k])])
    return Worst(
        run.nodes[k],
        float(run.times[at]),
        math.sqrt(max(0.0, float(means[k]))),
        math.sqrt(max(0.0, float(square[at, k]))),
        by_error,
    )


class StartUp(NamedTuple):
    """Trace P of a node at its first sample, ``now``, and its mean over its last samples."""

    first: float
    now: float
    last: float


def after_start_up(
    run: StoredRun, summary: Mapping[str, Any], worst: Worst
) -> tuple[Worst, StartUp | None]:
    """Return the worst sample of the worst node after its start-up, and, if its worst sample of all
    was in the start-up, its trace P then.

    The start-up lasts until trace P has come down halfway from its first value to its last ones.
    """
    k, at = run.nodes.index(worst.node), int(np.searchsorted(run.times, worst.time))
    traces = np.trace(run.P[:, k], axis1=1, axis2=2)
    first, now = float(traces[0]), float(traces[at])
    last = float(traces[-max(1, int(LATE_SHARE * len(traces))) :].mean())
    low = np.flatnonzero(traces <= 0.5 * (first + last))
    if not last < COME_DOWN * first or not len(low) or low[0] <= at:
        return worst, None
    used = samples_averaged(run, summary)
    chosen = used.errors if worst.by_error else used.covariances
    rest = chosen[chosen >= low[0]]
    start = StartUp(first, now, last)
    if not len(rest):
        return worst, start
    square = run.sq_error[:, k] if worst.by_error else traces
    then = int(rest[np.argmax(square[rest])])
    peak = math.sqrt(max(0.0, float(square[then])))
    return worst._replace(time=float(run.times[then]), peak=peak), start


def samples_averaged(run: StoredRun, summary: Mapping[str, Any]) -> SampleIndices:
    """Return the indices of the samples that the summary averages over."""
    found = summary.get("rounding_from")
    blurred = math.inf if found is None else float(found)
    return select_averaged_samples(run.times, blurred, run.count("diverged") > 0)


class WorstSample(NamedTuple):
    """The worst node and its worst sample, ``overall`` and after the ``start`` of the filters: that
    one is ``explained``; ``start`` is None if the worst sample was not in it.
    """

    overall: Worst
    explained: Worst
    start: StartUp | None


def worst_sample(run: StoredRun, summary: Mapping[str, Any]) -> WorstSample | None:
    """Return the worst sample of a run with the contents of its summary.json, None without one."""
    worst = node_most_off(run, summary)
    if worst is None:
        return None
    return WorstSample(worst, *after_start_up(run, summary, worst))
