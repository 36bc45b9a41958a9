"""Sentences at the top of a page, computed from the data: the worst node, why, and the bound."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable

import numpy as np
import scipy

from netkf.checks.innovations import Innovations
from netkf.core.printable import count_phrase
from netkf.engines.soundness import describe_divergence
from netkf.linalg.arrays import FloatArray
from netkf.report.data import describe_innovations, information_age
from netkf.report.directories import (
    ReportSource,
    StartUp,
    WorstSample,
    WorstSamples,
    describe_replica,
    summary_samples,
)
from netkf.runs.outcomes import downtimes
from netkf.runs.stored import StoredRun
from netkf.runs.summary import CONFIDENCE
from netkf.runs.tables import format_number, format_with_error
from netkf.studies.compare import Comparison, Entry, quantity_label
from netkf.studies.opening import StoredComparison
from netkf.theory.common.papers import PAPERS
from netkf.trace.messages import DELIVERED, LATE, LOST
from netkf.trace.run import first_difference

UNUSUAL_SHARE = 0.9
"""An age of information is called unusually old if it exceeds this share of the node's samples."""
MIN_AGES = 10
"""Samples that a node needs before one of its ages of information is compared with the others."""
ARRIVAL_DEVIATIONS = 4.0
"""Standard deviations from which on a delivery ratio of a node differs from that of all."""
ROUNDING = 1e-9
"""Relative excess of a bound that rounding explains."""
MAX_LISTED = 4
"""Nodes or links that a sentence lists."""
MAX_COMPARED = 500_000
"""Events of a run up to which two runs are compared event by event."""
PAPER = f". H is the paper {PAPERS['H']}"
FALSE_ALARM = 0.01
"""Probability that the NEES of at least one sample of a run is called too large if P is exact."""


def describe_source(
    source: ReportSource, messages: np.ndarray, readings: Innovations | str | None = None
) -> list[str]:
    """Return the sentences on top of the page, the most important first, without full stops, from
    MESSAGE rows ``messages`` (M,), none without a run, and innovations or the reason for none.
    """
    if source.kind == "sweep":
        return [*_describe_status(source), *_describe_sweep(source)]
    if source.kind == "verdict":
        return _describe_verdict(source)
    if source.filters is not None:
        return _describe_filters(source.filters)
    sentences = _describe_status(source)
    if source.kind == "ensemble":
        sentences += [*_describe_ensemble(source), *_describe_bound(source)]
        if source.run is not None:
            sentences.append(describe_replica(source.run.replica, source.runs, source.replicas))
    elif source.run is not None and len(source.run.times):
        sentences += _describe_worst_node(source, source.run, messages)
        if isinstance(readings, Innovations):
            sentences.append(describe_innovations(readings, source.scenario))
        sentences += _describe_bound(source)
    elif source.status == "complete":
        sentences.append(
            "No samples were recorded, so there is nothing to animate: run again with --trace full"
        )
    if source.verdict is not None:
        sentences += _describe_verdict(source)
    return sentences


def describe_differences(
    comparison: Comparison | str, first: ReportSource, second: ReportSource
) -> list[str]:
    """Return sentences on how two sources differ, or ``comparison``, the reason why not known."""
    if isinstance(comparison, str):
        return [comparison]
    of_all = {row.quantity: row.entries for row in comparison.rows if row.node < 0}
    measure = "rms_error" if of_all["rms_error"][0].value is not None else "mean_trace"
    sentences = [_describe_winner(measure, *of_all[measure])]
    # ``real``: the interval of the difference excludes 0.
    others = [
        f"{quantity_label(name)} ({format_number(b.value)} against {format_number(a.value)})"
        for name, (a, b) in of_all.items()
        if b.real and name != measure
    ]
    if others:
        sentences.append(f"Other certain differences of B from A: {', '.join(others)}")
    remarks = [remark[:1].upper() + remark[1:] for remark in comparison.remarks()]
    return sentences + remarks + _describe_first_difference(first, second)


def _describe_winner(name: str, a: Entry, b: Entry) -> str:
    """Return which of two values, of A and of B, is smaller, and if that is certain."""
    label = quantity_label(name)
    if a.value is None or b.value is None:
        return f"The {label} of {'A' if a.value is None else 'B'} is unknown"
    if a.value == b.value:
        return f"A and B have the same {label}, {format_number(a.value)}"
    (better, less), (worse, more) = sorted([("A", a.value), ("B", b.value)], key=lambda e: e[1])
    sentence = f"{better} has the smaller {label}: {format_number(less)} against "
    sentence += f"{format_number(more)} of {worse}"
    sentence += f" ({100.0 * (less / more - 1.0):.3g} %)" if more > 0.0 else ""
    if b.low is None:
        return f"{sentence}. Single runs have no intervals, so no difference is certain"
    ends = f"{format_number(b.low)} .. {format_number(b.high)}"
    of_squares = " of mean squares" if "squares" in b.method else ""
    certain = "certain" if b.real else "not certain"
    return f"{sentence}; that is {certain}: the difference{of_squares}, B - A, lies in {ends}"


def _describe_first_difference(first: ReportSource, second: ReportSource) -> list[str]:
    if first.run is None or second.run is None:
        return []
    if max(len(first.run.log), len(second.run.log)) > MAX_COMPARED:
        return []
    if (first.run.nodes, first.run.seed) != (second.run.nodes, second.run.seed):
        return []  # the runs differ from the first event on
    replica = "" if first.kind == "run" else f" of replica {first.run.replica}"
    difference = first_difference(first.run, second.run)
    if difference is None:
        return [f"All {len(first.run.log):,} events{replica} are the same"]
    return [f"First difference{replica}: {difference}"]


def _describe_status(source: ReportSource) -> list[str]:
    """Return sentences on what limits the results: interruption, failure, divergence, one node."""
    sentences, run = [], source.run
    if source.status == "interrupted":
        sentences.append(_describe_interruption(source))
    elif source.status == "failed":
        sentences.append(f"Failed: {source.manifest.get('error', 'no reason was written')}")
    if run is not None and run.count("diverged"):
        problem = describe_divergence(run.nodes, run.x, run.xhat, run.P, run.error)
        sentences.append(
            f"Diverged: {problem} at {_format_time(float(run.times[-1]))}, and the run ended there"
        )
    if run is not None and len(run.nodes) == 1:
        sentences.append("There is one node, so nothing is sent")
    return sentences


def _describe_interruption(source: ReportSource) -> str:
    runs = source.manifest["runs"]
    if runs["wanted"] > 1:
        progress = f"{runs['done']:,} of {runs['wanted']:,} runs are done"
    elif source.run is not None and len(source.run.times):
        last_time = float(source.run.times[-1])
        progress = f"the run stopped after its sample at {_format_time(last_time)}"
    else:
        progress = "the run stopped before its first sample"
    return f"Interrupted: {progress}. This page covers only the part that was finished"


def _describe_worst_node(source: ReportSource, run: StoredRun, messages: np.ndarray) -> list[str]:
    if source.worst is None:
        return []
    worst = source.worst.overall
    count = len(run.nodes)
    # The sample at time 0 is not averaged: it shows the initial condition, not the filter.
    skips_start = run.times[0] <= 0.0 < worst.time
    if not worst.by_error:
        start = "after time 0 " if skips_start else ""
        finding = (
            "There is no ground truth: errors are unavailable. By its own covariance node "
            f"{worst.node} was least certain: square root of mean trace P "
            f"{format_number(worst.value)}, the largest of {count} nodes; "
            f"{start}it peaked at {_format_time(worst.time)} with {format_number(worst.peak)}"
        )
    else:
        overall = source.summary.get("overall", {}).get("rms_error")
        rank = f", the largest of {count} nodes (all nodes {format_number(overall)})"
        start = "After time 0 its" if skips_start else "Its"
        finding = (
            f"Node {worst.node} was worst: RMS error {format_number(worst.value)} over time"
            f"{rank if count > 1 else ''}. {start} error was largest at "
            f"{_format_time(worst.time)}: {format_number(worst.peak)}"
        )
    return [finding, *_explain_worst(source, run, messages, source.worst)]


def _explain_worst(
    source: ReportSource, run: StoredRun, messages: np.ndarray, samples: WorstSamples
) -> list[str]:
    worst, topology = samples.explained, source.scenario.topology
    received = messages[messages["receiver"] == worst.node]
    sentences = []
    if samples.start is not None:
        sentences.append(_describe_start_up(samples.overall, worst, samples.start))
    sentences += [
        f"It was down at {_format_time(worst.time)}, since {_format_time(one.begin)}"
        for one in downtimes(source.scenario, run.seed, run.replica)
        if one.node == worst.node and one.begin <= worst.time < one.end
    ]
    if len(received):
        # Messages that arrived later did not influence the sample.
        cutoff = float(source.cutoffs(np.array([worst.time]))[0])
        sentences.append(
            _describe_last_messages(received, worst, cutoff, lambda k: str(topology.named(k)))
            + _judge_age(source, run, received, worst)
            + _compare_delivery(messages, received)
        )
    if worst.by_error:
        sentences += _judge_error(source, run, worst)
    return sentences


def _describe_start_up(worst: WorstSample, later: WorstSample, start: StartUp) -> str:
    sentence = (
        f"The filters had just started at {_format_time(worst.time)}: trace P was "
        f"{format_number(start.now)}, {format_number(start.first)} at the first sample and "
        f"{format_number(start.last)} on average over the last ones"
    )
    if later.time == worst.time:
        return sentence
    quantity = "error" if worst.by_error else "square root of trace P"
    return (
        f"{sentence}. The largest {quantity} after this start-up was {format_number(later.peak)} "
        f"at {_format_time(later.time)}, which is explained here"
    )


def _judge_error(source: ReportSource, run: StoredRun, worst: WorstSample) -> list[str]:
    """Return a sentence on whether P allows the error of the worst sample; empty without NEES."""
    column, row = run.nodes.index(worst.node), int(np.searchsorted(run.times, worst.time))
    nees, n = float(run.nees[row, column]), int(source.scenario.sizes[column])
    if not math.isfinite(nees):
        return []
    # NEES is chi-square with n degrees of freedom if P is exact. The samples are dependent, so the
    # maximum over them is bounded by Bonferroni's inequality.
    samples = len(summary_samples(run, source.summary).errors) * len(run.nodes)
    limit = float(scipy.special.chdtri(n, FALSE_ALARM / samples))
    judgement = (
        f"far more than its P says: NEES {format_number(nees)}, above"
        if nees > limit
        else f"within what its P allows: NEES {format_number(nees)}, not above"
    )
    return [
        f"The error at {_format_time(worst.time)} was {judgement} {format_number(limit)}, which "
        f"the worst of {samples:,} samples exceeds with probability {FALSE_ALARM:.0%} at most if P "
        f"is exact (the mean is then {n})"
    ]


def _describe_last_messages(
    received: np.ndarray, worst: WorstSample, cutoff: float, label: Callable[[int], str]
) -> str:
    """Return a sentence on the last message of each neighbour by ``cutoff`` s, and losses."""
    # For each sender the seconds since its last message that arrived was sent, inf without one.
    ages, missing = [], 0
    for sender in np.unique(received["sender"]).tolist():
        link = received[(received["sender"] == sender) & (received["sent"] <= cutoff)]
        arrived = link[(link["outcome"] == DELIVERED) & (link["ended"] <= cutoff)]
        last_sent = float(arrived["sent"].max()) if len(arrived) else -math.inf
        missing += len(link[(link["sent"] > last_sent) & np.isin(link["outcome"], (LOST, LATE))])
        ages.append((max(0.0, worst.time - last_sent), sender))
    heard = sorted((entry for entry in ages if math.isfinite(entry[0])), reverse=True)
    oldest = [f"node {label(s)} ({format_number(age)} s before)" for age, s in heard[:MAX_LISTED]]
    listed = "it had last heard " + ", ".join(oldest) if oldest else "it had heard no node"
    if len(heard) > MAX_LISTED:
        listed += f" (the {MAX_LISTED} oldest of {len(heard)} links)"
    silent = len(ages) - len(heard)
    if oldest and silent:
        listed += f" and had not heard {count_phrase(silent, 'other node')} yet"
    losses = f"{count_phrase(missing, 'message')} to it had been lost or late "
    losses += "since" if oldest else "by then"
    return f"Why: {listed}; {losses}"


def _compare_delivery(messages: np.ndarray, received: np.ndarray) -> str:
    """Return how delivery to a node differs from that of the run; empty if by chance."""
    node_count, total = max(1, len(received)), max(1, len(messages))
    node_ratio = int((received["outcome"] == DELIVERED).sum()) / node_count
    overall_ratio = int((messages["outcome"] == DELIVERED).sum()) / total
    # Standard deviation of the node's ratio if its messages arrive like all others.
    deviation = math.sqrt(overall_ratio * (1.0 - overall_ratio) / node_count)
    if abs(node_ratio - overall_ratio) <= ARRIVAL_DEVIATIONS * deviation:
        return ""
    return (
        f". Over the whole run {node_ratio:.1%} of {len(received):,} messages to it arrived, of "
        f"those to all nodes {overall_ratio:.1%}"
    )


def _judge_age(source: ReportSource, run: StoredRun, heard: np.ndarray, worst: WorstSample) -> str:
    """Return whether the node's information was unusually old at its worst sample, or ""."""
    # The latest arrivals (T,) that the estimates sampled at ``run.times`` (T,) include, in seconds.
    cutoffs = source.cutoffs(run.times)
    ages: FloatArray = information_age(heard, (worst.node,), run.times, cutoffs)[:, 0]
    age = ages[int(np.searchsorted(run.times, worst.time))]
    later_ages = ages[run.times > 0.0]
    # Without any arrival the age is the time since the start, which says nothing new.
    if len(later_ages) < MIN_AGES or not age < worst.time:
        return ""
    share = float((later_ages < age).mean())
    mean = format_number(float(later_ages.mean()))
    if share >= UNUSUAL_SHARE:
        return (
            f". That is unusually old: {format_number(float(age))} s on average over its links, "
            f"older than at {share:.0%} of its samples (mean {mean} s)"
        )
    return (
        f". That is not unusual: {format_number(float(age))} s on average over its links, mean "
        f"over the run {mean} s"
    )


def _describe_ensemble(source: ReportSource) -> list[str]:
    ensemble = source.ensemble
    assert ensemble is not None
    errors = np.sqrt(ensemble.average[:, 0])  # RMS errors of the nodes, then of all together
    if not np.isfinite(errors[:-1]).any():
        if not source.scenario.plant.truth_known:
            return ["There is no ground truth: errors are unavailable"]
        return ["No node has a finite RMS error"]
    k = int(np.nanargmax(errors[:-1]))
    rows = {row["node"]: row for row in source.summary.get("nodes", [])}
    error = rows.get(ensemble.nodes[k], {}).get("rms_error_se")
    return [
        f"Over {source.runs:,} runs node {ensemble.nodes[k]} was worst: RMS error "
        f"{format_with_error(float(errors[k]), error)}, the largest of {len(ensemble.nodes)} nodes "
        f"(all nodes {format_number(float(errors[-1]))})"
    ]


def _describe_bound(source: ReportSource) -> list[str]:
    return [text + PAPER if "H(" in text else text for text in _bound_sentence(source)]


def _bound_sentence(source: ReportSource) -> list[str]:
    summary = source.summary
    if not summary:
        return []
    rows = [row for row in summary["nodes"] if row["bound"] and row["mean_trace"] is not None]
    if not rows:
        return [f"No bound: {summary.get('bound', 'unknown')}"]
    # The text is like "H(12), promised by ...": the name of the bound comes first.
    bound = summary["bound"].split(",")[0]
    # The node with the largest ratio need not be one that exceeds the bound beyond its error.
    miss = (1.0 - CONFIDENCE) / len(rows)
    margin = -float(scipy.special.stdtrit(max(1, source.runs - 1), miss))
    # Where P does not depend on chance it may equal its bound, up to rounding.
    exceeding = [
        row
        for row in rows
        if source.runs > 1
        and float(row["mean_trace"]) - margin * float(row.get("mean_trace_se") or 0.0)
        > (1.0 + ROUNDING) * float(row["bound"])
    ]
    top = max(exceeding or rows, key=lambda row: float(row["mean_trace"]) / float(row["bound"]))
    ratio = float(top["mean_trace"]) / float(top["bound"])
    numbers = (
        f"mean trace P {format_with_error(top['mean_trace'], top.get('mean_trace_se'))} against "
        f"{format_number(top['bound'])} at node {top['node']}, ratio {format_number(ratio)}"
    )
    if exceeding:
        return [
            f"The bound of {bound} is exceeded by more than {margin:.2g} standard errors at "
            f"{len(exceeding)} of {len(rows)} nodes; most: {numbers}"
        ]
    if source.runs > 1:
        return [f"The bound of {bound} holds; closest: {numbers}"]
    side = "below" if ratio <= 1.0 else "above"
    return [
        f"The bound of {bound} is about the mean over runs. In this one run "
        f"P was {side} it: largest {numbers}. netkf check decides if it holds"
    ]


def _describe_verdict(source: ReportSource) -> list[str]:
    verdict = source.verdict or {}
    rows = verdict.get("rows", [])
    # Each row is one promise; its verdict is holds, broken, undecided or not promised.
    counts = Counter(str(row["verdict"]) for row in rows)
    broken = counts["broken"]
    if broken:
        result = f"{broken} promises are broken" if broken > 1 else "1 promise is broken"
    else:
        result = "No promise is broken"
    listed = ", ".join(f"{counts[name]} {name}" for name in sorted(counts))
    summary = (
        f"{result} in {verdict.get('runs', 0):,} runs ({listed}); all intervals hold together "
        f"with probability {format_number(verdict.get('confidence'))}"
    )
    broken_promises = [
        f"Broken: {row['promise']} [{row['source']}]" for row in rows if row["verdict"] == "broken"
    ]
    return [summary, *broken_promises]


def _describe_sweep(source: ReportSource) -> list[str]:
    assert source.sweep is not None
    table, keys = source.sweep.table, source.sweep.keys
    if not len(table):
        return ["The sweep has no finished point yet"]
    worst_rms = table["worst_rms"].to_numpy(dtype=np.float64)
    if not np.isfinite(worst_rms).any():
        return [f"{len(table):,} points; none has a finite error"]
    best = table.iloc[int(np.nanargmin(worst_rms))]
    settings = ", ".join(f"{key} = {best[key]}" for key in keys)
    return [
        f"Of {len(table):,} points the worst node did best at {settings}: RMS error "
        f"{format_number(float(best['worst_rms']))}; the largest is "
        f"{format_number(float(np.nanmax(worst_rms)))}"
    ]


def _describe_filters(comparison: StoredComparison) -> list[str]:
    rows = [row for row in comparison.rows if row.ran and math.isfinite(row.rms_error.value)]
    if not rows:
        return ["No filter has a finite RMS error"]
    best = min(rows, key=lambda row: row.rms_error.value)
    listed = ", ".join(f"{row.filter} {format_number(row.rms_error.value)}" for row in rows)
    sentences = [
        f"Of {len(rows)} filters over {comparison.runs:,} runs of each, {best.filter} had the "
        f"smallest RMS error ({listed})"
    ]
    for row in rows:
        error = row.rms_error
        if error.real:
            side = "less" if error.difference < 0.0 else "more"
            sentences.append(
                f"Certain: the RMS error of {row.filter} is {side} than that of "
                f"{comparison.first}, by {format_number(abs(error.difference))}; the difference "
                f"lies in {format_number(error.low)} .. {format_number(error.high)}"
            )
    if len(sentences) == 1:
        sentences.append(f"No difference of RMS errors from {comparison.first} is certain")
    # "-": unknown, as for a single run.
    inconsistent = [
        f"{row.filter} ({row.consistency})"
        for row in rows
        if row.consistency not in ("consistent", "-")
    ]
    if inconsistent:
        sentences.append(f"P does not describe the errors of {', '.join(inconsistent)}")
    incomplete = [row for row in comparison.rows if row.status != "complete"]
    return sentences + [f"{row.filter}: {row.status}" for row in incomplete]


def _format_time(seconds: float) -> str:
    return f"t = {seconds:.6g} s"
