"""What the centralised filter has at a value found by ``netkf size``, and which key would help."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from netkf.core.errors import NetkfError
from netkf.runs.tables import format_number
from netkf.scenario.scenario import Scenario
from netkf.studies.metrics import central_traces
from netkf.studies.targets import Target, quantity_by_theory

STEP = 1.1
"""Factor by which keys are changed to see which helps."""
LESS = 1.0 - 1e-6
"""Ratio of the quantity to before from which a key does not help."""
BEYOND = "no exchange of messages reaches the limit, better readings may"
"""End of the sentence where the centralised filter, whose errors are the smallest, misses it."""


def describe_help(scenario: Scenario, target: Target, searched: str) -> str:
    """Return a sentence on the centralised filter, and which key other than ``searched`` would
    change the quantity of the ``target`` most, by theory; empty if theory knows neither.
    """
    if target.of_runs:
        return ""
    try:
        traces = central_traces(scenario)
    except NetkfError:
        return ""
    has_roots = target.of_errors and target.quantity != "within_central"
    trace = float(traces.max() if target.of_worst else traces.mean())
    value = math.sqrt(trace) if target.of_errors else trace
    name = "RMS error" if target.of_errors else "trace of P"
    sentence = f"a centralised filter has {name} {format_number(value)} there"
    if has_roots and value > target.limit:
        return f"{sentence}: {BEYOND}"
    changes = sorted(_changes(scenario, target, searched))
    if not changes or changes[0][0] >= LESS:
        return sentence
    listed = [
        f"{key} = {text} ({100.0 * (ratio - 1.0):+.2g} %)" for ratio, key, text in changes[:2]
    ]
    return f"{sentence}; by theory {target.quantity} would fall most with {', then '.join(listed)}"


def _changes(scenario: Scenario, target: Target, searched: str) -> list[tuple[float, str, str]]:
    """Return for keys changed by STEP the ratio of the quantity to before, the key and value."""
    try:
        before = quantity_by_theory(scenario, target)[0]
    except NetkfError:
        return []
    found = []
    for key, changes, shown in _candidates(scenario):
        if key == searched:
            continue
        try:
            after = quantity_by_theory(scenario.replace(changes), target)[0]
        except NetkfError:
            continue
        found.append((after / before, key, shown))
    return found


def _candidates(scenario: Scenario) -> list[tuple[str, dict[str, Any], str]]:
    clock, loss = scenario.network.activation, scenario.network.channel.loss
    algorithm, found = scenario.filter.algorithm, []
    for key, part, name in (
        ("network.activation.rate", clock, "rate"),
        ("network.channel.loss.delivery", loss, "delivery"),
        ("filter.epsilon", algorithm, "epsilon"),
    ):
        value = getattr(part, name, None)
        if not isinstance(value, float):
            continue
        steps = [value * STEP, value / STEP] if name == "epsilon" else [value * STEP]
        steps = [min(step, 1.0) if name == "delivery" else step for step in steps]
        found += [(key, {key: s}, f"{s:.3g}") for s in steps if s != value]
    noises = [getattr(sensor, "R", None) for sensor in scenario.sensors]
    known = [np.asarray(R) for R in noises if R is not None]
    if known and len(known) == len(noises):
        changes = {f"sensors.{k}.R": (R / STEP).tolist() for k, R in enumerate(known)}
        found.append(("sensors.*.R", changes, "less by a tenth"))
    return found
