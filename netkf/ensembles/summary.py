"""The summary of an ensemble: that of one run, averaged over runs, with standard errors."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from netkf.ensembles.statistics import MESSAGES, RunStatistics
from netkf.linalg.arrays import FloatArray
from netkf.network.graphs import node_columns
from netkf.runs.summary import CONFIDENCE, PromisedTraces, nees_bounds, summary_notes
from netkf.scenario.scenario import Scenario
from netkf.scenario.usage import record_usage


def summarise_ensemble(
    scenario: Scenario, statistics: RunStatistics, promised: PromisedTraces
) -> dict[str, Any]:
    """Return the content of an ensemble's summary.json, with the keys of one run's summary.

    ``rms_error`` is the root of the mean square error of all runs; a key that ends in ``_se`` is a
    standard error. ``promised`` are the traces of covariances that theory promises: the bound on
    the mean of P over time, its limit, and that of a centralised filter.
    """
    # (N + 1, 3): of each node and of all, the mean square error, mean trace of P and mean NEES.
    mean = statistics.averages.mean.reshape(-1, 3)
    error = statistics.averages.standard_error().reshape(-1, 3)
    # JSON has no infinity: None if rounding blurs no errors.
    rounding_from = statistics.rounding_from if np.isfinite(statistics.rounding_from) else None
    *nodes, overall = node_rows(scenario, mean, error, promised)
    messages = statistics.messages.mean[0].tolist()
    messages_se = statistics.messages.standard_error()[0].tolist()
    summary: dict[str, Any] = {
        "runs": statistics.runs,
        "diverged": int(statistics.totals[1]),
        "nodes": nodes,
        "overall": overall,
        "limit": promised.limit,
        "central": promised.central,
        "bound": promised.reason or "Tanwani's H(12), promised by H Theorem 2",
        "rounding_from": rounding_from,
        "notes": summary_notes(scenario, rounding_from, bool(np.isfinite(mean[:, 1]).any())),
        "messages": dict(zip(MESSAGES, messages, strict=True)),
        "messages_se": dict(zip(MESSAGES, messages_se, strict=True)),
    }
    if scenario.plant.truth_known:
        summary["nees"] = _chi_square(scenario, statistics)
    if statistics.conserved:
        summary["conserved"] = {
            name: {"exact": sums.mean[0, 0], "total": sums.mean[0, 1], "drift": drift}
            for name, (sums, drift) in statistics.conserved.items()
        }
    # Which recorded data runs used: the same in all runs, unless one diverged and ended early.
    records = {} if statistics.totals[1] else record_usage(scenario, sent=None)
    if records:
        summary["records"] = records
    return summary


def _chi_square(scenario: Scenario, statistics: RunStatistics) -> dict[str, float]:
    n, runs = scenario.plant.n, statistics.runs
    low, high = nees_bounds(n, runs)
    clear = (scenario.times > 0.0) & (scenario.times < statistics.rounding_from)
    usable = clear & (statistics.samples.size == runs)
    nees = statistics.samples.mean.reshape(len(usable), len(scenario.nodes), -1)[:, :, -1]
    means = nees[usable]
    share_inside = float(((means >= low) & (means <= high)).mean()) if means.size else np.nan
    return {"n": n, "confidence": CONFIDENCE, "low": low, "high": high, "inside": share_inside}


def node_rows(
    scenario: Scenario, mean: FloatArray, error: FloatArray, promised: PromisedTraces
) -> list[dict[str, Any]]:
    """Return the rows of an ensemble's summary.json, N + 1: of each node, and of all together.

    ``mean`` and ``error`` (N + 1, 3) are the mean square error, mean trace of P and mean NEES, with
    standard errors.
    """
    bounds: list[float | None] = [None] * len(mean)
    if promised.bound is not None:
        after_start = promised.bound[scenario.times > 0.0]
        of_nodes = (after_start if len(after_start) else promised.bound).mean(axis=0)
        bounds = [*of_nodes.tolist(), float(of_nodes.mean())]
    rows = []
    for (square, trace, nees), errors, bound in zip(
        mean.tolist(), error.tolist(), bounds, strict=True
    ):
        rms = math.sqrt(square) if square >= 0.0 else math.nan
        rows.append(
            {
                "rms_error": rms,
                "rms_error_se": 0.0 if rms == 0.0 else errors[0] / (2.0 * rms),
                "mean_trace": trace,
                "mean_trace_se": errors[1],
                "bound": bound,
                "ratio": None if bound is None else trace / bound,
                "ratio_se": None if bound is None else errors[1] / bound,
                "mean_nees": nees,
                "mean_nees_se": errors[2],
            }
        )
    columns = [node_columns(node) for node in scenario.nodes]
    return [*map(dict.__or__, columns, rows), rows[-1]]
