"""Push-sum in continuous time: broadcast rounds by running sums, each node by its own clock; the
methods of ``push_sum.PushSum`` under clocks.

The network's information is a mass that is spread over the nodes. Node i holds the weight w_i,
which starts at 1, and with N nodes its share of the information is ``(w_i / N) P_i^-1`` and
``(w_i / N) P_i^-1 xhat_i``: an estimate is a ratio of masses. A sample adds ``H' R^-1 H`` and
``H' R^-1 y``, so it counts N / w_i times at its own node until it has spread. Between events each
node predicts its own estimate and covariance.

A round offers each of the d nodes that can hear the share 1 / (d + 1) of all mass. What travels
is not the share but the total ``sent`` of all shares so far; a receiver gains the difference to
the last total that it ``heard``. So a lost message only delays mass, and the weight in nodes and
under way stays N (running-sum push-sum; P has no such form). In the limit of fast rounds every node
is the central filter.

Totals refer to an instant: as time passes they are predicted with the plant, without its noise, for
which ``U -> Phi^-T U Phi^-1`` and ``u -> Phi^-T u`` with Phi = e^{A gap} would be right. All totals
are predicted in the same way, so their differences are too. But information about a mode that
decays would grow without bound in old totals, until nothing else of them were left; so that about
each mode fades by the rate r at which the plant forgets it: it stays as it is, and what is under
way weighs as much as when it left, whatever other modes there are. The P_g, g = 1 to G, project on
the parts of the state with one rate r_g each, 0 for all that do not decay (``modes.RateGroups``).
With M = sum_g e^{-r_g gap} P_g Phi^-1

    U -> M' U M,    u_g -> e^{-r_g gap} M' u_g    for each part u_g = U P_g x of u,

which is again information about the plant's state: ``M' U M P_g Phi x = e^{-r_g gap} M' U P_g x``.
The parts must be kept apart in totals, for that: u is their sum.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from netkf.algorithms.filter import Message, NodeInfo, Reading
from netkf.algorithms.kernels.root_update import lower_root
from netkf.algorithms.models import Backward, first_root, sample_update
from netkf.linalg.arrays import FloatArray

MIN_ACCURACY = 1e-4
"""Relative accuracy with which a total must grow by a share in floating point; otherwise the node
offers nothing.
"""


class Offer(NamedTuple):
    """The payload of a broadcast: its ``number`` among those of its sender, from 0, and the running
    ``total`` (1 + n n + G n,) of all shares so far: weight w, information U by rows and, for each
    of G groups of modes, the part ``U P_g xhat`` of u; ``projectors`` (G, n, n) are the P_g.
    """

    number: int
    total: FloatArray
    projectors: FloatArray


class RunningSums(NamedTuple):
    """The state of a node that exchanges mass by running sums.

    xhat, root : estimate (n,) and root (n, n) of its covariance
    model : of the plant and the node's sensors
    weight : w, the node's part of the N of all nodes
    sent : total (1 + n n + G n,) of the shares offered to each receiver so far, of w, information
           U and the G parts of ``u = U xhat``
    rounds : number of broadcasts so far
    heard : the newest offer heard, by sender; its total refers to the present state
    receivers, nodes : number of nodes that can hear this one, and N
    """

    xhat: FloatArray
    root: FloatArray
    model: Any
    weight: float
    sent: FloatArray
    rounds: int
    heard: Mapping[int, Offer]
    receivers: int
    nodes: int

    @property
    def P(self) -> FloatArray:
        """The covariance ``root root'`` (n, n) of the estimate."""
        return self.root @ self.root.T


def start(model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> RunningSums:
    """Return the state at time 0, with estimate ``mean`` (n,), covariance ``cov`` (n, n), weight 1
    and nothing sent; ``node`` says how many nodes can hear it, and how many there are.
    """
    n = len(mean)
    return RunningSums(
        xhat=mean,
        root=first_root(cov),
        model=model,
        weight=1.0,
        sent=np.zeros(1 + n * n + n * len(model.groups.rates)),
        rounds=0,
        heard={},
        receivers=node.receivers,
        nodes=node.nodes,
    )


def predict_sums(state: RunningSums, gap: float) -> RunningSums:
    """Return the state ``gap`` seconds later: estimate and root are predicted, and all totals of
    information, sent and heard, are made to refer to the plant's later state.
    """
    xhat, root = state.model.predict(state.xhat, state.root, gap)
    # Totals that were heard move too: the next ones, which are compared with them, will have moved.
    back = state.model.backward(gap)
    heard = {sender: predict_offer(offer, back) for sender, offer in state.heard.items()}
    return state._replace(xhat=xhat, root=root, sent=_move_total(state.sent, back), heard=heard)


def predict_offer(offer: Offer, back: Backward) -> Offer:
    """Return the ``offer`` with its total made to refer to a later state of the plant; ``back`` is
    the model's transition of information over the time between.
    """
    return offer._replace(total=_move_total(offer.total, back))


def _move_total(total: FloatArray, back: Backward) -> FloatArray:
    """Return a ``total`` (1 + n n + G n,) of (w, U, parts of u) about a state one gap later."""
    inverse, fading = back
    n, out = len(inverse), total.copy()
    U = total[1 : 1 + n * n].reshape(n, n)
    out[1 : 1 + n * n] = (inverse.T @ U @ inverse).reshape(-1)
    parts = total[1 + n * n :].reshape(-1, n)
    out[1 + n * n :] = (fading[:, None] * (parts @ inverse)).reshape(-1)
    return out


def offer(state: RunningSums) -> tuple[RunningSums, Offer | None]:
    """Return the state after one round, and its offer; None if nobody can hear. The node gives a
    share 1 / (d + 1) of its mass to each of d receivers: its weight shrinks, while estimate and
    covariance, ratios of masses, stay.
    """
    if state.receivers == 0:
        return state, None
    n, projectors = len(state.xhat), state.model.groups.projectors
    # The mass (w, U, parts of u): U = (w / N) P^-1 with P^-1 = S^-T S^-1 for the root S.
    try:
        inverse = scipy.linalg.solve_triangular(
            state.root, np.eye(n), lower=True, check_finite=False
        )
    except np.linalg.LinAlgError:  # P has fallen to 0: its inverse ends the run as diverged
        inverse = np.full((n, n), np.inf)
    U = (state.weight / state.nodes) * (inverse.T @ inverse)
    mass = np.concatenate([[state.weight], U.reshape(-1), _parts(projectors, U, state.xhat)])
    sent = state.sent + mass / (state.receivers + 1)
    # The node gives up exactly the amount by which its total grew, for each receiver. The mass of a
    # node that receives nothing shrinks with each round, until the total no longer grows in
    # floating point: then it keeps its mass, and sends the same total again.
    grown, share = float(sent[0] - state.sent[0]), float(mass[0]) / (state.receivers + 1)
    if abs(grown - share) > MIN_ACCURACY * share:
        offered = Offer(state.rounds, state.sent, projectors)
        return state._replace(rounds=state.rounds + 1), offered
    weight, offered = state.weight - state.receivers * grown, Offer(state.rounds, sent, projectors)
    return state._replace(weight=weight, sent=sent, rounds=state.rounds + 1), offered


def absorb_totals(state: RunningSums, messages: Sequence[Message]) -> RunningSums:
    """Return the state after all offers in ``messages``: its mass gains the growth of each sender's
    total since it was last heard, while an offer older than that adds nothing. ``xhat``, ``root``,
    ``weight`` and ``heard`` differ.
    """
    gained, heard = np.zeros_like(state.sent), dict(state.heard)
    for message in messages:
        new_offer: Offer = message.payload
        # A total refers to the time of sending.
        if message.age > 0.0:
            new_offer = predict_offer(new_offer, state.model.backward(message.age))
        last_offer = heard.get(message.sender)
        if last_offer is not None and new_offer.number <= last_offer.number:
            continue
        gained = gained + (
            new_offer.total if last_offer is None else new_offer.total - last_offer.total
        )
        heard[message.sender] = new_offer
    # No weight arrived: with only old totals nothing has changed.
    if not gained[0] > 0.0:
        return state
    n, weight = len(state.xhat), state.weight + float(gained[0])
    U, u = gained[1 : 1 + n * n].reshape(n, n), gained[1 + n * n :].reshape(-1, n).sum(axis=0)
    # P^-1 <- (w P^-1 + N U) / w+ with the new weight w+. With ``scaled`` T, T T' = (w+ / w) P, it
    # is T^-T (I + (N / w+) T' U T) T^-1; eigenvalues of the bracket below 1 would be negative
    # information, by rounding.
    scaled = np.sqrt(weight / state.weight) * state.root
    share = state.nodes / weight
    values, vectors = np.linalg.eigh(np.eye(n) + 0.5 * share * (scaled.T @ (U + U.T) @ scaled))
    root = lower_root(scaled @ (vectors / np.sqrt(np.maximum(values, 1.0))))
    # xhat <- xhat + P (N / w+) (u - U xhat) with the new P.
    xhat = state.xhat + root @ (root.T @ (share * (u - U @ state.xhat)))
    return state._replace(xhat=xhat, root=root, weight=weight, heard=heard)


def update_sums(state: RunningSums, reading: Reading) -> RunningSums:
    """Return the state after a ``reading``: ``U += H' R^-1 H`` and ``u += H' R^-1 y``. Since
    ``U = (w / N) P^-1``, that is a Kalman update by a reading with noise covariance R w / N.
    """
    if not len(reading.y):
        return state
    R = reading.R * (state.weight / state.nodes)
    xhat, root = sample_update(state.xhat, state.root, reading.y, reading.H, R)
    return state._replace(xhat=xhat, root=root)


def weights(state: RunningSums) -> dict[str, list[float]]:
    """Return as "weight" terms whose sum over all nodes is N, so that a run can report its drift:
    the node's weight, plus the total that it sent to each receiver, less the totals it heard.
    """
    heard = [-float(offer.total[0]) for offer in state.heard.values()]
    sent = [float(state.sent[0])] * state.receivers
    return {"weight": [state.weight, *sent, *heard]}


def shift(state: RunningSums, offset: FloatArray) -> RunningSums:
    """Return the state with ``offset`` (n,) added to the estimate, for a move of the origin, and
    ``U offset`` to every ``u = U xhat``.
    """
    heard = {sender: shift_offer(offer, offset) for sender, offer in state.heard.items()}
    sent = _shift_total(state.sent, offset, state.model.groups.projectors)
    return state._replace(xhat=state.xhat + offset, sent=sent, heard=heard)


def shift_offer(offer: Offer, offset: FloatArray) -> Offer:
    """Return the ``offer`` with ``U offset`` added to its vector ``u = U xhat``, for a move of the
    origin by which estimates change by ``offset`` (n,).
    """
    return offer._replace(total=_shift_total(offer.total, offset, offer.projectors))


def _shift_total(total: FloatArray, offset: FloatArray, projectors: FloatArray) -> FloatArray:
    """Return a ``total`` (1 + n n + G n,) of (w, U, parts of u) after a move of the origin by which
    estimates change by ``offset`` (n,): ``u + U offset``.
    """
    n, out = len(offset), total.copy()
    out[1 + n * n :] += _parts(projectors, total[1 : 1 + n * n].reshape(n, n), offset)
    return out


def _parts(projectors: FloatArray, U: FloatArray, x: FloatArray) -> FloatArray:
    """Return the parts ``U P_g x`` (G n,) of ``U x``, with U (n, n), x (n,) and the ``projectors``
    P_g (G, n, n) on G groups of modes.
    """
    return np.asarray((projectors @ x @ U.T).reshape(-1))
