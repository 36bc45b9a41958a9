"""Runs in slots with all exchanges that their samples depend on."""

from __future__ import annotations

import dataclasses

from netkf.core.errors import EngineError, ScenarioError, TheoryError
from netkf.runs.simulate import simulate
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run


def with_last_exchanges(scenario: Scenario, run: Run) -> Run:
    """Return the run with the exchanges at the horizon, from a longer one; else TheoryError."""
    algorithm, plant, horizon = scenario.node_filter, scenario.slot_plant, scenario.horizon
    slots = plant.slots_of(run.times).tolist()
    last = slots[-1] if slots else 0
    if algorithm.timing.predicts or not algorithm.timing.talks or not plant.over(last, horizon):
        return run
    try:
        longer = scenario.replace({"horizon": plant.slot_time(last + 1), "probe": [horizon]})
        repeated = simulate(longer, seed=run.seed, replica=run.replica)
    except (ScenarioError, EngineError) as error:
        raise TheoryError(
            "the exchanges of the slot at the horizon are not in the trace, and the run cannot be "
            f"repeated over a longer horizon ({error}): sample before it"
        ) from None
    return dataclasses.replace(run, log=repeated.log)
