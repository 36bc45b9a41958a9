"""Push-sum in continuous time: broadcast rounds by running sums, each node by its own clock.

Every node holds mass: a weight w, which starts at 1, and the information (U, u) that samples bring,
``U += H' R^-1 H`` and ``u += H' R^-1 y``. A round offers each of the d nodes that can hear the share
1 / (d + 1) of all of it. What travels is not the share but the total ``sent`` that was ever offered;
a hearer gains the difference to the last total it ``heard``, so a lost message only postpones, and
the mass in nodes and under way stays what it was (running-sum push-sum; P has no such form).

Information refers to an instant: as time passes it is predicted with the plant, without its noise,
``U -> s Phi^-T U Phi^-1`` and ``u -> s Phi^-T u`` with Phi = e^{A gap}. All totals are predicted alike,
so differences stay what they are. s = e^{-2 r gap} lets old information fade where it would grow
without bound, with r the fastest rate at which the plant forgets its state (0 if it never does).

With N nodes ``N U / w`` and ``N u / w`` are what a node knows of all samples of the network. It uses
how these differ from what it ``used`` before, ``P^-1 += dU`` and ``xhat += P (du - dU xhat)``. As
rounds get fast the differences are the samples themselves, and every node is the central filter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.filter import Message, NodeInfo, Reading
from netkf.algorithms.models import Backward, first_root
from netkf.algorithms.root_update import lower_root
from netkf.core.arrays import FloatArray

LEAST = 0.05
"""Least eigenvalue of I + root' dU root that is used: a reading looks N times as precise at its own
node until it has spread, and taking that back at once could leave no covariance."""


class Offer(NamedTuple):
    """What a broadcast carries: which one it is of its sender, and the running ``total``."""

    number: int
    total: FloatArray


class RunningSums(NamedTuple):
    """Estimate ``xhat`` (n,), ``root`` (n, n) of its covariance, the model; ``mass`` (1 + n n + n,)
    = (w, U, u); the total ``sent`` to each receiver and how many ``rounds``; by sender the number
    and total ``heard`` last; ``used`` (n n + n,), the information in the estimate; how many can
    hear (``receivers``) and how many ``nodes`` there are.
    """

    xhat: FloatArray
    root: FloatArray
    model: Any
    mass: FloatArray
    sent: FloatArray
    rounds: int
    heard: Mapping[int, Offer]
    used: FloatArray
    receivers: int
    nodes: int

    @property
    def P(self) -> FloatArray:
        """``root root'`` (n, n)."""
        return self.root @ self.root.T


def predict(state: RunningSums, gap: float) -> RunningSums:
    """The state ``gap`` seconds later."""
    xhat, root = state.model.predict(state.xhat, state.root, gap)
    back = state.model.backward(gap)
    heard = {sender: aged(offer, back) for sender, offer in state.heard.items()}
    return state._replace(
        xhat=xhat,
        root=root,
        mass=_moved(state.mass, back, 1),
        sent=_moved(state.sent, back, 1),
        used=_moved(state.used, back, 0),
        heard=heard,
    )


def aged(offer: Offer, back: Backward) -> Offer:
    """What was offered, in terms of a later state."""
    return offer._replace(total=_moved(offer.total, back, 1))


def _moved(values: FloatArray, back: Backward, first: int) -> FloatArray:
    inverse, fading = back
    n = len(inverse)
    out = values.copy()
    U = values[first : first + n * n].reshape(n, n)
    out[first : first + n * n] = (fading * (inverse.T @ U @ inverse)).reshape(-1)
    out[first + n * n :] = fading * (inverse.T @ values[first + n * n :])
    return out


def start(model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> RunningSums:
    """Weight 1 and no information yet."""
    n = len(mean)
    mass = np.zeros(1 + n * n + n)
    mass[0] = 1.0
    return RunningSums(
        xhat=mean,
        root=first_root(cov),
        model=model,
        mass=mass,
        sent=np.zeros_like(mass),
        rounds=0,
        heard={},
        used=np.zeros(n * n + n),
        receivers=node.receivers,
        nodes=node.nodes,
    )


def offer(state: RunningSums) -> tuple[RunningSums, Offer | None]:
    """One round: the node gives up exactly what its total grew by, for each receiver."""
    if state.receivers == 0:
        return state, None
    sent = state.sent + state.mass / (state.receivers + 1)
    mass = state.mass - state.receivers * (sent - state.sent)
    state = state._replace(mass=mass, sent=sent, rounds=state.rounds + 1)
    return state, Offer(state.rounds, sent)


def hear(state: RunningSums, messages: Sequence[Message]) -> RunningSums:
    """Gain what each total grew by since it was heard last; an older one brings nothing."""
    mass, heard = state.mass, dict(state.heard)
    for message in messages:
        news: Offer = message.payload
        if message.age > 0.0:
            news = aged(news, state.model.backward(message.age))
        last = heard.get(message.sender)
        if last is None:
            mass = mass + news.total
        elif news.number > last.number:
            mass = mass + (news.total - last.total)
        else:
            continue
        heard[message.sender] = news
    return _use(state._replace(mass=mass, heard=heard))


def add_reading(state: RunningSums, reading: Reading) -> RunningSums:
    """``U += H' R^-1 H`` and ``u += H' R^-1 y``."""
    if not len(reading.y):
        return state
    weighted = np.linalg.solve(reading.R, reading.H).T
    U, u = weighted @ reading.H, weighted @ reading.y
    return _use(state._replace(mass=state.mass + np.concatenate([[0.0], U.reshape(-1), u])))


def _use(state: RunningSums) -> RunningSums:
    """Put what is new into the estimate, if that leaves a covariance; else later."""
    n = len(state.xhat)
    known = state.mass[1:] * (state.nodes / state.mass[0])
    new = known - state.used
    dU, du = new[: n * n].reshape(n, n), new[n * n :]
    if not new.any():
        return state
    S = state.root
    inner = np.eye(n) + S.T @ (0.5 * (dU + dU.T)) @ S
    values, vectors = np.linalg.eigh(inner)
    if not values[0] > LEAST:
        return state
    # (P^-1 + dU)^-1 = S (I + S' dU S)^-1 S'
    root = lower_root(S @ (vectors / np.sqrt(values)))
    xhat = state.xhat + root @ (root.T @ (du - dU @ state.xhat))
    return state._replace(xhat=xhat, root=root, used=known)


def weights(state: RunningSums) -> dict[str, list[float]]:
    """The terms of the node's weight, with what it sent and what it heard: over all nodes they
    come to what nodes hold and what is under way, N.
    """
    heard = [-float(offer.total[0]) for offer in state.heard.values()]
    sent = [float(state.sent[0])] * state.receivers
    return {"weight": [float(state.mass[0]), *sent, *heard]}


def shift(state: RunningSums, offset: FloatArray) -> RunningSums:
    """The estimate, and ``u`` by ``U offset`` wherever there is one."""
    heard = {sender: shift_offer(offer, offset) for sender, offer in state.heard.items()}
    return state._replace(
        xhat=state.xhat + offset,
        mass=_shifted(state.mass, offset, 1),
        sent=_shifted(state.sent, offset, 1),
        used=_shifted(state.used, offset, 0),
        heard=heard,
    )


def shift_offer(offer: Offer, offset: FloatArray) -> Offer:
    """``u`` by ``U offset``."""
    return offer._replace(total=_shifted(offer.total, offset, 1))


def _shifted(values: FloatArray, offset: FloatArray, first: int) -> FloatArray:
    n = len(offset)
    out = values.copy()
    out[first + n * n :] += values[first : first + n * n].reshape(n, n) @ offset
    return out
