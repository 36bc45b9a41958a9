"""``netkf check``: theory against simulation, a row a promise."""

from __future__ import annotations

import dataclasses
import importlib
import math
import textwrap
from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from netkf.checks import clocked
from netkf.checks.evidence import (
    BROKEN,
    NOT_PROMISED,
    VERDICTS,
    Evidence,
    Finding,
    Promise,
    Row,
    identity,
    judge,
    rounded_away,
)
from netkf.checks.exact import promised_filter, stand_in
from netkf.checks.mode_sequences import look_at
from netkf.checks.samples import times
from netkf.core.errors import ScenarioError, TheoryError
from netkf.core.fields import integer, number
from netkf.engines.base import Engine
from netkf.engines.simpy.engine import SimpyEngine
from netkf.ensembles.replicas import replicate
from netkf.runs.files import finite
from netkf.runs.simulate import LOAD, choose_engine, simulate
from netkf.scenario.registry import spoken
from netkf.scenario.scenario import Scenario
from netkf.theory import assumptions
from netkf.trace.run import Run

if TYPE_CHECKING:
    import pandas as pd

FEWEST, TWINS, SAME = 10, 10, 1e-6


@dataclasses.dataclass(frozen=True)
class Verdict:
    """Evidence for every promise; true where none is broken.

    ``confidence``: all intervals of all rows hold together with at least this probability.
    """

    scenario: str
    runs: int
    seed: int
    confidence: float
    rows: tuple[Evidence, ...]

    def __bool__(self) -> bool:
        return all(row.verdict != BROKEN for row in self.rows)

    @property
    def table(self) -> pd.DataFrame:
        """A row a promise: promise, source, assumptions, margin, low, high, tolerance, verdict,
        needed, evidence.
        """
        import pandas as pd

        names = [field.name for field in dataclasses.fields(Evidence)]
        return pd.DataFrame([dataclasses.astuple(row) for row in self.rows], columns=names)


def paper_of(scenario: Scenario) -> Any:
    """The module with the promises of the scenario's filter; raises TheoryError without one."""
    promised = promised_filter(scenario.filter.algorithm)
    if promised.paper:
        module = importlib.import_module(f"netkf.checks.{promised.paper}")
        return clocked if module.SLOTS_ONLY and not scenario.slotted else module
    raise TheoryError(f"nothing is promised of the {spoken(promised)} filter that could be checked")


def watched(scenario: Scenario) -> Scenario:
    """The scenario with samples where the promises look."""
    return dataclasses.replace(scenario, probe=np.array(times(scenario)))


class Told(NamedTuple):
    """What one replica says: to the paper (None of a run that diverged), and how far the estimates
    are from those of the filter that a user's class should be, on the same readings and messages;
    nan where none was asked or rounding hides it; and whether the run diverged.
    """

    paper: Any
    apart: float
    diverged: bool = False


def witness(scenario: Scenario, seed: int, replica: int, engine: str | Engine = "auto") -> Told:
    """One replica of a watched scenario."""
    run, promised = simulate(scenario, seed, replica, engine), stand_in(scenario)
    apart = math.nan
    if promised is not scenario and replica < TWINS:
        twin = simulate(promised, seed, replica, SimpyEngine())
        apart = _apart(run, twin)
    if run.status == "diverged":
        return Told(None, apart, True)
    return Told(paper_of(scenario).witness(scenario, run), apart)


def _apart(run: Run, twin: Run) -> float:
    """The largest difference of the errors of two runs with one truth, in standard deviations,
    where rounding is far smaller than what is looked for; nan where it nowhere is.
    """
    both = min(len(run.times), len(twin.times))
    size = np.sqrt(np.trace(twin.P[:both], axis1=-2, axis2=-1))[..., None]
    rounded = np.maximum(run.rounding[:both], twin.rounding[:both])[:, None, None]
    gap = np.abs(run.error[:both] - twin.error[:both]) / np.maximum(size, 1e-300)
    clear = np.broadcast_to(rounded <= 0.1 * SAME * size, gap.shape)
    return float(np.nan_to_num(gap[clear], nan=np.inf).max()) if clear.any() else math.nan


def _twin(told: list[Told], level: float) -> Finding:
    """The first replicas against the filter that the class should be."""
    asked = [one.apart for one in told[:TWINS]]
    if np.isnan(asked).all():
        return rounded_away(0.0)
    apart = float(np.nanmax(asked))
    words = f"{min(TWINS, len(told))} runs beside those of the filter that it should be"
    return identity(apart, SAME, words)


TWIN = Promise(
    "its estimates are those of the filter that it derives from, on the same readings",
    "the class itself",
    (),
    _twin,
    exact=True,
)


def _sound(told: list[Told], level: float) -> Finding:
    """No run ends early."""
    diverged = sum(one.diverged for one in told)
    words = f"{diverged} of {len(told)} runs ended early, so no other promise is looked at"
    return Finding((-diverged / len(told),) * 3, 0.0, words)


SOUND = Promise(
    "estimates are finite and covariances positive semidefinite",
    "the class itself",
    (),
    _sound,
    exact=True,
)


def verdict(scenario: Scenario, witnesses: Iterable[Told], seed: int, confidence: float) -> Verdict:
    """The verdict on a watched scenario from what its runs say, in the order of replicas."""
    paper, told = paper_of(scenario), list(witnesses)
    _demand_covariances(scenario, told)
    if any(one.diverged for one in told):
        rows = judge([SOUND], told, [], len(told), 1.0)
        return Verdict(scenario.name, len(told), seed, confidence, tuple(rows))
    stacked = paper.Witness(*map(np.array, zip(*(one.paper for one in told), strict=True)))
    seen = paper.Observed(scenario, stacked, seed)
    table = [Row(*row) for row in assumptions(stand_in(scenario)).itertuples(index=False)]
    found = judge(
        paper.promises(scenario),
        seen,
        [*table, *paper.rows(scenario)],
        len(told),
        1.0 - confidence,
    )
    if stand_in(scenario) is not scenario:
        found = [*judge([TWIN], told, [], len(told), 1.0), *found]
    return Verdict(scenario.name, len(told), seed, confidence, tuple(found))


def _demand_covariances(scenario: Scenario, told: list[Told]) -> None:
    """Raise TheoryError where there is nothing to hold promises against."""
    diverged = sum(one.diverged for one in told)
    if diverged and stand_in(scenario) is scenario:
        words = f"{diverged} of {len(told)} runs diverged, so there are no limits to look at"
        raise TheoryError(f"{words}; shorten the horizon")
    if not diverged and all(np.isnan(one.paper.P).all() for one in told):
        raise TheoryError("the filter gives no covariance, and promises are about covariances")


def check(
    scenario: Scenario,
    runs: int = 500,
    seed: int | None = None,
    confidence: float = 0.99,
    workers: int | None = None,
    executor: Executor | None = None,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Verdict:
    """Hold everything that is promised of the scenario's filter against ``runs`` replicas.

    The state is sampled where the promises look, whatever ``probe`` says. A filter of one's own is
    held to what is promised of the one that it derives from. ``workers``, ``executor``,
    ``scheduler`` and ``progress`` as for ``netkf.monte_carlo``; they do not change the verdict.

    Raises TheoryError where nothing is promised, ScenarioError for bad arguments.
    """
    if not isinstance(scenario, Scenario):
        raise ScenarioError("", "check takes a netkf.Scenario", scenario, LOAD)
    count = integer(low=FEWEST)("runs", runs)
    sure = number(above=0.0, below=1.0)("confidence", confidence)
    root = scenario.seed if seed is None else integer(low=0)("seed", seed)
    paper_of(scenario)
    if not scenario.is_random:
        raise TheoryError(
            "the state or the readings are recorded: there is one run, and no law to check; "
            "netkf theory says what is assumed"
        )
    if scenario.slotted and look_at(scenario)[-1] < FEWEST:
        words = f"must have at least {FEWEST} slots to check limits"
        raise ScenarioError("horizon", words, scenario.horizon, "lengthen it")
    chosen = watched(scenario)
    seen = replicate(
        partial(witness, engine=choose_engine("auto", chosen)),
        chosen,
        count,
        root,
        workers=workers,
        executor=executor,
        scheduler=scheduler,
        progress=progress,
    )
    return verdict(chosen, seen, root, sure)


def verdict_text(found: Verdict, claim: str = "") -> str:
    """For a terminal."""
    lines = [f"{found.scenario}: {claim}" if claim else found.scenario, ""]
    for row in found.rows:
        lines.append(
            f"{row.verdict.upper() if row.verdict == BROKEN else row.verdict:<13}"
            f"{row.promise}  [{row.source}]"
        )
        words = row.evidence
        if row.verdict == NOT_PROMISED:
            words = row.assumptions
        elif row.low < row.high:
            ends = [f"{value + 0.0:.3g}" for value in (row.margin, row.low, row.high)]  # no -0
            words += "; margin {} in [{}, {}]".format(*ends)
            words += f", {row.tolerance:g} below 0 is tolerated" if row.tolerance else ""
        if row.needed is not None:
            words += f"; needs about {row.needed:,} runs"
        indent = " " * 13
        lines += textwrap.wrap(words, 87, initial_indent=indent, subsequent_indent=indent)
    counts = Counter(row.verdict for row in found.rows)
    shown = ", ".join(f"{counts[v]} {v}" for v in VERDICTS if counts[v])
    sure = f"{found.confidence:.6g}"
    lines += [
        "",
        f"{shown}; {found.runs:,} runs, all intervals together hold with probability {sure}",
    ]
    return "\n".join(lines)


def verdict_json(found: Verdict) -> dict[str, Any]:
    """Plain values."""
    document = dataclasses.asdict(found)
    plain: dict[str, Any] = finite({**document, "holds": bool(found)})
    return plain
