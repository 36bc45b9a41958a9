"""Push-sum by running sums in the event loop: the kernels of algorithms/running_sums.

A total (w, U, u) refers to an instant and is predicted with the plant. Here each total has a time
of its own, and is predicted only when it is used.
"""

from __future__ import annotations

import math

import numpy as np

from netkf.algorithms.kernels.constant_gains import fill_inverse_transition
from netkf.algorithms.kernels.root_flow import transform_root
from netkf.algorithms.modes import RateGroups
from netkf.algorithms.running_sums import MIN_ACCURACY
from netkf.engines.compiled.instant_updates import use_instant
from netkf.engines.compiled.state import Simulation
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.jacobi import diagonalise
from netkf.linalg.lanes import ONE
from netkf.linalg.structs import Struct


class Totals(Struct):
    """Running sums of N nodes on W directed links; a total has m = 1 + n n + G n numbers: weight w,
    information U and the parts of u of G groups of modes.

    weight : (N,), weights w that nodes hold
    sent, sent_at : totals (N, m) that each node has offered to each of its receivers, and the times
                    (N,) that they refer to
    rounds, receivers : (N,), number of broadcasts so far, and of nodes that can hear
    heard, number, heard_at : last total (W, m) that was heard, its number (W,) (-1: none) and the
                              time that it refers to
    offered : totals (C, m) of messages under way
    kept, rates, projectors : of the plant's ``modes.RateGroups``
    gain, scratch : scratch, growth (m,) of the totals in an inbox, and (4, n, n)
    """

    weight: FloatArray
    sent: FloatArray
    sent_at: FloatArray
    rounds: IntArray
    receivers: IntArray
    heard: FloatArray
    number: IntArray
    heard_at: FloatArray
    offered: FloatArray
    kept: FloatArray
    rates: FloatArray
    projectors: FloatArray
    gain: FloatArray
    scratch: FloatArray


def empty_totals(state: Simulation, receivers: np.ndarray, groups: RateGroups) -> Totals:
    """Return the running sums of push-sum for N nodes at time 0: weight 1 at every node, and
    nothing sent yet. ``receivers`` (N,) is the number of nodes that can hear each node, ``groups``
    are the parts of the state that fade at one rate each.
    """
    count, n = state.xhat.shape
    m, directions = 1 + n * n + n * len(groups.rates), len(state.directions)
    return Totals(
        weight=np.ones(count),
        sent=np.zeros((count, m)),
        sent_at=np.zeros(count),
        rounds=np.zeros(count, dtype=np.int64),
        receivers=receivers,
        heard=np.zeros((directions, m)),
        number=np.full(directions, -1),
        heard_at=np.zeros(directions),
        offered=np.zeros((len(state.pool), m)),
        kept=groups.kept,
        rates=groups.rates,
        projectors=groups.projectors,
        gain=np.zeros(m),
        scratch=np.zeros((4, n, n)),
    )


@kernel
def predict_total(totals: Totals, values: FloatArray, k: int, gap: float) -> None:
    """Predict one running total, the sum of all that a node has offered so far, by ``gap`` seconds
    in place, as ``running_sums.predict_offer`` does: it is ``values[k]`` of K totals ``values``
    (K, 1 + n n + G n), weight w, information matrix U by rows, and the G parts of u.
    """
    if not gap > 0.0:
        return
    # Information moves by the transpose of M from the left and by M from the right.
    fill_inverse_transition(totals.kept, gap, totals.scratch)
    inverse, half, predicted = totals.scratch[0], totals.scratch[1], totals.scratch[2]
    n = len(inverse)
    for i in range(n):
        for j in range(n):
            total = 0.0
            for r in range(n):
                total += values[k, 1 + i * n + r] * inverse[r, j]
            half[i, j] = total
    for i in range(n):
        for j in range(n):
            total = 0.0
            for r in range(n):
                total += inverse[r, i] * half[r, j]
            values[k, 1 + i * n + j] = total
    for g in range(len(totals.rates)):
        # The mean of the modes of a group decays, unlike the information about them.
        begin, fading = 1 + (n + g) * n, math.exp(-totals.rates[g] * gap)
        for i in range(n):
            total = 0.0
            for r in range(n):
                total += inverse[r, i] * values[k, begin + r]
            predicted[0, i] = fading * total
        for i in range(n):
            values[k, begin + i] = predicted[0, i]


@kernel
def offer_round(state: Simulation, totals: Totals, h: int, now: float) -> bool:
    """Offer a share of the mass of node ``h`` (index) at ``now`` (seconds) to each of its
    receivers: the mass is its weight w, U = w / N P^-1 and u = U xhat. Adds the share to the total
    ``totals.sent[h]`` of all that the node has offered, and subtracts the weight given away from
    ``totals.weight[h]``. Return False if the node has no receivers.
    """
    receivers, n, weight = totals.receivers[h], state.xhat.shape[1], totals.weight[h]
    if receivers == 0:
        return False
    # Predict the total to now before it grows.
    predict_total(totals, totals.sent, h, now - totals.sent_at[h])
    totals.sent_at[h] = now
    totals.rounds[h] += 1
    inverse, U, sent = totals.scratch[0], totals.scratch[1], totals.sent
    before, share = sent[h, 0], weight / (receivers + 1)
    # ``grown`` is the amount by which the total really grows in floating point. The node gives up
    # exactly that for each receiver, so that the weight is conserved.
    grown = (before + share) - before
    # The share is at the level of rounding of the total: offer nothing in this round.
    if abs(grown - share) > MIN_ACCURACY * share:
        return True
    # P^-1 = S^-T S^-1.
    fill_inverse_root(inverse, state.root, h)
    for i in range(n):
        for j in range(n):
            total = 0.0
            for r in range(max(i, j), n):
                total += inverse[r, i] * inverse[r, j]
            # U = w / N P^-1.
            U[i, j] = weight / len(state.nodes) * total
            sent[h, 1 + i * n + j] += U[i, j] / (receivers + 1)
    part = totals.scratch[2]
    for g in range(len(totals.rates)):
        # U P_g xhat.
        for i in range(n):
            part[0, i] = 0.0
            for j in range(n):
                part[0, i] += totals.projectors[g, i, j] * state.xhat[h, j]
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += U[i, j] * part[0, j]
            sent[h, 1 + (n + g) * n + i] += total / (receivers + 1)
    sent[h, 0] = before + share
    totals.weight[h] -= receivers * grown
    return True


@kernel
def fill_inverse_root(out: FloatArray, root: FloatArray, h: int) -> None:
    """Write the inverse of the lower triangular root S = ``root[h]`` of P, one of N (N, n, n), into
    ``out`` (n, n), by forward substitution: information P^-1 is its transpose times it.
    """
    n = root.shape[1]
    for i in range(n):
        for j in range(i + 1):
            value = 1.0 if j == i else 0.0
            for r in range(j, i):
                value -= root[h, i, r] * out[r, j]
            out[i, j] = value / root[h, i, i]


@kernel
def hear(state: Simulation, totals: Totals, h: int, now: float) -> None:
    """Let node ``h`` (index) absorb the totals in its inbox at ``now`` (seconds). A total is the
    sum of all that its sender has offered so far, so that its growth since the sender was last
    heard makes up for messages lost in between; the growth is added to the mass of the node,
    ``totals.weight[h]``, ``state.xhat[h]`` and ``root[h]``. A total older than the last one heard
    adds nothing. The totals are stored as ``totals.heard``.
    """
    gain, pool, heard, offered = totals.gain, state.pool, totals.heard, totals.offered
    # Two passes over the inbox: first the sum of all growth, because the totals are not stored as
    # heard unless the weight grows.
    for j in range(len(gain)):
        gain[j] = 0.0
    m = state.nodes[h].inbox
    while m != -1:
        message = pool[m]
        w = message.direction
        # A total of a later round contains all earlier ones: only growth since then counts.
        if message.tag > totals.number[w]:
            # Predict both totals to now before they are compared.
            predict_total(totals, offered, m, now - message.sent)
            predict_total(totals, heard, w, now - totals.heard_at[w])
            totals.heard_at[w] = now
            for j in range(len(gain)):
                gain[j] += offered[m, j] - heard[w, j]
        m = message.next
    # No growth but rounding, or old totals only.
    if not gain[0] > 0.0:
        return
    # Store the totals, so that their growth is not counted again.
    m = state.nodes[h].inbox
    while m != -1:
        message = pool[m]
        if message.tag > totals.number[message.direction]:
            totals.number[message.direction] = message.tag
            for j in range(len(gain)):
                heard[message.direction, j] = offered[m, j]
        m = message.next
    # The weight grows by the gain, and P^-1 becomes the weighted mean.
    weight = totals.weight[h] + gain[0]
    factor = math.sqrt(weight / totals.weight[h])
    totals.weight[h] = weight
    gain_mass(state, totals, h, factor, len(state.nodes) / weight)


@kernel
def gain_mass(state: Simulation, totals: Totals, h: int, factor: float, share: float) -> None:
    """Add mass, ``totals.gain`` = (weight, U (n, n), parts of u), which node ``h`` (index) has
    heard from others, to its estimate: ``P^-1 <- (w P^-1 + N U) / w+`` with the new weight w+, and
    the estimate likewise. Changes ``state.xhat[h]`` and ``root[h]``, the root of P. ``factor`` is
    (w+ / w)^1/2, ``share`` is N / w+.
    """
    root, gain, n = state.root, totals.gain, state.xhat.shape[1]
    inner, half, vectors = totals.scratch[0], totals.scratch[1], totals.scratch[2]
    # S sqrt(w+ / w): the root of P with P^-1 scaled by w / w+.
    for i in range(n):
        for j in range(i + 1):
            root[h, i, j] *= factor
    # inner = I + share S' U S, with U symmetrised; then P = S inner^-1 S'.
    for i in range(n):
        for j in range(n):
            total = 0.0
            for r in range(j, n):
                total += (gain[1 + i * n + r] + gain[1 + r * n + i]) * root[h, r, j]
            half[i, j] = total
    for i in range(n):
        for j in range(n):
            total = 0.0
            for r in range(i, n):
                total += root[h, r, i] * half[r, j]
            inner[i, j] = 0.5 * share * total + (1.0 if i == j else 0.0)
    # Invert it by eigenvalues: U is a difference of sums, and may be indefinite by rounding.
    diagonalise(inner, vectors)
    update_root_by_gain(state, h, inner, vectors)
    move_by_gain(state, h, gain, share, totals.scratch[3, 0])


@kernel
def update_root_by_gain(state: Simulation, h: int, values: FloatArray, vectors: FloatArray) -> None:
    """Add the information that a node has heard to its P, the middle step of ``gain_mass``: replace
    its root S = ``state.root[h]`` (n, n) by the lower triangular root of ``S (I + share S' U S)^-1
    S' = S V D^-1 V' S'``. The eigenvalues D of the matrix in brackets are on the diagonal of
    ``values`` (n, n), raised to at least 1, and its eigenvectors V = ``vectors`` (n, n) in columns;
    ``h`` is the index of the node.
    """
    root, F, n = state.root, state.flow_scratch.values, state.xhat.shape[1]
    wide, noise = state.flow_scratch.wide, state.flow_scratch.T
    # F = S V D^-1/2, a root that is not triangular yet.
    for i in range(n):
        for j in range(n):
            total = 0.0
            for r in range(i + 1):
                total += root[h, i, r] * vectors[r, j]
            # Eigenvalues below 1 would add covariance: information cannot be negative.
            F[i * n + j] = total / math.sqrt(max(values[j, j], 1.0))
    # The new root is I times F, made triangular by Householder's reflections.
    for i in range(n):
        for j in range(i + 1):
            root[h, i, j] = 1.0 if i == j else 0.0
            noise[i, j] = 0.0
    transform_root(ONE, state.size, root[h], F, 0, wide, noise)


@kernel
def move_by_gain(
    state: Simulation, h: int, gain: FloatArray, share: float, innovation: FloatArray
) -> None:
    """Correct ``state.xhat[h]`` of node ``h`` (index) by the mass that it has heard, ``gain`` (1 +
    n n + G n,) = (weight, information matrix U by rows, the parts of the information vector u):
    ``xhat += P share (u - U xhat)`` with the new P and share = N / w+, w+ being the new weight;
    ``innovation`` (n,) is scratch.
    """
    root, xhat, n = state.root, state.xhat, state.xhat.shape[1]
    # innovation = N / w+ (u - U xhat).
    for i in range(n):
        total = 0.0
        for k in range(1 + n * n + i, len(gain), n):
            total += gain[k]
        for j in range(n):
            total -= gain[1 + i * n + j] * xhat[h, j]
        innovation[i] = share * total
    # S' innovation in place: entry j is not read again.
    for j in range(n):
        total = 0.0
        for i in range(j, n):
            total += root[h, i, j] * innovation[i]
        innovation[j] = total
    # S (S' innovation) = P innovation.
    for i in range(n):
        for j in range(i + 1):
            xhat[h, i] += root[h, i, j] * innovation[j]


@kernel
def add_reading(state: Simulation, totals: Totals, h: int, instant: int) -> None:
    """Add the samples of an ``instant`` (index in ``state.instants``) to the mass of node ``h``,
    its weighted share of the information in the network: ``U += H' R^-1 H`` and ``u += H' R^-1 y``,
    which counts N / w times in P^-1, w being the node's weight. Changes ``state.xhat[h]`` and
    ``root[h]``.
    """
    # Equivalent to noise R w / N.
    scale = math.sqrt(totals.weight[h] / len(state.nodes))
    use_instant(state, instant, state.root, state.xhat, h, scale)
