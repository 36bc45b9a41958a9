"""Innovations on a page: are readings as far from their predictions as the covariances say?"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from netkf.core.errors import NetkfError
from netkf.linalg.arrays import FloatArray
from netkf.report.directories import Opened
from netkf.report.packing import Packer
from netkf.runs.innovations import (
    Innovations,
    autocorrelations,
    chi_square_interval,
    compute_innovations,
)
from netkf.runs.tables import format_number

MAX_EVENTS = 200_000
"""Events of a run up to which a page replays it for its readings, some seconds."""
CONFIDENCE = 0.99
"""Probability that the interval of every node holds its mean, where P is exact."""
LEVEL = 1.96  # standard deviations of a normal number that hold 95 %


class NodeMeans(NamedTuple):
    """NIS over degrees of freedom of M nodes with readings: their ids (-1: readings that one filter
    uses together), ``means`` (M,), and the ends of the intervals that hold all of them with
    probability CONFIDENCE where P is exact.
    """

    nodes: np.ndarray
    means: FloatArray
    low: FloatArray
    high: FloatArray


def read_innovations(source: Opened) -> Innovations | str | None:
    """Return the innovations of the run of a source, by a replay, or the reason why there are none;
    None where there is no run.
    """
    if source.run is None or not len(source.run.times):
        return None
    if source.status in ("interrupted", "failed"):
        return f"the run was {source.status}, so that its readings are not replayed"
    try:
        return compute_innovations(source.run, MAX_EVENTS)
    except NetkfError as error:
        return str(error)


def node_means(found: Innovations) -> NodeMeans:
    """Return the mean NIS of each node with readings; sums of NIS are chi-square if P is exact."""
    known = np.isfinite(found.nis)
    nodes, which = np.unique(found.nodes[known], return_inverse=True)
    rows, sums = (
        np.asarray(np.bincount(which, weights=values[known], minlength=len(nodes)), np.float64)
        for values in (found.rows, found.nis)
    )
    # Bonferroni: nodes share the noise of the plant, so their sums are dependent.
    low, high = chi_square_interval(rows, 1.0 - (1.0 - CONFIDENCE) / max(1, len(nodes)))
    return NodeMeans(nodes, sums / rows, low, high)


def innovation_claim(found: Innovations) -> str:
    """Return a sentence on how far readings were from their predictions, and which node's P says
    otherwise.
    """
    nodes, means, low, high = node_means(found)
    count = int(np.isfinite(found.nis).sum())
    said = f"Over {count:,} readings"
    if found.increments:
        some = found.increments < len(found.nis)
        among = f"{found.increments:,} of them" if some else "which are"
        said += f", {among} increments between two events of a node,"
    said += " the squared innovation in units of its covariance (NIS per row; "
    said += "1 where P is exact) is "
    if len(nodes) == 1:
        where = f"at node {nodes[0]}" if nodes[0] >= 0 else "of the filter of all readings"
        return f"{said}{format_number(means[0])} {where}, {_judge_means(means[0], low[0], high[0])}"
    least, most = int(np.argmin(means)), int(np.argmax(means))
    said += f"{format_number(means[least])} (node {nodes[least]}) to "
    said += f"{format_number(means[most])} (node {nodes[most]})"
    above, below = int((means > high).sum()), int((means < low).sum())
    if not above and not below:
        return f"{said}: at all {len(nodes)} nodes with readings as exact covariances allow"
    parts = [f"too sure at {above} of {len(nodes)} nodes with readings"] if above else []
    parts += [f"more careful than readings need at {below} of {len(nodes)}"] if below else []
    return f"{said}: P is {' and '.join(parts)}"


def _judge_means(mean: float, low: float, high: float) -> str:
    """Return whether a mean squared innovation fits P, as text."""
    inside = f"{format_number(low)} .. {format_number(high)}"
    if mean > high:
        return f"P is too sure: {CONFIDENCE:.0%} of such means would lie in {inside}"
    if mean < low:
        return (
            f"P is more careful than needed: {CONFIDENCE:.0%} of such means would lie in {inside}"
        )
    return f"as exact covariances allow ({CONFIDENCE:.0%}: {inside})"


def innovation_columns(
    found: Innovations | str | None, nodes: tuple[int, ...], most: int, packer: Packer
) -> dict[str, Any] | None:
    """Return what the curves show of innovations, every k-th reading if there are more than
    ``most``; None without any.
    """
    if not isinstance(found, Innovations):
        return None
    known = np.flatnonzero(np.isfinite(found.nis))
    step = max(1, -(-len(known) // max(1, most)))
    kept = known[::step]
    curves, counts = autocorrelations(found)
    index = {node: k for k, node in enumerate(nodes)}
    means = node_means(found)
    return {
        "columns": {
            "t": packer.add(found.times[kept], "f8"),
            "node": packer.add([index.get(node, -1) for node in found.nodes[kept].tolist()], "i2"),
            "nis": packer.add(found.nis[kept] / found.rows[kept], "f8"),
        },
        "step": step,
        "total": len(known),
        "means": {
            str(index.get(node, -1)): [float(value) for value in values]
            for node, *values in zip(*(part.tolist() for part in means), strict=True)
        },
        "correlations": {
            str(index.get(node, -1)): {
                "band": LEVEL / float(np.sqrt(counts[node])),
                "values": curve.tolist(),
            }
            for node, curve in curves.items()
        },
    }
