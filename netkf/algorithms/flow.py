"""Flow filters: the former contract of filters in continuous time, for classes of users.

New filters derive from ``netkf.algorithms.filter.Filter``; ``algorithms.adapters`` makes one of a
flow filter. It is a frozen dataclass of parameters, its state a NamedTuple of arrays that nothing
changes in place; every method returns a new one. The host calls ``flow`` and then, where the node
has sensors, ``measure`` for the interval that just passed, and ``emit``/``absorb`` for messages.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from netkf.algorithms.filter import Increments
from netkf.algorithms.kernels.gains import gain_update
from netkf.algorithms.kernels.riccati import riccati_step
from netkf.algorithms.models import FlowModel, usable
from netkf.core.fields import Part
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import in_place

Reading = Increments
"""What the sensors of a node saw over the last ``gap`` seconds."""


class FlowState(NamedTuple):
    """Estimate ``xhat`` (n,), its covariance ``P`` (n, n) and the model they move by."""

    xhat: FloatArray
    P: FloatArray
    model: FlowModel


class Payload(NamedTuple):
    """What a message carries: the sender's estimate and covariance when it was sent."""

    xhat: FloatArray
    P: FloatArray


@dataclass(frozen=True, eq=False)
class FlowFilter(Part):
    """The contract of every filter in continuous time.

    The base class is the Kalman-Bucy filter of H (4a), (4b); filters differ mostly in ``absorb``.
    ``talks`` says whether its nodes exchange messages, ``pooled`` whether one filter reads the
    sensors of all nodes at once, ``inverts`` that covariances must never be singular.
    """

    talks: ClassVar[bool] = True
    inverts: ClassVar[bool] = False
    pooled: ClassVar[bool] = False

    def init(self, model: FlowModel, mean: FloatArray, cov: FloatArray) -> Any:
        """The state at time 0."""
        return FlowState(mean, cov, model)

    def flow(self, state: Any, gap: float) -> Any:
        """The state ``gap`` > 0 seconds later; its covariance counts the readings of the gap
        already, its estimate does not yet.
        """
        P, xhat = riccati_step(state.model.riccati, state.P, state.xhat, gap)
        return state._replace(xhat=xhat, P=P)

    def measure(self, state: Any, reading: Reading) -> Any:
        """The state once the readings of the gap that just passed are used."""
        xhat = gain_update(state.model.gains, state.P, state.xhat, reading.moments, reading.gap)
        return state._replace(xhat=xhat)

    def stretch(self, state: Any) -> float:
        """Seconds of readings that ``measure`` may use at once from this state on.

        A large covariance shrinks fast, and the weights of readings change as fast: on the time
        scale 1 / trace(P G), after a first guess or after a reset by a neighbour that knew less.
        """
        return usable(float((state.P * state.model.information).sum()))

    def emit(self, state: Any) -> Any:
        """What the node sends now."""
        return Payload(state.xhat, state.P)

    @abstractmethod
    def absorb(self, state: Any, messages: Sequence[tuple[float, Any, float]]) -> Any:
        """The state after all ``(weight, payload, age)`` that arrived at this instant, at most
        one from each neighbour, are used together. Payloads are left as they are.
        """

    def estimate(self, state: Any) -> tuple[FloatArray, FloatArray]:
        """``xhat`` (n,) and ``P`` (n, n) of the node now."""
        return state.xhat, state.P

    def weight(self, degree: int, peer_degree: int) -> float:
        """The weight a node of ``degree`` links gives to a message of a ``peer_degree`` one."""
        return 1.0 / (1.0 + max(degree, peer_degree))

    def largest_degree(self) -> float:
        """The largest number of links a node may have for the weights to make sense."""
        return np.inf


@in_place
def stretch_end(now: float, time: float, stretch: float) -> float:
    """Where a stretch of readings ends: by ``time``, and not where it begins."""
    end = now + stretch
    return end if now < end < time else time


def predict(model: FlowModel, payload: Payload, age: float) -> Payload:
    """A payload moved ``age`` seconds on by the model alone, without readings."""
    if age <= 0.0:
        return payload
    P, xhat = riccati_step(model.prediction, payload.P, payload.xhat, age)
    return Payload(xhat, P)
