"""The two baselines of every comparison: no communication, and all readings at one place.

``local_slots`` simulates many runs in the compiled engine, in place of the classes' methods; the
types of its arguments are described in ``kernels.slots``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from netkf.algorithms.filter import Exchange, Filter, Message
from netkf.algorithms.kernels.slots import (
    ReadingBlock,
    SlotLinks,
    SlotNodes,
    SlotPlan,
    SlotSamples,
    SlotScratch,
    predict_all,
    read_all,
    rebase,
    store_sample_of_slot,
)
from netkf.algorithms.registry import built_in
from netkf.linalg.compiling import kernel


@kernel
def local_slots(
    nodes: SlotNodes,
    readings: ReadingBlock,
    plan: SlotPlan,
    links: SlotLinks,  # noqa: ARG001 - nodes send nothing
    samples: SlotSamples,
    scratch: SlotScratch,
) -> None:
    """Simulate H filters that never talk over the S slots of a plan, in B blocks of L runs: in each
    slot they predict, then update with their own readings.

    Changes ``nodes.xhat`` (B, H, n, L) and ``nodes.root`` (B, H, n, n, L) in place and writes
    ``samples`` in the slots that have one.
    """
    for b in range(plan.up.shape[0]):
        for s in range(plan.up.shape[1]):
            if plan.sensed[s]:
                predict_all(nodes, scratch, b)
                read_all(nodes, readings, scratch, b, s)
            store_sample_of_slot(nodes, plan, samples, scratch, b, s)
            # Keep the estimates relative to an origin near the true state.
            rebase(nodes, readings, scratch, b, s)


@built_in("local")
@dataclass(frozen=True, eq=False)
class Local(Filter):
    """Every node runs a Kalman(-Bucy) filter on its own readings and never talks; samples in slots
    are filtered.
    """

    combination: ClassVar[str] = "none"
    schedule: ClassVar[tuple[str, ...]] = ("predict", "sense")
    clocks: ClassVar[tuple[str, ...]] = ()
    talks: ClassVar[bool] = False
    slot_kernel = staticmethod(local_slots)

    def absorb(self, state: Any, messages: Sequence[Message], exchange: Exchange) -> Any:
        """Return the state: nothing arrives."""
        return state

    shift = Filter.shift  # affine in the readings


@built_in("central")
@dataclass(frozen=True, eq=False)
class Central(Local):
    """One Kalman(-Bucy) filter reads all sensors without delay or loss; its estimate is recorded
    for every node.
    """

    pooled: ClassVar[bool] = True
    slot_kernel = staticmethod(local_slots)
