"""The worst node of a run and its worst sample: overall, and after the start-up of the filters."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from netkf.runs.stored import StoredRun
from netkf.runs.summary import SampleIndices, select_averaged_samples
from netkf.trace.nees import traces as traces_of

START_UP_RATIO, LATE_SHARE = 0.8, 0.25
"""Trace P has a start-up if its mean over the last quarter of the samples is below this share of
its first value."""


class WorstSample(NamedTuple):
    """The worst sample, at ``time`` seconds, of a node.

    value    : with ground truth the RMS error of the node over time, else the square root of its
               mean trace of P
    peak     : with ground truth the error at ``time``, else the square root of the trace of P then
    by_error : True with ground truth
    """

    node: int
    time: float
    value: float
    peak: float
    by_error: bool


class StartUp(NamedTuple):
    """The start-up of a node's filter: trace P at the ``first`` sample and at the worst one
    (``now``), and its mean over the ``last`` quarter of the samples.
    """

    first: float
    now: float
    last: float


class WorstSamples(NamedTuple):
    """The worst sample of a run.

    overall   : the worst sample of the worst node, that with the largest RMS error over time or,
                without ground truth, the largest mean trace of P
    explained : its worst sample after the start-up of its filter, in which trace P falls from its
                initial value halfway to the mean of its last ones; a page explains it
    start     : the start-up if the overall worst sample lies in it, else None
    """

    overall: WorstSample
    explained: WorstSample
    start: StartUp | None


def find_worst_samples(run: StoredRun, summary: Mapping[str, Any]) -> WorstSamples | None:
    """Return the worst samples of a run, None if no node has a finite mean."""
    if not len(run.times) or not run.nodes:
        return None
    by_error, averaged = run.truth_known, summary_samples(run, summary)
    traces = traces_of(run.P)
    square, rows = (run.sq_error, averaged.errors) if by_error else (traces, averaged.covariances)
    with np.errstate(all="ignore"):
        means = square[rows].mean(axis=0) if len(rows) else np.full(len(run.nodes), np.nan)
    if not np.isfinite(means).any():
        return None
    column = int(np.nanargmax(np.where(np.isfinite(means), means, -np.inf)))
    value = math.sqrt(max(0.0, float(means[column])))

    def worst_of(some: np.ndarray) -> WorstSample:
        row = int(some[np.argmax(square[some, column])])
        peak = math.sqrt(max(0.0, float(square[row, column])))
        return WorstSample(run.nodes[column], float(run.times[row]), value, peak, by_error)

    worst = worst_of(rows)
    trace = traces[:, column]
    first, now = float(trace[0]), float(trace[np.searchsorted(run.times, worst.time)])
    last = float(trace[-max(1, int(LATE_SHARE * len(trace))) :].mean())
    low = np.flatnonzero(trace <= 0.5 * (first + last))
    # No start-up, or the worst sample comes after it.
    if not last < START_UP_RATIO * first or not len(low) or run.times[low[0]] <= worst.time:
        return WorstSamples(worst, worst, None)
    later = rows[rows >= low[0]]
    return WorstSamples(worst, worst_of(later) if len(later) else worst, StartUp(first, now, last))


def summary_samples(run: StoredRun, summary: Mapping[str, Any]) -> SampleIndices:
    """Return the indices of the samples that the averages in summary.json are taken over."""
    rounding_from = summary.get("rounding_from")
    end = math.inf if rounding_from is None else float(rounding_from)
    return select_averaged_samples(run.times, end, run.count("diverged") > 0)
