"""``netkf check``: theory against simulation, a row a promise."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from netkf.algorithms.slot import Gossip, Intermittent
from netkf.core.errors import ScenarioError, TheoryError
from netkf.core.fields import integer, number
from netkf.experiments.checking import gossip, intermittent
from netkf.experiments.checking.evidence import BROKEN, Evidence, Row, judge
from netkf.experiments.checking.words import look_at
from netkf.experiments.simulate import simulate
from netkf.scenario.registry import spoken
from netkf.scenario.scenario import Scenario
from netkf.theory import assumptions

if TYPE_CHECKING:
    import pandas as pd

PAPERS: tuple[tuple[type, ModuleType], ...] = ((Gossip, gossip), (Intermittent, intermittent))
FEWEST = 10


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
    for kind, module in PAPERS:
        if isinstance(scenario.filter.algorithm, kind):
            return module
    name = spoken(scenario.filter.algorithm)
    raise TheoryError(f"nothing is promised of the {name} filter that could be checked")


def watched(scenario: Scenario) -> Scenario:
    """The scenario with samples where the promises look."""
    period = scenario.slot_plant.period
    return dataclasses.replace(scenario, probe=np.round(period * np.array(look_at(scenario)), 12))


def witness(scenario: Scenario, seed: int, replica: int) -> Any:
    """What one replica of a watched scenario says."""
    return paper_of(scenario).witness(scenario, simulate(scenario, seed, replica))


def verdict(scenario: Scenario, witnesses: Iterable[Any], seed: int, confidence: float) -> Verdict:
    """The verdict on a watched scenario from what its runs say."""
    paper, listed = paper_of(scenario), list(witnesses)
    stacked = paper.Witness(*map(np.array, zip(*listed, strict=True)))
    seen = paper.Seen(scenario, stacked, seed)
    table = [Row(*row) for row in assumptions(scenario).itertuples(index=False)]
    found = judge(
        paper.promises(scenario),
        seen,
        [*table, *paper.rows(scenario)],
        len(listed),
        1.0 - confidence,
    )
    return Verdict(scenario.name, len(listed), seed, confidence, tuple(found))


def check(
    scenario: Scenario, runs: int = 500, seed: int | None = None, confidence: float = 0.99
) -> Verdict:
    """Hold everything that is promised of the scenario's filter against ``runs`` replicas.

    Raises TheoryError where nothing is promised, ScenarioError for bad arguments.
    """
    count = integer(low=FEWEST)("runs", runs)
    sure = number(above=0.0, below=1.0)("confidence", confidence)
    root = scenario.seed if seed is None else integer(low=0)("seed", seed)
    if look_at(scenario)[-1] < FEWEST:
        raise ScenarioError("horizon", "is too short to check limits", scenario.horizon, "lengthen")
    chosen = watched(scenario)
    return verdict(chosen, (witness(chosen, root, r) for r in range(count)), root, sure)
