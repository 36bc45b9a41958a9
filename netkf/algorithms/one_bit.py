"""The sign-of-innovations filter: Ribeiro, Giannakis and Roumeliotis, "SOI-KF: Distributed Kalman
filtering with low-cost communications using the sign of innovations", IEEE Trans. Signal Processing
54, 2006.

In each slot one node, whose turn it is, sends the signs of the innovations of its reading, one bit
for each row, and it and all who hear it correct their estimates by these bits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from netkf.algorithms.filter import Filter, NodeInfo
from netkf.algorithms.kernels.estimates import rotate
from netkf.algorithms.kernels.run import absorb as nothing
from netkf.algorithms.records import Kernels, Record
from netkf.algorithms.registry import built_in
from netkf.algorithms.traits import Analysis, Needs, Timing
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import load, load_flags, root_of, select, spread, store

HALF_PI = math.pi / 2.0


@kernel
def has_read(run: Any, r: int) -> bool:
    """Return True if reading number ``r`` is one. A recorded sensor may have none in a slot: then y
    and H are zero, in all runs alike, so that the first lane tells.
    """
    first, matrix = run.first_y + r, run.first_H + run.matrix[r]
    for k in range(run.rows[r]):
        if run.y[first, k, 0] != 0.0:
            return True
        for i in range(len(run.size)):
            if run.H[matrix, k, i, 0] != 0.0:
                return True
    return False


@kernel
def emit_bits(record: Any, h: int, m: int, run: Any) -> None:
    """Send the signs, +1 or -1, of the innovations of node ``h``, and correct it by them."""
    lanes, r, asked = run.lanes, run.reading, load_flags(run.lanes, run.sends)
    # One node a slot: its bits refer to an estimate that all nodes share.
    if run.slot % record.nodes != int(record.turn[h, 0]) or not has_read(run, r):
        for q in range(len(lanes)):
            run.sends[q] = 0
        return
    first, matrix = run.first_y + r, run.first_H + run.matrix[r]
    for k in range(run.rows[r]):
        # Each row refers to the estimate that has used the bits of those before it.
        innovation = load(lanes, run.y, first, k)
        for i in range(len(run.size)):
            innovation -= load(lanes, run.H, matrix, k, i) * load(lanes, record.xhat, h, i)
        sign = select(innovation >= 0.0, spread(lanes, 1.0), spread(lanes, -1.0))
        store(lanes, record.payload.signs, m, k, sign)
        use_bit(record, h, run, sign, r, k, asked)


@kernel
def absorb_bits(record: Any, h: int, run: Any) -> None:
    """Correct node ``h`` by the bits that it hears."""
    for k in range(run.count):
        r, arrived = run.heard[k], load_flags(run.lanes, run.arrived, k)
        for i in range(run.rows[r]):
            sign = load(run.lanes, record.payload.signs, run.message[k], i)
            use_bit(record, h, run, sign, r, i, arrived)


@kernel
def use_bit(record: Any, h: int, run: Any, sign: Any, r: int, k: int, arrived: Any) -> None:
    """Correct node ``h`` by the ``sign`` (L,) of the innovation of row ``k``, where ``arrived``.

    The paper's update with noise variance 1 is ``x + sqrt(2 / pi) P h' / sqrt(p + 1) sign`` and
    ``P - (2 / pi) P h' h P / (p + 1)`` with ``p = h P h'``. The latter is a Kalman update with
    noise ``r = (pi / 2 - 1) p + pi / 2``, and the former its gain times
    ``sqrt(pi / 2 (p + 1)) sign``.
    """
    lanes, n, row, gains = run.lanes, len(run.size), run.row, run.gains
    matrix = run.first_H + run.matrix[r]
    # ``row`` becomes h S with P = S S', and ``square`` p = h P h'.
    square = spread(lanes, 0.0)
    for j in range(n):
        total = spread(lanes, 0.0)
        for i in range(j, n):
            total += load(lanes, run.H, matrix, k, i) * load(lanes, record.root, h, i, j)
        # Zeros in lanes where it has not arrived: a row of zeros changes nothing.
        total = select(arrived, total, 0.0)
        square += total * total
        store(lanes, row, j, total)
    # ``row`` becomes h S / sqrt(r): an observation of unit noise.
    scale = 1.0 / root_of((HALF_PI - 1.0) * square + HALF_PI)
    for j in range(n):
        store(lanes, row, j, scale * load(lanes, row, j))
    inverse_deviation = rotate(lanes, run.size, record.root, h, row, gains)
    step = sign * inverse_deviation * scale * root_of(HALF_PI * (square + 1.0))
    for i in range(n):
        x = load(lanes, record.xhat, h, i)
        store(lanes, record.xhat, h, i, x + load(lanes, gains, i) * step)


def one_bit_record(_: Any, infos: Sequence[NodeInfo], _models: Sequence[Any]) -> Record:
    """Return the turns of nodes, and signs in messages."""
    return Record(
        node={"turn": ()}, payload={"signs": (infos[0].rows,)}, settings={"nodes": infos[0].nodes}
    )


def begin_one_bit(_: Any, node: Mapping[str, np.ndarray], info: NodeInfo, _model: Any) -> None:
    """Set the node's turn: slots k with ``k % nodes == turn``."""
    node["turn"][...] = info.place


@built_in("one-bit")
@dataclass(frozen=True, eq=False)
class OneBit(Filter):
    """Nodes take turns: in slot k the node of index k mod N broadcasts the signs of its
    innovations, one bit for each row of its reading, and all who hear it correct by them,
    ``xhat + sqrt(2 / pi) P h' / sqrt(h P h' + r) b`` and ``P - (2 / pi) P h' h P / (h P h' + r)``
    for the sign b of a row h of H with noise variance r.

    It is the paper's filter if all nodes receive all bits. A node that misses some continues with
    another estimate, to which later bits do not refer. Readings enter as bits only, also the
    node's own.
    """

    analysis = Analysis(paper="one_bit", payload_numbers=lambda _, rows, __: rows / 64.0)
    timing = Timing(clocks=())
    needs = Needs(one_way=True, reads_what_it_sends=True)
    kernels = Kernels(
        update=nothing,  # a reading is used as bits, in the turn of its node
        emit=emit_bits,
        absorb=absorb_bits,
        shift_payload=nothing,
        decides=True,
        sends_readings=True,
        record=one_bit_record,
        begin=begin_one_bit,
    )

    shift = Filter.shift  # signs of innovations do not depend on the origin
