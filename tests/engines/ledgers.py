"""Small filters whose estimate is a ledger of what their node knew and did."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.traits import Timing
from netkf.core.fields import boolean, setting
from netkf.parts import Analysis, Filter

NODE, DEGREE, EMITTED, MASS, HEARD, DISORDER = range(6)


class LedgerState(NamedTuple):
    ledger: Any
    receivers: int
    last: Any = {}  # noqa: RUF012 - a new one replaces it


@dataclass(frozen=True, eq=False)
class Ledger(Filter):
    """Shares its mass evenly with those who may hear, numbers what it sends, and shows its books.

    ``silent``: nodes with odd ids send nothing.
    """

    silent: bool = setting(boolean, default=False)

    def init(self, model, mean, cov, node):
        ledger = np.array([node.node, node.degree, 0.0, 1.0 + node.node, 0.0, 0.0])
        return LedgerState(ledger, node.receivers)

    def predict(self, state, gap):
        return state

    def update(self, state, reading):
        return state

    def emit(self, state, exchange):
        if self.silent and state.ledger[NODE] % 2:
            return state, None
        hearers = len(exchange.receivers) or (1 if self.timing.pairwise else state.receivers)
        ledger = state.ledger.copy()
        share = ledger[MASS] / (hearers + 1)
        ledger[MASS] -= hearers * share
        ledger[EMITTED] += 1
        return state._replace(ledger=ledger), (ledger[EMITTED], share)

    def absorb(self, state, messages, exchange):
        ledger, last = state.ledger.copy(), dict(state.last)
        for message in messages:
            number, share = message.payload
            ledger[DISORDER] += number <= last.get(message.sender, 0)
            ledger[HEARD] += 1
            ledger[MASS] += share
            last[message.sender] = number
        return state._replace(ledger=ledger, last=last)

    def estimate(self, state):
        return state.ledger, None

    analysis = Analysis(conserved=lambda state: {"mass": float(state.ledger[MASS])})


@dataclass(frozen=True, eq=False)
class PairLedger(Ledger):
    """The same, in pairs."""

    timing = Timing(pairwise=True)


class StepsState(NamedTuple):
    emitted: tuple[Any, ...] = ()
    absorbed: tuple[Any, ...] = ()


@dataclass(frozen=True, eq=False)
class Steps(Filter):
    """Two exchanges a slot, of one step and of three; keeps when it sent and absorbed."""

    timing = Timing(
        schedule=("exchange", "predict", "sense", "exchange"),
        clocks=(),
        first_slot=1,
        steps=lambda phase: 1 + 2 * phase,
    )

    def init(self, model, mean, cov, node):
        return StepsState()

    def predict(self, state, gap):
        return state

    def update(self, state, reading):
        return state

    def emit(self, state, exchange):
        return state._replace(emitted=(*state.emitted, tuple(exchange)[1:4])), 0.0

    def absorb(self, state, messages, exchange):
        return state._replace(absorbed=(*state.absorbed, tuple(exchange)[1:4]))

    def estimate(self, state):
        expected = [
            (phase, step, 1 + k // 4)
            for k in range(0, len(state.absorbed), 4)
            for phase, step in ((0, 0), (1, 0), (1, 1), (1, 2))
        ]
        right = state.emitted == state.absorbed == tuple(expected)
        return np.array([len(state.absorbed), float(right)]), None
