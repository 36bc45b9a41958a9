"""Values of the runs of one filter, and paired differences of two filters on the same runs."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
import scipy.special

from netkf.engines.base import Engine
from netkf.ensembles.statistics import run_values
from netkf.laws.intervals import interval_of_squares
from netkf.linalg.arrays import FloatArray
from netkf.runs.simulate import simulate
from netkf.scenario.scenario import Scenario
from netkf.studies.metrics import mean_over_runs
from netkf.trace.batch import RunBatch
from netkf.trace.nees import without_padding
from netkf.trace.schema import CODES

ROUNDING = 1e-9
"""Relative difference up to which two filters count as equal."""


class FilterValues(NamedTuple):
    """Values of R runs, averages over the samples after time 0 (R,) each.

    square   : squared error, mean of all nodes
    worst    : largest error of any node at any sample (not an average)
    nees     : e' P^-1 e, mean of all nodes
    diverged : True if the run ended early
    """

    square: FloatArray
    worst: FloatArray
    nees: FloatArray
    diverged: np.ndarray


def block_values(scenario: Scenario, seed: int, replicas: range, engine: Engine) -> FilterValues:
    """Simulate ``replicas`` of ``seed`` and return their values; for ``replicate_blocks``."""
    parts = []
    for batch in engine.run_many(scenario, seed, replicas):
        values = run_values(batch, scenario)
        # (R,): squared error and NEES, means over time and nodes.
        square, _, nees = values.averages[:, -1].T
        ends = enumerate(values.rounding_from.tolist())
        worst = np.array([_largest_error(batch, r, end) for r, end in ends])
        parts.append(FilterValues(square, worst, nees, values.diverged > 0))
    return join_values(*parts)


def _largest_error(batch: RunBatch, r: int, blurred_from: float) -> float:
    """Return the largest |e| of run ``r`` after time 0 and before ``blurred_from`` s, or nan."""
    length = int(batch.lengths[r])
    times = batch.times[:length]
    # The last sample of a run that diverges is not finite.
    usable = (times > 0.0) & ~(times >= blurred_from)
    if batch.diverged[r]:
        usable[-1:] = False
    e, _ = without_padding(batch.error[r, :length][usable], batch.P[r, :length][usable])
    sizes = np.linalg.norm(e, axis=-1)
    return float(sizes.max()) if sizes.size else math.nan


def join_values(*parts: FilterValues) -> FilterValues:
    """Return the values of several batches as one."""
    return FilterValues(*(np.concatenate(values) for values in zip(*parts, strict=True)))


class Traffic(NamedTuple):
    """The traffic of all nodes in a run; a broadcast is one of the ``transmissions``."""

    transmissions: int
    bytes: float


def count_traffic(scenario: Scenario, seed: int, engine: Engine) -> Traffic:
    """Simulate replica 0 and return what its nodes send: transmissions and bytes."""
    log, slotted = simulate(scenario, seed, 0, engine).log, scenario.slotted
    sent = log[log["kind"] == CODES["send"]]
    if slotted:
        # All messages of a node in one step of an exchange are one transmission.
        sent = np.unique(sent[["t", "phase", "node"]])
    elif (log["kind"] == CODES["transmit"]).any():
        sent = log[log["kind"] == CODES["transmit"]]
    # The exchange of the slot, by which some filters send different things; -1 under clocks.
    phases = sent["phase"].tolist() if slotted else [-1] * len(sent)
    pairs = zip(sent["node"].tolist(), phases, strict=True)
    return Traffic(len(sent), sum(itertools.starmap(scenario.message_size, pairs)))


class Quantity(NamedTuple):
    """A mean over runs with its standard error, and its difference from that of the first filter.

    ``low`` and ``high`` are the interval of the difference, ``real`` is True if it excludes 0; nan
    and False without a difference.
    """

    value: float
    se: float
    difference: float = math.nan
    low: float = math.nan
    high: float = math.nan
    real: bool = False


def estimate_quantities(
    values: FilterValues, first: FilterValues | None, n: float, level: float
) -> dict[str, Quantity]:
    """Return ``rms_error``, ``worst_instant`` and ``nees_ratio`` (NEES / n) of a filter of n
    states, the mean of the nodes', with the paired differences from the ``first`` one; each
    interval misses with probability ``level``.
    """
    quantities = {}
    base = _influences(first, n) if first is not None else {}
    for name, (value, influence) in _influences(values, n).items():
        runs = len(influence)
        quantity = Quantity(value, mean_over_runs(influence).error)
        if name in base and not (values.diverged.any() or first is None or first.diverged.any()):
            base_value, influence_difference = base[name][0], influence - base[name][1]
            width = _width(influence_difference, level)
            gap = value - base_value
            # The interval excludes 0, and the difference is not mere rounding, by which two forms
            # of one algorithm differ.
            real = runs > 1 and abs(gap) > max(width, ROUNDING * abs(value))
            quantity = quantity._replace(
                difference=gap, low=gap - width, high=gap + width, real=bool(real)
            )
        quantities[name] = quantity
    return quantities


def _influences(values: FilterValues, n: float) -> dict[str, tuple[float, FloatArray]]:
    """Return each quantity with its influence values (R,), whose mean has its error."""
    # Delta method: differences of two filters have the error of differences of influences.
    rms = math.sqrt(float(values.square.mean()))
    # d sqrt(m) = dm / (2 sqrt(m))
    square = values.square / (2.0 * rms) if rms > 0.0 else values.square
    nees = values.nees / n
    return {
        "rms_error": (rms, square),
        "worst_instant": (float(values.worst.mean()), values.worst),
        "nees_ratio": (float(nees.mean()), nees),
    }


def _width(values: FloatArray, level: float) -> float:
    """Return half of Student's interval for the mean of ``values`` (R,); nan for one value."""
    if len(values) < 2:
        return math.nan
    quantile = float(scipy.special.stdtrit(len(values) - 1, 1.0 - level / 2.0))
    return quantile * mean_over_runs(values).error


def credibility(values: FilterValues, n: float, level: float) -> str:
    """Return whether P fits the errors of a filter: "overconfident", "conservative" or
    "consistent", as the interval of NEES / n, which misses with probability ``level``, lies
    above, below or around 1; "-" where NEES is unknown or one run shows nothing.
    """
    ratios = values.nees / n
    if len(ratios) < 2 or not np.isfinite(ratios).all():
        return "-"
    low, high = interval_of_squares(ratios, level)
    if low > 1.0:
        return "overconfident"
    return "conservative" if high < 1.0 else "consistent"
