"""Kernels of a filter in both engines: SimPy calls them for one run, compiled code for several."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from netkf.core.contracts import is_netkf_class
from netkf.core.errors import ScenarioError
from netkf.engines.base import Engine
from netkf.engines.compiled.engine import CompiledEngine
from netkf.engines.simpy.engine import SimpyEngine
from netkf.linalg.arrays import FloatArray
from netkf.network.channels import Channel
from netkf.network.lives import Crashes
from netkf.network.losses import Bernoulli
from netkf.scenario.scenario import Scenario
from netkf.testing.small_runs import kinds_of, make_systems, small_scenario
from netkf.testing.watching import ROUNDING, WatchedPart, scaled_difference

RUNS = range(9)
"""Runs of the comparison: more than are side by side."""
DELIVERY, UP, DOWN = 0.6, 3.0, 1.0
"""Delivery probability, and mean times in ticks for which node 0 is up and down."""


def check_kernels(watched: WatchedPart) -> None:
    """Check that a user's kernels give the same numbers in both engines, and beside other runs."""
    part, compiled = watched.part, CompiledEngine()
    if part.kernels is None or is_netkf_class(type(part)):
        return
    for scenario in _scenarios(part):
        if compiled.refusal(scenario) is not None:
            continue
        alone, beside = (_simulate(engine, scenario) for engine in (SimpyEngine(), compiled))
        for name, one, other in zip(("xhat", "P"), alone, beside, strict=True):
            differences = [scaled_difference(*pair) for pair in zip(one, other, strict=True)]
            run = int(np.argmax(differences))
            rule = "must give each run what it has alone, in both engines"
            got = f"{name} that differs by {differences[run]:.2g} of its size in run {run}"
            remedy = "compute in all lanes: select by run.arrived, and leave messages as they are"
            watched.demand("kernels", differences[run] <= ROUNDING, rule, got, remedy)


def _scenarios(part: Any) -> Iterator[Scenario]:
    """Yield a scenario in slots, and one under clocks, that the filter accepts."""
    kinds, channel = kinds_of(part), Channel(loss=Bernoulli(DELIVERY))
    for slotted in (True, False):
        system = make_systems(part.needs.inverts or part.needs.inverts_under_clocks)[-1]
        kind = next((k for k in kinds if bool(k.slots) == slotted and not k.increments), None)
        if kind is None:
            continue
        kind = kind._replace(slots=4 * kind.slots)
        crashes = Crashes(nodes=(0,), mean_up=UP, mean_down=DOWN)
        try:
            yield small_scenario(part, system, kind, channel, (crashes,))
        except ScenarioError:  # it cannot be down
            yield small_scenario(part, system, kind, channel)


def _simulate(engine: Engine, scenario: Scenario) -> tuple[FloatArray, FloatArray]:
    """Return xhat (R, T, F, n) and P (R, T, F, n, n) of all runs, without nan."""
    batches = list(engine.run_many(scenario, 0, RUNS))
    xhat, P = (np.concatenate([getattr(b, name) for b in batches]) for name in ("xhat", "P"))
    return np.nan_to_num(xhat), np.nan_to_num(P)
