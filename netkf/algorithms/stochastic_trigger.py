"""The stochastic event trigger: Han, Mo, Wu, Weerakkody, Sinopoli and Shi, "Stochastic
event-triggered sensor schedule for remote state estimation", IEEE Trans. Automatic Control 60,
2015; the closed-loop schedule.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np

from netkf.algorithms.delegate import FORWARDED, Delegate, forwarded
from netkf.algorithms.filter import Exchange, Filter, Message, NodeInfo, Reading
from netkf.algorithms.intermittent import Intermittent
from netkf.algorithms.models import first_root, sample_update
from netkf.algorithms.registry import built_in
from netkf.core.errors import ScenarioError
from netkf.core.fields import definite_covariance, either, field, instance, nested, positive
from netkf.linalg.arrays import FloatArray


def trigger_matrix(Y: float | FloatArray, rows: int) -> FloatArray:
    """Return Y (p, p) for a reading of so many rows: a number is that times the identity."""
    return np.asarray(Y if isinstance(Y, np.ndarray) else Y * np.eye(rows))


def entries_at(scenario: Any, node: int) -> list[int]:
    """Return the entries of the sensors of a node."""
    return [place.entry for place in scenario.placed.get(node, ())]


def silence_noise(R: FloatArray, Y: float | FloatArray) -> FloatArray:
    """Return ``R + Y^-1`` (p, p), the noise of the reading that silence stands for."""
    return np.asarray(R + np.linalg.inv(trigger_matrix(Y, len(R))))


def is_silent(z: FloatArray, Y: float | FloatArray, uniform: float) -> bool:
    """Return True if an innovation z (p,) is not sent: with probability ``exp(-z' Y z / 2)``."""
    return uniform < math.exp(-0.5 * float(z @ trigger_matrix(Y, len(z)) @ z))


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


@dataclass(frozen=True, eq=False)
class ScheduledReadings(Filter):
    """Every node broadcasts its reading y or is silent, and all who hear nothing use that, too.

    Silence is as informative as a reading ``H xbar`` with noise ``R + Y^-1``. Own readings count
    when they are sent, and the first is sent.
    """

    Y: float | FloatArray

    paper: ClassVar[str] = "stochastic_trigger"
    combination: ClassVar[str] = "scheduled readings"
    clocks: ClassVar[tuple[str, ...]] = ()
    first_slot: ClassVar[int] = 1
    one_way: ClassVar[bool] = True
    randomised: ClassVar[bool] = True
    fixed_sensors: ClassVar[bool] = True

    def payload_numbers(self, n: int, rows: int, phase: int) -> int:
        """Return the numbers of a message, a reading; sensors do not change and are not counted."""
        return rows

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> ScheduledState:
        """Return the first state of a node, to which no sensor is known yet."""
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
        # The sender is known from its first message on: that is sent in any case.
        if -1 in state.senders and is_silent(z, self.Y, exchange.uniform):
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
                # No innovation with respect to the prediction.
                wider = silence_noise(R, self.Y)
                xhat, root = sample_update(xhat, root, H @ state.prior, H, wider)
        known = tuple(sorted(sensors))
        return state._replace(
            xhat=xhat, root=root, senders=known, sensors=tuple(sensors[j] for j in known)
        )

    def shift(self, state: ScheduledState, offset: FloatArray) -> ScheduledState:
        """Return the state shifted by ``offset``: the trigger looks at innovations."""
        reading = state.reading
        if reading is not None:
            reading = reading._replace(y=reading.y + reading.H @ offset)
        return state._replace(xhat=state.xhat + offset, prior=state.prior + offset, reading=reading)

    def shift_payload(self, payload: Reading, offset: FloatArray) -> Reading:
        """Move a reading."""
        return payload._replace(y=payload.y + payload.H @ offset)


class WrappedState(NamedTuple):
    """The state of the wrapped filter, ``inner``; the innovation z (p,) of the last reading, None
    without one; if the node has ``begun`` to send after readings; if it is ``silent`` until the
    next one, None before that is decided.
    """

    inner: Any
    z: FloatArray | None = None
    begun: bool = False
    silent: bool | None = None


@dataclass(frozen=True, eq=False)
class TriggeredMessages(Filter):
    """A filter whose nodes send nothing after readings that bring little news.

    The filter takes a message that is not sent for one that is lost. Nodes use their own readings
    in any case, and those without a reading send.
    """

    Y: float | FloatArray
    inner: Filter

    clocks: ClassVar[tuple[str, ...]] = ()
    randomised: ClassVar[bool] = True
    paper: ClassVar[str] = ""
    combination: ClassVar[str] = ""
    # Who is heard depends on data.
    P_by_design: ClassVar[tuple[str, str]] = ("", "")
    slot_kernel: ClassVar[Any] = None

    @property
    def wrapped(self) -> Filter:
        """The filter that the trigger belongs to."""
        return self.inner

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> WrappedState:
        """Nothing is decided yet."""
        return WrappedState(self.inner.init(model, mean, cov, node))

    def predict(self, state: WrappedState, gap: float) -> WrappedState:
        """Predict."""
        return state._replace(inner=self.inner.predict(state.inner, gap))

    def update(self, state: WrappedState, reading: Reading) -> WrappedState:
        """Keep the innovation for the decision, and use the reading."""
        z = None
        if len(reading.y):
            z = reading.y - reading.H @ self.inner.estimate(state.inner)[0]
        return WrappedState(self.inner.update(state.inner, reading), z, state.begun)

    def emit(self, state: WrappedState, exchange: Exchange) -> tuple[WrappedState, Any]:
        """Send what the filter sends, or nothing until the next reading."""
        silent = state.silent
        if silent is None:
            # After the first reading a node sends in any case.
            silent = (
                state.z is not None and state.begun and is_silent(state.z, self.Y, exchange.uniform)
            )
            begun = state.begun or state.z is not None
            state = state._replace(silent=silent, begun=begun)
        if silent:
            return state, None
        inner, payload = self.inner.emit(state.inner, exchange)
        return state._replace(inner=inner), payload

    def absorb(
        self, state: WrappedState, messages: Sequence[Message], exchange: Exchange
    ) -> WrappedState:
        """Use what was sent."""
        return state._replace(inner=self.inner.absorb(state.inner, messages, exchange))

    def estimate(self, state: WrappedState) -> tuple[FloatArray, FloatArray | None]:
        """Return the estimate of the filter."""
        return self.inner.estimate(state.inner)

    def shift(self, state: WrappedState, offset: FloatArray) -> WrappedState:
        """The trigger looks at innovations, which do not move."""
        return state._replace(inner=self.inner.shift(state.inner, offset))

    def stopped(self, state: WrappedState) -> bool:
        """Return True once the filter has stopped."""
        return self.inner.stopped(state.inner)

    def conserved(self, state: WrappedState) -> Any:
        """Return what the filter conserves."""
        return self.inner.conserved(state.inner)


for _name in set(FORWARDED) - vars(TriggeredMessages).keys():
    setattr(TriggeredMessages, _name, forwarded(_name))


@built_in("event-triggered", trigger="stochastic")
@dataclass(frozen=True, eq=False)
class StochasticTrigger(Delegate):
    """A node is silent after a reading with probability ``exp(-z' Y z / 2)``, with the innovation
    ``z = y - H xbar``, Han et al. 2015, closed loop; never after its first reading.

    inner  the filter, which runs in slots and sends. With "intermittent" silence is used: it is as
           informative as a reading `H xbar` with noise `R + Y^-1`. Others take it for a loss
    Y      positive definite, of as many rows as each reading; a number is that times the identity

    With "intermittent" errors stay Gaussian with covariance P, and a node sends with probability
    ``1 - det(I + Pi Y)^-1/2``, ``Pi = H Pbar H' + R``, where everyone hears everyone and no message
    is lost: who misses one takes it for silence. Own readings count when they are sent. With other
    filters a node uses its reading in any case, and is silent until the next one.
    """

    clocks: ClassVar[tuple[str, ...]] = ()
    talks: ClassVar[bool] = True

    inner: Filter = field(instance(Filter))
    Y: float | FloatArray = field(either(positive, definite_covariance, nested(1)))

    @cached_property
    def wrapped(self) -> Filter:
        """The filter that runs."""
        if type(self.inner) is Intermittent:
            return ScheduledReadings(self.Y)
        return TriggeredMessages(self.Y, self.inner)

    def check_scenario(self, scenario: Any) -> None:
        """Raise ScenarioError where the filter or Y do not fit."""
        inner = self.inner
        if isinstance(inner, Delegate) or inner.schedule is None or not inner.talks:
            raise ScenarioError(
                "filter.inner",
                "must be a filter in slots whose nodes send messages, without a trigger",
                type(inner).__name__,
                'write inner = { kind = "intermittent" }, or another one',
            )
        inner.check_scenario(scenario)
        if not isinstance(self.Y, np.ndarray):
            return
        for node in scenario.nodes:
            rows = sum(len(scenario.sensors[k].R) for k in entries_at(scenario, node))
            if rows not in (0, len(self.Y)):
                raise ScenarioError(
                    "filter.Y",
                    f"must be {rows} x {rows} for the readings of node {node}",
                    f"{len(self.Y)} x {len(self.Y)}",
                    "write a number, which is that times the identity",
                )
