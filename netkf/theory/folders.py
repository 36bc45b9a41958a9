"""What the folders of the papers state about the filters that name them (``Analysis.paper``)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from netkf.algorithms.belief_propagation import is_forest
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.columns import ErrorColumns
from netkf.theory.common.delayed_jumps import DelayedJumps
from netkf.theory.common.evidence import AssumptionRow
from netkf.theory.common.jumps import ClockJumps, SlotJumps
from netkf.theory.common.plant_assumptions import model_and_start_rows
from netkf.theory.common.random_links import all_messages_arrive
from netkf.theory.constant_gain import linear_errors as constant_gains
from netkf.theory.diffusion import assumptions as diffusion
from netkf.theory.gossip import assumptions as gossip
from netkf.theory.information_consensus import assumptions as information_consensus
from netkf.theory.intermittent import assumptions as intermittent
from netkf.theory.kalman_consensus import linear_errors as kalman_consensus
from netkf.theory.push_sum import assumptions as push_sum
from netkf.theory.push_sum.promises import slot_lines, slot_promises
from netkf.theory.stochastic_trigger.errors import UNHEARD, all_hear_all, error_columns, start_equal
from netkf.theory.track_fusion.steady_errors import tracks_in_slots
from netkf.trace.run import Run

LinearErrors = SlotJumps | ClockJumps | DelayedJumps
Rows = Callable[[Scenario], list[AssumptionRow]]
ARRIVES = "every message arrives in its slot"


@dataclass(frozen=True)
class PaperTheory:
    """What a paper's folder states about a scenario with one of its filters; None: nothing.

    slot_rows : assumptions in slots, as rows of the table; None: those of any filter
    slot_conditions : those beside the model and the start of filters, where there are no others
    weight_rows : assumptions on weights under clocks
    error_columns : exact errors of a run, of a filter that is not affine
    slot_jumps, clock_jumps : errors in slots and under clocks as a linear system with jumps, of a
                              filter whose gains are constant
    steady_slots : radius and exact steady covariances (N, n, n) of errors in slots, where P is the
                   covariance of the error
    slot_promises, slot_lines : results in slots as plain JSON, and their lines for a terminal
    """

    slot_rows: Rows | None = None
    slot_conditions: Rows | None = None
    weight_rows: Rows | None = None
    error_columns: Callable[[Scenario, Run], ErrorColumns] | None = None
    slot_jumps: Callable[[Scenario], LinearErrors] | None = None
    clock_jumps: Callable[[Scenario], LinearErrors] | None = None
    steady_slots: Callable[[Scenario], tuple[float, FloatArray | None]] | None = None
    slot_promises: Callable[[Scenario], dict[str, Any]] | None = None
    slot_lines: Callable[[dict[str, Any], Callable[[Any], str]], list[str]] | None = None


def _no_loss(scenario: Scenario, source: str, arrives: str, otherwise: str) -> list[AssumptionRow]:
    """Return the row that no message is lost, with what follows from that and else."""
    lossless = all_messages_arrive(scenario)
    return [("no message is lost", source, lossless, arrives if lossless else otherwise)]


def _tree_rows(scenario: Scenario) -> list[AssumptionRow]:
    """Return the row under which P of belief propagation is the covariance of the error."""
    tree = is_forest(scenario)
    evidence = "every reading arrives on one way" if tree else "readings return and count again"
    return [("the graph has no loops", "Weiss and Freeman 2001", tree, evidence)]


def _pair_rows(scenario: Scenario) -> list[AssumptionRow]:
    """Return the row under which kept cross-covariances are those of the errors."""
    pairs = max(scenario.topology.degrees.values()) < 2
    evidence = "both know how their errors correlate"
    if not pairs:
        evidence = "how errors correlate with those of third nodes is approximated"
    return [("no node has two neighbours", "Luft et al. 2018", pairs, evidence)]


def _track_rows(scenario: Scenario) -> list[AssumptionRow]:
    analysis = scenario.node_filter.analysis
    rows = model_and_start_rows(scenario, analysis.source)
    if analysis.P_by_design[0] == "equal":
        rows += _no_loss(scenario, analysis.source, ARRIVES, "P depends on who is heard")
    return rows


def _silence_rows(scenario: Scenario) -> list[AssumptionRow]:
    """Return the rows under which errors under the stochastic trigger are as large as P says."""
    source, heard, alike = "Han et al. 2015", all_hear_all(scenario), start_equal(scenario)
    evidence = "silence is a decision" if heard else UNHEARD
    start = "with the same mean and covariance"
    if not alike:
        start = "silence is about the sender's prediction, which is not the hearer's"
    return [
        ("every node hears every other, without losses", source, heard, evidence),
        ("all filters have one estimate from the start", source, alike, start),
    ]


def _reset_rows(scenario: Scenario) -> list[AssumptionRow]:
    """Return the row that Pi = I - epsilon L is doubly stochastic, paper H (5)."""
    algorithm: Any = scenario.filter.algorithm
    epsilon, degree = algorithm.epsilon, max(scenario.topology.degrees.values())
    diagonal = 1.0 - epsilon * degree
    evidence = f"epsilon {epsilon:g}, largest degree {degree}, least diagonal entry {diagonal:.3g}"
    name = "Pi is doubly stochastic, 0 < epsilon <= 1/max degree"
    return [(name, "H (5)", diagonal >= -1e-12, evidence)]


OF_PAPERS = {
    "belief_propagation": PaperTheory(slot_conditions=_tree_rows, weight_rows=_tree_rows),
    "block_cross_covariances": PaperTheory(slot_conditions=_pair_rows, weight_rows=_pair_rows),
    "consensus_innovations": PaperTheory(
        slot_conditions=lambda scenario: _no_loss(
            scenario, "Das and Moura 2017", ARRIVES, "gains are those without losses"
        )
    ),
    "constant_gain": PaperTheory(
        slot_jumps=constant_gains.constant_gain_jumps, clock_jumps=constant_gains.clock_jumps
    ),
    "diffusion": PaperTheory(diffusion.slot_rows),
    "event_triggered": PaperTheory(
        slot_conditions=lambda scenario: _no_loss(
            scenario,
            "Battistelli et al. 2018",
            "neighbours have what was sent",
            "a sender does not notice a loss",
        )
    ),
    "gossip": PaperTheory(gossip.slot_rows),
    "hybrid": PaperTheory(weight_rows=_reset_rows),
    "information_consensus": PaperTheory(information_consensus.slot_rows),
    "intermittent": PaperTheory(intermittent.slot_rows),
    "kalman_consensus": PaperTheory(slot_jumps=kalman_consensus.consensus_jumps),
    "push_sum": PaperTheory(push_sum.slot_rows, slot_promises=slot_promises, slot_lines=slot_lines),
    "stochastic_trigger": PaperTheory(slot_conditions=_silence_rows, error_columns=error_columns),
    "track_fusion": PaperTheory(_track_rows, steady_slots=tracks_in_slots),
}


def theory_of(scenario: Scenario) -> PaperTheory:
    """Return what the paper of a scenario's filter states; nothing without one."""
    return OF_PAPERS.get(scenario.node_filter.analysis.paper, PaperTheory())
