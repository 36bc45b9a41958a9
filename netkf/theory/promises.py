"""``netkf theory``: assumptions, bounds and limits of a scenario, without a simulation.

H is the paper on the hybrid filter, see theory/README.md. S is the limit of its bound on the mean
of P as link rates grow.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from typing import Any

import numpy as np

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.runs.files import to_json_value
from netkf.runs.labels import mismatch_note
from netkf.runs.tables import MAX_NODES, format_number, format_table
from netkf.scenario.registry import name_of
from netkf.scenario.scenario import Scenario
from netkf.theory import (
    central_covariance,
    covariance_bound,
    limit_covariance,
    link_rate_for,
    mean_square_radius,
    steady_covariance,
    steady_covariance_bound,
    steady_error_covariance,
    true_limit_covariance,
)
from netkf.theory.assumption_rows import assumption_rows
from netkf.theory.block_promises import block_lines, block_promises
from netkf.theory.common.blocks import have_one_view
from netkf.theory.common.evidence import require_every_reading
from netkf.theory.common.papers import paper_legend
from netkf.theory.common.requirements import scenario_of_estimates
from netkf.theory.folders import theory_of
from netkf.theory.hybrid.coupled import concerns_hybrid_paper
from netkf.theory.hybrid.steady import steady_by_node
from netkf.theory.mean_square import has_linear_errors, is_quickly_solved
from netkf.theory.traces import delay_suffix, limit_label

CLOSE_TO_S = 0.1  # distance from S, as a share of its Frobenius norm, to find link rates for
MAX_RATE_NODES = 60  # largest network for which they are found within seconds
MAX_UNKNOWNS = 60_000  # of the steady bound, which takes about ten seconds
MAX_COUPLED = 120_000  # unknowns times neighbours of a node: dense networks take longer
MARKS = {True: "holds", False: "FAILS", None: "unknown"}
LIMITS: dict[str, Callable[[Scenario], FloatArray]] = {
    "limit_covariance": limit_covariance,
    "true_limit_covariance": true_limit_covariance,
    "central_covariance": central_covariance,
}


def compute_promises(scenario: Scenario) -> dict[str, Any]:
    """Return what theory states as plain JSON: assumptions, bounds, rates, limits, results of the
    paper and exact errors, None with a ``reason``; of the last piece but for the bound at the end.
    """
    if have_one_view(scenario):
        scenario = scenario_of_estimates(scenario)
    promises: dict[str, Any] = {
        "scenario": scenario.name,
        "filter": name_of("filter", scenario.filter.algorithm),
        "nodes": list(scenario.nodes),
        "assumptions": [
            {
                "assumption": assumption,
                "source": source,
                "holds": None if holds is None else bool(holds),
                "evidence": evidence,
            }
            for assumption, source, holds, evidence in assumption_rows(scenario)
        ],
    }
    if scenario.views is not None:
        of_blocks: dict[str, Any] = to_json_value(promises | block_promises(scenario))
        return of_blocks
    whole, scenario = scenario, scenario.last_piece
    if scenario.slotted:
        slot_promises = theory_of(scenario).slot_promises
        if slot_promises is not None:
            promises[scenario.node_filter.analysis.paper] = slot_promises(scenario)
        else:
            promises["slot_central_covariance"] = _value_or_reason(
                lambda: _slot_central_covariance(scenario)
            )
    if has_linear_errors(scenario) and scenario.node_filter.timing.talks:
        promises["steady_error"] = _steady_error(scenario)
    if not scenario.slotted:
        ends = np.array([scenario.horizon])
        promises["bound_at_horizon"] = _value_or_reason(lambda: covariance_bound(whole, ends)[0])
        promises["steady_bound"] = _steady_bound(scenario)
        promises["link_rate"] = _sufficient_link_rate(scenario)
        for name, function in LIMITS.items():
            # The default argument keeps the present function of the loop.
            promises[name] = _value_or_reason(lambda function=function: function(scenario))  # type: ignore[misc]
    document: dict[str, Any] = to_json_value(promises)
    return document


def _sufficient_link_rate(scenario: Scenario) -> dict[str, Any]:
    try:
        if len(scenario.nodes) > MAX_RATE_NODES:
            raise TheoryError(
                f"not looked for beyond {MAX_RATE_NODES} nodes; "
                "netkf.theory.link_rate_for looks for them however long it takes"
            )
        delta = CLOSE_TO_S * float(np.linalg.norm(limit_covariance(scenario)))
        factor, rate = link_rate_for(scenario, delta)
    except TheoryError as error:
        return {"value": None, "factor": None, "delta": None, "reason": str(error)}
    return {"value": rate, "factor": factor, "delta": delta, "reason": None}


def _steady_error(scenario: Scenario) -> dict[str, Any]:
    """Return the steady error covariances (N, n, n) as an entry, and the ``radius``."""

    def covariance() -> FloatArray:
        """Return the steady error covariances (N, n, n); raises TheoryError if they take long."""
        if not is_quickly_solved(scenario):
            raise TheoryError(
                "left out, because it takes more than seconds; "
                "netkf.theory.steady_error_covariance computes it however long it takes"
            )
        return steady_error_covariance(scenario)

    result = _value_or_reason(covariance)
    return {**result, "radius": None if result["reason"] else mean_square_radius(scenario)}


def _slot_central_covariance(scenario: Scenario) -> FloatArray:
    """Return P* (n, n) of all readings in every slot; raises TheoryError if H varies."""
    _ = scenario.linear_plant  # raises TheoryError if there is no F
    require_every_reading(scenario)
    for node in scenario.sensing_nodes:
        scenario.observation_matrices(node)  # raises TheoryError if H is not constant
    model = scenario.pooled_slot_model
    return steady_covariance(model.F, model.Q, model.H, model.R)


def _steady_bound(scenario: Scenario) -> dict[str, Any]:
    """Return the steady bounds (N, n, n) on the mean of P as an entry, or the reason."""
    n = scenario.plant.n
    unknowns = len(scenario.nodes) * n * (n + 1) // 2
    degree = len(scenario.topology.directions) / len(scenario.nodes)
    excess = ""
    if unknowns > MAX_UNKNOWNS:
        excess = f"more than {MAX_UNKNOWNS:,}"
    elif unknowns * degree > MAX_COUPLED:
        excess = f"and its nodes have {degree:,.3g} neighbours each"
    if excess:
        reason = (
            f"left out, because it has {unknowns:,} unknowns, {excess}; "
            "netkf.theory.steady_covariance_bound computes it however long it takes"
        )
        return {"value": None, "trace": None, "reason": reason}
    result = _value_or_reason(lambda: steady_covariance_bound(scenario))
    if result["reason"] and not scenario.filter.algorithm.timing.talks:
        return {**_value_or_reason(lambda: steady_by_node(scenario)), "reason": result["reason"]}
    return result


def _value_or_reason(function: Callable[[], FloatArray]) -> dict[str, Any]:
    """Return an entry: ``value`` and ``trace`` of ``function()``, or its ``reason``."""
    try:
        value = function()
    except TheoryError as error:
        return {"value": None, "trace": None, "reason": str(error)}
    trace = np.trace(value, axis1=-2, axis2=-1)
    return {"value": value.tolist(), "trace": trace.tolist(), "reason": None}


def promises_text(scenario: Scenario, promises: dict[str, Any]) -> str:
    """Return the ``promises`` of :func:`compute_promises` as text for a terminal."""
    title = f"{scenario.name}: {scenario.claim}" if scenario.claim else scenario.name
    lines = [title, "", "assumptions", *_assumption_lines(promises["assumptions"])]
    lines += paper_legend(row["source"] for row in promises["assumptions"])
    if "least_error" in promises:
        return "\n".join([*lines, *block_lines(promises)])
    if have_one_view(scenario):
        scenario = scenario_of_estimates(scenario)
    if len(scenario.plant.changes):
        since = f"{scenario.plant.changes[-1]:g} s"
        lines += ["", f"steady states and limits: of the plant from {since} on"]
        scenario = scenario.last_piece
    paper = scenario.node_filter.analysis.paper
    slot_lines = theory_of(scenario).slot_lines
    if paper in promises and slot_lines is not None:
        return "\n".join([*lines, "", *slot_lines(promises[paper], format_number)])
    if scenario.slotted:
        central = promises["slot_central_covariance"]
        trace = central["reason"] or format_number(central["trace"])
        lines += ["", f"trace of P*, the prediction covariance with all readings: {trace}"]
        return "\n".join([*lines, *_steady_error_lines(scenario, promises)])
    if concerns_hybrid_paper(scenario):
        lines += _bound_lines(scenario, promises)
    lines += _limit_lines(scenario, promises)
    return "\n".join([*lines, *_steady_error_lines(scenario, promises)])


def _steady_error_lines(scenario: Scenario, promises: dict[str, Any]) -> list[str]:
    if "steady_error" not in promises:
        return []
    error, title = promises["steady_error"], "trace of the steady error covariance, exact"
    if error["reason"]:
        return textwrap.wrap(f"{title}: {error['reason']}", 98, subsequent_indent="    ")
    traces, nodes = np.array(error["trace"]), scenario.nodes
    smallest, largest = (
        f"{format_number(float(traces[k]))} at node {nodes[k]}"
        for k in (int(np.argmin(traces)), int(np.argmax(traces)))
    )
    mean, radius = format_number(float(traces.mean())), format_number(float(error["radius"]))
    return [f"{title}: mean {mean}, from {smallest} to {largest}; mean-square radius {radius}"]


def _assumption_lines(rows: list[dict[str, Any]]) -> list[str]:
    lines = []
    for row in rows:
        lines.append(f"  {MARKS[row['holds']]:7}  {row['assumption']}  [{row['source']}]")
        indent = " " * 11
        lines += textwrap.wrap(row["evidence"], 94, initial_indent=indent, subsequent_indent=indent)
    return lines


def _bound_lines(scenario: Scenario, promises: dict[str, Any]) -> list[str]:
    lines = ["", "trace of the bound on E[P_i]"]
    columns = {
        f"at {scenario.horizon:g} s": promises["bound_at_horizon"],
        "steady state": promises["steady_bound"],
    }
    for label, column in columns.items():
        if column["reason"]:
            lines += textwrap.wrap(
                f"{label}: {column['reason']}", 98, initial_indent="  ", subsequent_indent="    "
            )
    if any(column["trace"] for column in columns.values()):
        lines.append(textwrap.indent(_bound_table(scenario, list(columns.values())), "  "))
    return lines


def _limit_lines(scenario: Scenario, promises: dict[str, Any]) -> list[str]:
    labels = {"central_covariance": "centralised filter with all readings"}
    if concerns_hybrid_paper(scenario):
        error_limit = "limit of the true error covariance (derived)" + delay_suffix(scenario)
        limit = f"{limit_label(scenario)}, as links tick ever faster"
        labels = {"limit_covariance": limit, "true_limit_covariance": error_limit, **labels}
    lines = ["", "traces to compare"]
    for name, label in labels.items():
        value = promises[name]
        lines.append(f"  {label}: {value['reason'] or format_number(value['trace'])}")
    link_rate = promises["link_rate"]
    if link_rate["reason"] is None:
        rates = f"{format_number(link_rate['factor'])} times the rates given"
        if link_rate["value"] is not None:
            rates = f"links from {format_number(link_rate['value'])} per second on"
        lines.append(f"  {rates} keep the steady bound within {CLOSE_TO_S:.0%} of S, H Theorem 3")
    note = mismatch_note(scenario)
    return [*lines, f"note: {note}"] if note else lines


def _bound_table(scenario: Scenario, columns: list[dict[str, Any]]) -> str:
    rows = []
    for k, node in enumerate(scenario.nodes):
        traces = [column["trace"][k] if column["trace"] else None for column in columns]
        rows.append([str(node), *map(format_number, traces)])
    header = ["node", f"at {scenario.horizon:g} s", "steady state"]
    if len(rows) <= MAX_NODES:
        return format_table(header, rows)
    # Ranked by the steady bound, or by that at the horizon if there is no steady bound.
    ranking = [column["trace"] for column in columns if column["trace"]][-1]
    sizes = np.nan_to_num(np.array(ranking, dtype=np.float64), nan=np.inf)
    order, third = np.argsort(sizes, kind="stable"), MAX_NODES // 3
    middle = (len(order) - third) // 2
    listed = [*order[:third], *order[middle : middle + third], *order[-third:]]
    line = (
        f"the {third} nodes with the smallest, the middle and the largest bound of "
        f"{len(rows):,}; --json has all"
    )
    return "\n".join([line, format_table(header, [rows[k] for k in listed])])
