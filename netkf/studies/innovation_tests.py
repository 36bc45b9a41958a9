"""``netkf.innovations``: does a run fit its model, node by node, without a true state?

Innovations, readings minus their predictions in units of their covariance, are white with NIS
chi-square if the model is right and the filter optimal. Each node is tested on its mean NIS, its
bias, Ljung and Box's statistic (Biometrika 65, 1978) and on stretches of time that differ from the
rest. Bonferroni's inequality makes all verdicts hold together at the stated confidence. Nodes that
exchange estimates have correlated innovations: there only NIS and bias are tested, with as many
independent readings as the correlation found leaves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.special import chndtrinc, gammainc, gammaincc, gammaincinv, ndtr, ndtri, stdtrit

from netkf.algorithms.baselines import Central
from netkf.algorithms.registry import overridden
from netkf.checks.innovations import MIN_READINGS, Innovations, autocorrelation, compute_innovations
from netkf.core.errors import ScenarioError
from netkf.core.fields import number
from netkf.core.notebook import NotebookTable
from netkf.laws.intervals import POWER
from netkf.linalg.arrays import FloatArray
from netkf.runs.files import require_run
from netkf.runs.simulate import simulate
from netkf.runs.summary import chi_square_interval
from netkf.runs.tables import format_error, format_number, format_table, shorten_rows
from netkf.scenario.scenario import Scenario
from netkf.studies.likelihood import CentralModel
from netkf.trace.run import Run

if TYPE_CHECKING:
    import pandas as pd

LAGS = 10
"""Lags of Ljung and Box's statistic, at most a fifth of the readings."""
MIN_INDEPENDENT = 20
"""Least number of readings, less those that correlation takes away, that are judged."""
STRETCHES = 64
"""Parts of a run, of as many readings each, at whose ends a stretch of time may begin or end."""
SHUFFLES = 20_000
MAX_ROWS = 40  # rows that fit onto a screen
DETECTABLE = ("nis_detectable", "bias_detectable", "correlation_detectable")


class Law(NamedTuple):
    """What innovations are if the model is right: "white", "exact" (of the right size, but
    correlated), "smaller" (P is conservative), or "" (unknown, for a ``reason``).
    """

    kind: str
    reason: str = ""


class Stretch(NamedTuple):
    """The readings ``first`` .. ``end`` - 1 of a node that differ most from what they should be,
    and the probability ``p`` that some stretch differs as much by chance.
    """

    first: int
    end: int
    p: float


def ljung_box(values: FloatArray, lags: int) -> float:
    """Return n (n + 2) sum_k r_k^2 / (n - k) over ``lags`` of n ``values``, about their mean."""
    n, r = len(values), autocorrelation(values - values.mean(), lags)
    return float(n * (n + 2.0) * (r * r / (n - np.arange(1, lags + 1))).sum())


def whiteness_p(columns: list[FloatArray], lags: int, level: float) -> tuple[float, float]:
    """Return the sum of Ljung and Box's statistics of independent ``columns``, and its p."""
    total, freedom = sum(ljung_box(column, lags) for column in columns), lags * len(columns)
    p = float(gammaincc(0.5 * freedom, 0.5 * total))
    if not level**3 < p < level:
        return total, p
    random, exceeding, size = np.random.default_rng(1), 0, 500
    for _ in range(SHUFFLES // size):
        sums = np.zeros(size)
        for column in columns:
            x = random.permuted(np.tile(column - column.mean(), (size, 1)), axis=1)
            n, power = len(column), float(column.var() * len(column))
            for k in range(1, lags + 1):
                r = np.einsum("ij,ij->i", x[:, k:], x[:, :-k]) / power
                sums += n * (n + 2.0) * r * r / (n - k)
        exceeding += int((sums >= total).sum())
    return total, (exceeding + 1.0) / (SHUFFLES + 1.0)


def find_stretch(nis: FloatArray, rows: np.ndarray, sums: FloatArray) -> Stretch:
    """Return the stretch of M readings that differs most. Without one ``nis`` (M,) are chi-square
    with ``rows`` (M,) degrees of freedom, and ``sums`` (M,) normal with variance ``rows``.
    """
    ends = np.unique(np.linspace(0, len(nis), min(STRETCHES, len(nis)) + 1).astype(int))
    cumulated = [np.append(0.0, np.cumsum(values))[ends] for values in (nis, rows, sums)]
    j, k = np.triu_indices(len(ends), 1)
    S, m, z = (values[k] - values[j] for values in cumulated)
    scale = 0.5 * (S - m - m * np.log(np.maximum(S, 1e-300) / m))
    gain = np.maximum(scale, 0.5 * z * z / m)
    tails = np.minimum(gammaincc(0.5 * m, 0.5 * S), gammainc(0.5 * m, 0.5 * S))
    tails = np.minimum(tails, ndtr(-np.abs(z) / np.sqrt(m)))
    # A beginning or an end inside the run has to be worth the choice among so many.
    gain += math.log(len(ends)) * ((j == 0) + (k == len(ends) - 1.0))
    best = int(np.argmax(gain))
    # Two tests of two sides for each stretch.
    return Stretch(int(ends[j[best]]), int(ends[k[best]]), min(1.0, 4.0 * len(S) * tails.min()))


@dataclass(frozen=True)
class NodeInnovations:
    """What the ``readings`` of a node say; what could not be tested is nan.

    nis : mean NIS for each value read, which should lie in ``nis_low`` .. ``nis_high``; the test
          finds a mean of ``nis_detectable`` with probability 0.9
    bias : mean innovation of the ``component`` of readings (counted from 0) that stands out most,
           in its unit, which should be within ``bias_reach`` of 0; ``bias_detectable`` is found
           with probability 0.9
    label : what this component is, by the names and units of the plant, as x (m); else empty
    ljung_box, freedom, p_white : the statistic, its degrees of freedom and its p;
        ``correlation_detectable`` at one lag is found with probability 0.9
    log_likelihood : log density of the readings given those that the node knew before
    since, until : seconds, where innovations are rejected: of the stretch that differs most, nan
                   if it begins or ends with the readings
    verdict : begins with BROKEN if the model does not explain the readings
    """

    node: int
    readings: int
    nis: float
    nis_low: float
    nis_high: float
    nis_detectable: float
    bias: float
    bias_reach: float
    bias_detectable: float
    component: int
    ljung_box: float
    freedom: int
    p_white: float
    correlation_detectable: float
    log_likelihood: float
    since: float
    until: float
    verdict: str
    label: str = ""


@dataclass(frozen=True, eq=False, repr=False)
class InnovationTests(NotebookTable):
    """Rows by node with readings (-1: all nodes, read by one filter); false if a node's innovations
    contradict the model. All verdicts hold together at ``confidence`` if the model is right.
    """

    scenario: str
    confidence: float
    law: Law
    rows: tuple[NodeInnovations, ...]

    def __repr__(self) -> str:
        broken = sum(row.verdict.startswith("BROKEN") for row in self.rows)
        return (
            f"<netkf innovations of {self.scenario!r}: {broken} of {len(self.rows)} nodes BROKEN>"
        )

    def __bool__(self) -> bool:
        return not any(row.verdict.startswith("BROKEN") for row in self.rows)

    @property
    def table(self) -> pd.DataFrame:
        """One row per node."""
        import pandas as pd

        return pd.DataFrame([vars(row) for row in self.rows])


@np.errstate(under="ignore")
def innovations(run: Run | Scenario, confidence: float = 0.99) -> InnovationTests:
    """Test the innovations of each node of a ``run``, or of one that is simulated from a scenario.
    No true state is needed.

    The innovations of the filter ``central`` are attributed to the nodes whose sensors gave the
    readings, in their order within an instant. Raises NetkfError without readings or covariances.
    """
    confidence = number(above=0.0, below=1.0)("confidence", confidence)
    if isinstance(run, Scenario):
        run = simulate(run)
    return judge_innovations(require_run(run), recorded_innovations(run), confidence)


def recorded_innovations(run: Run) -> Innovations:
    """Return the innovations of a run; raises NetkfError without any."""
    scenario = run.scenario
    exact = scenario.filter.gate is None and not scenario.network.clocks
    central = scenario.node_filter
    if isinstance(central, Central) and not overridden(central) and exact:
        try:
            return CentralModel(scenario, run.seed, run.replica).as_innovations()
        except ScenarioError:
            pass  # increments, a model that changes, or readings that are too large
    return compute_innovations(run)


def law_of(scenario: Scenario) -> Law:
    """Return what the innovations of a scenario's filter are if its model is right."""
    algorithm, linear = scenario.node_filter, scenario.plant.linear and scenario.has_linear_sensors
    for reason, holds in (
        ("the gate takes the largest readings away", scenario.filter.gate is not None),
        ("P is that of a linearised model", not linear),
        ("filters do not know the input", scenario.misses_input),
        ("a node that restarts forgets", bool(scenario.forgetful_nodes)),
        ("it is not known what P of a user's filter is", overridden(algorithm)),
    ):
        if holds:
            return Law("", reason)
    # Nodes that tell each other readings only, or nothing, are Kalman filters of what they know.
    if not (algorithm.timing.talks and any(map(algorithm.analysis.tells_estimates, (-1, 0)))):
        return Law("white")
    if algorithm.analysis.swaps:
        return Law("exact")
    if algorithm.analysis.P_by_design[not scenario.slotted] == "larger":
        return Law("smaller")
    return Law("", "P of this filter is not promised to describe its errors")


def judge_innovations(
    scenario: Scenario, recorded: Innovations, confidence: float
) -> InnovationTests:
    """Return the verdicts on ``recorded`` innovations of a run of ``scenario``."""
    law, is_finite = law_of(scenario), np.isfinite(recorded.nis)
    nodes = np.unique(recorded.nodes[is_finite]).tolist()
    level = (1.0 - confidence) / max(1, len(nodes)) / (4 if law.kind == "white" else 2)
    chosen = (np.flatnonzero(is_finite & (recorded.nodes == node)) for node in nodes)
    rows = [_judge_node(scenario, recorded, of_node, law, level) for of_node in chosen]
    return InnovationTests(scenario.name, confidence, law, tuple(rows))


def _judge_node(
    scenario: Scenario, recorded: Innovations, chosen: np.ndarray, law: Law, level: float
) -> NodeInnovations:
    """Return the row of the node of ``chosen`` readings, with tests at ``level``."""
    # The central filter, -1, is no node of the network.
    number = int(recorded.nodes[chosen[0]])
    node = scenario.topology.named(number) if number >= 0 else number
    is_white = law.kind == "white"
    nis, rows = recorded.nis[chosen], recorded.rows[chosen]
    freedom, mean = float(rows.sum()), float(nis.sum() / rows.sum())
    whitened = [recorded.whitened[i] for i in chosen]
    places, are_told = _value_indices(recorded, chosen)
    flat, of = np.concatenate(whitened), np.concatenate(places)
    columns = [flat[of == c] for c in np.unique(of)]
    # Correlated readings count as fewer independent ones.
    inflation = 1.0 if is_white else _inflation(columns)
    low, high, detectable = _limits(freedom / inflation, level)
    bias, reach, found, component = _bias(recorded, chosen, of, inflation, level)
    label = scenario.label_of_value(node, component, None if are_told else rows)
    whiteness = _whiteness(columns, level)
    stretch = find_stretch(nis, rows, np.array([one.sum() for one in whitened]))
    since, until = math.nan, math.nan
    reasons = [reason for reason, holds in (
        (f"NIS above {high:.3g}", bool(law.kind) and mean > high),
        (f"NIS below {low:.3g}", law.kind in ("white", "exact") and mean < low),
        (f"biased in {label}" if label else "biased", bool(law.kind) and abs(bias) > reach),
        ("correlated", is_white and whiteness.p < level),
    ) if holds]  # fmt: skip
    if is_white and not reasons and stretch.p < level:
        reasons.append("some readings are not like the others")
    if reasons:
        since, until = _ends_of(stretch, recorded.times[chosen])
        ends = (("since", since), ("until", until))
        reasons += [f"{word} {time:g} s" for word, time in ends if math.isfinite(time)]
    unbroken = _unbroken(law, freedom / inflation, mean < low)
    return NodeInnovations(
        node, len(chosen), mean, low, high, detectable, bias, reach, found, component, *whiteness,
        float(recorded.log_density[chosen].sum()), since, until,
        f"BROKEN: {', '.join(reasons)}" if reasons else unbroken, label,
    )  # fmt: skip


def _value_indices(recorded: Innovations, chosen: np.ndarray) -> tuple[list[np.ndarray], bool]:
    """Return which value each of ``chosen`` readings is of, and True if the record tells it."""
    told = [recorded.components[i] for i in chosen] if recorded.components else [None]
    known = [one for one in told if one is not None]
    if len(known) == len(chosen):
        return known, True
    return [np.arange(p) for p in recorded.rows[chosen]], False


def _limits(counted: float, level: float) -> tuple[float, float, float]:
    """Return the limits of a mean of so many squares, and the variance that POWER finds."""
    if not counted > 0.0:
        return 0.0, math.inf, math.inf
    low, high = (float(end) for end in chi_square_interval(counted, 1.0 - level))
    return low, high, high / (2.0 * float(gammaincinv(0.5 * counted, 1.0 - POWER)) / counted)


class _Whiteness(NamedTuple):
    statistic: float
    freedom: int
    p: float
    correlation: float


def _whiteness(columns: list[FloatArray], level: float) -> _Whiteness:
    """Return the test of Ljung and Box, and the correlation that POWER finds."""
    lags = min(LAGS, max(map(len, columns)) // 5)
    columns = [column for column in columns if len(column) >= MIN_READINGS]
    if not columns:
        return _Whiteness(math.nan, 0, math.nan, math.nan)
    freedom, count = lags * len(columns), sum(map(len, columns))
    # At one lag, of which the test has this probability of finding it.
    critical = 2.0 * float(gammaincinv(0.5 * freedom, 1.0 - 0.1 * level))
    correlation = math.sqrt(float(chndtrinc(critical, freedom, 1.0 - POWER)) / count)
    statistic, p = whiteness_p(columns, lags, level)
    return _Whiteness(statistic, freedom, p, min(1.0, correlation))


def _ends_of(stretch: Stretch, times: FloatArray) -> tuple[float, float]:
    """Return when a stretch begins and ends (s), nan where the readings do."""
    since = float(times[stretch.first]) if stretch.first else math.nan
    return since, float(times[stretch.end - 1]) if stretch.end < len(times) else math.nan


def _unbroken(law: Law, counted: float, is_small: bool) -> str:
    if not law.kind:
        return "not judged"
    if not counted:
        return "not judged: too few independent readings"
    expected = "as expected: P is conservative by design"
    return expected if law.kind == "smaller" and is_small else "consistent"


def _inflation(columns: list[FloatArray]) -> float:
    """Return by how much autocorrelation increases the variance of the sum of a series, at most."""
    largest = 1.0
    for column in columns:
        r = autocorrelation(column - column.mean(), max(1, len(column) // 4))
        found = 1.0 + 2.0 * float(r[: int(np.argmax(np.append(r, -1.0) <= 0.0))].sum())
        largest = max(largest, found * (1.0 + 4.0 * (found - 1.0) / len(column)))
        if len(column) < MIN_INDEPENDENT * found:
            return math.inf
    return largest


def _bias(
    recorded: Innovations, chosen: np.ndarray, places: np.ndarray, inflation: float, level: float
) -> tuple[float, float, float, int]:
    """Return the largest bias, how far from 0 it may be, what POWER finds, and the component."""
    best = math.nan, math.inf, math.nan, -1
    values = np.concatenate([recorded.values[i] for i in chosen])
    deviations = np.concatenate([recorded.deviations[i] for i in chosen])
    components = np.unique(places).tolist()
    for c in components:
        v, weights = values[places == c], deviations[places == c] ** -2.0
        bias, error = float(weights @ v / weights.sum()), math.sqrt(inflation / weights.sum())
        tail = level / len(components) / 2.0
        quantile = -float(ndtri(tail))
        if inflation > 1.0:  # estimated from as many independent values
            quantile = -float(stdtrit(max(len(v) / inflation - 1.0, 1.0), tail))
        reach = quantile * error
        if best[3] < 0 or abs(bias) / reach > abs(best[0]) / best[1]:
            best = bias, reach, reach + float(ndtri(POWER)) * error, c
    return best


def format_innovations(tests: InnovationTests, full: bool = True) -> str:
    """Return a row per node, those that are broken first unless ``full``, and a legend."""
    listed = sorted(tests.rows, key=lambda row: not (full or row.verdict.startswith("BROKEN")))
    named = any(row.label or row.component for row in listed)
    header = ["node", "readings", "NIS", "bias", *["of"] * named]
    header += ["Ljung-Box p", "log-likelihood", "verdict"]
    rows = [
        [
            str(row.node),
            f"{row.readings:,}",
            format_number(row.nis),
            format_number(row.bias) + format_error(row.bias_reach, digits=2),
            *[row.label or f"y{row.component}"] * named,
            format_number(row.p_white),
            f"{row.log_likelihood:.6g}",
            row.verdict,
        ]
        for row in listed
    ]
    words = {
        "white": "if the model is right, NIS is 1 on average and innovations are white",
        "exact": "if the model is right, NIS is 1 on average; exchanges correlate innovations, so "
        "that whiteness is not tested",
        "smaller": "if the model is right, NIS is at most 1 on average, for P is conservative by "
        "design; exchanges correlate innovations, so that whiteness is not tested",
        "": f"no node is judged: {tests.law.reason}",
    }
    lines = [format_table(header, rows if full else shorten_rows(rows, MAX_ROWS)), ""]
    lines.append(f"{words[tests.law.kind]}; all together at confidence {tests.confidence:g}")
    # Where readings are too few nothing can be found.
    judged = [row for row in tests.rows if math.isfinite(row.nis_detectable + row.bias_detectable)]
    if tests.law.kind and judged:
        # Correlations are not tested where readings are very few.
        values = [[getattr(row, name) for name in DETECTABLE] for row in judged]
        largest = np.fmax.reduce(values).tolist()
        text = "found with probability 0.9 at every node judged: a mean NIS of {:.3g}, a bias of {}"
        white = tests.law.kind == "white" and math.isfinite(largest[2])
        text += ", a correlation at one lag of {:.3g}" if white else ""
        # Biases of different units do not compare.
        found = sorted((row.label, row.bias_detectable) for row in judged)
        largest[1] = ", ".join(
            f"{b:.3g} in {of}" if of else f"{b:.3g}" for of, b in dict(found).items()
        )
        lines.append(text.format(*largest))
    return "\n".join(lines)
