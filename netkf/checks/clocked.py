"""Gossip, intermittent observations and push-sum under clocks, held against their equations: their
papers are about slots, and what is exact given the events holds in continuous time too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from netkf.checks.evidence import Finding, Promise, Row, identity
from netkf.checks.exact import (
    as_computed,
    exact,
    expected_nees,
    not_too_small,
    stand_in,
    within_reach,
)
from netkf.checks.laws import exact_start
from netkf.checks.samples import Seen, replay
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run

MASS = 1e-9


class Witness(NamedTuple):
    """What one run says, as :class:`Exact`; ``drift`` is the largest relative drift of a sum over
    all nodes that exchanges should conserve, 0 if there is none.
    """

    P: FloatArray
    e: FloatArray
    nees: FloatArray
    replayed: FloatArray
    Sigma: FloatArray
    whole: FloatArray
    drift: float


@dataclass(frozen=True)
class Observed(Seen):
    """Witnesses of many runs, stacked."""


def witness(scenario: Scenario, run: Run) -> Witness:
    """Reduce a run whose samples are at ``times``."""
    drift = [abs(total - start) / abs(start) for start, total in run.sums.values()]
    return Witness(*exact(scenario, run), max(drift, default=0.0))


def rows(scenario: Scenario) -> list[Row]:
    """What the tests need."""
    return [exact_start(scenario), within_reach(scenario)]


def conserved(seen: Observed, level: float) -> Finding:
    """The sums at the end against those at the start, messages under way included."""
    drift = float(np.nan_to_num(seen.runs.drift, nan=np.inf).max())
    return identity(drift, MASS, f"drift of the total weight in {seen.count} runs")


REACH, START = "exact errors are within reach", "the filters start"
PROMISES = (
    Promise(
        "P follows the equations along the events of each run",
        "derived",
        (REACH,),
        replay,
        exact=True,
    ),
    Promise(
        "errors have the covariance that the equations give them",
        "derived",
        (START, REACH),
        as_computed,
    ),
    Promise(
        "NEES has the mean that exact errors say",
        "derived",
        (START, REACH),
        expected_nees,
    ),
)
MASS_STAYS = Promise("mass is conserved", "P Lemma 1, derived", (), conserved, exact=True)
HONEST = Promise(
    "P is at least the covariance of the error, given the events",
    "derived",
    ("the filters know", START, REACH),
    not_too_small,
    exact=True,
)


def promises(scenario: Scenario) -> tuple[Promise, ...]:
    """Push-sum conserves mass; its P is no bound, since a node counts its own samples N times."""
    if stand_in(scenario).hosted.combination == "sums":
        return (MASS_STAYS, *PROMISES)
    return (*PROMISES[:1], HONEST, *PROMISES[1:])
