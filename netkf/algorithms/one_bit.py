"""The sign-of-innovations filter: Ribeiro, Giannakis and Roumeliotis, "SOI-KF: Distributed Kalman
filtering with low-cost communications using the sign of innovations", IEEE Trans. Signal Processing
54, 2006.

In each slot one node, whose turn it is, sends the signs of the innovations of its reading, one bit
for each row, and it and all who hear it correct their estimates by these bits.

Kernels simulate L runs at once (lanes, the last axis) in B blocks, with the structs of
``kernels.slots``: ``nodes`` (estimates and roots of H filters), ``readings`` (whitened, so that
noise has variance 1), ``plan`` (the events of S slots), ``links``, ``samples`` (output) and
``scratch``. Estimates are relative to an origin near the true state, which moves in some slots
(``rebase``, ``shift``), so that large states cost no digits. A kernel ``*_single`` runs one node
in one run, for the SimPy engine: both engines round alike.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from netkf.algorithms.filter import Exchange, Filter, Message, NodeInfo, Reading
from netkf.algorithms.kernels.slots import (
    ARRIVING,
    SENDING,
    ReadingBlock,
    SlotLinks,
    SlotNodes,
    SlotPlan,
    SlotSamples,
    SlotScratch,
    block_of_reading,
    drop_silent,
    predict_all,
    rebase,
    rotate_lanes,
    store_sample_of_slot,
    whiten_reading,
)
from netkf.algorithms.models import first_root
from netkf.algorithms.registry import built_in
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import (
    LANES,
    ONE,
    Lanes,
    aligned,
    any_lane,
    load,
    load_flags,
    root_of,
    select,
    spread,
    store,
)

HALF_PI = math.pi / 2.0


class Bits(NamedTuple):
    """A payload: ``signs`` (p,) of the innovations of a reading's rows, and the whitened rows
    ``H`` (p, n) of the sensor, which all nodes know.
    """

    signs: FloatArray
    H: FloatArray


class OneBitState(NamedTuple):
    """The state of a node.

    xhat, root : estimate (n,) and root (n, n) of its covariance P
    model : of the plant and the node's sensors
    reading : the node's own reading of this slot, or None
    turn, nodes : the node sends in slots k with ``k % nodes == turn``
    """

    xhat: FloatArray
    root: FloatArray
    model: Any
    reading: Reading | None
    turn: int
    nodes: int

    @property
    def P(self) -> FloatArray:
        """The covariance ``root root'`` (n, n) of the estimate."""
        return self.root @ self.root.T


class BitArrays(NamedTuple):
    """Scratch for L runs: the ``signs`` (p, L) of the innovations that are sent in a slot."""

    signs: FloatArray


@kernel
def one_bit_slots(
    nodes: SlotNodes,
    readings: ReadingBlock,
    plan: SlotPlan,
    links: SlotLinks,
    samples: SlotSamples,
    scratch: SlotScratch,
    arrays: BitArrays,
) -> None:
    """Simulate H sign-of-innovations filters over the S slots of a plan, in B blocks of L runs: in
    each slot they predict, and the node whose turn it is corrects itself and those who hear it by
    its bits.

    Changes ``nodes.xhat`` (B, H, n, L) and ``nodes.root`` (B, H, n, n, L) in place, writes 0 into
    ``plan.sent`` and ``plan.up`` for messages that are not sent, and writes ``samples``.
    ``plan.part`` says which part of a slot is simulated: up to the messages that are sent
    (SENDING), from their arrival on (ARRIVING), or both.
    """
    for b in range(plan.up.shape[0]):
        for s in range(plan.up.shape[1]):
            # One node a slot: its bits refer to an estimate that all nodes share.
            turn = (plan.first + s) % len(nodes.rows)
            if plan.exchanged[s] and plan.part != ARRIVING:
                silence_others(plan, readings, nodes.rows, turn, b, s)
                drop_silent(plan, links, b, s, 0)
            if plan.part == SENDING:
                continue
            if plan.sensed[s]:
                predict_all(nodes, scratch, b)
                share_bits(nodes, readings, plan, links, scratch, arrays, turn, b, s)
            store_sample_of_slot(nodes, plan, samples, scratch, b, s)
            rebase(nodes, readings, scratch, b, s)


@kernel
def silence_others(
    plan: SlotPlan, readings: ReadingBlock, rows: np.ndarray, turn: int, b: int, s: int
) -> None:
    """Write 0 into ``plan.sent[b, s, 0]`` (H, L) for all nodes but the one with index ``turn``, and
    for that one too if it has no reading in slot ``s`` of block ``b``; ``rows`` (H,) are the rows
    of each node's reading.

    Axes: H filters, L runs side by side.
    """
    for h in range(plan.sent.shape[3]):
        if h != turn or not has_read(readings, rows[h], b, s, h):
            for q in range(plan.sent.shape[4]):
                plan.sent[b, s, 0, h, q] = 0


@kernel
def has_read(readings: ReadingBlock, rows: int, b: int, s: int, h: int) -> bool:
    """Return True if filter ``h`` of block ``b``, with ``rows`` rows, has a reading in slot ``s``.

    A recorded sensor may have none in a slot: then y and H are zero, in all runs alike, so that
    the first lane tells.
    """
    # A fixed H has one block and one slot.
    c, t = min(b, readings.H.shape[0] - 1), min(s, readings.H.shape[1] - 1)
    for k in range(rows):
        if readings.y[b, s, h, k, 0] != 0.0:
            return True
        for i in range(readings.H.shape[4]):
            if readings.H[c, t, h, k, i, 0] != 0.0:
                return True
    return False


@kernel
def has_links(links: SlotLinks, h: int) -> bool:
    """Return True if a link begins or ends at filter ``h``: only then is it asked for messages, and
    uses its own bits.
    """
    linked = links.first[h] < links.first[h + 1]
    for m in range(len(links.sender)):
        linked |= links.sender[m] == h
    return bool(linked)


@kernel
def share_bits(
    nodes: SlotNodes,
    readings: ReadingBlock,
    plan: SlotPlan,
    links: SlotLinks,
    scratch: SlotScratch,
    arrays: BitArrays,
    turn: int,
    b: int,
    s: int,
) -> None:
    """Compute the bits of the node with index ``turn`` in slot ``s`` of block ``b``, and correct it
    and the nodes that hear it by them.

    Changes ``nodes.xhat[b]`` (H, n, L) and ``nodes.root[b]`` (H, n, n, L) of these nodes;
    ``arrays.signs`` are the bits. Axes: H filters, L runs side by side.
    """
    lanes, rows = scratch.lanes, nodes.rows[turn]
    # ``sent`` does not matter: a node uses its own bits even if a trigger keeps it silent.
    if not has_links(links, turn) or not has_read(readings, rows, b, s, turn):
        return
    send_bits(
        lanes, nodes.xhat, nodes.root, b, turn, rows, readings, s, arrays.signs, scratch.row,
        scratch.gains,
    )  # fmt: skip
    for m in range(len(links.sender)):
        if links.sender[m] != turn:
            continue
        arrived = load_flags(lanes, plan.up, b, s, 0, links.direction[m])
        for h in range(len(nodes.rows)):
            if any_lane(arrived) and links.first[h] <= m < links.first[h + 1]:
                for k in range(rows):
                    use_bit(
                        lanes, nodes.xhat, nodes.root, b, h, load(lanes, arrays.signs, k),
                        readings, (s, turn, k), arrived, scratch.row, scratch.gains,
                    )  # fmt: skip


@kernel
def send_bits(
    lanes: Lanes,
    x: FloatArray,
    root: FloatArray,
    b: int,
    h: int,
    rows: int,
    readings: ReadingBlock,
    s: int,
    signs: FloatArray,
    row: FloatArray,
    gains: FloatArray,
) -> None:
    """Write the ``signs`` (p, L), +1 or -1, of the innovations of filter ``h`` in slot ``s`` of
    block ``b``, and correct the filter by them: changes ``x[b, h]`` of x (B, H, n, L) and
    ``root[b, h]`` of root (B, H, n, n, L). ``rows`` rows of its reading count; ``row`` and
    ``gains`` (n, L) are scratch.

    Axes: B blocks of L runs, H filters.
    """
    # A fixed H has one block and one slot.
    c, t = min(b, readings.H.shape[0] - 1), min(s, readings.H.shape[1] - 1)
    for k in range(rows):
        # Each row refers to the estimate that has used the bits of those before it.
        innovation = load(lanes, readings.y, b, s, h, k)
        for i in range(x.shape[2]):
            innovation -= load(lanes, readings.H, c, t, h, k, i) * load(lanes, x, b, h, i)
        store(lanes, signs, k, select(innovation >= 0.0, spread(lanes, 1.0), spread(lanes, -1.0)))
        use_bit(
            lanes, x, root, b, h, load(lanes, signs, k), readings, (s, h, k), True, row, gains
        )  # fmt: skip


@kernel
def use_bit(
    lanes: Lanes,
    x: FloatArray,
    root: FloatArray,
    b: int,
    h: int,
    sign: Any,
    readings: ReadingBlock,
    index: tuple[int, int, int],
    arrived: Any,
    row: FloatArray,
    gains: FloatArray,
) -> None:
    """Correct filter ``h`` of block ``b`` by the ``sign`` (+1 or -1 in each of L lanes) of the
    innovation of one whitened row of a reading, in the lanes where it has ``arrived`` (flags (L,)
    or True): changes ``x[b, h]`` of x (B, H, n, L) and ``root[b, h]`` of root (B, H, n, n, L).

    ``index`` [s, sender, k] is slot, filter and row in ``readings.H``; ``row`` and ``gains`` (n, L)
    are scratch. The paper's update with noise variance 1 is
    ``x + sqrt(2 / pi) P h' / sqrt(p + 1) sign`` and ``P - (2 / pi) P h' h P / (p + 1)`` with
    ``p = h P h'``. The latter is a Kalman update with noise ``r = (pi / 2 - 1) p + pi / 2``, and
    the former its gain times ``sqrt(pi / 2 (p + 1)) sign``. Axes: B blocks of runs, H filters.
    """
    s, sender, k = index
    n = x.shape[2]
    # A fixed H has one block and one slot.
    c, t = min(b, readings.H.shape[0] - 1), min(s, readings.H.shape[1] - 1)
    # ``row`` becomes h S with P = S S', and ``square`` p = h P h'.
    square = spread(lanes, 0.0)
    for j in range(n):
        total = spread(lanes, 0.0)
        for i in range(j, n):
            total += load(lanes, readings.H, c, t, sender, k, i) * load(lanes, root, b, h, i, j)
        # Zeros in lanes where it has not arrived: a row of zeros changes nothing.
        total = select(arrived, total, 0.0)
        square += total * total
        store(lanes, row, j, total)
    # ``row`` becomes h S / sqrt(r): an observation of unit noise.
    scale = 1.0 / root_of((HALF_PI - 1.0) * square + HALF_PI)
    for j in range(n):
        store(lanes, row, j, scale * load(lanes, row, j))
    # The Kalman gain of such an observation is ``gains`` times ``inverse_deviation``. The argument
    # ``size`` is ``row``, of length n.
    inverse_deviation = rotate_lanes(lanes, row, root, b, h, row, gains)
    step = sign * inverse_deviation * scale * root_of(HALF_PI * (square + 1.0))
    for i in range(n):
        store(lanes, x, b, h, i, load(lanes, x, b, h, i) + load(lanes, gains, i) * step)


@kernel
def send_bits_single(
    x: FloatArray, root: FloatArray, readings: ReadingBlock, signs: FloatArray, work: FloatArray
) -> None:
    """Write the ``signs`` (p, 1), +1 or -1, of the innovations of one node in one run, and correct
    its estimate x (1, 1, n, 1) and root (1, 1, n, n, 1) by them in place; ``work`` (2, n, 1) is
    scratch.
    """
    send_bits(ONE, x, root, 0, 0, len(signs), readings, 0, signs, work[0], work[1])


@kernel
def use_bits_single(
    x: FloatArray, root: FloatArray, readings: ReadingBlock, signs: FloatArray, work: FloatArray
) -> None:
    """Correct the estimate x (1, 1, n, 1) and root (1, 1, n, n, 1) of one node in one run, in
    place, by the ``signs`` (p, 1) of the innovations of a sender's reading, whose rows H are in
    ``readings``; ``work`` (2, n, 1) is scratch.
    """
    for k in range(len(signs)):
        use_bit(
            ONE, x, root, 0, 0, load(ONE, signs, k), readings, (0, 0, k), True, work[0], work[1]
        )  # fmt: skip


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

    paper: ClassVar[str] = "one_bit"
    schedule: ClassVar[tuple[str, ...] | None] = ("predict", "sense", "exchange")
    clocks: ClassVar[tuple[str, ...]] = ()
    one_way: ClassVar[bool] = True
    reads_what_it_sends: ClassVar[bool] = True
    slot_kernel = staticmethod(one_bit_slots)

    def decides_in_slots(self) -> bool:
        """Return True: a node is silent except in its turn, and the compiled ``slot_kernel`` writes
        which nodes send.
        """
        return True

    def slot_arrays(
        self, states: Sequence[Any], infos: Sequence[NodeInfo], runs: int
    ) -> tuple[BitArrays]:
        """Return space (p, L) for the bits of one reading in L runs, where p is the number of rows
        of the largest sensor of the nodes in ``states``.
        """
        return (BitArrays(aligned((max(1, *(len(s.model.H) for s in states)), LANES))),)

    def payload_numbers(self, n: int, rows: int, phase: int) -> float:
        """Return the size of a message in numbers of 64 bits: one bit for each of the ``rows`` of a
        reading.
        """
        return rows / 64.0

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> OneBitState:
        """Return the first state of a node, with estimate ``mean`` (n,) and covariance ``cov``
        (n, n); it knows its turn from its index ``node.place``.
        """
        return OneBitState(mean, first_root(cov), model, None, node.place, node.nodes)

    def update(self, state: OneBitState, reading: Reading) -> OneBitState:
        """Return the state with the ``reading``, if it has rows, kept for ``emit`` in the same
        slot; the estimate moves only there, by the bits.
        """
        return state._replace(reading=reading if len(reading.y) else None)

    def emit(self, state: OneBitState, exchange: Exchange) -> tuple[OneBitState, Bits | None]:
        """Return, in the node's turn and if it has a reading, the state corrected by the bits of
        the reading, and as the payload these bits with the whitened rows H; else the unchanged
        state and None.
        """
        if state.reading is None or exchange.slot % state.nodes != state.turn:
            return state, None
        y, H = whiten_reading(*state.reading[:3])
        # ``send_bits_single`` writes the signs, in place, before they become the payload.
        signs = np.zeros(len(y))
        return apply_bits(state, send_bits_single, y, H, signs), Bits(signs, H)

    def absorb(
        self, state: OneBitState, messages: Sequence[Message], exchange: Exchange
    ) -> OneBitState:
        """Return the state corrected by the bits of the sender whose turn it is."""
        for message in messages:
            signs, H = message.payload
            # ``use_bits_single`` ignores the reading y, which the receiver does not know.
            state = apply_bits(state, use_bits_single, np.zeros(len(signs)), H, signs)
        return state

    shift = Filter.shift  # signs of innovations do not depend on the origin

    def shift_payload(self, payload: Bits, offset: FloatArray) -> Bits:
        """Return the payload of a message under way, for a move of the origin by which estimates
        change by ``offset`` (n,): unchanged, since bits have no coordinates.
        """
        return payload


def apply_bits(
    state: OneBitState, use: Any, y: FloatArray, H: FloatArray, signs: FloatArray
) -> OneBitState:
    """Return the state corrected by the bits of a whitened reading y (p,), H (p, n), which the
    kernel ``use`` applies: ``send_bits_single``, for the sender, writes the ``signs`` (p,) in
    place, ``use_bits_single``, for a receiver, reads them and ignores y.
    """
    n = len(state.xhat)
    x = np.array(state.xhat).reshape(1, 1, n, 1)
    root = np.array(state.root).reshape(1, 1, n, n, 1)
    use(x, root, block_of_reading(y, H), signs[:, None], np.empty((2, n, 1)))
    return state._replace(xhat=x.reshape(n), root=np.tril(root.reshape(n, n)))
