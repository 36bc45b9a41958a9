"""What arrived in the exchanges of runs in slots, with all that their samples depend on."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

from netkf.core.errors import EngineError, ScenarioError, TheoryError
from netkf.core.instants import MAX_GIVEN_TICKS
from netkf.runs.simulate import simulate
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run
from netkf.trace.schema import ROUND, SEND, rows_of

Step = tuple[int, int, int]
"""A slot, an exchange in it (phase) and a step of that."""


def arrivals_in_slots(
    scenario: Scenario, run: Run
) -> Iterator[tuple[Step, int, int, float, float]]:
    """Yield step, sender, receiver, time of arrival and age (s) of each message that arrived."""
    rows = rows_of(run.log, "round", "send", "deliver")
    names = ("kind", "node", "peer", "message", "phase", "t", "age")
    columns = (scenario.slot_plant.slots_of(rows["t"]), *(rows[name] for name in names))
    # Matchings have one step, and no rounds.
    steps, sent = dict[tuple[int, int], int](), dict[Step, Step]()
    for slot, kind, node, peer, number, phase, t, age in zip(
        *(column.tolist() for column in columns), strict=True
    ):
        if kind == ROUND:
            steps[slot, phase] = steps.get((slot, phase), -1) + 1
        elif kind == SEND:
            sent[node, peer, number] = slot, phase, steps.get((slot, phase), 0)
        else:
            yield sent.pop((peer, node, number)), peer, node, t, age


def with_last_exchanges(scenario: Scenario, run: Run) -> Run:
    """Return the run with the exchanges at the horizon, from a longer one; else TheoryError."""
    algorithm, plant, horizon = scenario.node_filter, scenario.slot_plant, scenario.horizon
    slots = plant.slots_of(run.times).tolist()
    last = slots[-1] if slots else 0
    if algorithm.timing.predicts or not algorithm.timing.talks or not plant.over(last, horizon):
        return run
    grid, end = scenario.time_grid, plant.slot_time(last + 1)
    # The run is the same, to the bit, if its instants are; those of a very short one are not.
    is_same = end * grid.per_second <= MAX_GIVEN_TICKS
    resolution, refine = (grid.resolution, grid.refine) if is_same else (None, None)
    changes = {"time.resolution": resolution, "time.refine": refine}
    try:
        longer = scenario.replace({"horizon": end, "probe": [horizon], **changes})
        repeated = simulate(longer, seed=run.seed, replica=run.replica)
    except (ScenarioError, EngineError) as error:
        raise TheoryError(
            "the exchanges of the slot at the horizon are not in the trace, and the run cannot be "
            f"repeated over a longer horizon ({error}): sample before it"
        ) from None
    return dataclasses.replace(run, log=repeated.log)
