"""A filter of coupled blocks: each node estimates its own, and takes what its neighbours tell of
theirs for inputs with a covariance.

A block moves by ``x_a' = A_aa x_a + sum_b A_ab x_b + w_a``. Its owner knows estimates of all x_b,
and bounds P_b of the covariances of their errors, but not how these errors correlate. For any
weights that sum to one

    P_a' = sum_b (1 / weight_b) A_ab P_b A_ab' + Q_a

is a bound again, with b = a among them. The weights here are those with the least trace, in
proportion to the root of the trace of ``A_ab P_b A_ab'``; without coupling it is a Kalman filter's.

A node keeps the whole state, its own blocks first. Its *groups* are its own blocks, and then all
blocks of each other owner; nothing is known of how errors of two groups correlate.

Farina, Ferrari-Trecate and Scattolini, "Moving-horizon partition-based state estimation of
large-scale systems", Automatica 46(5), 2010; Khan and Moura, "Distributing the Kalman filter for
large-scale systems", IEEE Trans. Signal Processing 56(10), 2008.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from netkf.algorithms.filter import Filter, NodeInfo
from netkf.algorithms.kernels.block_fusion import (
    CI,
    NAIVE,
    NO_GAIN,
    fuse,
    fusion_of,
    multiply_in_place,
    semidefinite_root,
)
from netkf.algorithms.kernels.run import predict_estimate, shift_vector, transition
from netkf.algorithms.records import Kernels, Record, estimate_shapes
from netkf.algorithms.registry import built_in
from netkf.algorithms.traits import Analysis, Needs
from netkf.core.errors import ScenarioError
from netkf.core.places import Key, Place
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.structs import Struct


class Groups(Struct):
    """The groups of K states of N entries.

    number, count : (K, N), that of each entry, and (K,), how many there are
    member, first : (K, N), the entries by group; those of group g begin with ``first[k, g]``
    """

    number: IntArray
    count: IntArray
    member: IntArray
    first: IntArray


def groups_of(number: IntArray) -> Groups:
    """Return the groups with these numbers (K, N)."""
    count = 1 + number.max(axis=1, initial=0)
    ends = np.arange(number.shape[1] + 1)
    first = [np.searchsorted(np.sort(row), ends) for row in number]
    return Groups(
        number=number,
        count=count,
        member=np.argsort(number, axis=1, kind="stable"),
        first=np.array(first, dtype=np.int64).reshape(len(number), -1),
    )


@kernel
def set_gap(record: Any, h: int, run: Any) -> None:
    """Write how node ``h`` moves over ``run.gap`` seconds into ``T`` and the noise ``W`` (N, N)."""
    n, root = len(record.T), record.moved_root
    transition(run.model, run, record.x, h, run.noise)
    for i in range(n):
        for j in range(n):
            record.T[i, j] = run.noise[i, j, 0]
    record.moved_x[:], root[:] = 0.0, 0.0
    predict_estimate(run.model, run, record.moved_x, root, 0, h)
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for c in range(j + 1):
                total += root[0, i, c, 0] * root[0, j, c, 0]
            record.W[i, j] = record.W[j, i] = total


@kernel
def equal_in_lanes(A: FloatArray, k: int) -> bool:
    """Return True if the matrix ``A[k]`` (n, n, L) is the same in all lanes."""
    for i in range(A.shape[1]):
        for j in range(A.shape[2]):
            for q in range(1, A.shape[3]):
                if A[k, i, j, q] != A[k, i, j, 0]:
                    return False
    return True


@kernel
def move_vector(T: FloatArray, x: FloatArray, h: int, scratch: FloatArray) -> None:
    """Multiply ``x[h]`` (N, L) by ``T``."""
    n = len(T)
    for q in range(x.shape[2]):
        for i in range(n):
            scratch[i] = x[h, i, q]
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += T[i, j] * scratch[j]
            x[h, i, q] = total


@kernel
def copy_lane(A: FloatArray, h: int, q: int, end: int) -> None:
    """Copy the matrix ``A[h]`` of lane ``q`` to those up to ``end``."""
    for p in range(q + 1, end):
        for i in range(A.shape[1]):
            for j in range(A.shape[2]):
                A[h, i, j, p] = A[h, i, j, q]


@kernel
def move_covariance(record: Any, P: FloatArray, h: int, q: int) -> None:
    """Replace ``P[h]`` by ``T P T' + W`` in lane ``q``."""
    T, row, n = record.T, record.row, len(record.T)
    multiply_in_place(P, h, T, row, q)
    for i in range(n):
        for j in range(n):
            row[j] = P[h, i, j, q]
        for j in range(i + 1):
            total = record.W[i, j]
            for c in range(n):
                total += row[c] * T[j, c]
            P[h, i, j, q] = total
    for i in range(n):
        for j in range(i):
            P[h, j, i, q] = P[h, i, j, q]


@kernel
def size_of_term(record: Any, groups: Groups, k: int, g: int, other: int) -> float:
    """Return the root of the trace of the covariance that group ``other`` brings into ``g``."""
    Phi, bounds, total = record.Phi_now, record.bounds_now, 0.0
    for c in range(groups.first[k, g], groups.first[k, g + 1]):
        i = groups.member[k, c]
        for d in range(groups.first[k, other], groups.first[k, other + 1]):
            a = groups.member[k, d]
            for e in range(groups.first[k, other], groups.first[k, other + 1]):
                b = groups.member[k, e]
                total += Phi[i, a] * bounds[a, b] * Phi[i, b]
    return math.sqrt(max(0.0, total))


@kernel
def add_term(
    record: Any, groups: Groups, k: int, g: int, other: int, factor: float, P: FloatArray
) -> None:
    """Add the covariance that group ``other`` brings into ``g``, times ``factor``, to ``P``."""
    Phi, bounds, row = record.Phi_now, record.bounds_now, record.row
    start, end = groups.first[k, other], groups.first[k, other + 1]
    for c in range(groups.first[k, g], groups.first[k, g + 1]):
        i = groups.member[k, c]
        for e in range(start, end):
            b, row[e] = groups.member[k, e], 0.0
            for d in range(start, end):
                a = groups.member[k, d]
                row[e] += factor * Phi[i, a] * bounds[a, b]
        for d in range(groups.first[k, g], c + 1):
            j = groups.member[k, d]
            for e in range(start, end):
                P[i, j] += row[e] * Phi[j, groups.member[k, e]]
            P[j, i] = P[i, j]


@kernel
def bound_after(record: Any, groups: Groups, k: int, g: int, P: FloatArray) -> None:
    """Write into the entries of ``P`` of group ``g`` of number ``k`` of ``groups`` the bound of its
    covariance of least trace, after a move by ``Phi_now`` with ``Q_now`` from ``bounds_now``.
    """
    sizes, total, own = record.sizes, 0.0, groups.member[k]
    for other in range(groups.count[k]):
        sizes[other] = size_of_term(record, groups, k, g, other)
        total += sizes[other]
    for c in range(groups.first[k, g], groups.first[k, g + 1]):
        for d in range(groups.first[k, g], groups.first[k, g + 1]):
            P[own[c], own[d]] = record.Q_now[own[c], own[d]]
    for other in range(groups.count[k]):
        if sizes[other] > 0.0:
            add_term(record, groups, k, g, other, total / sizes[other], P)


@kernel
def predict(record: Any, h: int, run: Any) -> None:
    """Predict node ``h``. Bounds follow from those at the last use in one step, so that they do not
    depend on how often somebody looks.
    """
    set_gap(record, h, run)
    T, L, same = record.T, len(run.lanes), equal_in_lanes(record.bounds, h)
    move_vector(T, record.x, h, record.row)
    move_vector(T, record.start_x, h, record.row)
    same = same and equal_in_lanes(record.Phi, h) and equal_in_lanes(record.Q, h)
    # Runs in which the same has happened have the same covariances, which take most of the time.
    step = L if same else 1
    for q in range(0, L, step):
        multiply_in_place(record.Phi, h, T, record.row, q)
        move_covariance(record, record.Q, h, q)
        move_covariance(record, record.start_P, h, q)
        find_present(record, h, q, q + step)
        copy_lane(record.Phi, h, q, q + step)
        copy_lane(record.Q, h, q, q + step)
        copy_lane(record.start_P, h, q, q + step)


@kernel
def find_present(record: Any, h: int, q: int, end: int) -> None:
    """Write the estimate of each group now: by what was used last, or, where that has become worse,
    by what was known at the start. Covariances are those of lane ``q``, in all up to ``end``.
    """
    n, groups, P = len(record.T), record.groups, record.now_P
    for i in range(n):
        for p in range(q, end):
            record.now_x[i, p] = record.x[h, i, p]
        for j in range(n):
            record.Phi_now[i, j], record.Q_now[i, j] = record.Phi[h, i, j, q], record.Q[h, i, j, q]
            record.bounds_now[i, j] = record.bounds[h, i, j, q]
    P[:] = 0.0
    for g in range(groups.count[h]):
        bound_after(record, groups, h, g, P)
        own = groups.member[h, groups.first[h, g] : groups.first[h, g + 1]]
        trace = known = 0.0
        for i in own:
            trace += P[i, i]
            known += record.start_P[h, i, i, q]
        if trace > known:
            for i in own:
                for p in range(q, end):
                    record.now_x[i, p] = record.start_x[h, i, p]
                for j in own:
                    P[i, j] = record.start_P[h, i, j, q]
    write_estimate(record, h, q, end)


@kernel
def write_estimate(record: Any, h: int, q: int, end: int) -> None:
    """Make the estimates of all groups, ``now_x`` and ``now_P``, those of node ``h``."""
    n, root = len(record.T), record.term
    for i in range(n):
        for p in range(q, end):
            record.xhat[h, i, p] = record.now_x[i, p]
        for j in range(n):
            root[i, j] = record.now_P[i, j]
    semidefinite_root(root, n)
    for i in range(n):
        for j in range(n):
            record.root[h, i, j, q] = root[i, j] if j <= i else 0.0
    copy_lane(record.root, h, q, end)


@kernel
def read_estimate(
    x: FloatArray, root: FloatArray, place: tuple[int, int, int], order: np.ndarray,
    group: np.ndarray, out: tuple[FloatArray, FloatArray],
) -> None:  # fmt: skip
    """Write estimate number m and the bounds within each ``group`` (N,) into ``out``, of the lanes
    from q up to ``end``, ``place`` = (m, q, end); component i is number ``order[i]``.
    """
    (m, q, end), (means, P), n = place, out, len(order)
    for i in range(n):
        for p in range(q, end):
            means[i, p] = x[m, order[i], p]
        for j in range(n):
            a, b, total = order[i], order[j], 0.0
            for c in range(min(a, b) + 1 if group[i] == group[j] else 0):
                total += root[m, a, c, q] * root[m, b, c, q]
            P[i, j] = total


@kernel
def begin_anew(record: Any, h: int, q: int, end: int) -> None:
    """Let node ``h`` go on from the estimates of all groups now."""
    for i in range(len(record.T)):
        for p in range(q, end):
            record.x[h, i, p] = record.now_x[i, p]
            for j in range(len(record.T)):
                record.bounds[h, i, j, p] = record.now_P[i, j]
                record.Phi[h, i, j, p], record.Q[h, i, j, p] = 1.0 if i == j else 0.0, 0.0
    write_estimate(record, h, q, end)


@kernel
def take_group(record: Any, h: int, g: int) -> int:
    """Make the estimate of group ``g`` the one to be updated; return the number of its states."""
    f, groups, at = record.fusion, record.groups, record.at
    f.n = groups.first[h, g + 1] - groups.first[h, g]
    for i in range(f.n):
        at[i] = groups.member[h, groups.first[h, g] + i]
    for i in range(f.n):
        for j in range(f.n):
            f.P[i, j] = record.now_P[at[i], at[j]]
    return int(f.n)


@kernel
def update_group(record: Any, count: int, q: int, end: int) -> None:
    """Update the group taken with ``count`` rows, whose errors with the covariance ``heard`` may
    correlate with that of the group.
    """
    f, at, z, x = record.fusion, record.at, record.z, record.now_x
    correlated = False
    for c in range(count):
        for d in range(count):
            f.told[c, d] = 0.0
            correlated = correlated or f.heard[c, d] != 0.0
    for i in range(f.n):
        for j in range(f.n):
            f.dependent[i, j] = f.P[i, j] if correlated else 0.0
    if not fuse(f, count, CI if correlated else NAIVE):
        return
    for p in range(q, end):
        for c in range(count):
            for i in range(f.n):
                z[c, p] -= f.H[c, i] * x[at[i], p]
        for i in range(f.n):
            for c in range(count):
                x[at[i], p] += f.K[i, c] * z[c, p]
    for i in range(f.n):
        for j in range(f.n):
            record.now_P[at[i], at[j]] = f.P[i, j]


@kernel
def update(record: Any, h: int, run: Any) -> None:
    """Use readings of own blocks, and those of these and another group together, as observations
    of the own blocks with the error of the other group.
    """
    r, group, L = run.reading, record.groups.number[h], len(run.lanes)
    place, matrix = run.first_y + r, run.first_H + run.matrix[r]
    # run.H may be that of all runs.
    step = L if equal_in_lanes(record.root, h) and equal_in_lanes(run.H, matrix) else 1
    for q in range(0, L, step):
        end, says = q + step, False
        for g in range(record.groups.count[h]):
            count = 0
            for c in range(run.rows[r]):
                if group_of_row(run, matrix, c, q, group) == g:
                    if not says:
                        order, out = record.order, (record.now_x, record.now_P)
                        read_estimate(record.xhat, record.root, (h, q, end), order, group, out)
                        says = True
                    add_row(record, run, (place, matrix, c), (q, end), group, count)
                    count += 1
            if count > 0:
                update_own_blocks(record, h, g, count)
                update_group(record, count, q, end)
        if says:
            begin_anew(record, h, q, end)


@kernel
def group_of_row(run: Any, matrix: int, c: int, q: int, group: np.ndarray) -> int:
    """Return the other group on which row ``c`` depends, 0 for none, -1 if it says nothing."""
    found = -1
    for i in range(len(group)):
        if run.H[matrix, c, i, q] != 0.0:
            found = max(found, group[i])
    return found


@kernel
def add_row(
    record: Any, run: Any, which: tuple[int, int, int], lanes: tuple[int, int],
    group: np.ndarray, k: int,
) -> None:  # fmt: skip
    """Make a row of a reading number ``k`` of an observation, with its part in other groups."""
    f, (place, matrix, c), own, (q, end) = record.fusion, which, 0, lanes
    for p in range(q, end):
        record.z[k, p] = run.y[place, c, p]
    for i in range(len(group)):
        entry = run.H[matrix, c, i, q]
        record.others[k, i] = entry if group[i] > 0 else 0.0
        if group[i] == 0:
            f.H[k, own] = entry
            own += 1
        for p in range(q, end if group[i] > 0 else q):
            record.z[k, p] -= entry * record.now_x[i, p]


@kernel
def update_own_blocks(record: Any, h: int, g: int, count: int) -> None:
    """Let the own blocks be updated with ``count`` white rows that depend on group ``g``, too."""
    f, others, n = record.fusion, record.others, len(record.T)
    for c in range(count):
        for d in range(count):
            f.heard[c, d] = 0.0
            f.noise[c, d] = 1.0 if c == d else 0.0
            for i in range(n if g > 0 else 0):
                for j in range(n if others[c, i] != 0.0 else 0):
                    f.heard[c, d] += others[c, i] * record.now_P[i, j] * others[d, j]
    take_group(record, h, 0)


@kernel
def absorb(record: Any, h: int, run: Any) -> None:
    """Use the messages of this instant one after the other, by sender."""
    L, same = len(run.lanes), equal_in_lanes(record.root, h)
    for k in range(run.count):
        for q in range(1, L):
            same = same and run.arrived[k, q] == run.arrived[k, 0]
        same = same and equal_in_lanes(record.payload.root, run.message[k])
    step = L if same else 1
    for q in range(0, L, step):
        says = False
        for k in range(run.count):
            if run.arrived[k, q] == 1:
                if not says:
                    out, place = (record.now_x, record.now_P), (h, q, q + step)
                    order, group = record.order, record.groups.number[h]
                    read_estimate(record.xhat, record.root, place, order, group, out)
                    says = True
                hear(record, h, run, k, q, q + step)
        if says:
            begin_anew(record, h, q, q + step)


@kernel
def hear(record: Any, h: int, run: Any, k: int, q: int, end: int) -> None:
    """Use message ``k``: what its sender has of its own blocks, predicted to now."""
    m, w, payload, x, P = (
        run.message[k], run.link[k], record.payload, record.heard_x, record.heard_P
    )  # fmt: skip
    told, place = record.told.number[w], (m, q, end)
    read_estimate(payload.xhat, payload.root, place, record.theirs[w], told, (x, P))
    if run.age[k] > 0.0:
        predict_sender(record, h, run, k)
    f, at, common = record.fusion, record.at, record.common
    for g in range(record.groups.count[h]):
        size, count, heard = take_group(record, h, g), 0, 0.0
        for i in range(size):
            if told[at[i]] == 0:
                common[count] = at[i]
                for j in range(size):
                    f.H[count, j] = 1.0 if i == j else 0.0
                count += 1
        for c in range(count):
            heard += P[common[c], common[c]]
            for p in range(q, end):
                record.z[c, p] = x[common[c], p]
            for d in range(count):
                f.heard[c, d], f.noise[c, d] = P[common[c], common[d]], 0.0
        if count > 0:
            update_group(record, count, q, end)
        if count == size:
            replace_group(record, size, heard, q, end)


@kernel
def replace_group(record: Any, size: int, heard: float, q: int, end: int) -> None:
    """Replace what is known of the group by what was told, if its trace ``heard`` is less."""
    at, before = record.at, 0.0
    for i in range(size):
        before += record.now_P[at[i], at[i]]
    for i in range(size if heard < (1.0 - NO_GAIN) * before else 0):
        for p in range(q, end):
            record.now_x[at[i], p] = record.heard_x[at[i], p]
        for j in range(size):
            record.now_P[at[i], at[j]] = record.heard_P[at[i], at[j]]


@kernel
def predict_sender(record: Any, h: int, run: Any, k: int) -> None:
    """Predict what message ``k`` tells to now, with what its sender has of other blocks."""
    x, P, gap, n = record.heard_x, record.heard_P, run.gap, len(record.T)
    run.gap = run.age[k]
    set_gap(record, h, run)
    run.gap = gap
    for i in range(n):
        record.row[i] = x[i, 0]
        for j in range(n):
            record.Phi_now[i, j], record.Q_now[i, j] = record.T[i, j], record.W[i, j]
            record.bounds_now[i, j] = P[i, j]
    for i in range(n):
        x[i, 0] = 0.0
        for j in range(n):
            x[i, 0] += record.T[i, j] * record.row[j]
    bound_after(record, record.told, run.link[k], 0, P)


@kernel
def shift(record: Any, h: int, run: Any) -> None:
    """Move all estimates of node ``h`` with the origin."""
    shift_vector(run, record.xhat, h)
    shift_vector(run, record.x, h)
    shift_vector(run, record.start_x, h)


def partition_record(_: Any, infos: Sequence[NodeInfo], models: Sequence[Any]) -> Record:
    """Return the record. A node keeps, besides the estimates of all groups now, what it last used:
    ``x`` (N,), predicted to now, and the ``bounds`` (N, N) of that time, 0 between groups, with
    ``Phi`` and ``Q`` of the time since; and what is known of the start, predicted to now.
    """
    n = len(models[0].information)
    square = (n, n)
    orders = [_blocks_in_order(info.blocks, info.whole, n) for info in infos]
    pairs = list(zip(infos, orders, strict=True))
    theirs, told = list[np.ndarray](), list[np.ndarray]()
    for info, order in pairs:
        for blocks in info.heard or ((),) * (len(infos) == 1):
            sent = _blocks_in_order(blocks, info.whole, n)
            numbers, of_sender = np.zeros(n, dtype=np.int64), _groups(blocks, sent, n)
            for key, entries in order.items():
                numbers[entries] = sent[key]
            theirs.append(numbers)
            told.append(of_sender[numbers])
    rows = max(n, *(info.rows for info in infos))
    return Record(
        node={
            **dict.fromkeys(("x", "start_x"), (n,)),
            **dict.fromkeys(("bounds", "Phi", "Q", "start_P"), square),
        },
        payload=estimate_shapes(n),
        scratch={
            **dict.fromkeys(("now_x", "heard_x"), (n,)),
            **{"moved_x": (1, n), "moved_root": (1, n, n), "z": (rows,)},
        },
        settings={
            "groups": groups_of(np.array([_groups(i.blocks, order, n) for i, order in pairs])),
            "theirs": np.reshape(theirs, (-1, n)).astype(np.int64),
            "told": groups_of(np.reshape(told, (-1, n)).astype(np.int64)),
            "order": np.arange(n),
            "fusion": fusion_of(n, rows),
            "others": np.zeros((rows, n)),
            **{name: np.zeros(n, dtype=np.int64) for name in ("at", "common")},
            **{name: np.zeros(n) for name in ("row", "sizes")},
            **{
                name: np.zeros(square)
                for name in ("T", "W", "Phi_now", "Q_now", "bounds_now", "term", "now_P", "heard_P")
            },
        },
    )


def _blocks_in_order(own: Sequence[Place], whole: Sequence[Place], n: int) -> dict[Key, np.ndarray]:
    """Return the entries of each block in the state of a node: its ``own`` ones come first."""
    blocks = own or whole or (Place("plant", None, 0, n),)
    keys = {place.key for place in blocks}
    found, first = dict[Key, np.ndarray](), 0
    for place in (*blocks, *(place for place in whole if place.key not in keys)):
        found[place.key] = np.arange(first, first + place.n)
        first += place.n
    return found


def _groups(own: Sequence[Place], order: dict[Key, np.ndarray], n: int) -> np.ndarray:
    """Return the number of the group of each entry: 0 for ``own`` blocks, then by owner."""
    numbers: dict[Any, int] = {}
    keys, group = {place.key for place in own} or set(order), np.zeros(n, dtype=np.int64)
    for key, entries in order.items():
        if key not in keys:
            owner = key if key[1] < 0 else key[1]
            group[entries] = numbers.setdefault(owner, 1 + len(numbers))
    return group


def begin_partition(_filter: Partition, node: Any, info: NodeInfo, _model: Any) -> None:
    """Set what is known at time 0."""
    n = len(node["xhat"])
    group = _groups(info.blocks, _blocks_in_order(info.blocks, info.whole, n), n)
    node["x"][:] = node["start_x"][:] = node["xhat"]
    node["start_P"][:] = node["root"] @ node["root"].T
    node["bounds"][:] = np.where(group[:, None] == group, node["start_P"], 0.0)
    node["Phi"][:] = np.eye(n)


def refuse_points_of_pairs(scenario: Any) -> None:
    """Raise ScenarioError where sigma points would make each row of a reading of several other
    nodes depend on all of them: how their errors correlate is not known.
    """
    method = scenario.filter.linearise
    if method == "ekf":
        return
    for k, node in enumerate(scenario.nodes):
        for placed in scenario.placed_sensors.get(node, ()):
            inside = np.isin(scenario.support(placed), scenario.view(k)).all()
            if inside or scenario.sensors[placed.entry].linear:
                continue
            rule = (
                f'must be "ekf" for the partition filter where node {node} reads blocks of others'
            )
            raise ScenarioError("filter.linearise", rule, method, "write that")


@built_in("partition")
@dataclass(frozen=True, eq=False)
class Partition(Filter):
    """Each node estimates blocks of its own that others drive, see the module.

    Of a block that it does not estimate a node has what a neighbour told last, predicted by the
    plant, which all nodes know with its inputs and changes; while messages are lost the bound
    grows. Before it has heard of a block, and wherever the bound has become worse than that, it
    has what was known at the start, predicted. What two nodes both estimate, and readings of blocks
    of the node and of one other owner, are used by covariance intersection. P is never below the
    covariance of the error. Messages that took time are predicted to the present with what the
    sender has of other blocks.
    """

    needs = Needs(
        one_way=True, samples=True, blocks=True, coupled=True, linear_plant=True,
        check=refuse_points_of_pairs,
    )  # fmt: skip
    analysis = Analysis(P_by_design=("larger", "larger"), affine=True)
    kernels = Kernels(
        partition_record, begin_partition, predict=predict, update=update, absorb=absorb,
        shift=shift, means=("xhat", "x", "start_x"),
    )  # fmt: skip
    shift = Filter.shift  # affine in readings and messages
