"""A filter of blocks: nodes that estimate different parts of the state tell each other their
estimates, and what they read of each other.

A message has the sender's estimate, which blocks it is about, and the sender's readings of this
instant that also depend on a block of the receiver. Such a reading, ``z = H_i x_i + H_j x_j + v``,
is for receiver i an observation of x_i with the noise ``H_j (x_j - xhat_j) + v``. Blocks that both
estimate are observed by the sender's estimate of them. How errors of both correlate is not known:
``rule`` says what is assumed.

Li and Nashashibi, "Cooperative multi-vehicle localization using split covariance intersection
filter", IEEE ITS Magazine 5(2), 2013; Julier and Uhlmann, "A non-divergent estimation algorithm in
the presence of unknown correlations", ACC 1997.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from netkf.algorithms.blocks import block_tables
from netkf.algorithms.filter import Filter, NodeInfo
from netkf.algorithms.kernels.block_fusion import (
    CI,
    NAIVE,
    SPLIT,
    fuse,
    fusion_of,
    semidefinite_root,
)
from netkf.algorithms.kernels.estimates import update_by_row
from netkf.algorithms.kernels.pairs import block_of_pair, linearise_pair
from netkf.algorithms.kernels.run import copy_estimate, predict_estimate, transition, use_reading
from netkf.algorithms.records import Kernels, Record
from netkf.algorithms.registry import built_in
from netkf.algorithms.traits import Analysis, Needs, Timing
from netkf.core.fields import field, one_of
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import Lanes, load, spread, store

NAIVE_NOTE = (
    'rule = "naive" takes errors of different nodes for independent, which they are not once nodes '
    "have told each other: P is overconfident"
)
LATE_NOTE = (
    "block-intersection uses no reading of the receiver in a message that took time: P may grow; "
    "block-belief-propagation uses those of instants at which the receiver has read something too"
)
RULES = {"naive": NAIVE, "ci": CI, "split": SPLIT}


@kernel(inlined=True)
def add_covariance(
    lanes: Lanes, n: int, root: FloatArray, h: int, factor: float, out: FloatArray, k: int
) -> None:
    """Replace ``out[k]`` (n, n, L) by P + ``factor`` times itself, P that of ``root[h]``."""
    for i in range(n):
        for j in range(i + 1):
            total = factor * load(lanes, out, k, i, j)
            for m in range(j + 1):
                total += load(lanes, root, h, i, m) * load(lanes, root, h, j, m)
            store(lanes, out, k, i, j, total)
            store(lanes, out, k, j, i, total)


@kernel
def predict(record: Any, h: int, run: Any) -> None:
    """Predict node ``h``. The plant's noise is independent of others, if nobody else estimates the
    same blocks.
    """
    lanes, n, dependent = run.lanes, len(run.size), record.dependent
    if record.rule == SPLIT:
        Phi, moved = run.noise, run.moved
        transition(run.model, run, record.xhat, h, Phi)
        if record.alone[h] == 0:
            add_covariance(lanes, n, record.root, h, -1.0, dependent, h)
        for i in range(n):
            for j in range(n):
                total = spread(lanes, 0.0)
                for m in range(n):
                    total += load(lanes, Phi, i, m) * load(lanes, dependent, h, m, j)
                store(lanes, moved, i, j, total)
        for i in range(n):
            for j in range(i + 1):
                total = spread(lanes, 0.0)
                for m in range(n):
                    total += load(lanes, moved, i, m) * load(lanes, Phi, j, m)
                store(lanes, dependent, h, i, j, total)
                store(lanes, dependent, h, j, i, total)
    predict_estimate(run.model, run, record.xhat, record.root, h, h)
    if record.rule == CI:
        add_covariance(lanes, n, record.root, h, 0.0, dependent, h)
    elif record.rule == SPLIT and record.alone[h] == 0:
        add_covariance(lanes, n, record.root, h, -1.0, dependent, h)


@kernel
def update(record: Any, h: int, run: Any) -> None:
    """Use the readings of the node's own states, row by row; those of pairs go with messages."""
    lanes, n, root, D = run.lanes, len(run.size), record.root, record.dependent
    first, matrix = run.first_y + run.reading, run.first_H + run.matrix[run.reading]
    gains, row = run.moved_mean, run.gains
    for r in range(run.rows[run.reading] if record.rule == SPLIT else 0):
        variance = spread(lanes, 1.0)
        for j in range(n):
            entry = spread(lanes, 0.0)
            for i in range(j, n):
                entry += load(lanes, run.H, matrix, r, i) * load(lanes, root, h, i, j)
            store(lanes, row, j, entry)
            variance += entry * entry
        for i in range(n):
            total = spread(lanes, 0.0)
            for j in range(i + 1):
                total += load(lanes, root, h, i, j) * load(lanes, row, j)
            store(lanes, gains, i, total / variance)
        # D <- (I - g h) D (I - g h)'.
        both = spread(lanes, 0.0)
        for i in range(n):
            total = spread(lanes, 0.0)
            for j in range(n):
                total += load(lanes, run.H, matrix, r, j) * load(lanes, D, h, j, i)
            store(lanes, row, i, total)
            both += total * load(lanes, run.H, matrix, r, i)
        for i in range(n):
            for j in range(n):
                g, other = load(lanes, gains, i), load(lanes, gains, j)
                entry = load(lanes, D, h, i, j) + g * both * other
                entry -= g * load(lanes, row, j) + load(lanes, row, i) * other
                store(lanes, D, h, i, j, entry)
        scratch = (run.row, run.moved_mean)
        place = (first, matrix, r)
        update_by_row(lanes, run.size, record.xhat, root, h, run.y, run.H, place, True, scratch)
    if record.rule != SPLIT:
        use_reading(run, record.xhat, root, h, run.reading, True)
    if record.rule == CI:
        add_covariance(lanes, n, root, h, 0.0, D, h)


@kernel
def emit(record: Any, h: int, m: int, run: Any) -> None:
    """Send the estimate. What a node has told may be in errors of others from now on."""
    lanes, n, payload = run.lanes, len(run.size), record.payload
    copy_estimate(run, payload.xhat, payload.root, m, record.xhat, record.root, h, True)
    for i in range(n):
        for j in range(n):
            store(lanes, payload.dependent, m, i, j, load(lanes, record.dependent, h, i, j))
    if record.rule == SPLIT:
        add_covariance(lanes, n, record.root, h, 0.0, record.dependent, h)


@kernel
def absorb(record: Any, h: int, run: Any) -> None:
    """Use the messages of this instant one after the other, by sender."""
    for k in range(run.count):
        for q in range(len(run.lanes)):
            if run.arrived[k, q] == 1:
                hear(record, h, run, k, q)


@kernel
def hear(record: Any, h: int, run: Any, k: int, q: int) -> None:
    """Use message ``k`` of the inbox in lane ``q`` at once: the sender's error is in all of it."""
    f, tables, pairs, m, r = record.fusion, record.tables, run.pairs, run.message[k], run.heard[k]
    n, root = len(f.x), record.root
    for i in range(n):
        f.x[i] = record.xhat[h, i, q]
    set_covariances(root, record.dependent, h, q, f.P, f.dependent)
    payload = record.payload
    set_covariances(payload.root, payload.dependent, m, q, record.heard_P, record.heard_D)
    f.noise[:], f.H[:], record.weights[:] = 0.0, 0.0, 0.0
    for i in range(tables.entry.shape[1]):
        record.heard_x[i] = payload.xhat[m, i, q]
    if run.age[k] > 0.0:
        predict_sent_blocks(record, h, run, k)
    count = use_common(record, run.link[k])
    # A reading that took time is of a state that noise has moved since, which is in errors too.
    if r >= 0 and len(pairs.row) > 0 and not run.age[k] > 0.0:
        for c in range(pairs.first[r], pairs.first[r + 1]):
            block = block_of_pair(pairs, c)
            if block >= 0 and tables.first[h, block] >= 0:
                use_pair(record, h, run, (m, r, c), q, count)
                count += pairs.length[c]
    if count > 0:
        weigh_sender(record, h, count)
        fuse(f, count, record.rule)
    for i in range(n):
        record.xhat[h, i, q] = f.x[i]
        for j in range(n):
            record.dependent[h, i, j, q] = f.dependent[i, j]
    semidefinite_root(f.P, n)
    for i in range(n):
        for j in range(i + 1):
            root[h, i, j, q] = f.P[i, j]


@kernel
def set_covariances(
    root: FloatArray, dependent: FloatArray, m: int, q: int, P: FloatArray, D: FloatArray
) -> None:
    """Write P of ``root[m]`` and the ``dependent[m]`` part of it, in lane ``q``."""
    for i in range(len(P)):
        for j in range(i + 1):
            total = 0.0
            for c in range(j + 1):
                total += root[m, i, c, q] * root[m, j, c, q]
            P[i, j] = P[j, i] = total
            D[i, j] = D[j, i] = dependent[m, i, j, q]


@kernel
def predict_sent_blocks(record: Any, h: int, run: Any, k: int) -> None:
    """Predict what message ``k`` tells of blocks that both estimate to now, as node ``h`` predicts
    its own. The noise of the plant since is in the errors of both.
    """
    f, x, root, heard_P = record.fusion, record.late_x, record.late_root, record.heard_P
    entry, n, gap = record.tables.entry, len(f.x), run.gap
    x[:], f.part[:] = 0.0, 0.0
    for i in range(entry.shape[1]):
        for j in range(entry.shape[1] if entry[run.link[k], i] >= 0 else 0):
            x[0, entry[run.link[k], i], 0] = record.heard_x[i]
            if entry[run.link[k], j] >= 0:
                f.part[entry[run.link[k], i], entry[run.link[k], j]] = heard_P[i, j]
    semidefinite_root(f.part, n)
    for i in range(n):
        for j in range(n):
            root[0, i, j, 0] = f.part[i, j] if j <= i else 0.0
    run.gap = run.age[k]
    predict_estimate(run.model, run, x, root, 0, h)
    run.gap = gap
    for i in range(entry.shape[1]):
        for j in range(entry.shape[1] if entry[run.link[k], i] >= 0 else 0):
            a, b, total = entry[run.link[k], i], entry[run.link[k], j], 0.0
            record.heard_x[i] = x[0, a, 0]
            for c in range(min(a, b) + 1 if b >= 0 else 0):
                total += root[0, a, c, 0] * root[0, b, c, 0]
            heard_P[i, j] = total
            record.heard_D[i, j] = 0.0 if record.rule == NAIVE else total


@kernel
def use_common(record: Any, link: int) -> int:
    """Make the sender's estimate of common states the first observed rows; return their number."""
    f, entry, row = record.fusion, record.tables.entry, 0
    for i in range(entry.shape[1]):
        if entry[link, i] >= 0:
            f.z[row] = record.heard_x[i]
            f.H[row, entry[link, i]] = 1.0
            record.weights[row, i] = -1.0
            row += 1
    return row


@kernel
def use_pair(record: Any, h: int, run: Any, what: tuple[int, int, int], q: int, start: int) -> None:
    """Make a reading of a pair, ``what`` = (m, r, c), rows of an observation from ``start`` on."""
    f, tables, pairs, (m, r, c) = record.fusion, record.tables, run.pairs, what
    rows, own, block = pairs.rows, pairs.own, block_of_pair(pairs, c)
    first, size, count = tables.first[h, block], tables.size[block], pairs.length[c]
    rows.x[:] = 0.0
    for i in range(own):
        rows.x[i] = record.payload.xhat[m, i, q]
    # What the node knew before the message.
    for i in range(size):
        rows.x[own + i] = record.xhat[h, first + i, q]
    linearise_pair(pairs, run, r, c, q)
    for a in range(count):
        f.z[start + a] = rows.value[a]
        for i in range(own):
            f.z[start + a] -= rows.J[a, i] * record.payload.xhat[m, i, q]
            record.weights[start + a, i] = rows.J[a, i]
        for i in range(size):
            f.H[start + a, first + i] = rows.J[a, own + i]
        for b in range(count):
            f.noise[start + a, start + b] = rows.C[a, b]


@kernel
def weigh_sender(record: Any, h: int, count: int) -> None:
    """Write the covariances of ``count`` rows of an observation which have the sender's error with
    ``weights``: of its dependent part and of the other one.
    """
    f, G, width = record.fusion, record.weights, len(record.heard_x)
    for a in range(count):
        for b in range(count):
            P = D = 0.0
            for i in range(width):
                for j in range(width):
                    P += G[a, i] * record.heard_P[i, j] * G[b, j]
                    D += G[a, i] * record.heard_D[i, j] * G[b, j]
            f.heard[a, b], f.told[a, b] = D, P - D
            # Others that estimate these blocks may use the same readings.
            if record.alone[h] == 0:
                f.told[a, b], f.noise[a, b] = P - D + f.noise[a, b], 0.0


def block_record(
    filtering: BlockIntersection, infos: Sequence[NodeInfo], models: Sequence[Any]
) -> Record:
    """Return the record: what is in every node's error but may be in those of others too."""
    n, tables = len(models[0].information), block_tables(infos, models)
    width = tables.entry.shape[1]
    rows = width + max(info.rows for info in infos)
    return Record(
        node={"dependent": (n, n)},
        payload={"xhat": (width,), "root": (width, width), "dependent": (width, width)},
        settings={
            "rule": RULES[filtering.rule],
            "alone": np.array([info.alone for info in infos], dtype=np.int64),
            "tables": tables,
            "fusion": fusion_of(n, rows),
            "heard_x": np.zeros(width),
            "weights": np.zeros((rows, width)),
            "heard_P": np.zeros((width, width)),
            "heard_D": np.zeros((width, width)),
            "late_x": np.zeros((1, n, 1)),
            "late_root": np.zeros((1, n, n, 1)),
        },
    )


def begin_block(filtering: BlockIntersection, node: Any, info: NodeInfo, _model: Any) -> None:
    """Set what may depend on others at time 0: errors are independent, but for rule "ci"."""
    P = node["root"] @ node["root"].T
    # The error of a node that begins again is in those of all whom it has told before.
    is_own = filtering.rule == "split" and info.alone and not info.forgets
    node["dependent"][:] = 0.0 if is_own or filtering.rule == "naive" else P


@built_in("block-intersection")
@dataclass(frozen=True, eq=False)
class BlockIntersection(Filter):
    """Each node estimates blocks of its own with its readings, with what others read of it, and
    with what they know of blocks that both estimate.

    rule  what is assumed of errors of different nodes: "split" (default), that those parts are
          independent of all others which a node has told nobody (split covariance intersection,
          Li and Nashashibi 2013); "ci", nothing (covariance intersection); "naive", that they are
          all independent, which is wrong and makes P too small

    With "split" and "ci" P is at least the covariance of the error. The weight is that with the
    least trace of P. What a message that took time tells of blocks that both estimate is predicted
    to now; its readings are of another instant, and not used.
    """

    rule: str = field(one_of("split", "ci", "naive"), default="split")

    timing = Timing(clocks=("directions", "nodes", "readings"))

    @property
    def needs(self) -> Needs:
        """Samples; notes say what the naive rule does, and which readings are left out."""
        return Needs(one_way=True, samples=True, blocks=True, notes=self._scenario_notes)

    def _scenario_notes(self, scenario: Any) -> tuple[str, ...]:
        naive = (NAIVE_NOTE,) if self.rule == "naive" else ()
        return naive if scenario.network.channel.delay.fixed == 0.0 else (*naive, LATE_NOTE)

    @property
    def analysis(self) -> Analysis:
        """The claim that P is no smaller than the covariance of the error; none of a naive rule."""
        design = ("", "") if self.rule == "naive" else ("larger", "larger")
        return Analysis(P_by_design=design, affine=True)

    kernels = Kernels(
        block_record, begin_block, predict=predict, update=update, emit=emit, absorb=absorb,
        sends_readings=True, counts_sends=True,
    )  # fmt: skip

    shift = Filter.shift  # affine in readings and messages
