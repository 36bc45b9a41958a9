"""Sentences computed from the data: which node was worst, when, why, and if the bound holds."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import scipy.special

from netkf.checks.report import PAPERS
from netkf.linalg.arrays import FloatArray
from netkf.report.directories import Opened
from netkf.report.innovations import innovation_claim
from netkf.report.messages import DELIVERED, LATE, LOST, information_age
from netkf.report.worst import StartUp, Worst, WorstSample, samples_averaged
from netkf.runs.innovations import Innovations
from netkf.runs.stored import StoredRun
from netkf.runs.tables import format_number
from netkf.studies.compare import Comparison
from netkf.studies.compare_filters import ComparedFilter
from netkf.studies.filter_values import Quantity
from netkf.studies.stored import StoredComparison
from netkf.trace.run import first_difference
from netkf.trace.schema import CODES

UNUSUAL = 0.9
"""Share of a node's samples whose age of information an unusual one exceeds."""
MAX_LISTED = 4
"""Links that a sentence lists."""
MAX_COMPARED = 500_000
"""Events of a run up to which two runs are compared event by event."""
LABELS = {"rms_error": "RMS error", "mean_trace": "mean trace P", "mean_nees": "mean NEES"}
PAPER = f". H is the paper {PAPERS['H']}"
CERTAIN = 0.01
"""Probability that, where P is exact, the NEES of any sample of a run is called too large."""


def findings(
    source: Opened, messages: np.ndarray, readings: Innovations | str | None = None
) -> list[str]:
    """Return sentences about a source with these MESSAGE rows and innovations of its ``readings``,
    the most important first.
    """
    if source.kind == "sweep":
        return [*_describe_ending(source), *_describe_sweep(source)]
    if source.kind == "verdict":
        return _describe_verdict(source)
    if source.filters is not None:
        return _of_filters(source.filters)
    found = [*_describe_ending(source)]
    if source.kind == "ensemble":
        found += [*_of_ensemble(source), *_describe_bound(source)]
    elif source.run is not None and len(source.run.times):
        found += _describe_trace(source, source.run, messages)
        found += [innovation_claim(readings)] if isinstance(readings, Innovations) else []
        found += _describe_bound(source)
    elif source.status == "complete":
        found.append("No samples were recorded, so nothing moves here: run again with --trace full")
    if source.verdict is not None:
        found += _describe_verdict(source)
    return found


def difference_findings(comparison: Comparison | str, one: Opened, other: Opened) -> list[str]:
    """Return sentences on how two sources, A and B, differ: certain differences of all nodes
    together, and the first event in which two single runs differ.
    """
    if isinstance(comparison, str):
        return [comparison]
    found = []
    for quantity, node, entries in comparison.rows:
        entry = entries[1]
        if entry.real and node < 0:
            name = LABELS.get(quantity, f"messages {quantity}")
            found.append(
                f"Certain: {name} of B is {format_number(entry.value)}, of A "
                f"{format_number(entries[0].value)}; the difference lies in "
                f"{format_number(entry.low)} .. {format_number(entry.high)}"
            )
    if not found:
        single = min(comparison.runs) < 2
        found = ["One run says nothing about certainty" if single else "No difference is certain"]
    return found + _first_event(one, other)


def _first_event(one: Opened, other: Opened) -> list[str]:
    """Return the first event in which two recorded runs differ."""
    if one.run is None or other.run is None:
        return []
    if max(len(one.run.log), len(other.run.log)) > MAX_COMPARED:
        return []
    if (one.run.nodes, one.run.seed) != (other.run.nodes, other.run.seed):
        return []  # they differ from the start
    which = "" if one.kind == "run" else f" of replica {one.run.replica}"
    difference = first_difference(one.run, other.run)
    if difference is None:
        return [f"All {len(one.run.log):,} events{which} are the same"]
    return [f"First difference{which}: {difference}"]


def _describe_ending(source: Opened) -> list[str]:
    """Return sentences on a run that did not end as planned, or on one that never began."""
    found, run = [], source.run
    if source.status == "interrupted":
        done = source.manifest["runs"]
        many = f"{done['done']:,} of {done['wanted']:,} runs are done"
        sampled = run is not None and len(run.times) > 0
        reached = (
            f"after its sample at {_format_time(_last_time(run))}"
            if sampled
            else "before it was sampled"
        )
        what = many if done["wanted"] > 1 else f"the run stopped {reached}"
        found.append(f"Interrupted: {what}. Everything here is about what was finished")
    elif source.status == "failed":
        found.append(f"Failed: {source.manifest.get('error', 'no reason was written')}")
    if run is not None and run.count("diverged"):
        rows = run.log[run.log["kind"] == CODES["diverged"]]
        nodes = ", ".join(map(str, rows["node"][:MAX_LISTED].tolist()))
        more = ", ..." if len(rows) > MAX_LISTED else ""
        when = _format_time(float(rows["t"][0])) if len(rows) else "an unknown time"
        found.append(
            f"Diverged: at {when} the estimate or the covariance of node {nodes}{more} was no "
            "longer usable, and the run ended there"
        )
    if run is not None and len(run.nodes) == 1:
        found.append("There is one node, so nothing is sent")
    return found


def _last_time(run: StoredRun | None) -> float:
    """Return the last sampled time in seconds, 0 without samples."""
    return float(run.times[-1]) if run is not None and len(run.times) else 0.0


def _describe_trace(source: Opened, run: StoredRun, messages: np.ndarray) -> list[str]:
    """Return the claims on the worst node of a run with a trace."""
    sample = source.worst
    if sample is None:
        return []
    worst = sample.overall
    count = len(run.nodes)
    if not worst.by_error:
        return [
            "There is no ground truth, so nobody knows which node was most wrong. Least certain by "
            f"its own covariance was node {worst.node}: square root of mean trace P "
            f"{format_number(worst.value)}, the largest of {count} nodes; "
            f"{_describe_start(run, worst)}it peaked at {_format_time(worst.time)} with "
            f"{format_number(worst.peak)}",
            *_explain_worst(source, run, messages, sample),
        ]
    overall = source.summary.get("overall", {}).get("rms_error")
    rank = f", the largest of {count} nodes (all nodes {format_number(overall)})"
    return [
        f"Node {worst.node} was worst: RMS error {format_number(worst.value)} over time"
        f"{rank if count > 1 else ''}. {_describe_start(run, worst).capitalize()}its error was "
        f"largest at {_format_time(worst.time)}: {format_number(worst.peak)}",
        *_explain_worst(source, run, messages, sample),
    ]


def _describe_start(run: StoredRun, worst: Worst) -> str:
    """Return the words that say that the worst sample is not looked for at time 0."""
    return "after time 0 " if run.times[0] <= 0.0 < worst.time else ""


def _explain_worst(
    source: Opened, run: StoredRun, messages: np.ndarray, sample: WorstSample
) -> list[str]:
    """Return sentences on the worst sample after the start-up: what was heard, and P."""
    worst = sample.explained
    into = messages[messages["receiver"] == worst.node]
    found = []
    if sample.start is not None:
        found.append(_startup_claim(sample.overall, worst, sample.start))
    if len(into):
        cut = float(source.cuts(np.array([worst.time]))[0])
        why = _describe_heard(into, worst, cut) + _describe_unusual(source, run, into, worst)
        found.append(why + _describe_arrivals(messages, into))
    if worst.by_error:
        found += _judge_error(source, run, worst)
    return found


def _startup_claim(worst: Worst, later: Worst, start: StartUp) -> str:
    """Return that the worst sample was in the start-up, and which one is explained instead."""
    said = (
        f"The filters had just started at {_format_time(worst.time)}: trace P was "
        f"{format_number(start.now)}, {format_number(start.first)} at the first sample and "
        f"{format_number(start.last)} on average over the last ones"
    )
    if later.time == worst.time:
        return said
    what = "error" if worst.by_error else "square root of trace P"
    return (
        f"{said}. The largest {what} after this start-up was {format_number(later.peak)} at "
        f"{_format_time(later.time)}, which is explained here"
    )


def _judge_error(source: Opened, run: StoredRun, worst: Worst) -> list[str]:
    """Return a sentence: whether P allows the error of a sample that was chosen for its size."""
    k, at = run.nodes.index(worst.node), int(np.searchsorted(run.times, worst.time))
    nees, n = float(run.nees[at, k]), run.x.shape[1]
    if not math.isfinite(nees):
        return []
    # NEES is chi-square with n degrees of freedom where P is exact. Bonferroni: the samples of all
    # nodes were looked at, dependent as they are.
    looked = len(samples_averaged(run, source.summary).errors) * len(run.nodes)
    limit = float(scipy.special.chdtri(n, CERTAIN / looked))
    judged = (
        f"far more than its P says: NEES {format_number(nees)}, above"
        if nees > limit
        else f"within what its P allows: NEES {format_number(nees)}, not above"
    )
    return [
        f"The error at {_format_time(worst.time)} was {judged} {format_number(limit)}, which the "
        f"worst of {looked:,} samples exceeds with probability {CERTAIN:.0%} at most where P is "
        f"exact (the mean is {n} then)"
    ]


def _describe_heard(into: np.ndarray, worst: Worst, cut: float) -> str:
    """Return a sentence: when the node had last heard whom by ``cut`` seconds, and the losses
    since.
    """
    links, missing = [], 0
    for sender in np.unique(into["sender"]).tolist():
        link = into[(into["sender"] == sender) & (into["sent"] <= cut)]
        arrived = link[(link["outcome"] == DELIVERED) & (link["ended"] <= cut)]
        since = float(arrived["sent"].max()) if len(arrived) else -math.inf
        after = link[(link["sent"] > since) & np.isin(link["outcome"], (LOST, LATE))]
        missing += len(after)
        links.append((max(0.0, worst.time - since), sender))
    heard = sorted((link for link in links if math.isfinite(link[0])), reverse=True)
    parts = [f"node {sender} ({format_number(age)} s before)" for age, sender in heard[:MAX_LISTED]]
    listed = "it had last heard " + ", ".join(parts) if parts else "it had heard nobody"
    if len(heard) > MAX_LISTED:
        listed += f" (the {MAX_LISTED} oldest of {len(heard)} links)"
    silent = len(links) - len(heard)
    if parts and silent:
        listed += f" and had not heard {silent} other node{'s' if silent > 1 else ''} yet"
    lost = f"{missing:,} message{'s' if missing != 1 else ''} to it had been lost or late "
    lost += "since" if parts else "by then"
    return f"Why: {listed}; {lost}"


def _describe_arrivals(messages: np.ndarray, into: np.ndarray) -> str:
    """Return how many messages to the node arrived in the whole run, where that is unusual."""
    counts = [int((rows["outcome"] == DELIVERED).sum()) for rows in (into, messages)]
    own, all_nodes = counts[0] / max(1, len(into)), counts[1] / max(1, len(messages))
    # Four standard deviations of a share of independent messages.
    if abs(own - all_nodes) <= 4.0 * math.sqrt(all_nodes * (1.0 - all_nodes) / max(1, len(into))):
        return ""
    return (
        f". Over the whole run {own:.1%} of {len(into):,} messages to it arrived, of those to all "
        f"nodes {all_nodes:.1%}"
    )


def _describe_unusual(source: Opened, run: StoredRun, into: np.ndarray, worst: Worst) -> str:
    """Return a sentence if the age of the node's information was unusual at its worst instant."""
    cuts = source.cuts(run.times)
    ages: FloatArray = information_age(into, (worst.node,), run.times, cuts)[:, 0]
    now = ages[int(np.searchsorted(run.times, worst.time))]
    later = ages[run.times > 0.0]
    if len(later) < 10 or not now < worst.time:  # too few to compare with, or nothing heard yet
        return ""
    share = float((later < now).mean())
    mean = format_number(float(later.mean()))
    if share >= UNUSUAL:
        return (
            f". That is unusually old: {format_number(float(now))} s on average over its links, "
            f"older than at {share:.0%} of its samples (mean {mean} s)"
        )
    return (
        f". That is not unusual: {format_number(float(now))} s on average over its links, mean "
        f"over the run {mean} s"
    )


def _of_ensemble(source: Opened) -> list[str]:
    """Return which node was worst over all runs, or over those that were kept."""
    found = source.ensemble
    assert found is not None
    errors = np.sqrt(found.average[:, 0])  # of the nodes, and last of all together
    if not np.isfinite(errors[:-1]).any():
        if not source.scenario.plant.truth_known:
            return ["There is no ground truth: errors are unavailable"]
        return ["No node has a finite RMS error"]
    k = int(np.nanargmax(errors[:-1]))
    rows = {row["node"]: row for row in source.summary.get("nodes", [])}
    error = rows.get(found.nodes[k], {}).get("rms_error_se")
    interval = f" +- {error:.1g}" if error is not None else ""
    return [
        f"Over {source.runs:,} runs node {found.nodes[k]} was worst: RMS error "
        f"{format_number(float(errors[k]))}{interval}, the largest of {len(found.nodes)} nodes "
        f"(all nodes {format_number(float(errors[-1]))})"
    ]


def _describe_bound(source: Opened) -> list[str]:
    """Return how the traces of P lie beside the bound: one run does not decide about a mean."""
    summary = source.summary
    if not summary:
        return []
    rows = [row for row in summary["nodes"] if row["bound"] and row["mean_trace"] is not None]
    if not rows:
        return [f"No bound: {summary.get('bound', 'unknown')}{PAPER}"]
    top = max(rows, key=lambda row: float(row["mean_trace"]) / float(row["bound"]))
    ratio = float(top["mean_trace"]) / float(top["bound"])
    numbers = (
        f"mean trace P {format_number(top['mean_trace'])}{_standard_error_text(top)} against "
        f"{format_number(top['bound'])} at node {top['node']}, ratio {format_number(ratio)}"
    )
    if source.runs > 1:
        error = float(top.get("mean_trace_se") or 0.0)
        above = float(top["mean_trace"]) - 2.0 * error > float(top["bound"])
        held = "is exceeded by more than two standard errors" if above else "holds"
        return [f"The bound {summary['bound'].split(',')[0]} {held}; closest: {numbers}{PAPER}"]
    side = "below" if ratio <= 1.0 else "above"
    return [
        f"The bound {summary['bound'].split(',')[0]} is about the mean over runs. In this one run "
        f"P was {side} it: largest {numbers}. netkf check decides if it holds{PAPER}"
    ]


def _standard_error_text(row: dict[str, Any]) -> str:
    """Return the standard error of the mean trace as text."""
    error = row.get("mean_trace_se")
    return f" +- {error:.1g}" if error is not None else ""


def _describe_verdict(source: Opened) -> list[str]:
    """Return the claims on a verdict: broken promises."""
    verdict = source.verdict or {}
    rows = verdict.get("rows", [])
    broken = [row for row in rows if row["verdict"] == "broken"]
    counts = {
        name: sum(row["verdict"] == name for row in rows) for name in _occurring_verdicts(rows)
    }
    listed = ", ".join(f"{count} {name}" for name, count in counts.items())
    head = f"{len(broken)} promises are broken" if len(broken) > 1 else "1 promise is broken"
    found = [
        f"{head if broken else 'No promise is broken'} in {verdict.get('runs', 0):,} runs "
        f"({listed}); all intervals hold together with probability "
        f"{format_number(verdict.get('confidence'))}"
    ]
    return found + [f"Broken: {row['promise']} [{row['source']}]" for row in broken]


def _occurring_verdicts(rows: list[dict[str, Any]]) -> list[str]:
    """Return the verdicts that occur, in alphabetical order."""
    return sorted({str(row["verdict"]) for row in rows})


def _describe_sweep(source: Opened) -> list[str]:
    """Return the claims on a sweep: its best point."""
    assert source.sweep is not None
    table, varied = source.sweep.table, source.sweep.keys
    if not len(table):
        return ["The sweep has no finished point yet"]
    column = table["worst_rms"].to_numpy(dtype=np.float64)
    if not np.isfinite(column).any():
        return [f"{len(table):,} points; none has a finite error"]
    best = table.iloc[int(np.nanargmin(column))]
    where = ", ".join(f"{key} = {best[key]}" for key in varied)
    return [
        f"Of {len(table):,} points the worst node did best at {where}: RMS error "
        f"{format_number(float(best['worst_rms']))}; the largest is "
        f"{format_number(float(np.nanmax(column)))}"
    ]


def _of_filters(found: StoredComparison) -> list[str]:
    """Return sentences: the best filter, certain differences, and filters that could not run."""
    ran = [row for row in found.rows if row.ran and math.isfinite(_rms_error(row).value)]
    if not ran:
        return ["No filter has a finite RMS error"]
    best = min(ran, key=lambda row: _rms_error(row).value)
    listed = ", ".join(f"{row.filter} {format_number(_rms_error(row).value)}" for row in ran)
    said = [
        f"Of {len(ran)} filters over {found.runs:,} runs of each, {best.filter} had the smallest "
        f"RMS error ({listed})"
    ]
    for row in ran:
        gap = _rms_error(row)
        if gap.real:
            side = "less" if gap.difference < 0.0 else "more"
            said.append(
                f"Certain: the RMS error of {row.filter} is {side} than that of {found.first}, by "
                f"{format_number(abs(gap.difference))}; the difference lies in "
                f"{format_number(gap.low)} .. {format_number(gap.high)}"
            )
    if len(said) == 1:
        said.append(f"No difference of RMS errors from {found.first} is certain")
    wrong = [f"{row.filter} ({row.consistency})" for row in ran if row.consistency != "consistent"]
    said += [f"P does not describe the errors of {', '.join(wrong)}"] if wrong else []
    noted = [row for row in found.rows if row.status != "complete"]
    return said + [f"{row.filter}: {row.status}" for row in noted]


def _rms_error(row: ComparedFilter) -> Quantity:
    """Return the RMS error of a compared filter."""
    return row.quantities["rms_error"]


def _format_time(seconds: float) -> str:
    """Return a time as text."""
    return f"t = {seconds:.6g} s"
