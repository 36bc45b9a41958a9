"""Flow filters: the deprecated contract for user filters in continuous time, and two helpers.

New filters derive from ``netkf.algorithms.filter.Filter``; ``algorithms.adapters`` wraps a flow
filter as one. A flow filter is a frozen dataclass of parameters. Its state is a NamedTuple of
arrays that are never changed in place; every method returns a new one. The engine calls ``flow``
and then, if the node has sensors, ``measure`` for the interval that just passed, and ``emit`` and
``absorb`` for messages.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from netkf.algorithms.filter import Increments
from netkf.algorithms.kernels.gains import gain_update
from netkf.algorithms.kernels.riccati import propagate_riccati
from netkf.algorithms.models import FlowModel, usable
from netkf.core.fields import Component
from netkf.linalg.arrays import FloatArray, as_kernel_array
from netkf.linalg.compiling import kernel

Reading = Increments
"""Increments of a node's sensors over the last ``gap`` seconds."""


class FlowState(NamedTuple):
    """The state of a node: estimate ``xhat`` (n,), its covariance ``P`` (n, n) and the model of
    plant and own sensors by which they move.
    """

    xhat: FloatArray
    P: FloatArray
    model: FlowModel


class Payload(NamedTuple):
    """The content of a message: estimate ``xhat`` (n,) and covariance ``P`` (n, n) of the sender at
    the time of sending.
    """

    xhat: FloatArray
    P: FloatArray


@dataclass(frozen=True, eq=False)
class FlowFilter(Component):
    """The deprecated contract of filters in continuous time.

    The base class is a Kalman-Bucy filter on the node's own readings, Tanwani (CDC 2021), paper H
    (4a), (4b); filters differ mostly in ``absorb``.
    ``talks`` says whether its nodes exchange messages, ``pooled`` whether one filter reads the
    sensors of all nodes at once, ``inverts`` that covariances must never be singular.
    """

    talks: ClassVar[bool] = True
    inverts: ClassVar[bool] = False
    pooled: ClassVar[bool] = False

    def init(self, model: FlowModel, mean: FloatArray, cov: FloatArray) -> Any:
        """Return the state at time 0 from ``mean`` (n,) and ``cov`` (n, n)."""
        return FlowState(mean, cov, model)

    def flow(self, state: Any, gap: float) -> Any:
        """Return the state ``gap`` > 0 seconds later. Its covariance counts the readings of the gap
        already, its estimate does not yet.
        """
        P, xhat = propagate_riccati(
            state.model.riccati, as_kernel_array(state.P), as_kernel_array(state.xhat), gap
        )
        return state._replace(xhat=xhat, P=P)

    def measure(self, state: Any, reading: Reading) -> Any:
        """Return the state after the increments dy of p sensor rows over the gap that just passed,
        of which ``reading.moments`` (2 p,) holds ``int dy`` and ``int P_1 dy``, P_1 the Legendre
        polynomial on the gap: only the estimate moves, since ``flow`` has counted them in P.
        """
        xhat = gain_update(state.model.gains, state.P, state.xhat, reading.moments, reading.gap)
        return state._replace(xhat=xhat)

    def stretch(self, state: Any) -> float:
        """Return the seconds of readings that ``measure`` may use at once from this state on.

        A large covariance shrinks fast, and the weights of readings change as fast: on the time
        scale 1 / trace(P G), G = H' R^-1 H, after a first guess or after a reset by a neighbour
        that knew less.
        """
        return usable(float((state.P * state.model.information).sum()))

    def emit(self, state: Any) -> Any:
        """Return the payload that the node sends now: its estimate (n,) and covariance (n, n)."""
        return Payload(state.xhat, state.P)

    @abstractmethod
    def absorb(self, state: Any, messages: Sequence[tuple[float, Any, float]]) -> Any:
        """Return the state after using all messages that arrived at this instant together, at most
        one from each neighbour. Each is a tuple (weight, payload, age): the weight given to its
        sender (``weight``), what the sender's ``emit`` returned, and the seconds since then, by
        which ``predict`` brings a payload up to now. Payloads must not be changed.
        """

    def estimate(self, state: Any) -> tuple[FloatArray, FloatArray]:
        """Return ``xhat`` (n,) and ``P`` (n, n) of the node now."""
        return state.xhat, state.P

    def weight(self, degree: int, peer_degree: int) -> float:
        """Return the weight that a node of ``degree`` links gives to a message of one of
        ``peer_degree`` links; by default the Metropolis weight.
        """
        return 1.0 / (1.0 + max(degree, peer_degree))

    def largest_degree(self) -> float:
        """Return the largest number of links for which the weights make sense."""
        return np.inf


@kernel
def interval_end(now: float, time: float, length: float) -> float:
    """Return the end, in seconds, of a measurement interval that begins at ``now`` and lasts
    ``length`` seconds, but ends at ``time`` at the latest.

    Engines cut the time to the next event, ``time``, into such intervals, see
    ``Filter.max_measurement_interval``. One too short to change the clock would repeat for ever; it
    ends at ``time`` instead.
    """
    end = now + length
    return end if now < end < time else time


def predict(model: FlowModel, payload: Payload, age: float) -> Payload:
    """Return a ``payload``, estimate (n,) and covariance (n, n), predicted ``age`` seconds ahead by
    the model, without readings; for ``absorb`` of user filters, to bring late messages up to now.
    """
    if age <= 0.0:
        return payload
    P, xhat = propagate_riccati(
        model.prediction, as_kernel_array(payload.P), as_kernel_array(payload.xhat), age
    )
    return Payload(xhat, P)
