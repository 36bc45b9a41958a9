"""The stochastic event trigger: Han, Mo, Wu, Weerakkody, Sinopoli and Shi, "Stochastic
event-triggered sensor schedule for remote state estimation", IEEE Trans. Automatic Control 60,
2015; the closed-loop schedule.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from netkf.algorithms.filter import Exchange, Filter, Message, NodeInfo, Reading
from netkf.algorithms.models import first_root, sample_update
from netkf.algorithms.registry import built_in
from netkf.core.fields import field, positive
from netkf.linalg.arrays import FloatArray


class ScheduledState(NamedTuple):
    """Estimate ``xhat`` (n,) with ``root`` (n, n) and the model; ``prior`` (n,), the prediction of
    this slot; the own ``reading``, and whether it was ``sent`` in this slot; the sensors (H, R) of
    all nodes known to have some, by ``senders``, the own one as -1.
    """

    xhat: FloatArray
    root: FloatArray
    model: Any
    prior: FloatArray
    reading: Reading | None = None
    sent: bool = False
    senders: tuple[int, ...] = ()
    sensors: tuple[tuple[FloatArray, FloatArray], ...] = ()

    @property
    def P(self) -> FloatArray:
        """``root root'`` (n, n)."""
        return self.root @ self.root.T


@built_in("stochastic-trigger")
@dataclass(frozen=True, eq=False)
class StochasticTrigger(Filter):
    """Every node broadcasts its reading y unless a uniform number is below ``exp(-z' Y z / 2)``,
    with its innovation ``z = y - H xbar``; all who hear nothing use that, too.

    strength  Y is ``strength`` times R^-1

    Silence is as informative as a reading ``H xbar`` with noise ``R + Y^-1``, so that errors stay
    Gaussian with covariance P, and a node sends with probability ``1 - det(I + Pi Y)^-1/2``,
    ``Pi = H Pbar H' + R``. That is so where everyone hears everyone and no message is lost: who
    misses one takes it for silence. Own readings count when they are sent, and the first is sent.
    """

    strength: float = field(positive, default=1.0)

    paper: ClassVar[str] = "stochastic_trigger"
    combination: ClassVar[str] = "scheduled readings"
    clocks: ClassVar[tuple[str, ...]] = ()
    first_slot: ClassVar[int] = 1
    one_way: ClassVar[bool] = True
    randomised: ClassVar[bool] = True
    fixed_sensors: ClassVar[bool] = True

    def payload_numbers(self, n: int, rows: int, phase: int) -> int:
        """A message is a reading; sensors do not change and are not counted."""
        return rows

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> ScheduledState:
        """No sensor is known yet."""
        return ScheduledState(mean, first_root(cov), model, mean)

    def predict(self, state: ScheduledState, gap: float) -> ScheduledState:
        """Predict, and keep the prediction, to which all decisions of the slot refer."""
        xhat, root = state.model.predict(state.xhat, state.root, gap)
        return state._replace(xhat=xhat, root=root, prior=xhat, reading=None, sent=False)

    def update(self, state: ScheduledState, reading: Reading) -> ScheduledState:
        """Keep the reading for the exchange of the slot."""
        return state._replace(reading=reading if len(reading.y) else None)

    def emit(
        self, state: ScheduledState, exchange: Exchange
    ) -> tuple[ScheduledState, Reading | None]:
        """Send the reading, or say by silence that it was near its prediction."""
        reading = state.reading
        if reading is None:
            return state, None
        z = reading.y - reading.H @ state.prior
        square = self.strength * float(z @ np.linalg.solve(reading.R, z))
        # The sender is known from its first message on: that is sent in any case.
        if -1 in state.senders and exchange.uniform < math.exp(-0.5 * square):
            return state, None
        return state._replace(sent=True), reading

    def absorb(
        self, state: ScheduledState, messages: Sequence[Message], exchange: Exchange
    ) -> ScheduledState:
        """Use the readings that were sent, and the silence of all other known sensors."""
        arrived = {message.sender: message.payload for message in messages}
        if state.sent and state.reading is not None:
            arrived[-1] = state.reading
        sensors = dict(zip(state.senders, state.sensors, strict=True))
        sensors.update({j: (reading.H, reading.R) for j, reading in arrived.items()})
        xhat, root = state.xhat, state.root
        for sender, (H, R) in sorted(sensors.items()):
            if sender in arrived:
                xhat, root = sample_update(xhat, root, arrived[sender].y, H, R)
            else:
                # R + Y^-1, and no innovation with respect to the prediction.
                wider = (1.0 + 1.0 / self.strength) * R
                xhat, root = sample_update(xhat, root, H @ state.prior, H, wider)
        known = tuple(sorted(sensors))
        return state._replace(
            xhat=xhat, root=root, senders=known, sensors=tuple(sensors[j] for j in known)
        )

    def shift(self, state: ScheduledState, offset: FloatArray) -> ScheduledState:
        """Affine given what is sent, and the trigger looks at innovations."""
        reading = state.reading
        if reading is not None:
            reading = reading._replace(y=reading.y + reading.H @ offset)
        return state._replace(xhat=state.xhat + offset, prior=state.prior + offset, reading=reading)

    def shift_payload(self, payload: Reading, offset: FloatArray) -> Reading:
        """Move a reading."""
        return payload._replace(y=payload.y + payload.H @ offset)
