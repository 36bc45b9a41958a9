"""Slot filters: the deprecated contract of filters in slots, kept for users' classes.

New filters derive from ``netkf.algorithms.filter.Filter``; ``algorithms.adapters`` makes one of a
slot filter. Each slot is a short sequence of phases that the filter declares, its ``programme``,
such as ``("exchange", "sense")``. An exchange has one step or several; in each every node may send
once and then absorbs all that arrived before its inbox closed, at the end of the step. In a sense
phase it is given the reading of the slot. States are NamedTuples of arrays that nothing changes in
place. Covariances are carried as square roots, ``P = root root'``.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from netkf.algorithms.baselines import Central as SlotCentral
from netkf.algorithms.baselines import Local as SlotLocal
from netkf.algorithms.filter import FirstSlot, Reading
from netkf.algorithms.gossip import Gossip
from netkf.algorithms.intermittent import Intermittent
from netkf.algorithms.kernels.root_update import lower_root
from netkf.algorithms.models import SlotModel, sample_update
from netkf.core.fields import Component
from netkf.linalg.arrays import FloatArray, square_root

__all__ = [
    "Gossip",
    "Intermittent",
    "Reading",
    "Role",
    "SlotCentral",
    "SlotFilter",
    "SlotLocal",
    "SlotModel",
    "SlotState",
    "update_and_predict",
]
"""Filters and models have moved; users' classes may still import them from here."""

Messages = Sequence[tuple[float, Any, float]]
"""(weight, payload, age) of each message: the weight that the receiver gives it, and its seconds
under way.
"""


class SlotState(NamedTuple):
    """The state of a node: estimate ``xhat`` (n,), ``root`` (n, n) of its covariance, the
    ``model``, and a reading that it has ``kept`` to send it, or None.
    """

    xhat: FloatArray
    root: FloatArray
    model: SlotModel
    kept: Any = None


class Role(NamedTuple):
    """What a node may know about the network before slot 0.

    node : its id
    neighbours : number of neighbours when no link fails
    nodes : number of nodes
    information : (n, n), sum of H' R^-1 H of all sensors as the filters believe it
    own : weight left to the node when the messages of all neighbours arrive
    """

    node: int
    neighbours: int
    nodes: int
    information: FloatArray
    own: float = 1.0


@dataclass(frozen=True, eq=False)
class SlotFilter(Component):
    """The deprecated contract of filters in slots: the engine calls these methods, and class
    variables say how.

    ``programme`` lists the phases of a slot, "exchange" or "sense"; ``first_slot`` is the first in
    which nodes exchange; ``predicts`` says that a sample shows the prediction with which a slot
    begins, else what is known after its reading; ``pairwise`` that nodes exchange in pairs (a
    matching), else all with all neighbours; ``one_way`` that links may go one way and that nodes
    need not all be joined; ``inverts`` that covariances must never be singular; ``talks`` that
    nodes exchange messages; ``pooled`` that one filter reads the sensors of all nodes at once.
    """

    programme: ClassVar[tuple[str, ...]] = ("exchange", "sense")
    first_slot: ClassVar[int] = FirstSlot()  # type: ignore[assignment]
    predicts: ClassVar[bool] = True
    pairwise: ClassVar[bool] = False
    one_way: ClassVar[bool] = False
    inverts: ClassVar[bool] = False
    talks: ClassVar[bool] = True
    pooled: ClassVar[bool] = False

    def init(self, model: SlotModel, mean: FloatArray, cov: FloatArray) -> Any:
        """Return the state at slot 0 from ``mean`` (n,) and ``cov`` (n, n)."""
        return SlotState(mean, square_root(cov), model)

    def place(self, state: Any, role: Role) -> Any:
        """Return the ``state`` of ``init`` completed for a node that knows its ``role``; called
        once, before slot 0.
        """
        return state

    def steps(self, phase: int) -> int:
        """Return how often exchange number ``phase`` of a slot, from 0, is repeated, in equal
        times.
        """
        return 1

    def redraws(self, phase: int, step: int) -> bool:
        """Return True if links draw new outcomes (which messages arrive) in repetition ``step``,
        from 0, of exchange number ``phase``; else each keeps its last one. The first step always
        draws.
        """
        return True

    @abstractmethod
    def sense(self, state: Any, reading: Reading) -> Any:
        """Return the state after the node's reading of this slot, which has no rows if the node has
        no sensors.
        """

    def emit(self, state: Any, phase: int) -> Any:
        """Return the payload of each step of exchange number ``phase``; None sends nothing."""
        return None

    def absorb(self, state: Any, phase: int, messages: Messages) -> Any:
        """Return the state when the inbox of a step of exchange number ``phase`` closes; called for
        every node, with all ``messages`` that arrived in time, in the order of their senders.
        """
        return state

    def stopped(self, state: Any) -> bool:
        """Return True once the node has permanently frozen its network estimate."""
        return False

    def conserved(self, state: Any) -> dict[str, float]:
        """Return quantities by name whose sums over all nodes no exchange changes as long as
        messages are lost in both directions or in none; a run reports how far the sums have
        drifted.
        """
        return {}

    def weight(self, degree: int, peer_degree: int) -> float:
        """Return the weight that a node of ``degree`` links gives to a message of one of
        ``peer_degree`` links, by default the Metropolis weight.
        """
        return 1.0 / (1.0 + max(degree, peer_degree))

    @property
    def pair_weights(self) -> FloatArray | None:
        """Weights of N nodes (N, N) in the order of their ids: entry [l, i] is the weight that node
        i gives to a message of node l. None if ``weight`` gives the weights.
        """
        return None

    def largest_degree(self) -> float:
        """Return the largest number of links that a node may have."""
        return np.inf

    def estimate(self, state: Any) -> tuple[FloatArray, FloatArray]:
        """Return the estimate ``xhat`` (n,) and its covariance ``P`` (n, n)."""
        return state.xhat, state.root @ state.root.T


def update_and_predict(
    xhat: FloatArray, root: FloatArray, model: SlotModel, reading: Reading
) -> tuple[FloatArray, FloatArray]:
    """Return the prediction (n,) of the next slot and the lower triangular root (n, n) of its
    covariance, from a prediction ``xhat`` (n,), any ``root`` (n, n) of its covariance, and the
    reading of the slot, which may have no rows. For users' slot filters that predict last.
    """
    root = lower_root(root)
    if len(reading.y):
        xhat, root = sample_update(xhat, root, reading.y, reading.H, reading.R)
    return model.predict(xhat, root, model.period)
