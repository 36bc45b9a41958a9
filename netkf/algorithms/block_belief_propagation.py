"""Gaussian belief propagation over blocks of the state and readings of pairs of nodes.

The variable of a node is the path of its block: its states at the instants of readings and now. Its
own evidence is the motion of the block with the node's own readings, and a reading of a pair is a
factor of two paths. A message is what its sender believes of its own path without what it knows
from the receiver, together with its readings of the receiver's block; with these and its own
readings of the sender the receiver has independent evidence of its own path (Weiss and Freeman,
"Correctness of belief propagation in Gaussian graphical models of arbitrary topology", Neural
Computation 13, 2001).

It is the path and not the present state alone, because noise of the plant makes everything that is
known of two nodes depend on each other: messages about the present would be counted twice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from netkf.algorithms.belief_propagation import MAX_STEPS, is_forest
from netkf.algorithms.blocks import block_tables
from netkf.algorithms.filter import Filter, NodeInfo
from netkf.algorithms.kernels.paths import absorb, emit, path_scratch, predict, shift, update
from netkf.algorithms.kernels.run import absorb as keep_payload
from netkf.algorithms.records import Kernels, Record
from netkf.algorithms.registry import built_in
from netkf.algorithms.traits import Analysis, Needs, Timing
from netkf.core.errors import ScenarioError
from netkf.core.fields import field, integer

MAX_WINDOW = 1000
"""A message of more states could not be sent: a larger value is a mistake."""
MAX_MEMORY = 2**25
"""Numbers that all nodes may keep in a run, of which several may be side by side."""


LATE_NOTE = (
    "of a message that took time it uses readings of instants at which the receiver has read "
    "something too, and no others: the window has no states of other instants"
)


def note_loops(scenario: Any) -> tuple[str, ...]:
    """Return notes where the graph of a ``netkf.Scenario`` has loops, and messages take time."""
    rule = "the graph has loops, on which evidence returns and counts again; P is too small"
    notes = [] if is_forest(scenario) else [rule]
    if not scenario.slotted and scenario.network.channel.delay.fixed != 0.0:
        notes.append(LATE_NOTE)
    return tuple(f"block-belief-propagation: {note}" for note in notes)


def path_record(
    filtering: BlockBeliefPropagation, infos: Sequence[NodeInfo], models: Sequence[Any]
) -> Record:
    """Return the record: of its own readings a node knows its ``path``, the states at the ``count``
    first ``times`` of its window and now, of which it keeps ``total`` readings of pairs, each
    ``since`` its time; what the sender of each link has told are ``rows`` of ``evidence``.
    """
    n, tables, ints = len(models[0].information), block_tables(infos, models), np.int64
    v, W = tables.entry.shape[1], min(filtering.window, infos[0].instants)
    most, p = infos[0].most_pairs
    kept: dict[str, Any] = {
        "since": (W * most,),
        **dict.fromkeys(("block", "sensor", "number", "length"), ((W * most,), ints)),
        **{"y": (W * most, p), "R": (W * most, p, p), "origin": (W * most, 2, v)},
        **dict.fromkeys(("J", "J_other"), (W * most, p, v)),
        "total": ((), ints),
    }
    path = (W + 1) * n
    return Record(
        node={
            **{"path": (path,), "path_root": (path, path), "times": (W,), "count": ((), ints)},
            **kept,
        },
        link={
            **{"evidence": (W * n, W * n), "evidence_z": (W * n,)},
            **{"rows": ((), ints), "sent": ()},
        },
        payload={
            **{"times": (W,), "count": ((), ints), "sent": ()},
            **{"mean": (W, v), "x": (W, v), "root": (W, v, W, v)},
            **kept,
        },
        scratch={"F": (n, n), "moved": (1, n), "moved_root": (1, n, n)},
        settings={"tables": tables, "work": path_scratch(W, n, v, 2 * W * most, p)},
    )


def begin_path(_filter: BlockBeliefPropagation, node: Any, _info: NodeInfo, _model: Any) -> None:
    """Begin with an empty window: errors of different nodes are independent."""
    n = len(node["xhat"])
    node["path"][:n], node["path_root"][:n, :n] = node["xhat"], node["root"]


@built_in("block-belief-propagation")
@dataclass(frozen=True, eq=False)
class BlockBeliefPropagation(Filter):
    """Each node estimates a block of its own by what its neighbours believe of theirs and what both
    have read of each other.

    steps   messages on each directed link in a slot
    window  instants that nodes remember: of readings, and in slots of sending. A message replaces
            that which was heard before, of which only what it says of the window is kept, unless
            that makes P smaller than the new one

    On a tree P is the covariance of the error, whatever is lost, late or out of order, also with
    noise of the plant: lost messages keep the last one heard. With a window as long as the run it
    is that of the Kalman filter with all readings that have reached the node, where nodes read at
    the same instants: a reading of another instant counts if it comes at once. If nothing is lost
    and ``steps`` is the diameter of the tree, that of all blocks. A shorter window makes P larger.
    Where links form loops P is too small. What is not linear is linearised at beliefs.
    """

    steps: int = field(integer(low=1, high=MAX_STEPS), default=1)
    window: int = field(integer(low=1, high=MAX_WINDOW), default=10)

    kernels = Kernels(
        path_record,
        begin_path,
        predict=predict,
        update=update,
        emit=emit,
        absorb=absorb,
        shift=shift,
        # What it tells is of the past.
        shift_payload=keep_payload,
        means=("xhat", "path", "evidence_z", "x", "y"),
        keeps_pairs="number",
        counts_sends=True,
        addressed=True,
    )

    @property
    def needs(self) -> Needs:
        """Its demands on a scenario."""
        return Needs(
            one_way=True, samples=True, blocks=True, own_blocks=True, check=self._check_memory,
            notes=note_loops,
        )  # fmt: skip

    def _check_memory(self, scenario: Any) -> None:
        """Raise ScenarioError where paths of a ``netkf.Scenario`` would not fit into memory."""
        info, links = scenario.node_infos[0], len(scenario.topology.directions)
        size = min(self.window, info.instants) * scenario.width
        if (len(scenario.nodes) + 2 * links) * size * size > MAX_MEMORY:
            rule = "is too long: what nodes keep of so many instants would not fit into memory"
            raise ScenarioError("filter.window", rule, self.window, "write a shorter one")

    @property
    def timing(self) -> Timing:
        """The only exchange of a slot has ``steps`` steps."""
        return Timing(steps=lambda _: self.steps)

    @property
    def analysis(self) -> Analysis:
        """The size of a message to one receiver."""
        return Analysis("belief_propagation", affine=True, payload_numbers=self._numbers)

    def _numbers(self, n: int, _rows: int, _phase: int) -> float:
        size = self.window * n
        return 2 * size + size * (size + 1) // 2

    shift = Filter.shift  # affine in readings and messages
