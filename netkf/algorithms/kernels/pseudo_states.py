"""Consensus plus innovations in kernels: estimates yhat of the pseudo-state ``y = G x``.

Filter ``h`` of a block has index ``[b, h]`` of stacks with lanes (``netkf.linalg.lanes``):
estimates of states and of pseudo-states (B, H, n, L).
"""

from __future__ import annotations

from typing import Any

from netkf.algorithms.kernels.slots import ReadingBlock, SlotLinks
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import Lanes, load, load_flags, select, spread, store


@kernel
def predict_pseudo(
    lanes: Lanes,
    x: FloatArray,
    y: FloatArray,
    b: int,
    h: int,
    A: FloatArray,
    rest: FloatArray,
    moved: FloatArray,
) -> None:
    """Move the estimate of the pseudo-state to the next slot, ``A yhat + rest xhat``, before that
    of the state moves; ``moved`` (n, L) is scratch.
    """
    n = len(A)
    for i in range(n):
        total = spread(lanes, 0.0)
        for j in range(n):
            total += A[i, j] * load(lanes, y, b, h, j) + rest[i, j] * load(lanes, x, b, h, j)
        store(lanes, moved, i, total)
    # All rows need the old yhat, hence the copy.
    for i in range(n):
        store(lanes, y, b, h, i, load(lanes, moved, i))


@kernel
def innovate(
    lanes: Lanes,
    y: FloatArray,
    b: int,
    h: int,
    rows: int,
    inverse: FloatArray,
    readings: ReadingBlock,
    s: int,
    state: FloatArray,
    z: FloatArray,
) -> None:
    """Write ``H' R^-1 (reading - H G^+ yhat)`` into ``z`` (n, L), for the reading of slot ``s``
    with ``rows`` whitened rows; ``state`` (n, L) is scratch for ``G^+ yhat``.
    """
    n = len(inverse)
    # H that is fixed has one block and one slot.
    c, t = min(b, readings.H.shape[0] - 1), min(s, readings.H.shape[1] - 1)
    # G^+ yhat is the state that the pseudo-state stands for.
    for i in range(n):
        total = spread(lanes, 0.0)
        for j in range(n):
            total += inverse[i, j] * load(lanes, y, b, h, j)
        store(lanes, state, i, total)
        store(lanes, z, i, 0.0)
    # Whitened rows have R = I, so that H' R^-1 is H'.
    for k in range(rows):
        innovation = load(lanes, readings.y, b, s, h, k)
        for j in range(n):
            innovation -= load(lanes, readings.H, c, t, h, k, j) * load(lanes, state, j)
        for i in range(n):
            entry = load(lanes, readings.H, c, t, h, k, i) * innovation
            store(lanes, z, i, load(lanes, z, i) + entry)


@kernel
def correct_pseudo(
    lanes: Lanes,
    y: FloatArray,
    b: int,
    h: int,
    links: SlotLinks,
    up: Any,
    s: int,
    B: FloatArray,
    M: FloatArray,
    z: FloatArray,
    corrected: FloatArray,
) -> None:
    """Write ``yhat_h + sum_l B_hl (yhat_l - yhat_h) + M_h z`` into ``corrected`` (H, n, L) at h,
    with the estimates that filter ``h`` hears in the first step of slot ``s``.

    ``y`` (blocks, H, n, L) are the estimates yhat, of which block ``b`` is corrected; ``up`` flags
    the messages that arrive; ``B`` (W, n, n) in the order of ``links``, ``M`` (H, n, n), the
    innovation ``z`` (n, L).
    """
    n = M.shape[1]
    # Into an array of its own: the other filters still hear the estimates from before.
    for i in range(n):
        total = load(lanes, y, b, h, i)
        for j in range(n):
            total += M[h, i, j] * load(lanes, z, j)
        store(lanes, corrected, h, i, total)
    for m in range(links.first[h], links.first[h + 1]):
        arrived = load_flags(lanes, up, b, s, 0, links.direction[m])
        sender = links.sender[m]
        for i in range(n):
            total = spread(lanes, 0.0)
            for j in range(n):
                total += B[m, i, j] * (load(lanes, y, b, sender, j) - load(lanes, y, b, h, j))
            term = select(arrived, total, 0.0)
            store(lanes, corrected, h, i, load(lanes, corrected, h, i) + term)


@kernel
def correct_state(
    lanes: Lanes,
    x: FloatArray,
    y: FloatArray,
    b: int,
    h: int,
    K: FloatArray,
    G: FloatArray,
    corrected: FloatArray,
    difference: FloatArray,
) -> None:
    """Take ``corrected[h]`` as the estimate of the pseudo-state and move that of the state towards
    it, ``xhat + K_h (yhat - G xhat)``; ``K`` (H, n, n), ``difference`` (n, L) is scratch.
    """
    n = len(G)
    # The whole difference first: it needs all of the old xhat.
    for i in range(n):
        total = load(lanes, corrected, h, i)
        store(lanes, y, b, h, i, total)
        for j in range(n):
            total -= G[i, j] * load(lanes, x, b, h, j)
        store(lanes, difference, i, total)
    for i in range(n):
        total = load(lanes, x, b, h, i)
        for j in range(n):
            total += K[h, i, j] * load(lanes, difference, j)
        store(lanes, x, b, h, i, total)


@kernel
def shift_pseudo(
    lanes: Lanes, y: FloatArray, readings: ReadingBlock, G: FloatArray, b: int, s: int
) -> None:
    """Count the pseudo-states of a block from that of the state of slot ``s``, where a frame of
    coordinates begins.
    """
    if readings.rebased[s]:
        n = len(G)
        for i in range(n):
            origin = spread(lanes, 0.0)
            for j in range(n):
                origin += G[i, j] * load(lanes, readings.local, b, s, j)
            for h in range(y.shape[1]):
                store(lanes, y, b, h, i, load(lanes, y, b, h, i) - origin)
