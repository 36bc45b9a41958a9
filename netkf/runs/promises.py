"""``netkf theory``: assumptions, bounds and limits of a scenario, without a simulation."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from typing import Any

import numpy as np

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.runs.files import finite
from netkf.runs.labels import delay_suffix, limit_label, mismatch_note
from netkf.runs.tables import MAX_NODES, format_number, table
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
from netkf.theory.assumptions import assumption_rows
from netkf.theory.common.mean_square import has_linear_errors, is_quickly_solved
from netkf.theory.common.papers import paper_function
from netkf.theory.hybrid.steady import steady_by_node

CLOSE_TO_S = 0.1  # of the Frobenius norm of S
MAX_RATED = 60  # nodes for which rates are looked for in seconds
MAX_UNKNOWNS = 60_000  # of the steady bound, which takes some ten seconds
MAX_COUPLED = 120_000  # unknowns times links of a node: dense networks take longer
MARKS = {True: "holds", False: "FAILS", None: "unknown"}
LIMITS: dict[str, Callable[[Scenario], FloatArray]] = {
    "limit_covariance": limit_covariance,
    "true_limit_covariance": true_limit_covariance,
    "central_covariance": central_covariance,
}


def compute_promises(scenario: Scenario) -> dict[str, Any]:
    """Return assumptions, the bound at the horizon and in the steady state, and limits.

    The values are plain JSON; if a number does not exist, ``reason`` says why.
    """
    found: dict[str, Any] = {
        "scenario": scenario.name,
        "filter": name_of("filter", scenario.filter.algorithm),
        "nodes": list(scenario.nodes),
        "assumptions": [
            {"assumption": a, "source": s, "holds": None if h is None else bool(h), "evidence": e}
            for a, s, h, e in assumption_rows(scenario)
        ],
    }
    own = paper_function(scenario, "promises", "slot_promises") if scenario.slotted else None
    if own is not None:
        found[scenario.hosted.paper] = own(scenario)
    elif scenario.slotted:
        found["slot_central_covariance"] = _value_or_reason(lambda: _slot_central(scenario))
    if has_linear_errors(scenario) and scenario.hosted.talks:
        found["steady_error"] = _steady_error(scenario)
    if scenario.slotted:
        plain: dict[str, Any] = finite(found)
        return plain
    ends = np.array([scenario.horizon])
    found["bound_at_horizon"] = _value_or_reason(lambda: covariance_bound(scenario, ends)[0])
    found["steady_bound"] = _steady(scenario)
    found["link_rate"] = _link_rate(scenario)
    for name, function in LIMITS.items():
        found[name] = _value_or_reason(lambda function=function: function(scenario))  # type: ignore[misc]
    whole: dict[str, Any] = finite(found)
    return whole


def _link_rate(scenario: Scenario) -> dict[str, Any]:
    """Return the link rates from which on the steady bound is within a share of the size of S."""
    try:
        if len(scenario.nodes) > MAX_RATED:
            raise TheoryError(
                f"not looked for beyond {MAX_RATED} nodes; netkf.theory.link_rate_for looks for "
                "them however long it takes"
            )
        delta = CLOSE_TO_S * float(np.linalg.norm(limit_covariance(scenario)))
        factor, rate = link_rate_for(scenario, delta)
    except TheoryError as error:
        return {"value": None, "factor": None, "delta": None, "reason": str(error)}
    return {"value": rate, "factor": factor, "delta": delta, "reason": None}


def _steady_error(scenario: Scenario) -> dict[str, Any]:
    """Return the exact steady mean squares of the errors and their radius."""

    def covariance() -> FloatArray:
        """Return the steady error covariance; raises TheoryError if that takes long."""
        if not is_quickly_solved(scenario):
            raise TheoryError(
                "left out, because it takes more than seconds; "
                "netkf.theory.steady_error_covariance computes it however long it takes"
            )
        return steady_error_covariance(scenario)

    found = _value_or_reason(covariance)
    return {**found, "radius": None if found["reason"] else mean_square_radius(scenario)}


def _slot_central(scenario: Scenario) -> FloatArray:
    """Return P* (n, n), the prediction covariance of a filter with all readings in every slot."""
    for node in scenario.sensing:
        scenario.observation(node)  # raises where H is not fixed
    model = scenario.pooled_slot_model
    return steady_covariance(model.F, model.Q, model.H, model.R)


def _steady(scenario: Scenario) -> dict[str, Any]:
    """Return the steady bound; without messages some nodes may have one and others not."""
    n = scenario.plant.n
    unknowns = len(scenario.nodes) * n * (n + 1) // 2
    degree = len(scenario.topology.directions) / len(scenario.nodes)
    large = f"more than {MAX_UNKNOWNS:,}" if unknowns > MAX_UNKNOWNS else ""
    if not large and unknowns * degree > MAX_COUPLED:
        large = f"and its nodes have {degree:,.3g} neighbours each"
    if large:
        reason = (
            f"left out, because it has {unknowns:,} unknowns, {large}; "
            "netkf.theory.steady_covariance_bound computes it however long it takes"
        )
        return {"value": None, "trace": None, "reason": reason}
    found = _value_or_reason(lambda: steady_covariance_bound(scenario))
    if found["reason"] and not scenario.filter.algorithm.talks:
        found = {**_value_or_reason(lambda: steady_by_node(scenario)), "reason": found["reason"]}
    return found


def _value_or_reason(function: Callable[[], FloatArray]) -> dict[str, Any]:
    """Return a matrix with its trace, or the reason why there is none."""
    try:
        value = function()
    except TheoryError as error:
        return {"value": None, "trace": None, "reason": str(error)}
    trace = np.trace(value, axis1=-2, axis2=-1)
    return {"value": value.tolist(), "trace": trace.tolist(), "reason": None}


def promises_text(scenario: Scenario, found: dict[str, Any]) -> str:
    """Return the result of :func:`compute_promises` as text for a terminal."""
    title = f"{scenario.name}: {scenario.claim}" if scenario.claim else scenario.name
    lines = [title, "", "assumptions", *_assumption_lines(found["assumptions"])]
    paper = scenario.hosted.paper
    if paper and paper in found:
        own_lines = paper_function(scenario, "promises", "slot_lines")(found[paper], format_number)
        return "\n".join([*lines, "", *own_lines])
    if scenario.slotted:
        central = found["slot_central_covariance"]
        trace = central["reason"] or format_number(central["trace"])
        lines += ["", f"trace of P*, the prediction covariance with all readings: {trace}"]
        return "\n".join([*lines, *_error_lines(scenario, found)])
    lines += [*_bound_lines(scenario, found), *_limit_lines(scenario, found)]
    return "\n".join([*lines, *_error_lines(scenario, found)])


def _error_lines(scenario: Scenario, found: dict[str, Any]) -> list[str]:
    """Return the lines on exact steady mean squares, where the filter has constant gains."""
    if "steady_error" not in found:
        return []
    value, title = found["steady_error"], "trace of the steady error covariance, exact"
    if value["reason"]:
        return textwrap.wrap(f"{title}: {value['reason']}", 98, subsequent_indent="    ")
    traces, nodes = np.array(value["trace"]), scenario.nodes
    low, high = int(np.argmin(traces)), int(np.argmax(traces))
    ends = [f"{format_number(float(traces[k]))} at node {nodes[k]}" for k in (low, high)]
    mean, radius = (format_number(float(one)) for one in (traces.mean(), value["radius"]))
    return [f"{title}: mean {mean}, from {ends[0]} to {ends[1]}; mean-square radius {radius}"]


def _assumption_lines(rows: list[dict[str, Any]]) -> list[str]:
    """Return the lines on assumptions."""
    lines = []
    for row in rows:
        lines.append(f"  {MARKS[row['holds']]:7}  {row['assumption']}  [{row['source']}]")
        indent = " " * 11
        lines += textwrap.wrap(row["evidence"], 94, initial_indent=indent, subsequent_indent=indent)
    return lines


def _bound_lines(scenario: Scenario, found: dict[str, Any]) -> list[str]:
    """Return the lines on bounds, a table of traces by node."""
    lines = ["", "trace of the bound on E[P_i]"]
    columns = {
        f"at {scenario.horizon:g} s": found["bound_at_horizon"],
        "steady state": found["steady_bound"],
    }
    for label, column in columns.items():
        if column["reason"]:
            lines += textwrap.wrap(
                f"{label}: {column['reason']}", 98, initial_indent="  ", subsequent_indent="    "
            )
    if any(column["trace"] for column in columns.values()):
        lines.append(textwrap.indent(_by_node(scenario, list(columns.values())), "  "))
    return lines


def _limit_lines(scenario: Scenario, found: dict[str, Any]) -> list[str]:
    """Return the lines on limits to compare with."""
    error_limit = "limit of the true error covariance (derived)" + delay_suffix(scenario)
    labels = {
        "limit_covariance": f"{limit_label(scenario)}, as links tick ever faster",
        "true_limit_covariance": error_limit,
        "central_covariance": "centralised filter with all readings",
    }
    lines = ["", "traces to compare"]
    for name, label in labels.items():
        lines.append(f"  {label}: {found[name]['reason'] or format_number(found[name]['trace'])}")
    if found["link_rate"]["reason"] is None:
        lines.append(_rate_line(found["link_rate"]))
    note = mismatch_note(scenario)
    return [*lines, f"note: {note}"] if note else lines


def _rate_line(found: dict[str, Any]) -> str:
    """Return the line on the rates of H Theorem 3."""
    rates = f"{format_number(found['factor'])} times the rates given"
    if found["value"] is not None:
        rates = f"links from {format_number(found['value'])} per second on"
    return f"  {rates} keep the steady bound within {CLOSE_TO_S:.0%} of S, H Theorem 3"


def _by_node(scenario: Scenario, columns: list[dict[str, Any]]) -> str:
    """Return a row per node; of large networks the nodes with the smallest, middle and largest
    bounds.
    """
    rows = [
        [str(node), *(format_number(c["trace"][k] if c["trace"] else None) for c in columns)]
        for k, node in enumerate(scenario.nodes)
    ]
    header = ["node", f"at {scenario.horizon:g} s", "steady state"]
    if len(rows) <= MAX_NODES:
        return table(header, rows)
    traces = [c["trace"] for c in columns if c["trace"]]
    sizes = np.nan_to_num(np.array(traces[-1], dtype=np.float64), nan=np.inf)
    order, third = np.argsort(sizes, kind="stable"), MAX_NODES // 3
    middle = (len(order) - third) // 2
    listed = [*order[:third], *order[middle : middle + third], *order[-third:]]
    line = (
        f"the {third} nodes with the smallest, the middle and the largest bound of "
        f"{len(rows):,}; --json has all"
    )
    return "\n".join([line, table(header, [rows[k] for k in listed])])
