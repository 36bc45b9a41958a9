"""What the folders of the papers state about the filters that name them (``Analysis.paper``)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.belief_propagation import assumptions as beliefs
from netkf.theory.common.columns import ErrorColumns
from netkf.theory.common.delayed_jumps import DelayedJumps
from netkf.theory.common.evidence import AssumptionRow
from netkf.theory.common.jumps import ClockJumps, SlotJumps
from netkf.theory.consensus_innovations import assumptions as pseudo_states
from netkf.theory.constant_gain import linear_errors as constant_gains
from netkf.theory.diffusion import assumptions as diffusion
from netkf.theory.event_triggered import assumptions as event_triggers
from netkf.theory.gossip import assumptions as gossip
from netkf.theory.hybrid import assumptions as hybrid
from netkf.theory.information_consensus import assumptions as information_consensus
from netkf.theory.intermittent import assumptions as intermittent
from netkf.theory.kalman_consensus import linear_errors as kalman_consensus
from netkf.theory.push_sum import assumptions as push_sum
from netkf.theory.push_sum.promises import slot_lines, slot_promises
from netkf.theory.stochastic_trigger import assumptions as stochastic_triggers
from netkf.theory.stochastic_trigger.errors import error_columns
from netkf.theory.track_fusion import assumptions as tracks
from netkf.theory.track_fusion.steady_errors import tracks_in_slots
from netkf.trace.run import Run

LinearErrors = SlotJumps | ClockJumps | DelayedJumps
Rows = Callable[[Scenario], list[AssumptionRow]]


@dataclass(frozen=True)
class PaperTheory:
    """What a paper's folder states about a scenario with one of its filters; None: nothing.

    slot_rows : assumptions in slots, as rows of the table; None: those of any filter
    weight_rows : assumptions on weights under clocks
    error_columns : exact errors of a run, of a filter that is not affine
    slot_jumps, clock_jumps : errors in slots and under clocks as a linear system with jumps, of a
                              filter whose gains are constant
    steady_slots : radius and exact steady covariances (N, n, n) of errors in slots, where P is the
                   covariance of the error
    slot_promises, slot_lines : results in slots as plain JSON, and their lines for a terminal
    """

    slot_rows: Rows | None = None
    weight_rows: Rows | None = None
    error_columns: Callable[[Scenario, Run], ErrorColumns] | None = None
    slot_jumps: Callable[[Scenario], LinearErrors] | None = None
    clock_jumps: Callable[[Scenario], LinearErrors] | None = None
    steady_slots: Callable[[Scenario], tuple[float, FloatArray]] | None = None
    slot_promises: Callable[[Scenario], dict[str, Any]] | None = None
    slot_lines: Callable[[dict[str, Any], Callable[[Any], str]], list[str]] | None = None


OF_PAPERS = {
    "belief_propagation": PaperTheory(beliefs.slot_rows, beliefs.weight_rows),
    "consensus_innovations": PaperTheory(pseudo_states.slot_rows),
    "constant_gain": PaperTheory(
        slot_jumps=constant_gains.slot_jumps, clock_jumps=constant_gains.clock_jumps
    ),
    "diffusion": PaperTheory(diffusion.slot_rows),
    "event_triggered": PaperTheory(event_triggers.slot_rows),
    "gossip": PaperTheory(gossip.slot_rows),
    "hybrid": PaperTheory(weight_rows=hybrid.weight_rows),
    "information_consensus": PaperTheory(information_consensus.slot_rows),
    "intermittent": PaperTheory(intermittent.slot_rows),
    "kalman_consensus": PaperTheory(slot_jumps=kalman_consensus.slot_jumps),
    "push_sum": PaperTheory(push_sum.slot_rows, slot_promises=slot_promises, slot_lines=slot_lines),
    "stochastic_trigger": PaperTheory(stochastic_triggers.slot_rows, error_columns=error_columns),
    "track_fusion": PaperTheory(tracks.slot_rows, steady_slots=tracks_in_slots),
}


def theory_of(scenario: Scenario) -> PaperTheory:
    """Return what the paper of a scenario's filter states; nothing without one."""
    return OF_PAPERS.get(scenario.node_filter.analysis.paper, PaperTheory())
