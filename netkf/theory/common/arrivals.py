"""Messages of a run in slots that arrived in time, by slot, exchange and step."""

from __future__ import annotations

import dataclasses

import numpy as np

from netkf.core.errors import EngineError, ScenarioError, TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.runs.simulate import simulate
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run
from netkf.trace.schema import CODES

ArrivalsByStep = dict[tuple[int, int, int], FloatArray]
"""By slot, phase and step, (N, N): 1 where the message of node j reached node i in time."""


def arrivals_by_step(scenario: Scenario, run: Run) -> ArrivalsByStep:
    """Return the messages of a run that arrived in time, by slot, phase and step of the phase.

    The keys are 0-based: the slot, the exchange within the slot, the step within the exchange. Each
    value is an (N, N) table, receiver by sender; keys without a message are missing.
    """
    index, size, period = scenario.topology.index, len(scenario.nodes), scenario.slot_plant.period
    rows = run.log[run.log["kind"] == CODES["deliver"]]
    sent, length = scenario.time_grid.snap(rows["t"] - rows["age"]), scenario.phase_length
    slot = scenario.slot_plant.slots_of(sent)
    # A message belongs to the step in which it was sent.
    since = sent - slot * period - rows["phase"] * length
    phases = (scenario.node_filter.schedule or ()).count("exchange")
    steps = np.array([scenario.node_filter.exchange_steps(phase) for phase in range(phases)])
    step = np.round(since * steps[rows["phase"]] / length).astype(int)
    if not len(rows):
        return {}
    keys, key_indices = np.unique(
        np.stack([slot, rows["phase"], step]), axis=1, return_inverse=True
    )
    index_of = np.vectorize(index.__getitem__, otypes=[int])
    arrived = np.zeros((keys.shape[1], size, size))
    arrived[key_indices.reshape(-1), index_of(rows["node"]), index_of(rows["peer"])] = 1.0
    return {(t, phase, k): arrived[n] for n, (t, phase, k) in enumerate(keys.T.tolist())}


def with_last_exchanges(scenario: Scenario, run: Run) -> Run:
    """Return the run with the exchanges of the slot at the horizon, if its state there is that
    after them, as samples of filtered estimates are: the trace ends before that slot. They are
    those of the same run over a longer horizon.

    Raises TheoryError if there is no such run.
    """
    algorithm, plant, horizon = scenario.node_filter, scenario.slot_plant, scenario.horizon
    slots = plant.slots_of(run.times).tolist()
    last = slots[-1] if slots else 0
    if algorithm.predicts or not algorithm.talks or not plant.over(last, horizon):
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
