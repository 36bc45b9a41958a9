"""Messages of a run in slots that arrived in time, by slot, exchange and step."""

from __future__ import annotations

import numpy as np

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
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


def require_traced_exchanges(scenario: Scenario, run: Run) -> None:
    """Raise TheoryError if a filtered estimate is sampled at the horizon: the exchanges of the slot
    that begins there are not in the trace.
    """
    plant = scenario.slot_plant
    slots = plant.slots_of(run.times).tolist()
    if slots and plant.over(slots[-1], scenario.horizon):
        message = "the exchanges of the slot at the horizon are not in the trace: sample before it"
        raise TheoryError(message)
