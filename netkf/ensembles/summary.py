"""The summary of an ensemble: that of one run, averaged over runs, with standard errors."""

from __future__ import annotations

from typing import Any

import numpy as np

from netkf.ensembles.statistics import MESSAGES, RunStatistics
from netkf.linalg.arrays import FloatArray
from netkf.runs.quantities import ensemble_names, quantity_rows
from netkf.runs.summary import CONFIDENCE, PromisedTraces, nees_bounds, node_rows, summary_notes
from netkf.scenario.scenario import Scenario
from netkf.scenario.usage import record_usage


def summarise_ensemble(
    scenario: Scenario, statistics: RunStatistics, promised: PromisedTraces
) -> dict[str, Any]:
    """Return the content of an ensemble's summary.json, with the keys of one run's summary, and
    standard errors under those that end in ``_se``.
    """
    # (N + 1, 3): of each node and of all, the mean square error, mean trace of P and mean NEES.
    mean = statistics.averages.mean.reshape(-1, 3)
    error = statistics.averages.standard_error().reshape(-1, 3)
    # JSON has no infinity: None if rounding blurs no errors.
    rounding_from = statistics.rounding_from if np.isfinite(statistics.rounding_from) else None
    names = ensemble_names(scenario)
    moments = statistics.quantities
    values, errors = (x.reshape(-1, len(names)) for x in (moments.mean, moments.standard_error()))
    rows = node_rows(scenario, mean, mean_bounds(scenario, promised), error)
    quantities = quantity_rows(names, values, errors)
    *nodes, overall = (a | b for a, b in zip(rows, quantities, strict=True))
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
    runs = statistics.runs
    low, high = np.array([nees_bounds(n, runs) for n in scenario.sizes.tolist()]).T
    largest = int(np.argmax(scenario.sizes))
    clear = (scenario.times > 0.0) & (scenario.times < statistics.rounding_from)
    usable = clear & (statistics.samples.size == runs)
    nees = statistics.samples.mean.reshape(len(usable), len(scenario.nodes), -1)[:, :, -1]
    means = nees[usable]
    share_inside = float(((means >= low) & (means <= high)).mean()) if means.size else np.nan
    # Bounds of the node with most states; samples of others are compared with theirs.
    return {
        "n": scenario.width,
        "confidence": CONFIDENCE,
        "low": float(low[largest]),
        "high": float(high[largest]),
        "inside": share_inside,
    }


def mean_bounds(scenario: Scenario, promised: PromisedTraces) -> FloatArray | None:
    """Return averages (N + 1,) of the promised bound after time 0, last of all nodes; or None."""
    if promised.bound is None:
        return None
    after_start = promised.bound[scenario.times > 0.0]
    nodes = (after_start if len(after_start) else promised.bound).mean(axis=0)
    return np.append(nodes, nodes.mean())
