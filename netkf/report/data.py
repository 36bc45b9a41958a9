"""The data of a run for the live views of a page: columns of numbers, thinned if there are many;
innovations and their autocorrelations.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import scipy

from netkf.checks.innovations import Innovations, autocorrelations, compute_innovations
from netkf.core.errors import NetkfError
from netkf.figures.layout import get_positions
from netkf.linalg.arrays import FloatArray
from netkf.report.directories import ReportSource, WorstSample
from netkf.report.markup import Packer
from netkf.runs.connectivity import newest_heard
from netkf.runs.outcomes import downtimes
from netkf.runs.stored import StoredRun
from netkf.runs.summary import NORMAL_QUANTILE, chi_square_interval, nees_bounds
from netkf.runs.tables import format_number
from netkf.scenario.scenario import Scenario
from netkf.studies.consistency import judged_blocks
from netkf.trace.messages import DELIVERED, LATE, LOST, UNDER_WAY, by_link
from netkf.trace.nees import errors
from netkf.trace.schema import CODES, rows_of

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
    sentence = f"Over {int(np.isfinite(readings.nis).sum()):,} readings"
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


BINS = 60
"""Equal intervals of a run in which traffic is counted."""
MAX_LINKS = 20_000
"""Directed links that a page draws."""
MAX_MARKS = 5_000
"""Events of the kinds MARKS that a page holds."""
MARKS = ("stop", "crash", "restart", "join", "leave", "diverged", "swap")
"""Kinds of events of nodes that views mark beside samples and messages."""
ELLIPSE_LEVEL = 0.95  # probability within the ellipses and intervals that are drawn


class Budget(NamedTuple):
    """The largest numbers of messages and of sample values (numbers) of one run on a page."""

    messages: int
    values: int

    def scaled(self, share: float) -> Budget:
        """Return a budget of this ``share`` of the size."""
        return Budget(int(share * self.messages), int(share * self.values))


def run_data(
    source: ReportSource,
    run: StoredRun,
    messages: np.ndarray,
    readings: Innovations | str | None,
    layout: list[list[float]],
    budget: Budget,
    packer: Packer,
) -> dict[str, Any]:
    """Return the data of a run for the live views as JSON values, with columns in ``packer``:
    innovations ``readings`` or why there are none, positions ``layout``, numbers in the ``budget``.
    """
    worst = None if source.worst is None else source.worst.explained
    horizon = float(source.scenario.horizon)
    instant = worst.time if worst is not None else horizon
    rows = sample_indices(run, budget.values, instant)
    thinned = thin_messages(messages, budget.messages, instant)
    return {
        **_facts(source, run),
        "positions": layout,
        "axes": _state_axes(source, run, worst),
        "worst": None if worst is None else worst._asdict(),
        # Half axes of probability ELLIPSE_LEVEL, in standard deviations.
        "scale": {
            "ellipse": math.sqrt(float(scipy.special.chdtri(2, 1.0 - ELLIPSE_LEVEL))),
            "interval": float(scipy.special.ndtri(0.5 + 0.5 * ELLIPSE_LEVEL)),
        },
        "samples": _sample_columns(source, run, rows, messages, packer),
        "messages": _message_columns(thinned, run, packer),
        "senses": _event_columns(run, ("sense",), budget.messages // 2, packer),
        "marks": _event_columns(run, MARKS, MAX_MARKS, packer),
        "down": [
            (run.nodes.index(one.node), one.begin, min(one.end, 2.0 * horizon))
            for one in downtimes(source.scenario, run.seed, run.replica)
        ],
        "innovations": innovation_columns(readings, run, budget.messages // 4, packer),
        "traffic": bin_messages(messages, horizon, BINS),
        "totals": {
            "events": len(run.log),
            "messages": len(messages),
            "samples": len(run.times),
            "links": len(source.scenario.topology.directions),
        },
    }


def _facts(source: ReportSource, run: StoredRun) -> dict[str, Any]:
    """Return what is known of a run, its scenario and its network without its samples."""
    limits: dict[str, float] = {}
    if source.promised is not None:
        limits[source.promised.limit_label] = source.promised.limit
        limits["centralised filter"] = source.promised.central
    return {
        "label": source.label,
        "name": source.scenario.name,
        "status": source.status,
        "replica": run.replica,
        "words": source.replicas.describe(run.replica) if source.replicas else "",
        "horizon": float(source.scenario.horizon),
        "truth": run.truth_known,
        # In slots, messages that a node sends at the same time are one transmission.
        "broadcasts": bool(len(run.log)) and (source.scenario.slotted or run.count("transmit") > 0),
        "n": run.xhat.shape[2],
        "states": list(source.scenario.state_labels),
        "read": [source.scenario.what_is_read(node) for node in (*run.nodes, -1)],
        "nodes": list(run.nodes),
        "names": [str(node) for node in run.nodes],
        "sensors": [node for node in run.nodes if node in source.scenario.placed_sensors],
        "knowledge": source.knowledge,
        "flow": _flow_kind(source),
        "continuous": sorted(source.scenario.increment_sensors),
        "period": source.period,
        "links": [list(pair) for pair in source.scenario.topology.directions[:MAX_LINKS]],
        "limits": {name: value for name, value in limits.items() if math.isfinite(value)},
    }


def thinning_rules(data: dict[str, Any]) -> list[str]:
    """Return sentences on what ``run_data`` left out of a long run."""
    rules = []
    messages, totals = data["messages"], data["totals"]
    if messages["step"] > 1:
        rules.append(
            f"of {totals['messages']:,} messages the page holds {messages['count']:,}: all sent "
            f"from {messages['start']:.6g} to {messages['end']:.6g} s, and outside of that every "
            f"{messages['step']}th of each directed link by its number. Totals, traffic and ages "
            "of information are of all messages"
        )
    if data["samples"]["step"] > 1:
        rules.append(
            f"of {totals['samples']:,} sample times the page holds {data['samples']['count']:,}: "
            f"every {data['samples']['step']}th, the last, and the worst instants of the nodes "
            "with the largest errors. Averages are of all samples"
        )
    if totals["links"] > len(data["links"]):
        rules.append(
            f"of {totals['links']:,} directed links the first {len(data['links']):,} are drawn"
        )
    for name, label in (
        ("senses", "sensor readings"),
        ("marks", "other events of nodes"),
        ("innovations", "innovations"),
    ):
        columns = data[name]
        if columns is not None and columns["step"] > 1:
            rules.append(
                f"of {columns['total']:,} {label} the page holds every {columns['step']}th"
            )
    return rules


def sample_indices(run: StoredRun, max_values: int, instant: float) -> np.ndarray:
    """Return the sorted indices (K,) of the samples that a page holds: all, or every k-th, the
    last, that at ``instant`` (s) and each node's worst, as far as ``max_values`` numbers reach.
    """
    n, count = run.x.shape[1], len(run.nodes)
    # The numbers of a sample: for each node xhat, the upper triangle of P, squared error, NEES,
    # bound and age of information; for all nodes x and the time.
    values_per_sample = count * (n + n * (n + 1) // 2 + 4) + n + 1
    max_samples = max(2, max_values // max(1, values_per_sample))
    total = len(run.times)
    if total <= max_samples:
        return np.arange(total)
    step = -(-total // max(1, max_samples - 1))
    at_instant = min(int(np.searchsorted(run.times, instant)), total - 1)
    indices = {*range(0, total, step), at_instant, total - 1}
    if run.truth_known:
        error = np.where(np.isfinite(run.sq_error), run.sq_error, -1.0)
        worst_first = np.argsort(-error.max(axis=0), kind="stable")
        # A dictionary keeps the order of its keys, and each of them once.
        worst = dict.fromkeys(error.argmax(axis=0)[worst_first].tolist())
        indices.update(list(worst)[:max_samples])
    return np.array(sorted(indices))


def positions(source: ReportSource, run: StoredRun) -> list[list[float]]:
    """Return the [x, y] of each node on the page, in 0 .. 1: the scenario's, or a layout."""
    coordinates = get_positions(source.scenario, run)
    points = np.array([coordinates[node] for node in run.nodes], dtype=float).reshape(-1, 2)
    if not len(points) or not np.isfinite(points).all():
        return [[0.5, 0.5] for _ in run.nodes]
    low, high = points.min(axis=0), points.max(axis=0)
    size = max(float((high - low).max()), 1e-12)
    points = (points - 0.5 * (low + high)) / size
    return [[round(0.5 + x, 5), round(0.5 - y, 5)] for x, y in points.tolist()]


def _flow_kind(source: ReportSource) -> str:
    """Return how messages change their receivers: "combine", "swap", "readings" or "pooled"."""
    node_filter = source.scenario.node_filter
    if node_filter.timing.pooled:
        return "pooled"
    if node_filter.analysis.swaps:
        return "swap"
    return "combine" if node_filter.analysis.tells_estimates(-1) else "readings"


def _state_axes(source: ReportSource, run: StoredRun, worst: WorstSample | None) -> list[int]:
    n, observed_states = run.xhat.shape[2], set[int]()
    # Nodes with blocks of their own have other states in the same columns.
    for sensor in source.scenario.sensors if source.scenario.views is None else ():
        H = getattr(sensor, "H", None)
        if H is not None:
            observed_states |= set(np.flatnonzero(np.any(np.asarray(H) != 0.0, axis=0)).tolist())
    axes = sorted(observed_states)[:2] if len(observed_states) >= 2 else [0, min(1, n - 1)]
    if worst is None or not worst.by_error:
        return axes
    row, column = int(np.searchsorted(run.times, worst.time)), run.nodes.index(worst.node)
    by_error = np.argsort(-np.abs(run.error[row, column]), kind="stable").tolist()
    return axes if by_error[0] in axes else sorted(by_error[:2])


def _sample_columns(
    source: ReportSource, run: StoredRun, rows: np.ndarray, messages: np.ndarray, packer: Packer
) -> dict[str, Any]:
    """Return the samples ``rows`` (K,) for the live views; columns are added to ``packer``."""
    n = run.xhat.shape[2]
    i, j = np.triu_indices(n)  # P is symmetric: its upper triangle is enough
    total = len(run.times)
    times = run.times[rows]
    ages = information_age(messages, run.nodes, times, source.cutoffs(times))
    columns = {
        "t": packer.add(times, "f8"),
        "xhat": packer.add(run.xhat[rows], "f8"),
        "P": packer.add(run.P[rows][..., i, j], "f8"),
        "age": packer.add(ages, "f8"),
    }
    if run.truth_known:
        # There is no truth that all nodes estimate where each estimates its own blocks.
        if source.scenario.views is None:
            columns["x"] = packer.add(run.x[rows], "f8")
        columns["sq_error"] = packer.add(run.sq_error[rows], "f8")
        columns["nees"] = packer.add(run.nees[rows], "f8")
    # (T, N) bound on the trace of P by theory.
    bound = source.promised.bound if source.promised is not None else None
    if bound is not None and bound.shape == (total, len(run.nodes)):
        columns["bound"] = packer.add(bound[rows], "f8")
    sizes = source.scenario.sizes.tolist()
    intervals = {size: list(nees_bounds(size)) for size in sizes}
    step = 1
    if len(rows) < total:
        # Thinned samples are said to be thinned, even if the first two are neighbours.
        step = max(int(rows[1] - rows[0]), 2) if len(rows) > 1 else 2
    views = source.scenario.views or [np.arange(n)]
    blocks = judged_blocks(source.scenario)
    if run.truth_known and len(blocks) > len(sizes):
        for k, (h, _, own, _) in enumerate(blocks):
            square = np.ix_(rows, np.array([h]), own, own)
            e, P = run.error[np.ix_(rows, np.array([h]), own)], run.P[square]
            columns[f"nees_of_block_{k}"] = packer.add(errors(e, P)[1][:, 0], "f8")
    of_nodes = {
        "one_state": all(np.array_equal(views[0], view) for view in views),
        "sizes": sizes,
        "nees_intervals": [intervals[size] for size in sizes],
        "blocks": [[block.node, block.block] for block in blocks],
    }
    return {"columns": columns, "count": len(rows), "step": step, **of_nodes}


def _message_columns(thinned: ThinnedMessages, run: StoredRun, packer: Packer) -> dict[str, Any]:
    """Return the messages for the live views; ``number`` is the difference from the row before."""
    messages = thinned.messages
    nodes = np.array(run.nodes)
    ended = np.where(np.isnan(messages["ended"]), np.inf, messages["ended"])
    columns = {
        "sent": packer.add(messages["sent"], "f8"),
        # Most messages take no time, and zeros compress to almost nothing.
        "travel": packer.add(np.where(ended == messages["sent"], 0.0, ended), "f8"),
        "age": packer.add(np.nan_to_num(messages["age"], nan=0.0), "f8"),
        "sender": packer.add(np.searchsorted(nodes, messages["sender"]), "u2"),
        "receiver": packer.add(np.searchsorted(nodes, messages["receiver"]), "u2"),
        "number": packer.add(np.diff(messages["number"], prepend=0) & 0xFFFFFFFF, "u4"),
        "phase": packer.add(np.clip(messages["phase"], -1, 32767), "i2"),
        "outcome": packer.add(messages["outcome"], "u1"),
    }
    is_thinned = thinned.step > 1
    return {
        "columns": columns,
        "count": len(messages),
        "step": thinned.step,
        "start": thinned.start if is_thinned else None,
        "end": thinned.end if is_thinned else None,
    }


def _event_columns(
    run: StoredRun, kinds: tuple[str, ...], max_events: int, packer: Packer
) -> dict[str, Any]:
    """Return the events of ``kinds`` for the live views, every k-th if more than ``max_events``."""
    rows = rows_of(run.log, *kinds)
    step = max(1, -(-len(rows) // max(1, max_events)))
    events = rows[::step]
    columns = {
        "t": packer.add(events["t"], "f8"),
        "node": packer.add(np.searchsorted(np.array(run.nodes), events["node"]), "u2"),
        "kind": packer.add(events["kind"], "u1"),
    }
    names = {CODES[kind]: kind for kind in kinds}
    return {"columns": columns, "step": step, "total": len(rows), "names": names}


class ThinnedMessages(NamedTuple):
    """MESSAGE rows that a page holds: all sent from ``start`` to ``end`` seconds, and of the others
    those whose number on their directed link is a multiple of ``step``.
    """

    messages: np.ndarray
    start: float
    end: float
    step: int


def thin_messages(messages: np.ndarray, max_messages: int, instant: float) -> ThinnedMessages:
    """Return about ``max_messages`` MESSAGE rows: half around ``instant`` (s), half of the run."""
    if len(messages) <= max_messages:
        return ThinnedMessages(messages, -np.inf, np.inf, 1)
    sent = np.sort(messages["sent"])
    half = max_messages // 2
    # A fifth of the interval's messages are after the instant, so that a chart around it is whole.
    last = int(np.searchsorted(sent, instant, side="right")) + half // 5
    last = min(max(last, half), len(sent))
    start, end = float(sent[last - half]), float(sent[last - 1])
    inside = (messages["sent"] >= start) & (messages["sent"] <= end)
    step = -(-len(messages) // max(1, half))
    return ThinnedMessages(messages[inside | (messages["number"] % step == 0)], start, end, step)


def information_age(
    messages: np.ndarray, nodes: tuple[int, ...], times: FloatArray, cutoffs: FloatArray
) -> FloatArray:
    """Return the age (T, N) in seconds of the newest delivered message, averaged over links into a
    node, of samples with ``cutoffs`` (T,); before the first the time since 0, nan without links.
    """
    total = np.zeros((len(times), len(nodes)))
    links = np.zeros(len(nodes))
    for link in by_link(messages):
        column = int(np.searchsorted(nodes, link["receiver"][0]))
        arrived = link[link["outcome"] == DELIVERED]
        arrived = arrived[np.argsort(arrived["ended"], kind="stable")]
        newest = newest_heard(arrived["ended"], arrived["sent"], cutoffs)
        total[:, column] += np.maximum(0.0, times - newest)
        links[column] += 1.0
    with np.errstate(invalid="ignore"):
        return np.asarray(total / np.where(links > 0.0, links, np.nan))


def bin_messages(messages: np.ndarray, horizon: float, bins: int) -> dict[str, list[int]]:
    """Return by outcome the numbers (bins,) of messages sent in equal parts of ``horizon`` s."""
    edges = np.linspace(0.0, max(horizon, 1e-300), bins + 1)
    names = {"delivered": DELIVERED, "lost": LOST, "late": LATE, "under way": UNDER_WAY}
    return {
        name: np.histogram(messages["sent"][messages["outcome"] == code], edges)[0].tolist()
        for name, code in names.items()
    }
