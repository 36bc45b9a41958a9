"""``netkf theory``: what is promised for a scenario, without running it."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from typing import Any

import numpy as np

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.runs.files import finite
from netkf.runs.labels import limit_words, mismatch_words, without_delay
from netkf.runs.tables import MAX_NODES, number, table
from netkf.scenario.registry import name_of
from netkf.scenario.scenario import Scenario
from netkf.theory import (
    assumptions,
    central_covariance,
    covariance_bound,
    limit_covariance,
    steady_covariance,
    steady_covariance_bound,
    true_limit_covariance,
)
from netkf.theory.common.papers import paper_function
from netkf.theory.hybrid.steady import steady_by_node

MARKS = {True: "holds", False: "FAILS", None: "unknown"}
LIMITS: dict[str, Callable[[Scenario], FloatArray]] = {
    "limit_covariance": limit_covariance,
    "true_limit_covariance": true_limit_covariance,
    "central_covariance": central_covariance,
}


def promises(scenario: Scenario) -> dict[str, Any]:
    """Assumptions, bound at the horizon and in the steady state, limits; a text says why where a
    number does not exist. Plain JSON values.
    """
    rows = assumptions(scenario)
    found: dict[str, Any] = {
        "scenario": scenario.name,
        "filter": name_of("filter", scenario.filter.algorithm),
        "nodes": list(scenario.nodes),
        "assumptions": [
            {"assumption": a, "source": s, "holds": None if h is None else bool(h), "evidence": e}
            for a, s, h, e in rows.itertuples(index=False)
        ],
    }
    own = paper_function(scenario, "promises", "slot_promises") if scenario.slotted else None
    if own is not None:
        found[scenario.hosted.paper] = own(scenario)
    elif scenario.slotted:
        found["slot_central_covariance"] = _value(lambda: _slot_central(scenario))
    if scenario.slotted:
        plain: dict[str, Any] = finite(found)
        return plain
    ends = np.array([scenario.horizon])
    found["bound_at_horizon"] = _value(lambda: covariance_bound(scenario, ends)[0])
    found["steady_bound"] = _steady(scenario)
    for name, function in LIMITS.items():
        found[name] = _value(lambda function=function: function(scenario))  # type: ignore[misc]
    whole: dict[str, Any] = finite(found)
    return whole


def _slot_central(scenario: Scenario) -> FloatArray:
    """P*: the prediction covariance of a filter that gets every reading in every slot."""
    for node in scenario.sensing:
        scenario.observation(node)  # raises where H is not fixed
    model = scenario.pooled_slot_model
    return steady_covariance(model.F, model.Q, model.H, model.R)


def _steady(scenario: Scenario) -> dict[str, Any]:
    """Where filters do not talk, some nodes may have a steady state and others none."""
    found = _value(lambda: steady_covariance_bound(scenario))
    if found["reason"] and not scenario.filter.algorithm.talks:
        found = {**_value(lambda: steady_by_node(scenario)), "reason": found["reason"]}
    return found


def _value(function: Callable[[], FloatArray]) -> dict[str, Any]:
    try:
        value = function()
    except TheoryError as error:
        return {"value": None, "trace": None, "reason": str(error)}
    trace = np.trace(value, axis1=-2, axis2=-1)
    return {"value": value.tolist(), "trace": trace.tolist(), "reason": None}


def promises_text(scenario: Scenario, found: dict[str, Any]) -> str:
    """The same for a terminal."""
    lines = [
        f"{scenario.name}: {scenario.claim}" if scenario.claim else scenario.name,
        "",
        "assumptions",
    ]
    for row in found["assumptions"]:
        mark = MARKS[row["holds"]]
        lines.append(f"  {mark:7}  {row['assumption']}  [{row['source']}]")
        lines += textwrap.wrap(
            row["evidence"], 94, initial_indent=" " * 11, subsequent_indent=" " * 11
        )
    paper = scenario.hosted.paper
    if paper and paper in found:
        own_lines = paper_function(scenario, "promises", "slot_lines")(found[paper], number)
        return "\n".join([*lines, "", *own_lines])
    if scenario.slotted:
        value = found["slot_central_covariance"]
        words = value["reason"] or number(value["trace"])
        lines += ["", f"trace of P*, the prediction covariance with all readings: {words}"]
        return "\n".join(lines)
    lines += ["", "trace of the bound on E[P_i]"]
    columns = [found["bound_at_horizon"], found["steady_bound"]]
    for words, column in zip((f"at {scenario.horizon:g} s", "steady state"), columns, strict=True):
        if column["reason"]:
            lines += textwrap.wrap(
                f"{words}: {column['reason']}", 98, initial_indent="  ", subsequent_indent="    "
            )
    if any(column["trace"] for column in columns):
        lines.append(textwrap.indent(_by_node(scenario, columns), "  "))
    lines += ["", "traces to compare"]
    names = {
        "limit_covariance": f"{limit_words(scenario)}, as links tick ever faster",
        "true_limit_covariance": "limit of the true error covariance (derived)"
        + without_delay(scenario),
        "central_covariance": "centralised filter with all readings",
    }
    for name, words in names.items():
        lines.append(f"  {words}: {found[name]['reason'] or number(found[name]['trace'])}")
    if mismatch_words(scenario):
        lines.append(f"note: {mismatch_words(scenario)}")
    return "\n".join(lines)


def _by_node(scenario: Scenario, columns: list[dict[str, Any]]) -> str:
    """A row per node; of large networks the nodes with the smallest, middle and largest bounds."""
    rows = [
        [str(node), *(number(c["trace"][k] if c["trace"] else None) for c in columns)]
        for k, node in enumerate(scenario.nodes)
    ]
    header = ["node", f"at {scenario.horizon:g} s", "steady state"]
    if len(rows) <= MAX_NODES:
        return table(header, rows)
    traces = [c["trace"] for c in columns if c["trace"]]
    sizes = np.nan_to_num(np.array(traces[-1], dtype=np.float64), nan=np.inf)
    order, third = np.argsort(sizes, kind="stable"), MAX_NODES // 3
    middle = (len(order) - third) // 2
    shown = [*order[:third], *order[middle : middle + third], *order[-third:]]
    line = (
        f"the {third} nodes with the smallest, the middle and the largest bound of "
        f"{len(rows):,}; --json has all"
    )
    return "\n".join([line, table(header, [rows[k] for k in shown])])
