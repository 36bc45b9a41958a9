"""``netkf theory``: what is promised for a scenario, without running it."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from typing import Any

import numpy as np

from netkf.algorithms.push_sum import PushSum
from netkf.core.arrays import FloatArray
from netkf.core.errors import TheoryError
from netkf.experiments.files import finite
from netkf.experiments.push_sum_promises import push_sum_lines, push_sum_promises
from netkf.experiments.tables import MOST_NODES, number, table
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

LIMITS: tuple[tuple[str, str, Callable[[Scenario], FloatArray]], ...] = (
    ("limit_covariance", "limit of the bound as links tick ever faster, H(13)", limit_covariance),
    (
        "true_limit_covariance",
        "limit of the true error covariance (derived)",
        true_limit_covariance,
    ),
    ("central_covariance", "centralised filter with all readings", central_covariance),
)


def promises(scenario: Scenario) -> dict[str, Any]:
    """Assumptions, bound at the horizon and in the steady state, limits; a text says why where a
    number does not exist. Plain JSON values.
    """
    rows = assumptions(scenario)
    found: dict[str, Any] = {
        "scenario": scenario.name,
        "filter": type(scenario.filter.algorithm).__name__.lower(),
        "nodes": list(scenario.nodes),
        "assumptions": [
            {"assumption": a, "source": s, "holds": bool(h), "evidence": e}
            for a, s, h, e in rows.itertuples(index=False)
        ],
    }
    if isinstance(scenario.filter.algorithm, PushSum):
        found["push_sum"] = push_sum_promises(scenario)
    elif scenario.slotted:
        found["slot_central_covariance"] = _value(lambda: _slot_central(scenario))
    if scenario.slotted:
        plain: dict[str, Any] = finite(found)
        return plain
    ends = np.array([scenario.horizon])
    found["bound_at_horizon"] = _value(lambda: covariance_bound(scenario, ends)[0])
    found["steady_bound"] = _value(lambda: steady_covariance_bound(scenario))
    for name, _, function in LIMITS:
        found[name] = _value(lambda function=function: function(scenario))  # type: ignore[misc]
    whole: dict[str, Any] = finite(found)
    return whole


def _slot_central(scenario: Scenario) -> FloatArray:
    """P*: the prediction covariance of a filter that gets every reading in every slot."""
    model = scenario.pooled_slot_model
    return steady_covariance(model.F, model.Q, model.H, model.R)


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
        mark = "holds" if row["holds"] else "FAILS"
        lines.append(f"  {mark}  {row['assumption']}  [{row['source']}]")
        lines += textwrap.wrap(
            row["evidence"], 92, initial_indent=" " * 9, subsequent_indent=" " * 9
        )
    if "push_sum" in found:
        return "\n".join([*lines, "", *push_sum_lines(found["push_sum"])])
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
    delayed = scenario.filter.algorithm.talks and scenario.network.channel.delay.fixed != 0.0
    for name, words, _ in LIMITS:
        value = found[name]
        note = ", if messages took no time" if delayed and name != "central_covariance" else ""
        lines.append(f"  {words}{note}: {value['reason'] or number(value['trace'])}")
    return "\n".join(lines)


def _by_node(scenario: Scenario, columns: list[dict[str, Any]]) -> str:
    rows = [
        [str(node), *(number(c["trace"][k] if c["trace"] else None) for c in columns)]
        for k, node in enumerate(scenario.nodes)
    ]
    if len(rows) > MOST_NODES:
        middle = [f"({len(rows) - MOST_NODES} more)", "", ""]
        rows = [*rows[: MOST_NODES // 2], middle, *rows[-MOST_NODES // 2 :]]
    return table(["node", f"at {scenario.horizon:g} s", "steady state"], rows)
