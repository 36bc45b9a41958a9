"""Targets for sizing: a quantity by theory and by simulation, and what would help to reach it."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy

from netkf.core.errors import NetkfError, ScenarioError, TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.network.lives import DutyCycle, RecordedLife
from netkf.runs.quantities import NETWORK, has_ages
from netkf.runs.tables import format_number
from netkf.scenario.scenario import Scenario
from netkf.studies.metrics import RunMetrics, bound_traces, central_traces, over_central
from netkf.theory import assumptions
from netkf.theory.hybrid.samples import randomly_sampled_sensors

REACHED, MISSED, UNDECIDED, NOT_SHOWN = "reached", "missed", "undecided", "not shown"
"""States of a value; ``not shown``: an upper bound is above the limit, which proves nothing."""
AVERAGES = {
    "worst_rms": "RMS error of the node with the largest",
    "mean_rms": "RMS error of all nodes together",
    "worst_trace": "mean trace of P of the node with the largest",
    "mean_trace": "mean trace of P of all nodes",
    "within_central": "largest of the nodes' RMS errors, each over that of a centralised filter",
}
"""Quantities of a target that are averages over the samples after time 0."""
QUANTITIES = AVERAGES | {
    "worst_instant": "largest error of any node at any sample after time 0",
    "time_above": "share of samples whose error is above metrics.level",
    "mean_age": "mean age of the newest reading of each sensor, of all nodes",
    "worst_age": "largest age of the newest reading of any sensor at any node",
    "time_connected": "share of time in which the nodes that are up are connected",
    "transmissions": "transmissions of all nodes in a run",
    "bytes": "bytes transmitted by all nodes in a run",
    "joules": "joules spent by all nodes in a run",
}
"""Quantities of a target, beside quantile_99 and its kind."""
UNSEEN = 2
"""Runs added at either end of a share: of rare ones, unlike all others, none may have come yet
(Agresti and Coull, The American Statistician 52, 1998).
"""
QUANTILE = re.compile(r"quantile_(\d+(?:\.\d+)?)")


class QuantityInterval(NamedTuple):
    """An estimate of a quantity, and the ends of its interval."""

    value: float
    low: float
    high: float


class Target(NamedTuple):
    """A quantity that should be at most ``limit``, or at least if ``least``."""

    quantity: str
    limit: float
    least: bool = False

    def __str__(self) -> str:
        return f"{self.quantity} {'>=' if self.least else '<='} {self.limit:g}"

    @property
    def of_runs(self) -> bool:
        """True if it is one of ``runs.quantities``, which theory does not know."""
        return self.quantity not in AVERAGES

    @property
    def of_errors(self) -> bool:
        """True if it is about mean square errors, False if about covariances or of runs."""
        return not self.of_runs and not self.quantity.endswith("_trace")

    @property
    def description(self) -> str:
        """The quantity in words."""
        quantile = QUANTILE.fullmatch(self.quantity)
        if quantile:
            return f"error that is not exceeded in {quantile[1]} % of samples"
        return QUANTITIES[self.quantity]

    def has_rare_runs(self, scenario: Scenario) -> bool:
        """Return True if it is a share that few runs may have another value of than all others."""
        planned = all(isinstance(k, DutyCycle | RecordedLife) for k in scenario.network.lives)
        return self.quantity == "time_above" or (self.quantity == "time_connected" and not planned)

    def decide(self, interval: QuantityInterval) -> str:
        """Return if a quantity in this interval reaches the target."""
        low, high = interval.low, interval.high
        if low >= self.limit if self.least else high <= self.limit:
            return REACHED
        # Also if an end is not a number.
        return UNDECIDED if (high >= self.limit if self.least else low <= self.limit) else MISSED

    def prepare(self, scenario: Scenario) -> Scenario:
        """Return a scenario whose runs have the quantity; raises ScenarioError if none has, and
        TheoryError where the central filter has no P.
        """
        metrics = scenario.metrics
        quantile = QUANTILE.fullmatch(self.quantity)
        if quantile:
            metrics = dataclasses.replace(metrics, quantiles=(float(quantile[1]) / 100.0,))
        elif self.quantity == "time_above" and metrics.level is None:
            rule, remedy = "needs a level of errors", "add --set metrics.level=..."
            raise ScenarioError("--target", rule, self.quantity, remedy)
        elif self.quantity == "joules" and scenario.network.energy is None:
            rule, remedy = "needs network.energy", "add joules_per_packet to [network.energy]"
            raise ScenarioError("--target", rule, self.quantity, remedy)
        elif self.quantity == "within_central":
            try:
                central_traces(scenario)
            except TheoryError as error:
                rule = f"--target: within_central divides by P of a centralised filter: {error}"
                remedy = "ask for worst_rms; netkf compare-filters has the errors of both"
                raise TheoryError(f"{rule}; {remedy}") from None
        elif self.quantity in NETWORK:
            if self.quantity.endswith("_age") and not has_ages(scenario):
                rule = "needs nodes that hear of the readings of others"
                raise ScenarioError("--target", rule, self.quantity, "ask for worst_rms")
            metrics = dataclasses.replace(metrics, network=True)
        return dataclasses.replace(scenario, metrics=metrics)

    @property
    def of_worst(self) -> bool:
        """True if it is about the worst node, False if about all nodes together."""
        return not self.quantity.startswith("mean_")


def parse_target(text: Any) -> Target:
    """Return the target of a text like ``worst_rms<=0.5``; raises ScenarioError."""
    pattern = r"\s*([\w.]+)\s*(<=|>=)\s*(\S+)\s*"
    match = re.fullmatch(pattern, text) if isinstance(text, str) else None
    listed = ", ".join((*QUANTITIES, "quantile_99 and others up to quantile_100"))
    quantile = match and QUANTILE.fullmatch(match[1])
    is_known = match and (match[1] in QUANTITIES or (quantile and float(quantile[1]) <= 100.0))
    if match is None or not is_known:
        message = f"must be QUANTITY<=LIMIT with a quantity of {listed}"
        raise ScenarioError("--target", message, text, "write worst_rms<=0.5")
    least = match[2] == ">="
    if least != (match[1] == "time_connected"):
        right = f"{match[1]}{'<=' if least else '>='}"
        raise ScenarioError("--target", f"must be {right}LIMIT", text, f"write {right}{match[3]}")
    try:
        limit = float(match[3])
    except ValueError:
        limit = math.nan
    if not (math.isfinite(limit) and limit > 0.0):
        raise ScenarioError("--target", "limit must be a number above 0", match[3], "correct it")
    return Target(match[1], limit, least)


def quantity_by_theory(scenario: Scenario, target: Target) -> tuple[float, str]:
    """Return an upper bound on the quantity of the target, or the quantity itself, and a text that
    says which of the two it is, and why. Raises TheoryError if theory has no answer.
    """
    if target.of_runs:
        raise TheoryError(f"theory knows no {target.quantity}")
    traces, algorithm = bound_traces(scenario), scenario.filter.algorithm
    # Without exchange the bound of bound_traces() is the covariance itself.
    message = "exact: the covariance of filters that do not talk"
    if algorithm.timing.talks or randomly_sampled_sensors(scenario):
        message = "an upper bound: the trace of Tanwani's H(12), which E[P_i] stays below"
    if target.of_errors:
        message += _explain_errors(scenario)
    if target.quantity == "within_central":
        traces = over_central(traces, central_traces(scenario))
    value = float(traces.max() if target.of_worst else traces.mean())
    return math.sqrt(value) if target.of_errors else value, message


def theory_is_exact(scenario: Scenario, target: Target) -> bool:
    """Return True if ``quantity_by_theory`` is the quantity itself, False if it is a bound."""
    if scenario.filter.algorithm.timing.talks or randomly_sampled_sensors(scenario):
        return False
    return not target.of_errors or not scenario.other_starts


def _explain_errors(scenario: Scenario) -> str:
    """Return why P bounds the errors (Tanwani, H (10)); raises TheoryError if it need not."""
    if not scenario.filters_know_the_truth:
        raise TheoryError("the filters' model differs from the truth: P need not bound the errors")
    rows = assumptions(scenario)
    if not rows[rows["assumption"].str.startswith("P_i(0) >= ")]["holds"].all():
        raise TheoryError("P_i(0) is below the covariance of the first error: P need not bound it")
    exact = not scenario.other_starts and not scenario.filter.algorithm.timing.talks
    return "" if exact else "; P_i in turn bounds the covariance of the error, Tanwani's H (10)"


def quantity_by_simulation(
    metrics: RunMetrics,
    target: Target,
    level: float,
    central: FloatArray | None,
    names: Sequence[str] = (),
    rare: bool = False,
) -> QuantityInterval:
    """Return the quantity over runs with Student's interval, of the worst node for all nodes
    (Bonferroni), which misses it with probability ``level``; ``central`` (N,) are traces of P
    to divide by, ``names`` those of ``metrics.quantities``. Of a share ``rare`` runs may be unseen.
    """
    if target.of_runs:
        values = metrics.quantities[:, [names.index(target.quantity)]]
    else:
        values = metrics.mean_square if target.of_errors else metrics.trace
    if central is not None:
        values = over_central(values, central)
    if (np.isnan(values) & ~(metrics.diverged > 0)).any():
        # Rounding hides the errors of some run: nothing can be decided.
        return QuantityInterval(math.nan, -math.inf, math.inf)
    # A run that diverged is the worst.
    values = np.where(metrics.diverged > 0, 0.0 if target.least else np.inf, values)
    columns = values if target.of_worst else values.mean(axis=1, keepdims=True)
    tail = level / (2.0 * columns.shape[1])
    mean, low, high = _student_ends(columns, tail)
    if rare:
        unseen = np.full((UNSEEN, 1), 1.0)
        low = np.maximum(_student_ends(np.concatenate([columns, 0.0 * unseen]), tail)[1], 0.0)
        high = np.minimum(_student_ends(np.concatenate([columns, unseen]), tail)[2], 1.0)
    # The largest mean lies between the largest lower and the largest upper end of all columns.
    ends = np.array([mean.max(), low.max(), high.max()])
    ends = np.sqrt(np.maximum(ends, 0.0)) if target.of_errors else ends
    # nan is inf - inf of diverged runs, whose errors count as infinite.
    return QuantityInterval(*map(float, np.where(np.isnan(ends), np.inf, ends)))


def _student_ends(columns: FloatArray, tail: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return means (N,) of ``columns`` (R, N) and ends that miss them with probability ``tail``."""
    runs = len(columns)
    with np.errstate(over="ignore", invalid="ignore"):
        mean = columns.mean(axis=0)
        error = columns.std(axis=0, ddof=1) / math.sqrt(runs)
        width = float(scipy.special.stdtrit(runs - 1, 1.0 - tail)) * error
        return mean, mean - width, mean + width


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
    found: list[tuple[float, str, str]] = []
    if not before:
        return found  # nothing falls below 0, which has no ratios
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
