"""Push-sum in continuous time: broadcast rounds by running sums, each node by its own clock; the
verbs of ``push_sum.PushSum`` under clocks.

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

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from netkf.algorithms.filter import NodeInfo
from netkf.algorithms.kernels.estimates import add_covariance_product
from netkf.algorithms.kernels.intersection import invert_lanes
from netkf.algorithms.kernels.root_flow import cell_of, transition_series, transitions_at
from netkf.algorithms.kernels.run import predict_estimate, shift_vector, use_reading
from netkf.algorithms.kernels.square_root import triangularise
from netkf.algorithms.modes import RateGroups, rate_groups
from netkf.algorithms.records import Kernels, Record, packed_numbers
from netkf.linalg.arrays import FloatArray, cached_by_entries
from netkf.linalg.compiling import kernel
from netkf.linalg.generic import drop_lane
from netkf.linalg.jacobi import diagonalise
from netkf.linalg.lanes import ONE
from netkf.linalg.local import local_matrix, local_vector
from netkf.linalg.series import ORDER_9, horner
from netkf.linalg.spectra import balance
from netkf.linalg.structs import Size

MIN_ACCURACY = 1e-4
"""Relative accuracy with which a total must grow by a share in floating point; otherwise the node
offers nothing.
"""
CELLS, REACH = 64, 0.0625
"""Cells of the table of M, and their length times the norm of its exponent: the terms of order 10
are below rounding.
"""


def record(infos: Sequence[NodeInfo], models: Sequence[Any]) -> Record:
    """Return what a node knows: ``weight`` w, ``sent``, the total of the shares offered to each
    receiver so far, of w, information U by rows and the G parts of u, and ``heard``, the newest
    total heard from each sender; ``sent_at`` and ``heard_at`` are the times of the node's own clock
    ``elapsed`` that they refer to, ``rounds`` and ``number`` count broadcasts.
    """
    n = len(models[0].A)
    groups, unit, table = _tables_of(models[0].A)
    m = 1 + n * n + n * len(groups.rates)
    return Record(
        node={
            **dict.fromkeys(("weight", "elapsed", "sent_at"), ()),
            "sent": (m,),
            "rounds": ((), np.int64),
            "conserved": (1,),
        },
        link={"heard": (m,), "heard_at": (), "number": ((), np.int64)},
        payload={"total": (m,), "number": ((), np.int64)},
        numbers={"total": packed_numbers(n, 1, m - 1 - n * n)},
        settings={
            "receivers": np.array([info.receivers for info in infos], dtype=np.int64),
            "nodes": float(infos[0].nodes),
            "projectors": np.ascontiguousarray(groups.projectors),
            "unit": unit,
            "table": table,
            "back": np.zeros(table.shape[2]),
            "gain": np.zeros(m),
            "work": np.zeros((4, n, n)),
        },
    )


@cached_by_entries(16)
def _tables_of(A: FloatArray) -> tuple[RateGroups, float, FloatArray]:
    """Return groups of a plant, the length of a cell (s), and Taylor coefficients (CELLS, terms,
    n n + G), shared by equal plants: they take some 20 ms.
    """
    groups, terms = rate_groups(A), len(ORDER_9) + 1
    kept, rates = groups.kept, groups.rates
    norm = max(np.abs(balance(kept)[0]).sum(axis=1).max(), rates.max(initial=0.0), 1e-12)
    unit = 2.0 ** np.floor(np.log2(REACH / norm))
    middles = unit * (np.arange(CELLS) + 0.5)
    middles[0] = 0.0

    def series(drift: FloatArray) -> FloatArray:
        model = -drift, np.zeros(drift.shape), np.zeros((0, len(drift)))
        return np.asarray(transition_series(*model, transitions_at(*model, middles), terms)[0])

    # A plant of one state for each rate: powers of one number.
    parts = [series(kept), *(series(np.eye(1) * rate) for rate in rates)]
    parts = [part.reshape(CELLS, terms, -1) for part in parts]
    return groups, float(unit), np.concatenate(parts, axis=2).astype(np.float64)


def weights(state: Any) -> dict[str, list[float]]:
    """Return as "weight" terms whose sum over all nodes is N, so that a run can report its drift:
    the node's weight, plus the total that it sent to each receiver, less the totals it heard.
    """
    sent = [float(state.sent[0])] * int(state.record.receivers[0])
    return {"weight": [float(state.weight), *sent, *(-state.heard[:, 0]).tolist()]}


@kernel
def predict(record: Any, h: int, run: Any) -> None:
    """Predict the estimate; totals are predicted when they are used."""
    predict_estimate(run.model, run, record.xhat, record.root, h, h)
    record.elapsed[h, 0] += run.gap


@kernel
def update(record: Any, h: int, run: Any) -> None:
    """Add a reading to the mass: ``U += H' R^-1 H`` and ``u += H' R^-1 y``. Since
    ``U = (w / N) P^-1``, that is a Kalman update by a reading with noise covariance R w / N.
    """
    r, scale = run.reading, math.sqrt(record.nodes / record.weight[h, 0])
    for i in range(run.rows[r]):
        run.y[run.first_y + r, i, 0] *= scale
        for j in range(len(run.size)):
            run.H[run.first_H + run.matrix[r], i, j, 0] *= scale
    use_reading(run, record.xhat, record.root, h, r, True)


@kernel
def predict_total(record: Any, size: Size, total: FloatArray, gap: float) -> None:
    """Make a ``total`` (1 + n n + G n,) refer to the state ``gap`` seconds later, in place."""
    if not gap > 0.0:
        return
    fill_back(record, size, gap)
    n, M = len(size), record.back
    half, predicted = local_matrix(size, record.work[1]), local_vector(size, record.work[2, 0])
    # Information moves by the transpose of M from the left and by M from the right.
    for i in range(n):
        for j in range(n):
            entry = 0.0
            for r in range(n):
                entry += total[1 + i * n + r] * M[r * n + j]
            half[i, j] = entry
    for i in range(n):
        for j in range(n):
            entry = 0.0
            for r in range(n):
                entry += M[r * n + i] * half[r, j]
            total[1 + i * n + j] = entry
    for g in range(len(record.projectors)):
        # The mean of the modes of a group decays, unlike the information about them.
        begin = 1 + (n + g) * n
        for i in range(n):
            entry = 0.0
            for r in range(n):
                entry += M[r * n + i] * total[begin + r]
            predicted[i] = M[n * n + g] * entry
        for i in range(n):
            total[begin + i] = predicted[i]


@kernel
def fill_back(record: Any, size: Size, gap: float) -> None:
    """Write M over a ``gap`` in seconds by rows, and each e^{-r_g gap}, into ``record.back``."""
    table, back, doublings, n = record.table, record.back, 0, len(size)
    while gap >= len(table) * record.unit:
        gap, doublings = 0.5 * gap, doublings + 1
    cell, since = cell_of(record.unit, gap)
    horner(ORDER_9, back, len(back), table[cell], since)
    product = local_matrix(size, record.work[0])
    for _ in range(doublings):
        for i in range(n):
            for j in range(n):
                product[i, j] = 0.0
                for r in range(n):
                    product[i, j] += back[i * n + r] * back[r * n + j]
        for i in range(n):
            for j in range(n):
                back[i * n + j] = product[i, j]
        for g in range(n * n, len(back)):
            back[g] *= back[g]


@kernel
def emit(record: Any, h: int, m: int, run: Any) -> None:
    """Offer a share 1 / (d + 1) of all mass to each of d receivers: the node's weight shrinks,
    while estimate and covariance, ratios of masses, stay; a node that nobody hears sends nothing.
    """
    receivers = record.receivers[h]
    if receivers == 0:
        run.sends[0] = 0
        return
    sent, now = drop_lane(record.sent), record.elapsed[h, 0]
    # Predict the total to now before it grows.
    predict_total(record, run.size, sent[h], now - record.sent_at[h, 0])
    record.sent_at[h, 0] = now
    record.rounds[h, 0] += 1
    before, share = sent[h, 0], record.weight[h, 0] / (receivers + 1)
    # The node gives up exactly the amount by which its total grew in floating point, for each
    # receiver. The mass of a node that receives nothing shrinks with each round, until the total no
    # longer grows: then it keeps its mass, and sends the same total again.
    grown = (before + share) - before
    if abs(grown - share) <= MIN_ACCURACY * share:
        add_share(record, h, run, receivers)
        sent[h, 0] = before + share
        record.weight[h, 0] -= receivers * grown
    payload = record.payload
    for i in range(sent.shape[1]):
        payload.total[m, i, 0] = sent[h, i]
    payload.number[m, 0] = record.rounds[h, 0]


@kernel
def add_share(record: Any, h: int, run: Any, receivers: int) -> None:
    """Add a share of U = (w / N) P^-1 and of the parts of u = U xhat to what node h has sent."""
    inverse, U, part = record.work[0], record.work[1], record.work[2]
    sent, xhat, root, n = record.sent, record.xhat, record.root, len(run.size)
    # P^-1 = S^-T S^-1.
    invert_lanes(ONE, run.size, record.work, 0, root, h)
    for i in range(n):
        for j in range(n):
            total = 0.0
            for r in range(max(i, j), n):
                total += inverse[r, i] * inverse[r, j]
            U[i, j] = record.weight[h, 0] / record.nodes * total
            sent[h, 1 + i * n + j, 0] += U[i, j] / (receivers + 1)
    for g in range(len(record.projectors)):
        # U P_g xhat
        for i in range(n):
            part[0, i] = 0.0
            for j in range(n):
                part[0, i] += record.projectors[g, i, j] * xhat[h, j, 0]
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += U[i, j] * part[0, j]
            sent[h, 1 + (n + g) * n + i, 0] += total / (receivers + 1)


@kernel
def absorb(record: Any, h: int, run: Any) -> None:
    """Gain the growth of each sender's total since it was last heard, which makes up for messages
    lost in between; a total older than that adds nothing.
    """
    gain, payload, now = record.gain, record.payload, record.elapsed[h, 0]
    totals, heard = drop_lane(payload.total), drop_lane(record.heard)
    # Two passes: first the sum of all growth, because the totals are not stored as heard unless the
    # weight grows.
    for j in range(len(gain)):
        gain[j] = 0.0
    for k in range(run.count):
        m, w = run.message[k], run.link[k]
        if payload.number[m, 0] > record.number[w, 0]:
            # Predict both totals to now before they are compared.
            predict_total(record, run.size, totals[m], run.age[k])
            predict_total(record, run.size, heard[w], now - record.heard_at[w, 0])
            record.heard_at[w, 0] = now
            for j in range(len(gain)):
                gain[j] += totals[m, j] - heard[w, j]
    # No growth but rounding, or old totals only.
    if not gain[0] > 0.0:
        return
    for k in range(run.count):
        m, w = run.message[k], run.link[k]
        if payload.number[m, 0] > record.number[w, 0]:
            record.number[w, 0] = payload.number[m, 0]
            for j in range(len(gain)):
                heard[w, j] = totals[m, j]
    # The weight grows by the gain, and P^-1 becomes the weighted mean.
    weight = record.weight[h, 0] + gain[0]
    factor = math.sqrt(weight / record.weight[h, 0])
    record.weight[h, 0] = weight
    gain_mass(record, h, run, factor, record.nodes / weight)


@kernel
def gain_mass(record: Any, h: int, run: Any, factor: float, share: float) -> None:
    """Add the mass ``record.gain`` to the estimate of node h: ``P^-1 <- (w P^-1 + N U) / w+`` with
    the new weight w+, and the estimate likewise; ``factor`` is (w+ / w)^1/2, ``share`` is N / w+.
    """
    root, gain, n = drop_lane(record.root), record.gain, len(run.size)
    inner, half, vectors = record.work[0], record.work[1], record.work[2]
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
    update_root_by_gain(root, h, run, inner, vectors)
    # xhat += P N / w+ (u - U xhat) with the new P.
    innovation, xhat = record.work[3, 0], record.xhat
    for i in range(n):
        total = 0.0
        for k in range(1 + n * n + i, len(gain), n):
            total += gain[k]
        for j in range(n):
            total -= gain[1 + i * n + j] * xhat[h, j, 0]
        innovation[i] = total
    add_covariance_product(ONE, run.size, xhat, h, share, record.root, innovation, innovation)


@kernel
def update_root_by_gain(
    root: FloatArray, h: int, run: Any, values: FloatArray, vectors: FloatArray
) -> None:
    """Replace the root S of node h by the lower triangular root of ``S V D^-1 V' S'``, with the
    eigenvalues D on the diagonal of ``values`` (n, n), raised to at least 1, and eigenvectors V.
    """
    scratch, n = run.model.scratch, len(run.size)
    # S V D^-1/2, a root that is not triangular yet.
    for i in range(n):
        for j in range(n):
            total = 0.0
            for r in range(i + 1):
                total += root[h, i, r] * vectors[r, j]
            # Eigenvalues below 1 would add covariance: information cannot be negative.
            scratch.wide[i, j] = total / math.sqrt(max(values[j, j], 1.0))
            scratch.T[i, j] = 0.0
    triangularise(ONE, scratch.size, root[h], scratch.wide, scratch.T)


@kernel
def shift_total(record: Any, total: FloatArray, run: Any) -> None:
    """Add ``U P_g offset`` to each part of u: since u = U x, it moves with x."""
    n, moved = len(run.size), record.work[2]
    for g in range(len(record.projectors)):
        for i in range(n):
            moved[0, i] = 0.0
            for j in range(n):
                moved[0, i] += record.projectors[g, i, j] * run.offset[j, 0]
        for i in range(n):
            for j in range(n):
                total[1 + (n + g) * n + i] += total[1 + i * n + j] * moved[0, j]


@kernel
def shift(record: Any, h: int, run: Any) -> None:
    """Move the estimate and all totals of node h with the origin."""
    shift_vector(run, record.xhat, h)
    # Predicted forward: back to a time long ago an offset would grow with the modes that decay.
    sent, heard, now = drop_lane(record.sent), drop_lane(record.heard), record.elapsed[h, 0]
    predict_total(record, run.size, sent[h], now - record.sent_at[h, 0])
    record.sent_at[h, 0] = now
    shift_total(record, sent[h], run)
    for w in range(run.first[h], run.first[h + 1]):
        predict_total(record, run.size, heard[w], now - record.heard_at[w, 0])
        record.heard_at[w, 0] = now
        shift_total(record, heard[w], run)


@kernel
def shift_payload(record: Any, m: int, run: Any) -> None:
    """Move the total in payload m with the origin."""
    shift_total(record, drop_lane(record.payload.total)[m], run)


@kernel
def observe(record: Any, h: int, run: Any) -> None:
    """Write the part of node h in the sum of all weights, held and under way, which stays N."""
    total = record.weight[h, 0] + record.receivers[h] * record.sent[h, 0, 0]
    for w in range(run.first[h], run.first[h + 1]):
        total -= record.heard[w, 0, 0]
    record.conserved[h, 0, 0] = total


KERNELS = Kernels(
    predict=predict, update=update, emit=emit, absorb=absorb, shift=shift,
    shift_payload=shift_payload, observe=observe, counts_sends=True, unrolled=True,
)  # fmt: skip
