"""The sign-of-innovations filter: Ribeiro, Giannakis and Roumeliotis, "SOI-KF: Distributed Kalman
filtering with low-cost communications using the sign of innovations", IEEE Trans. Signal Processing
54, 2006.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from netkf.algorithms.filter import Exchange, Filter, Message, NodeInfo, Reading
from netkf.algorithms.kernels.root_update import lower_root
from netkf.algorithms.kernels.slots import whiten_reading
from netkf.algorithms.models import first_root
from netkf.algorithms.registry import built_in
from netkf.linalg.arrays import FloatArray


class Bits(NamedTuple):
    """A payload: ``signs`` (p,) of the innovations of a reading's rows, and what all nodes know of
    the sensor, the rows ``H`` (p, n) over the deviation of their noise.
    """

    signs: FloatArray
    H: FloatArray


class OneBitState(NamedTuple):
    """Estimate ``xhat`` (n,) and ``root`` (n, n) of P, the model; the node's own ``reading`` of
    this slot; its ``turn`` among so many ``nodes``.
    """

    xhat: FloatArray
    root: FloatArray
    model: Any
    reading: Reading | None
    turn: int
    nodes: int

    @property
    def P(self) -> FloatArray:
        """``root root'`` (n, n)."""
        return self.root @ self.root.T


@built_in("one-bit")
@dataclass(frozen=True, eq=False)
class OneBit(Filter):
    """Nodes take turns: in slot k the node at place k mod N of the ids broadcasts the signs of its
    innovations, one bit for each row of its reading, and all who hear it correct by them,
    ``xhat + sqrt(2 / pi) P h' / sqrt(h P h' + r) b`` and ``P - (2 / pi) P h' h P / (h P h' + r)``.

    It is the paper's filter where everyone hears everyone. Who misses bits goes on with another
    estimate, to which later bits do not refer. Readings enter as bits only, one's own too.
    """

    paper: ClassVar[str] = "one_bit"
    schedule: ClassVar[tuple[str, ...] | None] = ("predict", "sense", "exchange")
    clocks: ClassVar[tuple[str, ...]] = ()
    first_slot: ClassVar[int] = 1
    one_way: ClassVar[bool] = True

    def payload_numbers(self, n: int, rows: int, phase: int) -> float:
        """Return the numbers of a message: a bit for each row."""
        return rows / 64.0

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> OneBitState:
        """Return the first state of a node, which knows its turn."""
        return OneBitState(mean, first_root(cov), model, None, node.place, node.nodes)

    def update(self, state: OneBitState, reading: Reading) -> OneBitState:
        """Keep the reading for the exchange of the slot."""
        return state._replace(reading=reading if len(reading.y) else None)

    def emit(self, state: OneBitState, exchange: Exchange) -> tuple[OneBitState, Bits | None]:
        """Send the reading as bits in the node's turn, and use them."""
        if state.reading is None or exchange.slot % state.nodes != state.turn:
            return state, None
        y, H = whiten_reading(*state.reading[:3])
        signs = np.empty(len(y))
        for k in range(len(y)):
            # Each row refers to the estimate that has used the bits of those before it.
            signs[k] = 1.0 if y[k] >= H[k] @ state.xhat else -1.0
            state = use_bit(state, float(signs[k]), H[k])
        return state, Bits(signs, H)

    def absorb(
        self, state: OneBitState, messages: Sequence[Message], exchange: Exchange
    ) -> OneBitState:
        """Correct by the bits of the sender whose turn it is."""
        for message in messages:
            for sign, h in zip(message.payload.signs.tolist(), message.payload.H, strict=True):
                state = use_bit(state, sign, h)
        return state

    shift = Filter.shift  # signs of innovations do not depend on the origin

    def shift_payload(self, payload: Bits, offset: FloatArray) -> Bits:
        """Return the payload as it is: bits have no coordinates."""
        return payload


def use_bit(state: OneBitState, sign: float, h: FloatArray) -> OneBitState:
    """Return the state after the sign of the innovation of a row h (n,) with noise variance 1."""
    S = state.root
    seen = S.T @ h
    size = float(seen @ seen) + 1.0
    gain = S @ seen / math.sqrt(size)
    # P - (2 / pi) g g' = S (I - c seen seen') S' with c = (2 / pi) / size, whose root is
    # S (I - a seen seen') with a |seen|^2 = 1 - sqrt(1 - c |seen|^2).
    square = float(seen @ seen)
    c = 2.0 / math.pi / size
    a = c / (1.0 + math.sqrt(1.0 - c * square))
    root = lower_root(S - a * np.outer(S @ seen, seen))
    return state._replace(xhat=state.xhat + math.sqrt(2.0 / math.pi) * sign * gain, root=root)
