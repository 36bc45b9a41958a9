"""``netkf.consistency``: whether P says what the errors are, and whether it should.

NEES e' P^-1 e and NIS v' S^-1 v are held against what they should be: given the events of a run the
error covariance Sigma of each node is known exactly, so E[NEES] = tr(P^-1 Sigma) and E[NIS] =
tr(S^-1 (H Sigma H' + R)). That is n, or the number p of readings, for filters whose P is exact, and
less for those that are conservative by design, which are then not called wrong.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy.special

from netkf.core.errors import ScenarioError, TheoryError
from netkf.core.fields import integer, number
from netkf.engines.base import Engine
from netkf.ensembles.replicas import replicate
from netkf.linalg.arrays import FloatArray, block_diagonal
from netkf.rng.streams import Streams
from netkf.runs.simulate import choose_engine, simulate
from netkf.runs.summary import NO_COVARIANCE
from netkf.scenario.scenario import Scenario
from netkf.theory import error_covariance
from netkf.trace.nees import errors
from netkf.trace.run import Run, blurred

if TYPE_CHECKING:
    import pandas as pd

LOAD = "load it first: netkf.consistency(netkf.load(path))"
FEWEST = 10
UNDECIDED = "undecided: rounding blurs the errors of too many samples"
DESIGN = 0.02
"""Relative distance of the expected value from n that counts as by design."""


class Seen(NamedTuple):
    """Of one run: ``samples`` (T, N) of NEES after time 0, nan where rounding blurs the errors;
    means over the others (N,) of NEES, of its expected value, of NIS and of its expected value, nan
    where they do not exist; ``blurred_from`` (1,): the first time at which some are left out, inf
    without one; ``given`` (1,): whether the filter gives a covariance.
    """

    samples: FloatArray
    nees: FloatArray
    expected: FloatArray
    nis: FloatArray
    expected_nis: FloatArray
    blurred_from: FloatArray
    given: np.ndarray


def one_run(scenario: Scenario, seed: int, replica: int, engine: str | Engine = "auto") -> Seen:
    """What one replica says, for ``replicate``."""
    run = simulate(scenario, seed, replica, engine)
    _, nees = errors(run.error, run.P)
    kept = np.flatnonzero(run.times > 0.0)
    try:
        sigma = error_covariance(scenario, run)
    except TheoryError:
        sigma = None
    lost = blurred(run, run.P)
    lost |= False if sigma is None else blurred(run, sigma)
    nis, expected_nis = _innovations(scenario, run, sigma, lost)
    times = run.times[lost.any(axis=1) & (run.times > 0.0)]
    return Seen(
        np.where(lost, np.nan, nees)[kept],
        _mean(nees[kept], lost[kept]),
        _mean(_ratio(run.P, sigma)[kept], lost[kept]),
        nis,
        expected_nis,
        times[:1] if len(times) else np.full(1, np.inf),
        np.array([np.isfinite(run.P).any()]),
    )


def _mean(values: FloatArray, lost: np.ndarray) -> FloatArray:
    """(N,) over the samples (T, N) that are not lost; nan where there is none."""
    count = (~lost).sum(axis=0)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(lost, 0.0, values).sum(axis=0) / np.where(count, count, np.nan))


def _ratio(P: FloatArray, sigma: FloatArray | None) -> FloatArray:
    """tr(P^-1 Sigma), (T, N); nan where Sigma is not known or P is singular."""
    if sigma is None:
        return np.full(P.shape[:2], np.nan)
    found = np.full(P.shape[:2], np.nan)
    for place in np.ndindex(*found.shape):
        if np.isfinite(P[place]).all() and np.linalg.matrix_rank(P[place]) == P.shape[-1]:
            found[place] = np.trace(np.linalg.solve(P[place], sigma[place]))
    return found


def _innovations(
    scenario: Scenario, run: Run, sigma: FloatArray | None, lost: np.ndarray
) -> tuple[FloatArray, FloatArray]:
    """Mean NIS of each node's own readings and its expected value, (N,); in slots only, at slots
    whose prediction is a sample or follows from the one before. An innovation is the reading that
    the sensor would give of the error, so large states cost it no digits.
    """
    nothing = np.full(len(run.nodes), np.nan)
    if not scenario.slotted:
        return nothing, nothing
    streams, found, should = Streams(run.seed, run.replica), nothing.copy(), nothing.copy()
    steps = 0 if scenario.hosted.predicts else 1
    slots = np.round(run.times / scenario.slot_plant.period).astype(int).tolist()
    places = [k for k in range(steps, len(slots)) if slots[k] - slots[k - steps] == steps]
    places = [k for k in places if run.times[k] > 0.0]
    noise = _plant_noise(scenario, streams, [slots[k] for k in places])
    for i, node in enumerate(run.nodes):
        sensors = [scenario.slot_path(streams, node, p) for p in scenario.placed.get(node, ())]
        if not sensors or not places:
            continue
        believed, true = (
            block_diagonal([scenario.noise(p.entry, b) for p in scenario.placed[node]])
            for b in (True, False)
        )
        pairs = []
        for k, w in zip(places, noise, strict=True):
            if lost[k, i] or lost[k - steps, i]:
                continue
            H = np.concatenate([sensor.matrix(slots[k]) for sensor in sensors])
            e, P, error = _predicted(scenario, run, sigma, k - steps, i, w if steps else None)
            v = np.concatenate([sensor.reading(slots[k], e) for sensor in sensors])
            S = H @ P @ H.T + believed
            truly = (
                np.nan if error is None else np.trace(np.linalg.solve(S, H @ error @ H.T + true))
            )
            pairs.append((v @ np.linalg.solve(S, v), truly))
        if pairs:
            found[i], should[i] = np.array(pairs).mean(axis=0)
    return found, should


def _plant_noise(scenario: Scenario, streams: Streams, slots: list[int]) -> list[FloatArray]:
    """W (n,) of the steps that end in these slots: the path of a plant with no memory."""
    plant = scenario.slot_plant
    forgetful = dataclasses.replace(plant, F=np.zeros_like(plant.F))
    path = forgetful.truth(streams.generator("plant"))
    return [path.state(slot) for slot in slots]


def _predicted(
    scenario: Scenario,
    run: Run,
    sigma: FloatArray | None,
    k: int,
    node: int,
    noise: FloatArray | None,
) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """Error of a prediction, its P and the covariance of its error: those of sample k or, with the
    plant's ``noise`` (n,) of the step, one slot on.
    """
    e, P = run.error[k, node], run.P[k, node]
    error = None if sigma is None else sigma[k, node]
    if noise is None:
        return e, P, error
    F, Q = scenario.slot_belief
    plant = scenario.slot_plant
    if error is not None:
        same = np.array_equal(F, plant.F)
        error = plant.F @ error @ plant.F.T + plant.Q if same else None
    ahead = plant.F @ e + noise
    if not np.array_equal(F, plant.F):
        ahead = ahead + (plant.F - F) @ run.xhat[k, node]
    return ahead, F @ P @ F.T + Q, error


@dataclass(frozen=True)
class Row:
    """Of one node: mean NEES over runs and samples with the half width of its interval, what it
    should be (nan where that is not known), the share of samples whose mean over runs lies in the
    chi-square bounds, NIS and what it should be, and the verdict in words.
    """

    node: int
    nees: float
    width: float
    expected: float
    inside: float
    nis: float
    expected_nis: float
    verdict: str


@dataclass(frozen=True)
class Consistency:
    """Rows by node; false where the errors of one are not what they should be.

    ``low`` and ``high`` are the chi-square bounds on the mean NEES of one sample over the runs,
    where P is exact, each side missing with (1 - confidence) / 2; over n they bound the ANEES.
    ``notes`` say what was left out and why, a line each.
    """

    scenario: str
    n: int
    runs: int
    confidence: float
    low: float
    high: float
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return not any(row.verdict.startswith("BROKEN") for row in self.rows)

    @property
    def table(self) -> pd.DataFrame:
        """A row a node."""
        import pandas as pd

        return pd.DataFrame([vars(row) for row in self.rows])


def consistency(
    scenario: Scenario,
    runs: int = 50,
    seed: int | None = None,
    confidence: float = 0.95,
    workers: int | None = None,
    executor: Executor | None = None,
    scheduler: str | None = None,
    engine: str = "auto",
) -> Consistency:
    """Hold NEES and, in slots, NIS against what they should be.

    The verdicts compare the NEES of each run with its exact expected value given the events of the
    run (run by run, Student's interval; all nodes together at ``confidence``), or with n where that
    is not known (push-sum, a user's own filter). Raises ScenarioError for bad arguments and where
    there is no truth.
    """
    if not isinstance(scenario, Scenario):
        raise ScenarioError("", "consistency takes a netkf.Scenario", scenario, LOAD)
    if not scenario.is_random:
        words = "states or readings are recorded, so the law of the errors is unknown"
        raise ScenarioError("plant", words, None, "simulate the plant and all readings")
    count = integer(low=FEWEST)("runs", runs)
    sure = number(above=0.0, below=1.0)("confidence", confidence)
    task = partial(one_run, engine=choose_engine(engine, scenario))
    seen = replicate(
        task, scenario, count, seed, workers=workers, executor=executor, scheduler=scheduler
    )
    return weighed(scenario, seen, sure)


def weighed(scenario: Scenario, runs: Sequence[Seen], confidence: float) -> Consistency:
    """The rows of what several runs say."""
    n, count, level = scenario.plant.n, len(runs), 1.0 - confidence
    nees, expected, nis, expected_nis = (np.array([run[k] for run in runs]) for k in range(1, 5))
    blurred_from = float(min(run.blurred_from[0] for run in runs))
    given = any(run.given[0] for run in runs)
    low, high = (
        2.0 * float(scipy.special.gammaincinv(0.5 * count * n, q)) / count
        for q in (0.5 * level, 1.0 - 0.5 * level)
    )
    shortest = min(len(run.samples) for run in runs)
    means = np.mean([run.samples[:shortest] for run in runs], axis=0)
    clear = np.isfinite(means).sum(axis=0)
    inside = ((means >= low) & (means <= high)).sum(axis=0) / np.where(clear, clear, np.nan)
    quantile = float(scipy.special.stdtrit(count - 1, 1.0 - 0.5 * level / len(scenario.nodes)))
    right = scenario.filters_know_the_truth
    reason = "the design of the filter" if right else "the filters' model"
    rows = []
    for i, node in enumerate(scenario.nodes):
        known = bool(np.isfinite(expected[:, i]).all())
        lost = given and np.isfinite(blurred_from) and bool(np.isnan(nees[:, i]).any())
        gaps = nees[:, i] - (expected[:, i] if known else n)
        width = quantile * float(gaps.std(ddof=1)) / math.sqrt(count)
        should = float(expected[:, i].mean())
        rows.append(
            Row(
                node,
                float(nees[:, i].mean()),
                width,
                should,
                float(inside[i]),
                float(nis[:, i].mean()),
                float(expected_nis[:, i].mean()),
                NO_COVARIANCE
                if not given
                else UNDECIDED
                if lost
                else _verdict(float(gaps.mean()), width, should, n, known, reason),
            )
        )
    notes = () if given else (NO_COVARIANCE,)
    if np.isfinite(blurred_from):
        words = f"from {blurred_from:g} s on rounding of a large state blurs errors"
        notes = (*notes, f"{words}: those samples are left out; shorten the horizon")
    return Consistency(scenario.name, n, count, confidence, low, high, tuple(rows), notes)


def _verdict(gap: float, width: float, should: float, n: int, known: bool, reason: str) -> str:
    if not math.isfinite(gap):
        return "no NEES: P is singular or not finite"
    if not known:
        side = "near n" if abs(gap) <= width else "above n" if gap > 0.0 else "below n"
        return f"{side}; what it should be is not known"
    if abs(gap) > width:
        return f"BROKEN: errors are {'larger' if gap > 0.0 else 'smaller'} than they should be"
    if should < (1.0 - DESIGN) * n:
        return "as it should be: P is conservative by design"
    if should > (1.0 + DESIGN) * n:
        return f"as it should be: {reason} makes P too small"
    return "as it should be"
