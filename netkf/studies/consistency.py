"""``netkf.consistency``: compare NEES and NIS with their expected values.

Given the events of a run the error covariance Sigma of each node is known exactly, so the NEES
e' P^-1 e and the NIS v' S^-1 v have the means E[NEES] = tr(P^-1 Sigma) and E[NIS] =
tr(S^-1 (H Sigma H' + R)). They are n, and the number p of readings, for filters whose P is exact,
and less for those that are conservative by design, which are then not called inconsistent.
"""

from __future__ import annotations

import bisect
import dataclasses
import math
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from netkf.core.errors import ScenarioError, TheoryError
from netkf.core.fields import number, require_runs
from netkf.core.notebook import NotebookTable
from netkf.engines.base import Engine
from netkf.ensembles.pools import PoolOptions
from netkf.ensembles.replicas import replicate
from netkf.laws.intervals import interval_of_squares
from netkf.linalg.arrays import FloatArray, is_definite
from netkf.rng.streams import Streams
from netkf.runs.labels import covariance_bias
from netkf.runs.simulate import choose_engine, require_scenario, simulate
from netkf.runs.summary import NO_COVARIANCE, nees_bounds
from netkf.scenario.records import blocks_without_law, nodes_with_law, unjudged_line
from netkf.scenario.scenario import Scenario
from netkf.studies.innovation_tests import find_stretch
from netkf.studies.innovations import (
    ClockedInnovations,
    JudgedBlock,
    has_clocked_innovations,
    has_linear_innovations,
    nis_of,
    readings_of_block,
)
from netkf.theory.common.evidence import CONSISTENCY
from netkf.theory.errors import error_squares
from netkf.trace.nees import errors
from netkf.trace.run import Run, blurred_samples

if TYPE_CHECKING:
    import pandas as pd

MIN_RUNS = 10
MAX_ERRORS = 256
"""Largest number of errors N n of all nodes for which the exact covariance is computed. It takes
some seconds for each run, and the work grows with the third power of the number of nodes.
"""
UNDECIDED = "undecided: rounding blurs the errors of too many samples"
BIAS_TOLERANCE = 0.02
"""Relative distance of the expected value from n above which the verdict has a remark."""


def judged_blocks(scenario: Scenario) -> list[JudgedBlock]:
    """Return the blocks that are judged, node by node: those whose errors have a law."""
    lost = blocks_without_law(scenario)
    if len(scenario.layout.places) == 1:
        whole = np.arange(scenario.plant.n)
        return [JudgedBlock(k, "", whole, whole) for k in range(len(scenario.nodes))]
    blocks = []
    for k, places in enumerate(scenario.estimated):
        first = 0
        for place in places:
            if place in lost:
                first += place.n
                continue
            own, states = np.arange(place.n), np.arange(place.first, place.first + place.n)
            blocks.append(JudgedBlock(k, place.label, first + own, states))
            first += place.n
    return blocks


class RunConsistency(NamedTuple):
    """NEES and NIS of one run, of K blocks as nodes estimate them, see ``judged_blocks``.

    samples      : (T, K) NEES after time 0, nan if rounding blurs the error
    nees, expected : (K,) means over time of NEES and of its expected value, nan if unknown
    nis, expected_nis : (K,) means over time of NIS and of its expected value, nan if unknown
    blurred_from : (1,) first time (s) at which an error is left out, inf without one
    covariance_given : (1,) True if the filter gives a covariance
    reason       : (1,) text, why the expected values are unknown
    """

    samples: FloatArray
    nees: FloatArray
    expected: FloatArray
    nis: FloatArray
    expected_nis: FloatArray
    blurred_from: FloatArray
    covariance_given: np.ndarray
    reason: np.ndarray


# Errors of a filter that is unstable grow until their squares overflow: the verdicts say so.
@np.errstate(over="ignore", invalid="ignore")
def replica_consistency(
    scenario: Scenario, seed: int, replica: int, engine: str | Engine = "auto"
) -> RunConsistency:
    """Return the consistency of one ``replica`` of the runs of ``seed``; for ``replicate``."""
    blocks, shown = judged_blocks(scenario), scenario.times
    run = simulate(scenario, seed, replica, engine)
    innovations: Any = None
    if has_clocked_innovations(scenario):
        # They are those of predictions from the last event before: states are shown there.
        innovations = ClockedInnovations(scenario, run.log, Streams(seed, replica))
        scenario = dataclasses.replace(scenario, probe=innovations.times)
        run = innovations.run = simulate(scenario, seed, replica, engine)
    after_start = np.flatnonzero((run.times > 0.0) & np.isin(run.times, shown))
    sigma, why = None, ""  # (T, N, n, n), E[e e'] given the events; None if unknown or too large
    if _count_errors(scenario) <= MAX_ERRORS:
        try:
            sigma = error_squares(scenario, run)
            # Others follow what is recorded too, of which this is an average over a law.
            sigma[:, ~nodes_with_law(scenario)] = np.nan
        except TheoryError as error:
            why = str(error).removesuffix(f"; {CONSISTENCY}")
    columns = [_block_consistency(run, sigma, block) for block in blocks]
    nees, expected, blurred = (np.stack(column, axis=1) for column in zip(*columns, strict=True))
    if innovations is not None:
        innovations.sigma = sigma
    elif scenario.slotted and scenario.plant.linear and scenario.is_random:
        innovations = _Innovations(scenario, run, sigma)
    nis, expected_nis = _mean_nis(innovations, blocks, blurred)
    times = run.times[blurred.any(axis=1) & (run.times > 0.0)]
    return RunConsistency(
        samples=np.where(blurred, np.nan, nees)[after_start],
        nees=_mean(nees[after_start], blurred[after_start]),
        expected=_mean(expected[after_start], blurred[after_start]),
        nis=nis,
        expected_nis=expected_nis,
        blurred_from=times[:1] if len(times) else np.full(1, np.inf),
        covariance_given=np.array([np.isfinite(run.P).any()]),
        reason=np.array([why]),
    )


def _block_consistency(
    run: Run, sigma: FloatArray | None, block: JudgedBlock
) -> tuple[FloatArray, FloatArray, np.ndarray]:
    """Return NEES (T,) of a block, its expected value, and where the error is mostly rounding."""
    own = block.entries
    square = np.ix_(np.arange(len(run.times)), np.array([block.node]), own, own)
    P, covariance = run.P[square], None if sigma is None else sigma[square]
    blurred = blurred_samples(run, P)
    blurred |= False if covariance is None else blurred_samples(run, covariance)
    _, nees = errors(run.error[:, [block.node]][:, :, own], P)
    return nees[:, 0], _expected_nees(P, covariance)[:, 0], blurred[:, 0]


def _mean(values: FloatArray, blurred: np.ndarray) -> FloatArray:
    n = (~blurred).sum(axis=0)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(blurred, 0.0, values).sum(axis=0) / np.where(n, n, np.nan))


def _mean_known(values: Sequence[float]) -> float:
    """Return the mean over the runs that know a value: in some a node may have no reading."""
    known = [value for value in values if not math.isnan(value)]
    return float(np.mean(known)) if known else math.nan


def _count_errors(scenario: Scenario) -> int:
    return len(scenario.nodes) * scenario.width


def _expected_nees(P: FloatArray, sigma: FloatArray | None) -> FloatArray:
    """Return tr(P^-1 Sigma) (T, N); nan where Sigma is unknown or P singular."""
    expected = np.full(P.shape[:2], np.nan)
    if sigma is None:
        return expected
    usable = np.asarray(np.isfinite(P).all(axis=(-2, -1)))
    usable[usable] = is_definite(P[usable])
    expected[usable] = np.trace(np.linalg.solve(P[usable], sigma[usable]), axis1=-2, axis2=-1)
    return expected


def _mean_nis(
    innovations: Any, blocks: list[JudgedBlock], blurred: np.ndarray
) -> tuple[FloatArray, FloatArray]:
    """Return mean NIS (K,) and its expected value, over samples (T, K) that are not ``blurred``."""
    pairs = [
        np.array(list(innovations.of_block(block, blurred[:, k]) if innovations else ()))
        for k, block in enumerate(blocks)
    ]
    means = np.array([p.mean(axis=0) if len(p) else (np.nan, np.nan) for p in pairs])
    return means[:, 0], means[:, 1]


class _Innovations:
    """Innovations of a run in slots, from predictions that are samples (or one step after one)."""

    def __init__(self, scenario: Scenario, run: Run, sigma: FloatArray | None) -> None:
        self._scenario, self._run, self._sigma = scenario, run, sigma
        self._streams = Streams(run.seed, run.replica)
        # Samples of a predicting filter are predictions; others are predicted by one slot.
        self._steps = 0 if scenario.node_filter.timing.predicts else 1
        # Innovations exist where the sample that the prediction comes from was taken.
        slots = np.round(run.times / scenario.slot_plant.period).astype(int).tolist()
        self._samples = [
            k
            for k in range(self._steps, len(slots))
            if slots[k] - slots[k - self._steps] == self._steps and run.times[k] > 0.0
        ]
        self._slots = [slots[k] for k in self._samples]
        # With F = 0 the state is the noise of the last step, with the same draws.
        plant = scenario.linear_plant
        still: dict[str, Any] = {"F": np.zeros_like(plant.F)}
        schedule = tuple(dataclasses.replace(change, **still) for change in plant.schedule)
        memoryless = dataclasses.replace(plant, **still, schedule=schedule)
        path = memoryless.truth(self._streams.generator("plant"))
        self._noise = [path.state(slot) for slot in self._slots]

    def of_block(self, block: JudgedBlock, blurred: np.ndarray) -> Iterator[tuple[float, float]]:
        """Yield NIS of a block and its expected value, without ``blurred`` samples (T,)."""
        scenario, i, placed = self._scenario, block.node, readings_of_block(self._scenario, block)
        if not placed or not has_linear_innovations(scenario):
            return
        sensors = [scenario.slot_path(self._streams, self._run.nodes[i], p) for p in placed]
        laws = [
            [scenario.noise_covariance(p.entry, believed=b) for b in (True, False)] for p in placed
        ]
        for k, slot, noise in zip(self._samples, self._slots, self._noise, strict=True):
            source = k - self._steps  # the sample that is, or is advanced to, the prediction
            if blurred[k] or blurred[source]:
                continue
            predicted = self._prediction(source, i, (slot - 1, noise) if self._steps else None)
            zero, pairs = np.zeros(scenario.plant.n), zip(sensors, laws, strict=True)
            rows = [(sensor.matrix(slot), sensor.reading(slot, zero), *R) for sensor, R in pairs]
            yield nis_of(rows, scenario.view(i), predicted)

    def _prediction(
        self, k: int, i: int, last: tuple[int, FloatArray] | None
    ) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        """Return error, P and E[e e'] of sample k, or of its prediction over the ``last`` slot."""
        run, scenario = self._run, self._scenario
        own = scenario.is_estimated[i]
        square = np.ix_(own, own)
        e, P = run.error[k, i, own], run.P[k, i][square]
        Sigma = None if self._sigma is None else self._sigma[k, i][square]
        if last is None:
            return e, P, Sigma
        slot, noise = last
        whole = scenario.linear_plant
        # Of the plant, and of the filters' model, which may differ from it.
        now = bisect.bisect_right(whole.change_slots, slot)
        believed = bisect.bisect_right(scenario.followed_slots, slot)
        view: Any = scenario.view(i)
        pieces = (whole.pieces[now].F, whole.pieces[now].Q), scenario.believed_pieces[believed]
        (true_F, true_Q), (F, Q) = ([M[view][:, view] for M in piece] for piece in pieces)
        model_is_true = np.array_equal(F, true_F)
        if Sigma is not None:
            Sigma = true_F @ Sigma @ true_F.T + true_Q if model_is_true else None
        predicted = true_F @ e + noise[view]
        # x - xhat of the next slot, with the plant's F, F' of the model: F x + w - F' xhat
        # = F e + w + (F - F') xhat.
        if not model_is_true:
            predicted = predicted + (true_F - F) @ run.xhat[k, i, own]
        if whole.input is not None:
            gains, share = whole.input_gains, float(scenario.knows_input)
            unknown = (gains[now] - share * gains[believed]) @ whole.input.at(float(run.times[k]))
            if unknown[view].any():
                predicted, Sigma = predicted + unknown[view], None
        return predicted, F @ P @ F.T + Q, Sigma


@dataclass(frozen=True)
class NodeConsistency:
    """The consistency of one node, or of one block that it estimates, over all runs.

    block        : the name of the block and whose it is, as pose@3; empty for the whole state
    n            : its number of states
    nees         : mean NEES over runs and samples
    width        : reach of the interval of NEES minus its expected value (n if unknown) towards 0
    expected     : expected value of NEES, nan if unknown
    inside       : share of samples whose mean NEES over the runs lies in the chi-square bounds
    nis, expected_nis : mean NIS and its expected value, nan if unknown
    verdict      : a sentence, which begins with BROKEN if the errors are not as expected
    """

    node: int
    nees: float
    width: float
    expected: float
    inside: float
    nis: float
    expected_nis: float
    verdict: str
    block: str = ""
    n: int = 0

    @property
    def label(self) -> str:
        """The node, and the block if there are several."""
        return f"{self.node} ({self.block})" if self.block else str(self.node)


@dataclass(frozen=True)
class Consistency(NotebookTable):
    """Rows by node, and by block where there are several; false if errors contradict P.

    ``low`` and ``high`` are the two-sided chi-square bounds at ``confidence`` on the mean NEES of a
    sample over the runs if P is exact, of the largest number of states ``n``; divided by n they
    bound the ANEES. ``notes`` are sentences on what was left out, and why; ``states`` has the names
    and units of the states that NEES is of, empty without any.
    """

    scenario: str
    n: int
    runs: int
    confidence: float
    low: float
    high: float
    rows: tuple[NodeConsistency, ...]
    notes: tuple[str, ...] = ()
    states: str = ""

    def __repr__(self) -> str:
        broken = sum(row.verdict.startswith("BROKEN") for row in self.rows)
        nodes = f"{len(self.rows)} {'blocks' if self.rows[0].block else 'nodes'}"
        nodes = f"{broken} of {nodes} BROKEN" if broken else nodes
        return f"<netkf consistency of {self.scenario!r}: {nodes}; {self.runs:,} runs>"

    def __bool__(self) -> bool:
        return not any(row.verdict.startswith("BROKEN") for row in self.rows)

    @property
    def table(self) -> pd.DataFrame:
        """One row per node, or per block of each node."""
        import pandas as pd

        return pd.DataFrame([vars(row) for row in self.rows])


@np.errstate(under="ignore")
def consistency(
    scenario: Scenario,
    runs: int = 50,
    seed: int | None = None,
    confidence: float = 0.99,
    workers: int | None = None,
    executor: Executor | None = None,
    scheduler: str | None = None,
    engine: str = "auto",
) -> Consistency:
    """Compare NEES and, in slots, NIS of ``runs`` runs with their expected values, for each block
    of ``[[plants]]`` that a node estimates, or else for each node.

    The verdicts compare the NEES of each run with its exact expected value given the events of the
    run (run by run, see ``interval_of_squares``; all rows together at ``confidence``), or with n if
    that is unknown (push-sum with frozen or asymptotic gains, a user's own filter). ``seed`` and
    the options from ``workers`` on are those of ``netkf.monte_carlo``.

    Blocks that are recorded, unknown or read by recorded sensors are not judged; of nodes that hear
    of these the expected NEES is unknown.

    Raises ScenarioError for bad arguments and if there is no block to judge.
    """
    require_scenario(scenario, "consistency")
    has_law = len(blocks_without_law(scenario)) < len(scenario.layout.places)
    if not (has_law and judged_blocks(scenario)):
        rule = "states or readings are recorded, so the law of the errors is unknown"
        remedy = (
            "simulate the plant and all readings, or use netkf innovations, which needs no truth"
        )
        raise ScenarioError("plant", rule, None, remedy)
    count = require_runs(runs, MIN_RUNS)
    confidence = number(above=0.0, below=1.0)("confidence", confidence)
    task = partial(replica_consistency, engine=choose_engine(engine, scenario))
    pool = PoolOptions(workers, executor, scheduler)
    results = replicate(task, _without_horizon(scenario), count, seed, pool=pool)
    return judge_consistency(scenario, results, confidence)


def _without_horizon(scenario: Scenario) -> Scenario:
    """Return the scenario without a filtered sample at the horizon, whose exchanges are missing."""
    node_filter = scenario.node_filter
    if not scenario.slotted or not node_filter.timing.talks or node_filter.timing.predicts:
        return scenario
    over_end = [scenario.slot_plant.over(slot, scenario.horizon) for slot in scenario.sampled_slots]
    times = scenario.times[~np.array(over_end)]
    # The only samples after time 0 stay.
    if all(over_end) or not (times > 0.0).any():
        return scenario
    return dataclasses.replace(scenario, probe=times) if any(over_end) else scenario


@np.errstate(over="ignore", invalid="ignore")  # as in replica_consistency
def judge_consistency(
    scenario: Scenario, runs: Sequence[RunConsistency], confidence: float
) -> Consistency:
    """Return the consistency of each block over ``runs``, together at ``confidence``."""
    # ``level`` is the probability that some interval misses.
    blocks, count, level = judged_blocks(scenario), len(runs), 1.0 - confidence
    sizes = [len(block.entries) for block in blocks]
    low, high = np.array([nees_bounds(n, count, confidence) for n in sizes]).T
    shortest = min(len(run.samples) for run in runs)  # runs that diverged ended early
    means = np.mean([run.samples[:shortest] for run in runs], axis=0)
    usable, inside = np.isfinite(means).sum(axis=0), ((means >= low) & (means <= high)).sum(axis=0)
    # Shares (K,) of samples whose mean NEES over the runs is in ``low`` .. ``high``.
    shares_inside = inside / np.where(usable, usable, np.nan)
    # Bonferroni over the blocks.
    rows = [
        _judge_block(
            scenario, runs, (k, block), float(shares_inside[k]), level / len(blocks), means[:, k]
        )
        for k, block in enumerate(blocks)
    ]
    largest = int(np.argmax(sizes))
    blurred_from = min(run.blurred_from[0] for run in runs)
    given = any(run.covariance_given[0] for run in runs)
    notes = () if given else (NO_COVARIANCE,)
    if _count_errors(scenario) > MAX_ERRORS:
        reason = (
            f"the expected NEES is left out: the exact covariance of {_count_errors(scenario):,} "
            f"errors, more than {MAX_ERRORS}, takes long; netkf.theory.error_covariance computes it"
        )
        notes = (*notes, reason)
    if given and (why := runs[0].reason[0]):
        notes = (*notes, f"the expected NEES is unknown: {why}")
    if unjudged := unjudged_line(scenario):
        notes = (*notes, f"not judged: {unjudged}, so that errors have no known law")
    if np.isfinite(blurred_from):
        reason = f"from {blurred_from:g} s on rounding of a large state blurs errors"
        notes = (*notes, f"{reason}: those samples are left out; shorten the horizon")
    return Consistency(
        scenario=scenario.name,
        n=sizes[largest],
        runs=count,
        confidence=confidence,
        low=float(low[largest]),
        high=float(high[largest]),
        rows=tuple(rows),
        notes=notes,
        states=scenario.states_note,
    )


def _judge_block(
    scenario: Scenario,
    runs: Sequence[RunConsistency],
    judged: tuple[int, JudgedBlock],
    share_inside: float,
    level: float,
    means: FloatArray,
) -> NodeConsistency:
    """Return the row of a numbered block, with NEES over the runs ``means`` (T,)."""
    i, block = judged
    n = len(block.entries)
    nees = np.array([run.nees[i] for run in runs])
    expected = np.array([run.expected[i] for run in runs])
    is_known = bool(np.isfinite(expected).all())
    # NEES of an exact P has the mean n.
    right = np.where(expected > 0.0, expected, n) if is_known else np.full(len(runs), float(n))
    low, high = (float(right.mean()) * (r - 1.0) for r in interval_of_squares(nees / right, level))
    excess = float((nees - (expected if is_known else n)).mean())
    # The reach to the side of what is expected.
    width = excess - low if excess > 0.0 else high - excess
    if not any(run.covariance_given[0] for run in runs):
        verdict = NO_COVARIANCE
    elif not len(means):
        verdict = "no NEES: no sample after time 0"
    elif np.isfinite(min(run.blurred_from[0] for run in runs)) and np.isnan(nees).any():
        verdict = UNDECIDED
    else:
        mean = float(expected.mean()) if is_known else None
        verdict = _verdict(scenario, n, (excess, width), mean)
        if verdict.startswith("BROKEN"):
            verdict += _tell_since(scenario, means / float(right.mean()), len(runs) * n)
    return NodeConsistency(
        node=scenario.nodes[block.node],
        nees=float(nees.mean()),
        width=width,
        expected=float(expected.mean()),
        inside=share_inside,
        nis=_mean_known([run.nis[i] for run in runs]),
        expected_nis=_mean_known([run.expected_nis[i] for run in runs]),
        verdict=verdict,
        block=block.block,
        n=n,
    )


def _tell_since(scenario: Scenario, ratios: FloatArray, freedom: int) -> str:
    """Return since and until when ``ratios`` (T,) of NEES are off; empty if always."""
    times, known = scenario.times[scenario.times > 0.0][: len(ratios)], np.isfinite(ratios)
    if not known.any():
        return ""
    times, nees = times[known], freedom * ratios[known]
    first, end, _ = find_stretch(nees, np.full(len(nees), freedom), np.zeros(len(nees)))
    since = f", since {times[first]:g} s" if first else ""
    return since + (f", until {times[end - 1]:g} s" if end < len(times) else "")


def _verdict(
    scenario: Scenario, n: int, interval: tuple[float, float], expected: float | None
) -> str:
    """Return the verdict on NEES whose excess has an ``interval``: centre and half width."""
    excess, width = interval
    if not math.isfinite(excess):
        return "no NEES: P is singular, or P or the errors are not finite"
    if expected is None:
        side = "near n" if abs(excess) <= width else "above n" if excess > 0.0 else "below n"
        reason = "" if scenario.is_random else "what is recorded is heard too, so "
        if scenario.misses_input:
            return f"{side}; filters do not know the input"
        return f"{side}; {reason}the expected NEES is unknown"
    if abs(excess) > width:
        return f"BROKEN: errors are {'larger' if excess > 0.0 else 'smaller'} than expected"
    if abs(expected / n - 1.0) <= BIAS_TOLERANCE:
        return "consistent"
    return f"as expected: {_explain_bias(scenario, expected < n)}"


def _explain_bias(scenario: Scenario, conservative: bool) -> str:
    """Return why P is larger (``conservative``) or smaller than the covariance of the errors."""
    if scenario.misses_input:
        return "filters do not know the input, P is overconfident"
    if not scenario.filters_know_the_truth:
        return f"the filters' model makes P {'conservative' if conservative else 'overconfident'}"
    bias = covariance_bias(scenario)
    if conservative:
        return "P is conservative by design" if bias == "larger" else "P is conservative"
    if bias == "smaller":
        return "P is overconfident by design"
    mean = scenario.filter.mean
    starts = (
        mean if isinstance(mean, tuple) else (scenario.plant.start_mean if mean is None else mean,)
    )
    if all(np.array_equal(start, scenario.plant.start_mean) for start in starts):
        return "P is overconfident"
    return "P is overconfident: filters start elsewhere than the state"
