"""The worst node of a run and its worst sample: overall, and after the start-up of the filters."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from netkf.runs.stored import StoredRun
from netkf.runs.summary import SampleIndices, select_averaged_samples

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


def find_worst_sample(run: StoredRun, summary: Mapping[str, Any]) -> WorstSample | None:
    """Return the worst sample of the worst node of a run; None if no node has a finite mean.

    The worst node has the largest RMS error over time or, without ground truth, the largest mean
    trace of P. ``summary`` is the contents of summary.json.
    """
    if not len(run.times) or not run.nodes:
        return None
    by_error = run.truth_known
    traces = np.trace(run.P, axis1=2, axis2=3)
    square = run.sq_error if by_error else traces
    averaged = summary_samples(run, summary)
    rows = averaged.errors if by_error else averaged.covariances
    if not len(rows):
        return None
    with np.errstate(all="ignore"):
        means = square[rows].mean(axis=0)
    if not np.isfinite(means).any():
        return None
    column = int(np.nanargmax(np.where(np.isfinite(means), means, -np.inf)))
    row = int(rows[np.argmax(square[rows, column])])
    return WorstSample(
        node=run.nodes[column],
        time=float(run.times[row]),
        value=math.sqrt(max(0.0, float(means[column]))),
        peak=math.sqrt(max(0.0, float(square[row, column]))),
        by_error=by_error,
    )


class StartUp(NamedTuple):
    """The start-up of a node's filter: trace P at the ``first`` sample and at the worst one
    (``now``), and its mean over the ``last`` quarter of the samples.
    """

    first: float
    now: float
    last: float


def find_worst_after_start_up(
    run: StoredRun, summary: Mapping[str, Any], worst: WorstSample
) -> tuple[WorstSample, StartUp | None]:
    """Return the worst sample of a node after the start-up of its filter, in which trace P falls
    from its initial value, and the start-up, if ``worst``, the node's worst sample of all, lies in
    it; else ``worst`` itself and None.

    The start-up ends when trace P has decreased halfway from its first value to the mean of its
    last ones.
    """
    # Column of the node and row of its worst sample in the arrays of the run.
    column, row = run.nodes.index(worst.node), int(np.searchsorted(run.times, worst.time))
    traces = np.trace(run.P[:, column], axis1=1, axis2=2)
    first, now = float(traces[0]), float(traces[row])
    last = float(traces[-max(1, int(LATE_SHARE * len(traces))) :].mean())
    low = np.flatnonzero(traces <= 0.5 * (first + last))
    # No start-up, or the worst sample comes after it.
    if not last < START_UP_RATIO * first or not len(low) or low[0] <= row:
        return worst, None
    averaged = summary_samples(run, summary)
    rows = averaged.errors if worst.by_error else averaged.covariances
    later_rows = rows[rows >= low[0]]
    start = StartUp(first, now, last)
    if not len(later_rows):
        return worst, start
    square = run.sq_error[:, column] if worst.by_error else traces
    later_row = int(later_rows[np.argmax(square[later_rows])])
    peak = math.sqrt(max(0.0, float(square[later_row])))
    return worst._replace(time=float(run.times[later_row]), peak=peak), start


def summary_samples(run: StoredRun, summary: Mapping[str, Any]) -> SampleIndices:
    """Return the indices of the samples that the averages in summary.json are taken over."""
    rounding_from = summary.get("rounding_from")
    end = math.inf if rounding_from is None else float(rounding_from)
    return select_averaged_samples(run.times, end, run.count("diverged") > 0)


class WorstSamples(NamedTuple):
    """The worst sample of a run.

    overall   : the worst sample of the worst node
    explained : its worst sample after the start-up of its filter, which a page explains
    start     : the start-up if the overall worst sample lies in it, else None
    """

    overall: WorstSample
    explained: WorstSample
    start: StartUp | None


def find_worst_samples(run: StoredRun, summary: Mapping[str, Any]) -> WorstSamples | None:
    """Return the worst samples of a run overall and after the start-up; None if all are nan."""
    worst = find_worst_sample(run, summary)
    if worst is None:
        return None
    return WorstSamples(worst, *find_worst_after_start_up(run, summary, worst))
