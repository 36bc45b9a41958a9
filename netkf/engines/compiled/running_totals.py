"""Push-sum by running sums in the event loop (algorithms/running_sums, in loops).

Totals move with the plant. Here each keeps the time it refers to, and is moved once it is needed.
"""

from __future__ import annotations

import math

import numpy as np

from netkf.algorithms.kernels.root_flow import transform_root
from netkf.algorithms.running_sums import MIN_ACCURACY
from netkf.engines.compiled.late_readings import use_instant
from netkf.engines.compiled.state import Simulation
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.jacobi import diagonalise
from netkf.linalg.lanes import ONE
from netkf.linalg.small import multiply_square
from netkf.linalg.structs import Struct

TERMS = 18  # of the exponential, for a norm of at most 1/2


class Totals(Struct):
    """Running sums of N nodes on W directed links; m = 1 + n n + n numbers each.

    weight : (N,)
    sent, sent_at : totals (N, m) to each receiver, and the times (N,) that they refer to
    rounds, receivers : (N,), numbers of broadcasts and of nodes that can hear
    heard, number, heard_at : last total (W, m) heard, its number (W,) (-1: none) and its time
    offered : totals (C, m) of messages under way
    A, forgetting : of the plant (n, n), and the rate at which old information fades
    gained, scratch : (m,) and (4, n, n)
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
    A: FloatArray
    forgetting: float
    gained: FloatArray
    scratch: FloatArray


def empty_totals(
    state: Simulation, receivers: np.ndarray, A: FloatArray, forgetting: float
) -> Totals:
    """Weight 1 at every node, and nothing sent yet."""
    count, n = state.xhat.shape
    m, directions = 1 + n * n + n, len(state.directions)
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
        A=np.array(A, dtype=np.float64),
        forgetting=forgetting,
        gained=np.zeros(m),
        scratch=np.zeros((4, n, n)),
    )


@kernel
def fill_inverse(totals: Totals, gap: float) -> None:
    """Write ``e^{-A gap}`` into ``scratch[0]``: the power series of a part of the gap, squared."""
    A, out, term, moved = totals.A, totals.scratch[0], totals.scratch[1], totals.scratch[2]
    n, norm = len(A), 0.0
    for i in range(n):
        # The largest row sum of |A| gap bounds the norm of the series.
        row = 0.0
        for j in range(n):
            row += abs(A[i, j]) * gap
            out[i, j] = term[i, j] = 1.0 if i == j else 0.0
        norm = max(norm, row)
    # exp(-A g) = exp(-A g / 2^k)^(2^k): scaling and squaring.
    halvings, step = 0, -gap
    while norm > 0.5:
        norm, step, halvings = 0.5 * norm, 0.5 * step, halvings + 1
    # A norm of 0 leaves the identity.
    for k in range(1, TERMS if norm > 0.0 else 1):
        multiply_square(moved, term, A)
        for i in range(n):
            for j in range(n):
                term[i, j] = moved[i, j] * step / k
                out[i, j] += term[i, j]
    for _ in range(halvings):
        multiply_square(moved, out, out)
        for i in range(n):
            for j in range(n):
                out[i, j] = moved[i, j]


@kernel
def move_total(totals: Totals, values: FloatArray, k: int, gap: float) -> None:
    """Predict row ``k`` of totals by ``gap`` seconds: ``U <- s Phi^-T U Phi^-1``, ``u <- s Phi^-T
    u``.
    """
    if not gap > 0.0:
        return
    # Phi^-1 = exp(-A gap); information moves by Phi^-T from the left and by Phi^-1 from the right.
    fill_inverse(totals, gap)
    inverse, half, moved = totals.scratch[0], totals.scratch[1], totals.scratch[2]
    # Forgetting multiplies information by s = exp(-2 f gap).
    n, fading = len(inverse), math.exp(-2.0 * totals.forgetting * gap)
    for i in range(n):
        for j in range(n):
            total = 0.0
            for r in range(n):
                total += values[k, 1 + i * n + r] * inverse[r, j]
            half[i, j] = total
    for i in range(n):
        total = 0.0
        for r in range(n):
            total += inverse[r, i] * values[k, 1 + n * n + r]
        moved[0, i] = fading * total
    for i in range(n):
        values[k, 1 + n * n + i] = moved[0, i]
        for j in range(n):
            total = 0.0
            for r in range(n):
                total += inverse[r, i] * half[r, j]
            values[k, 1 + i * n + j] = fading * total


@kernel
def offer_round(state: Simulation, totals: Totals, h: int, now: float) -> bool:
    """Offer node ``h``'s share of its mass to its receivers, which shrinks all its masses by one
    factor; return False if nobody hears it.
    """
    receivers, n, weight = totals.receivers[h], state.xhat.shape[1], totals.weight[h]
    if receivers == 0:
        return False
    # The node's own total is brought to now before it grows.
    move_total(totals, totals.sent, h, now - totals.sent_at[h])
    totals.sent_at[h] = now
    totals.rounds[h] += 1
    inverse, U, sent = totals.scratch[0], totals.scratch[1], totals.sent
    # The node gives up exactly what its total grows by, for each receiver, or nothing.
    before, share = sent[h, 0], weight / (receivers + 1)
    # Exact in floating point: the total in fact grows by ``grown``, which may differ from
    # ``share``.
    grown = (before + share) - before
    # The share has become rounding beside the total: sending it would lose mass.
    if abs(grown - share) > MIN_ACCURACY * share:
        return True
    # P^-1 = S^-T S^-1.
    fill_inverse_root(inverse, state.root, h)
    for i in range(n):
        for j in range(n):
            total = 0.0
            for r in range(max(i, j), n):
                total += inverse[r, i] * inverse[r, j]
            # U = w / N P^-1 and u = U xhat.
            U[i, j] = weight / len(state.nodes) * total
            sent[h, 1 + i * n + j] += U[i, j] / (receivers + 1)
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += U[i, j] * state.xhat[h, j]
        sent[h, 1 + n * n + i] += total / (receivers + 1)
    sent[h, 0] = before + share
    # Conserved: the node gives up as often as a receiver will gain.
    totals.weight[h] -= receivers * grown
    return True


@kernel
def fill_inverse_root(out: FloatArray, root: FloatArray, h: int) -> None:
    """Write the inverse of row ``h`` of ``root``, lower triangular and regular, into ``out`` (n,
    n).
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
    """Add to the mass of node ``h`` the growth of each total since it was last heard; an older
    total adds nothing.
    """
    gained, pool, heard, offered = totals.gained, state.pool, totals.heard, totals.offered
    # Two passes over the inbox: gains first, because nothing is remembered if the mass did not
    # grow.
    for j in range(len(gained)):
        gained[j] = 0.0
    m = state.nodes[h].inbox
    while m != -1:
        message = pool[m]
        w = message.direction
        # A total of a later round contains all earlier ones: only growth since then counts.
        if message.tag > totals.number[w]:
            # Both totals are brought to now before they are compared.
            move_total(totals, offered, m, now - message.sent)
            move_total(totals, heard, w, now - totals.heard_at[w])
            totals.heard_at[w] = now
            for j in range(len(gained)):
                gained[j] += offered[m, j] - heard[w, j]
        m = message.next
    # Rounding, or old totals only.
    if not gained[0] > 0.0:
        return
    # Now remember what was heard, so that it is not gained again.
    m = state.nodes[h].inbox
    while m != -1:
        message = pool[m]
        if message.tag > totals.number[message.direction]:
            totals.number[message.direction] = message.tag
            for j in range(len(gained)):
                heard[message.direction, j] = offered[m, j]
        m = message.next
    # The weight of the node grows by what it gained, and P^-1 becomes the weighted mean.
    weight = totals.weight[h] + gained[0]
    size = math.sqrt(weight / totals.weight[h])
    totals.weight[h] = weight
    gain_mass(state, totals, h, size, len(state.nodes) / weight)


@kernel
def gain_mass(state: Simulation, totals: Totals, h: int, size: float, share: float) -> None:
    """Add gained mass to node ``h``: ``P^-1 <- (w P^-1 + N U) / w+`` and the estimate likewise.

    The root is multiplied by ``size``, the gain by ``share``; gained information cannot be
    negative.
    """
    root, gained, n = state.root, totals.gained, state.xhat.shape[1]
    inner, half, vectors = totals.scratch[0], totals.scratch[1], totals.scratch[2]
    # S sqrt(w+ / w): the root of P with P^-1 scaled by w / w+.
    for i in range(n):
        for j in range(i + 1):
            root[h, i, j] *= size
    # inner = I + share S' U S, with U symmetrised.
    for i in range(n):
        for j in range(n):
            total = 0.0
            for r in range(j, n):
                total += (gained[1 + i * n + r] + gained[1 + r * n + i]) * root[h, r, j]
            half[i, j] = total
    for i in range(n):
        for j in range(n):
            total = 0.0
            for r in range(i, n):
                total += root[h, r, i] * half[r, j]
            inner[i, j] = 0.5 * share * total + (1.0 if i == j else 0.0)
    # By eigenvalues, because U is a difference of sums and may be indefinite by rounding.
    diagonalise(inner, vectors)
    update_root_by_gain(state, h, inner, vectors)
    move_by_gain(state, h, gained, share, totals.scratch[3, 0])


@kernel
def update_root_by_gain(state: Simulation, h: int, values: FloatArray, vectors: FloatArray) -> None:
    """Write the triangular root of ``S V D^-1 V' S'``, where D (``values``, diagonal) is at least 1
    and V are ``vectors``.
    """
    root, F, n = state.root, state.flow_scratch.values, state.xhat.shape[1]
    wide, noise = state.flow_scratch.wide, state.flow_scratch.T
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
    state: Simulation, h: int, gained: FloatArray, share: float, news: FloatArray
) -> None:
    """Correct the estimate by what was gained, ``xhat += P share (u - U xhat)``; ``news`` (n,) is
    scratch.
    """
    root, xhat, n = state.root, state.xhat, state.xhat.shape[1]
    # N / w (u - U xhat): the innovation in terms of information.
    for i in range(n):
        total = gained[1 + n * n + i]
        for j in range(n):
            total -= gained[1 + i * n + j] * xhat[h, j]
        news[i] = share * total
    for j in range(n):  # S' news: entry j is not read again
        total = 0.0
        for i in range(j, n):
            total += root[h, i, j] * news[i]
        news[j] = total
    # S (S' news) = P news.
    for i in range(n):
        for j in range(i + 1):
            xhat[h, i] += root[h, i, j] * news[j]


@kernel
def add_reading(state: Simulation, totals: Totals, h: int, instant: int) -> None:
    """Add a reading, ``U += H' R^-1 H`` and ``u += H' R^-1 y``, N / w times that in P^-1."""
    # R scaled by w / N: the information counts N / w times in P^-1.
    scale = math.sqrt(totals.weight[h] / len(state.nodes))
    use_instant(state, instant, state.root, state.xhat, h, scale)
