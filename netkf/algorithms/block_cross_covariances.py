"""Cooperative localisation with kept cross-covariances: nodes that estimate blocks of their own
keep for each neighbour how the errors of both correlate.

Luft, Schubert, Roumeliotis and Burgard, "Recursive decentralized localization for multi-robot
systems with asynchronous pairwise communication", Int. J. Robotics Research 37(10), 2018.

The cross-covariance of the errors of nodes i and j is ``A_i C A_j'``. What changes the error of one
node alone, a prediction, an own reading and, in approximation, what it hears of a third node,
multiplies its own factor, which needs no message. Two nodes that hear each other compute the same
update from what both have sent, and renew C. In the paper they always hear each other. Here one of
both messages may be lost, and its sender does not know. So a node writes the new C in factors that
both know, those since their last update together, and tells it with its next message: two nodes
know their cross-covariance whatever is lost.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from netkf.algorithms.blocks import block_tables
from netkf.algorithms.filter import Filter, NodeInfo
from netkf.algorithms.kernels.block_fusion import (
    NAIVE,
    fuse,
    fusion_of,
    multiply_in_place,
    semidefinite_root,
    solve_gain,
)
from netkf.algorithms.kernels.pairs import block_of_pair, linearise_pair
from netkf.algorithms.kernels.run import (
    ALL,
    predict_estimate,
    shift_vector,
    transition,
    use_reading,
)
from netkf.algorithms.records import Kernels, Record
from netkf.algorithms.registry import built_in
from netkf.algorithms.traits import Analysis, Needs, Timing
from netkf.core.errors import ScenarioError
from netkf.core.fields import field, integer
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import load, store
from netkf.linalg.small import copy_matrix, solve_inplace

MAX_STEPS = 1000
"""More than any network needs: a larger value is a mistake."""
MAX_CONDITION = 1e10
"""Condition number of a factor that is inverted, beyond which too many digits would be lost."""
NEVER = -1.0
"""The time of the last update with a node that was never heard: errors are independent."""


@kernel
def copy_block(A: FloatArray, first: int, out: FloatArray) -> None:
    """Copy the square block of ``A`` that begins at ``first`` into ``out`` (n, n)."""
    for i in range(out.shape[0]):
        for j in range(out.shape[0]):
            out[i, j] = A[first + i, first + j]


@kernel
def write_product(T: FloatArray, A: FloatArray, turned: bool, out: FloatArray) -> None:
    """Write ``T A``, or ``T A'`` if ``turned``, into another matrix ``out`` (r, c)."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            total = 0.0
            for c in range(T.shape[1]):
                total += T[i, c] * (A[j, c] if turned else A[c, j])
            out[i, j] = total


@kernel
def move_factors(record: Any, h: int, run: Any, T: FloatArray, but: int, q: int) -> None:
    """Multiply the factors of node ``h`` by ``T`` (n, n), but those of one link."""
    for w in range(run.first[h], run.first[h + 1]):
        if w != but:
            multiply_in_place(record.base, w, T, record.column, q)
            multiply_in_place(record.last, w, T, record.column, q)


@kernel
def send_estimates(record: Any, h: int, run: Any, q: int) -> None:
    """Let node ``h`` send what it knows now, without own readings to use."""
    n = len(run.size)
    set_own(record, h, n, q)
    for i in range(n):
        record.told[h, i, q] = record.fusion.x[i]
        for j in range(n):
            record.told_P[h, i, j, q] = record.fusion.P[i, j]
    record.own[h, q] = 0
    for w in range(run.first[h], run.first[h + 1]):
        for i in range(n):
            for j in range(n):
                record.told_base[w, i, j, q] = record.base[w, i, j, q]
                record.told_last[w, i, j, q] = record.last[w, i, j, q]


@kernel
def set_own(record: Any, h: int, n: int, q: int) -> None:
    """Make the estimate of node ``h`` (n states) the first part of the joint one."""
    f = record.fusion
    for i in range(n):
        f.x[i] = record.xhat[h, i, q]
        for j in range(n):
            f.P[i, j] = 0.0
            for c in range(min(i, j) + 1):
                f.P[i, j] += record.root[h, i, c, q] * record.root[h, j, c, q]


@kernel
def predict(record: Any, h: int, run: Any) -> None:
    """Predict node ``h``; the noise of the plant is the block's own."""
    transition(run.model, run, record.xhat, h, run.noise)
    for q in range(len(run.lanes)):
        for i in range(len(run.size)):
            for j in range(len(run.size)):
                record.T[i, j] = run.noise[i, j, q]
        move_factors(record, h, run, record.T, -1, q)
    predict_estimate(run.model, run, record.xhat, record.root, h, h)
    for q in range(len(run.lanes)):
        send_estimates(record, h, run, q)


@kernel
def update(record: Any, h: int, run: Any) -> None:
    """Use the readings of the node's own block; those of pairs are kept for the exchange of this
    instant.
    """
    f = record.fusion
    for q in range(len(run.lanes)):
        f.x[:], f.P[:] = 0.0, 0.0
        set_own(record, h, len(run.size), q)
        if use_rows(record, run, run.reading, 0, q):
            copy_block(f.stays, 0, record.T)
            move_factors(record, h, run, record.T, -1, q)
        record.own[h, q] = 1
    use_reading(run, record.xhat, record.root, h, run.reading, True)


@kernel
def has_turn(record: Any, h: int, w: int, run: Any) -> bool:
    """Return True if node ``h`` and the sender of link ``w`` exchange now; under clocks they do
    whenever they can. Nodes that estimate the same blocks, as all do in one plant, are no pairs.
    """
    turn = (record.node[h] + record.peer[w]) % record.steps == run.step
    return bool(record.pairs[h] == 1 and (run.slot < 0 or turn))


@kernel
def emit(record: Any, h: int, m: int, run: Any) -> None:
    """Send the estimate with the factors of the receiver's tie; nothing if no pair has its turn."""
    # A node without neighbours transmits, as with any filter.
    first, talks = run.first[h], run.first[h] == run.first[h + 1]
    if run.receiver != ALL:
        write_message(record, h, m, run, run.receiver)
        return
    for w in range(first, run.first[h + 1]):
        talks = talks or has_turn(record, h, w, run)
        write_message(record, h, m + w - first, run, w)
    for q in range(len(run.lanes) if not talks else 0):
        run.sends[q] = 0


@kernel
def write_message(record: Any, h: int, m: int, run: Any, w: int) -> None:
    """Write payload ``m``, for the sender of link ``w``."""
    lanes, n, p = run.lanes, len(run.size), record.payload
    for i in range(n):
        store(lanes, p.xhat, m, i, load(lanes, record.told, h, i))
        for j in range(n):
            store(lanes, p.P, m, i, j, load(lanes, record.told_P, h, i, j))
    for q in range(len(lanes)):
        p.own[m, q] = record.own[h, q]
    if w < 0:
        return
    store(lanes, p.since, m, load(lanes, record.since, w))
    store(lanes, p.when, m, load(lanes, record.when, w))
    for i in range(n):
        for j in range(n):
            store(lanes, p.base, m, i, j, load(lanes, record.told_base, w, i, j))
            store(lanes, p.last, m, i, j, load(lanes, record.told_last, w, i, j))
        for j in range(record.core.shape[2]):
            store(lanes, p.core, m, i, j, load(lanes, record.core, w, i, j))
            store(lanes, p.seen, m, i, j, load(lanes, record.seen, w, i, j))


@kernel
def absorb(record: Any, h: int, run: Any) -> None:
    """Use the messages of this instant one after the other, by sender; one that took time is used
    for nothing.
    """
    for q in range(len(run.lanes)):
        met, n = False, len(run.size)
        for i in range(n):
            for j in range(n):
                record.moved[i, j] = 1.0 if i == j else 0.0
        for k in range(run.count):
            is_here = run.arrived[k, q] == 1 and not run.age[k] > 0.0
            if is_here and has_turn(record, h, run.link[k], run):
                meet(record, h, run, k, q)
                met = True
        # Each pair has one turn: readings of pairs that are left are about others.
        if met:
            send_estimates(record, h, run, q)


@kernel
def meet(record: Any, h: int, run: Any, k: int, q: int) -> None:
    """Use message ``k``: both nodes compute the same from what both have sent, each for itself."""
    f, n, m, w = record.fusion, len(run.size), run.message[k], run.link[k]
    A, A_j, C, X, T, p = record.A, record.A_j, record.C, record.X, record.T, record.payload
    v = len(A_j)
    since = set_factors(record, m, w, q)
    write_product(A, C, False, record.part)
    write_product(record.part, A_j, True, X)
    # Own readings are used by both nodes alone, if nothing else is.
    seen = record.seen_now
    copy_matrix(seen, X)
    set_joint(record, h, m, q, False)
    if record.own[h, q] == 1 and use_rows(record, run, run.reading, 0, q):
        copy_block(f.stays, 0, T)
        copy_matrix(record.L, A)
        write_product(T, record.L, False, A)
        copy_matrix(record.part, seen)
        write_product(T, record.part, False, seen)
    if p.own[m, q] == 1 and run.heard[k] >= 0 and use_rows(record, run, run.heard[k], n, q):
        copy_block(f.stays, n, record.T_j)
        copy_matrix(record.L_j, A_j)
        write_product(record.T_j, record.L_j, False, A_j)
        copy_matrix(record.part, seen)
        write_product(record.part, record.T_j, True, seen)
    usable = invert(A, record.sizes[h], record.L, record.inverse)
    usable = invert(A_j, record.peer_sizes[w], record.L_j, record.inverse_j) and usable
    if usable:
        set_joint(record, h, m, q, True)
        if record.own[h, q] == 1:
            use_rows(record, run, run.reading, 0, q)
        for j in range(v):
            record.other[j] = f.x[n + j]
            for i in range(n + v):
                record.beside[i, j] = f.P[i, n + j]
        use_others(record, h, run, k, q)
        # An error does not correlate with the innovations that have updated it: so this is the
        # cross-covariance, whether the other node hears them too or not.
        for i in range(n):
            for j in range(v):
                seen[i, j] = f.P[i, n + j]
        write_product(record.inverse, seen, False, record.part)
        write_product(record.part, record.inverse_j, True, C)
    copy_matrix(record.L, A)
    write_product(record.moved, record.L, False, A)
    keep_factors(record, w, q)
    now = run.now if run.slot < 0 else float(run.slot * record.steps + run.step)
    record.since[w, q], record.when[w, q] = since, now
    if usable:
        hear(record, h, run, k, q)


@kernel
def keep_factors(record: Any, w: int, q: int) -> None:
    """Keep the factors A and C of link ``w``, and what has moved them since."""
    for i in range(len(record.A)):
        for j in range(len(record.A)):
            record.base[w, i, j, q], record.last[w, i, j, q] = record.A[i, j], record.moved[i, j]
        for j in range(len(record.A_j)):
            record.core[w, i, j, q] = record.C[i, j]
            record.seen[w, i, j, q] = record.seen_now[i, j]


@kernel
def set_factors(record: Any, m: int, w: int, q: int) -> float:
    """Write the factors A, C and A_j of link ``w`` that both nodes know; return since when."""
    n, v, p = len(record.A), len(record.A_j), record.payload
    since = max(record.since[w, q], p.since[m, q])
    both = record.when[w, q] == p.when[m, q]
    mine = not both and record.since[w, q] == since
    theirs = not both and p.since[m, q] == since
    for i in range(n):
        for j in range(n):
            factor = record.told_base[w, i, j, q] if mine else record.told_last[w, i, j, q]
            record.A[i, j] = factor
    for i in range(v):
        for j in range(v):
            record.A_j[i, j] = p.base[m, i, j, q] if theirs else p.last[m, i, j, q]
    # Of two nodes one may know later that an update was that of both; the other has not been
    # updated since.
    for i in range(n):
        for j in range(v):
            if both:
                record.C[i, j] = record.seen[w, i, j, q]
            elif record.when[w, q] > p.when[m, q]:
                record.C[i, j] = record.core[w, i, j, q]
            else:
                record.C[i, j] = p.core[m, j, i, q]
    return float(record.when[w, q] if both else since)


@kernel
def set_joint(record: Any, h: int, m: int, q: int, crossed: bool) -> None:
    """Write what node ``h`` and payload ``m`` tell, with the cross-covariance X if ``crossed``."""
    f, n, v, p = record.fusion, len(record.A), len(record.A_j), record.payload
    for i in range(n):
        f.x[i] = record.told[h, i, q]
        for j in range(n):
            f.P[i, j] = record.told_P[h, i, j, q]
        for j in range(v):
            f.P[i, n + j] = f.P[n + j, i] = record.X[i, j] if crossed else 0.0
    for i in range(v):
        f.x[n + i] = p.xhat[m, i, q]
        for j in range(v):
            f.P[n + i, n + j] = p.P[m, i, j, q]


@kernel
def use_rows(record: Any, run: Any, r: int, first: int, q: int) -> bool:
    """Use reading ``r`` of the node whose states begin at ``first``; False if it says nothing."""
    f, n, place, matrix = record.fusion, len(run.size), run.first_y + r, run.first_H + run.matrix[r]
    count, says = run.rows[r], False
    f.noise[:] = 0.0
    for c in range(count):
        f.z[c], f.noise[c, c] = run.y[place, c, q], 1.0
        f.H[c, :] = 0.0
        for j in range(min(run.H.shape[2], len(record.A_j) if first > 0 else n)):
            f.H[c, first + j] = run.H[matrix, c, j, q]
            says = says or f.H[c, first + j] != 0.0
    if says:
        fuse(f, count, NAIVE)
    return says


@kernel
def use_others(record: Any, h: int, run: Any, k: int, q: int) -> bool:
    """Use the other node's readings and those of the pair; False if there are none."""
    own, r = record.payload.own[run.message[k], q] == 1, run.heard[k]
    says = bool(own and r >= 0 and use_rows(record, run, r, len(run.size), q))
    says = use_pairs(record, h, run, k, True, q) or says
    return use_pairs(record, h, run, k, False, q) or says


@kernel
def use_pairs(record: Any, h: int, run: Any, k: int, mine: bool, q: int) -> bool:
    """Use the readings of a pair that node ``h`` has taken (``mine``), or the sender of message
    ``k``, linearised at what both have told.
    """
    f, pairs, tables, n, v = (
        record.fusion, run.pairs, record.tables, len(run.size), len(record.A_j)
    )  # fmt: skip
    r, w, says = run.reading if mine else run.heard[k], run.link[k], False
    if r < 0 or len(pairs.row) == 0:
        return False
    rows, own, m = pairs.rows, pairs.own, run.message[k]
    for c in range(pairs.first[r], pairs.first[r + 1]):
        b = block_of_pair(pairs, c)
        if b < 0:
            continue
        first, size, count = tables.theirs[w, b] if mine else tables.first[h, b], 0, pairs.length[c]
        if first < 0:
            continue
        size, says = tables.size[b], True
        rows.x[:] = 0.0
        for i in range(min(own, n if mine else v)):
            rows.x[i] = record.told[h, i, q] if mine else record.payload.xhat[m, i, q]
        for i in range(size):
            other = record.payload.xhat[m, first + i, q] if mine else record.told[h, first + i, q]
            rows.x[own + i] = other
        linearise_pair(pairs, run, r, c, q)
        to, there = (0, n + first) if mine else (n, first)
        for a in range(count):
            f.z[a] = rows.value[a]
            f.H[a, :] = 0.0
            for i in range(min(own, n if mine else v)):
                f.H[a, to + i] = rows.J[a, i]
            for i in range(size):
                f.H[a, there + i] = rows.J[a, own + i]
            for d in range(count):
                f.noise[a, d] = rows.C[a, d]
        fuse(f, count, NAIVE)
    return says


@kernel
def hear(record: Any, h: int, run: Any, k: int, q: int) -> None:
    """Use at node ``h`` the readings that message ``k`` tells, the sender's own and of the pair."""
    f, n, v = record.fusion, len(run.size), len(record.A_j)
    set_own(record, h, n, q)
    for j in range(v):
        f.x[n + j] = record.other[j]
        for i in range(n):
            total = 0.0
            for c in range(n):
                total += record.moved[i, c] * record.beside[c, j]
            f.P[i, n + j] = f.P[n + j, i] = total
        for i in range(v):
            f.P[n + i, n + j] = record.beside[n + i, j]
    copy_block(f.P, 0, record.L)
    if not use_others(record, h, run, k, q):
        return
    for i in range(n):
        record.xhat[h, i, q] = f.x[i]
        for j in range(n):
            f.S[i, j], f.T[i, j] = record.L[i, j], f.P[i, j]
    # The factor by which an own reading would have multiplied the error: P after times the inverse
    # of P before, which is singular where something is known for certain.
    semidefinite_root(f.S, n)
    solve_gain(f, n)
    copy_block(f.K, 0, record.T)
    move_factors(record, h, run, record.T, run.link[k], q)
    copy_matrix(record.L, record.moved)
    write_product(record.T, record.L, False, record.moved)
    semidefinite_root(f.P, n)
    for i in range(n):
        for j in range(i + 1):
            record.root[h, i, j, q] = f.P[i, j]


@kernel
def invert(A: FloatArray, n: int, L: FloatArray, out: FloatArray) -> bool:
    """Write the inverse of the first ``n`` rows and columns of ``A`` into ``out``; False if columns
    of A, in whatever units, nearly depend on each other. ``L`` is scratch.
    """
    out[:] = 0.0
    for j in range(n):
        out[j, j] = 1.0
        for i in range(n):
            L[i, j] = A[i, j]
    for j in range(n):
        scale = column_size(A, j, n)
        for i in range(n):
            L[i, j] = A[i, j] / scale
    solve_inplace(L, out, n)
    total = 0.0
    for i in range(n):
        for j in range(n):
            total += out[i, j] * out[i, j]
    # In the norm of Frobenius; not for nan.
    if not math.sqrt(n * total) < MAX_CONDITION:
        return False
    for i in range(n):
        scale = column_size(A, i, n)
        for j in range(n):
            out[i, j] /= scale
    return True


@kernel
def column_size(A: FloatArray, j: int, n: int) -> float:
    """Return the norm of the first ``n`` entries of column ``j``."""
    total = 0.0
    for i in range(n):
        total += A[i, j] * A[i, j]
    return math.sqrt(total)


@kernel
def shift(record: Any, h: int, run: Any) -> None:
    """Move all estimates of node ``h`` with the origin."""
    shift_vector(run, record.xhat, h)
    shift_vector(run, record.told, h)


def pair_record(
    filtering: BlockCrossCovariances, infos: Sequence[NodeInfo], models: Sequence[Any]
) -> Record:
    """Return the record. A node tells ``told`` (n,) and ``told_P`` (n, n), what it knew before the
    readings of this instant, which are ``own`` until it is updated with others.

    For each neighbour, with n' states, it keeps the factors of their cross-covariance, A of its own
    and C that both share, twice: ``base`` (n, n) and ``core`` (n, n') since the time ``since`` of
    the last update known to be that of both nodes, ``last`` and ``seen`` since the last update by
    this node, at the time ``when``.
    """
    n, tables = len(models[0].information), block_tables(infos, models)
    v, links = tables.entry.shape[1], len(tables.entry)
    square, cross, ints = (n, n), (n, v), np.int64
    scratch = {
        **dict.fromkeys(("A", "T", "L", "inverse", "moved"), square),
        **dict.fromkeys(("A_j", "T_j", "L_j", "inverse_j"), (v, v)),
        **dict.fromkeys(("C", "X", "part", "seen_now"), cross),
        **{"other": (v,), "beside": (n + v, v), "column": (n,)},
    }
    heard = [sum(p.n for p in places) for info in infos for places in info.heard]
    own = [info.own_states(n) for info in infos]
    rows = max(n + v, *(info.rows for info in infos))
    return Record(
        node={"told": (n,), "told_P": square, "own": ((), ints)},
        link={
            **dict.fromkeys(("base", "last", "told_base", "told_last"), square),
            **{"core": cross, "seen": cross, "since": (), "when": ()},
        },
        link_start={
            **dict.fromkeys(("base", "last", "told_base", "told_last"), np.eye(n)),
            **{"since": NEVER, "when": NEVER},
        },
        payload={
            **{"xhat": (v,), "since": (), "when": (), "own": ((), ints)},
            **dict.fromkeys(("P", "base", "last", "core", "seen"), (v, v)),
        },
        settings={
            **{name: np.zeros(shape) for name, shape in scratch.items()},
            "tables": tables,
            "fusion": fusion_of(n + v, rows),
            "steps": filtering.steps,
            "pairs": np.array([len(info.blocks) > 0 for info in infos], dtype=ints),
            "node": np.array([info.node for info in infos], dtype=ints),
            "peer": np.resize([s for info in infos for s in info.senders] or [0], links),
            "sizes": np.array(own, dtype=ints),
            "peer_sizes": np.resize(heard or [n], links),
        },
    )


def begin_pair(_filter: BlockCrossCovariances, node: Any, _info: NodeInfo, _model: Any) -> None:
    """Tell the first estimate."""
    node["told"][:], node["told_P"][:] = node["xhat"], node["root"] @ node["root"].T


def require_both_ways(scenario: Any) -> None:
    """Raise ScenarioError if links of a ``netkf.Scenario`` go one way."""
    if scenario.topology.directed:
        rule = "must have links that go both ways for block-cross-covariances, whose nodes answer"
        remedy = 'leave directed out, or write kind = "block-intersection"'
        raise ScenarioError("network.graph.directed", rule, True, remedy)


@built_in("block-cross-covariances")
@dataclass(frozen=True, eq=False)
class BlockCrossCovariances(Filter):
    """Each node estimates a block of its own and keeps the cross-covariances with its neighbours,
    with whom it uses all that either has read at an instant, of itself and of the other.

    steps   of a slot, in which pairs take turns: nodes i and j exchange in step (i + j) % steps

    Two nodes that hear each other are the Kalman filter of both blocks; whatever is lost between
    two, P is the covariance of the error. With more nodes the cross-covariance with a third is
    approximated as if the readings of a pair had been own ones, and nothing is proved of P: the
    more pairs have nodes in common the more overconfident it is, most where they exchange at once,
    as pairs of one step do, and under clocks all of one instant. Both nodes are updated if both
    transmit at the instant of the readings; one that hears nothing then is not. A message that took
    time is used for nothing.
    """

    steps: int = field(integer(low=1, high=MAX_STEPS), default=8)

    needs = Needs(
        one_way=True,
        samples=True,
        blocks=True,
        own_blocks=True,
        memory="whose neighbours keep factors of the estimate that is forgotten",
        check=require_both_ways,
    )
    # To one receiver, of whom it says two factors and two cores.
    analysis = Analysis(
        paper="block_cross_covariances",
        affine=True,
        payload_numbers=lambda n, *_: n + n * (n + 1) // 2 + 4 * n * n,
    )
    kernels = Kernels(
        pair_record, begin_pair, predict=predict, update=update, emit=emit, absorb=absorb,
        shift=shift, means=("xhat", "told"), sends_readings=True, decides=True,
        depends_on_data=False, addressed=True,
    )  # fmt: skip

    @property
    def timing(self) -> Timing:
        """The only exchange of a slot has ``steps`` steps."""
        return Timing(steps=lambda _: self.steps)

    shift = Filter.shift  # affine in readings and messages
