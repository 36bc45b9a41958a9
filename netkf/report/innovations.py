"""Innovations of a run for a page: normalised innovations squared (NIS) and autocorrelations."""

from __future__ import annotations

from typing import Any

import numpy as np

from netkf.checks.innovations import Innovations, autocorrelations, compute_innovations
from netkf.core.errors import NetkfError
from netkf.linalg.arrays import FloatArray
from netkf.report.directories import ReportSource
from netkf.report.markup import Packer
from netkf.runs.stored import StoredRun
from netkf.runs.summary import NORMAL_QUANTILE, chi_square_interval
from netkf.runs.tables import format_number
from netkf.scenario.scenario import Scenario

MAX_EVENTS = 200_000
"""Events of a run up to which a page replays it for its readings, which takes some seconds."""
CONFIDENCE = 0.99
"""Probability that the intervals of all nodes contain their means if P is exact."""


def read_innovations(source: ReportSource) -> Innovations | str | None:
    """Return the innovations of a source's run, by a replay, the reason for none, or None."""
    if source.run is None or not len(source.run.times):
        return None
    if source.status in ("interrupted", "failed"):
        return f"the run was {source.status}, so that its readings are not replayed"
    try:
        return compute_innovations(source.run, MAX_EVENTS)
    except NetkfError as error:
        return str(error)


def node_means(readings: Innovations) -> tuple[np.ndarray, FloatArray, FloatArray, FloatArray]:
    """Return ids (M,), -1 for readings that one filter uses together, mean NIS per scalar reading,
    and its limits if P is exact, which hold for all nodes with probability CONFIDENCE.
    """
    finite = np.isfinite(readings.nis)
    nodes, columns = np.unique(readings.nodes[finite], return_inverse=True)
    # Numbers of scalar readings, the degrees of freedom, and sums of NIS of each node.
    freedom, sums = (
        np.asarray(np.bincount(columns, weights=values[finite], minlength=len(nodes)), np.float64)
        for values in (readings.rows, readings.nis)
    )
    # Sums of NIS are chi-square if P is exact. Nodes share the noise of the plant, so the sums are
    # dependent: Bonferroni's inequality makes the limits hold together.
    low, high = chi_square_interval(freedom, 1.0 - (1.0 - CONFIDENCE) / max(1, len(nodes)))
    return nodes, sums / freedom, low, high


def describe_innovations(readings: Innovations, scenario: Scenario) -> str:
    """Return a sentence on the nodes' mean NIS, and on how many contradict P."""
    ids, means, low, high = node_means(readings)
    nodes = [scenario.topology.named(k) if k >= 0 else k for k in ids.tolist()]
    count = int(np.isfinite(readings.nis).sum())
    sentence = f"Over {count:,} readings"
    if readings.increments:
        all_are = readings.increments == len(readings.nis)
        share = "which are" if all_are else f"{readings.increments:,} of them"
        sentence += f", {share} increments between two events of a node,"
    sentence += " the squared innovation in units of its covariance (NIS per row; "
    sentence += "1 if P is exact) is "
    if len(nodes) == 1:
        where = f"at node {nodes[0]}" if nodes[0] >= 0 else "of the filter of all readings"
        judgement = _judge_mean(means[0], low[0], high[0])
        return f"{sentence}{format_number(means[0])} {where}, {judgement}"
    smallest, largest = int(np.argmin(means)), int(np.argmax(means))
    sentence += f"{format_number(means[smallest])} (node {nodes[smallest]}) to "
    sentence += f"{format_number(means[largest])} (node {nodes[largest]})"
    above, below = int((means > high).sum()), int((means < low).sum())
    if not above and not below:
        return f"{sentence}: at all {len(nodes)} nodes with readings as exact covariances allow"
    judgements = []
    if above:
        judgements.append(f"overconfident at {above} of {len(nodes)} nodes with readings")
    if below:
        judgements.append(f"conservative at {below} of {len(nodes)}")
    return f"{sentence}: P is {' and '.join(judgements)}"


def _judge_mean(mean: float, low: float, high: float) -> str:
    """Return whether a node's ``mean`` NIS is consistent: in ``low`` .. ``high`` if P is exact."""
    interval = f"{format_number(low)} .. {format_number(high)}"
    if mean > high:
        return f"P is overconfident: {CONFIDENCE:.0%} of such means would lie in {interval}"
    if mean < low:
        return (
            f"P is more careful than needed: {CONFIDENCE:.0%} of such means would lie in {interval}"
        )
    return f"as exact covariances allow ({CONFIDENCE:.0%}: {interval})"


def innovation_columns(
    readings: Innovations | str | None, run: StoredRun, max_readings: int, packer: Packer
) -> dict[str, Any] | None:
    """Return NIS of readings as columns added to ``packer``, thinned to ``max_readings``, means and
    autocorrelations by index in ``run.nodes``, -1 for all. None without innovations.
    """
    if not isinstance(readings, Innovations):
        return None
    finite = np.flatnonzero(np.isfinite(readings.nis))
    step = max(1, -(-len(finite) // max(1, max_readings)))
    rows = finite[::step]
    curves, counts = autocorrelations(readings)
    index, label_of = {node: k for k, node in enumerate(run.nodes)}, run.scenario.label_of_value
    row_nodes = [index.get(node, -1) for node in readings.nodes[rows].tolist()]
    means = zip(*(column.tolist() for column in node_means(readings)), strict=True)
    return {
        "columns": {
            "t": packer.add(readings.times[rows], "f8"),
            "node": packer.add(row_nodes, "i2"),
            "nis": packer.add(readings.nis[rows] / readings.rows[rows], "f8"),
        },
        "step": step,
        "total": len(finite),
        "means": {
            str(index.get(node, -1)): [float(mean), float(low), float(high)]
            for node, mean, low, high in means
        },
        "correlations": {
            str(index.get(node, -1)): {
                "band": NORMAL_QUANTILE / float(np.sqrt(counts[node])),
                "values": curve.tolist(),
                "label": label_of(node, 0, readings.rows[readings.nodes == node]),
            }
            for node, curve in curves.items()
        },
    }
