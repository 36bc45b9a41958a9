"""Kernels of consensus plus innovations (Das and Moura 2017): estimates yhat of the pseudo-state.

With the information ``G = sum_i H_i' R_i^-1 H_i`` of all sensors the pseudo-state is ``y = G x``,
and ``H_i' R_i^-1`` times its reading shows node i a part of it. In each slot, with the gains B, M
and K that the caller has computed for it,

    yhat+ = yhat + sum_l B_l (yhat_l - yhat) + M z,   z = H' R^-1 (reading - H G^+ yhat)
    xhat+ = xhat + K (yhat+ - G xhat)

and then both are predicted. G^+ is the pseudo-inverse, since sensors may leave states unobserved.

Filter ``h`` of a block has index ``[b, h]`` of stacks with lanes (``netkf.linalg.lanes``):
estimates of states and of pseudo-states (B, H, n, L).

In a slot, one time step, nodes read, exchange messages in E steps and predict, in the order of the
filter. ``links`` lists the W directed links by receiver: those to filter h have the numbers
``links.first[h]`` to ``links.first[h + 1]`` - 1; ``up`` (B, S, E, W, L) flags the messages that
arrive.

``lanes`` is ONE for a single run or MANY for a block of L runs side by side: ``load``, ``store``
and ``select`` handle the L numbers of an entry as one SIMD value (``netkf.linalg.lanes``).
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
    coupling: FloatArray,
    predicted: FloatArray,
) -> None:
    """Predict the estimate of the pseudo-state G x of filter ``h`` of block ``b`` to the next slot:
    replace yhat = ``y[b, h]`` (n, L) by ``A yhat + coupling xhat``, with xhat = ``x[b, h]`` of the
    present slot: ``A = G F G^+`` and ``coupling = G F (I - G^+ G)`` for the transition F of a slot.

    ``x`` and ``y`` are (B, H, n, L), ``A`` and ``coupling`` (n, n); ``predicted`` (n, L) is
    scratch. Axes: B blocks of L runs, H filters.
    """
    n = len(A)
    for i in range(n):
        total = spread(lanes, 0.0)
        for j in range(n):
            total += A[i, j] * load(lanes, y, b, h, j) + coupling[i, j] * load(lanes, x, b, h, j)
        store(lanes, predicted, i, total)
    # All rows need the old yhat, hence the copy.
    for i in range(n):
        store(lanes, y, b, h, i, load(lanes, predicted, i))


@kernel
def fill_pseudo_innovation(
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
    """Write the pseudo-innovation ``H' R^-1 (reading - H G^+ yhat)`` of filter ``h`` of block ``b``
    into ``z`` (n, L), for the reading of slot ``s`` with ``rows`` whitened rows.

    ``y`` (B, H, n, L) are the estimates yhat; ``inverse`` (n, n) is G^+ and ``state`` (n, L)
    scratch for ``G^+ yhat``. Axes: B blocks of L runs, H filters.
    """
    n = len(inverse)
    # A fixed H is stored for one block and one slot only.
    c, t = min(b, readings.H.shape[0] - 1), min(s, readings.H.shape[1] - 1)
    # state = G^+ yhat.
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
    """Write ``yhat_h + sum_l B_hl (yhat_l - yhat_h) + M_h z`` into ``corrected[h]`` (n, L), summed
    over the estimates yhat_l that arrive at filter ``h`` of block ``b`` in the first step of slot
    ``s``.

    ``y`` (blocks, H, n, L) are the estimates yhat; ``up`` (blocks, S, E, W, L) flags the messages
    that arrive; ``B`` (W, n, n) are in the order of ``links``, ``M`` (H, n, n); ``z`` (n, L) is the
    pseudo-innovation. Axes: S slots, E exchange steps, W directed links, H filters, L runs side by
    side.
    """
    n = M.shape[1]
    # Into a separate array: the other filters still need yhat_h from before the step.
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
    """Set yhat = ``y[b, h]`` of filter ``h`` of block ``b`` to ``corrected[h]`` and correct the
    state by it in place, ``x[b, h] += K_h (yhat - G xhat)``.

    ``x`` and ``y`` are (B, H, n, L), ``corrected`` (H, n, L), ``K`` (H, n, n), G (n, n);
    ``difference`` (n, L) is scratch. Axes: B blocks of L runs, H filters.
    """
    n = len(G)
    # difference = yhat - G xhat, complete before xhat changes.
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
    """Move the origin of the estimates ``y[b]`` (H, n, L) of the pseudo-states G x in block ``b``,
    if that of the states moves in slot ``s`` (``readings.rebased[s]``): subtract G (n, n) times the
    true state ``readings.local[b, s]`` (n, L).

    Axes: H filters, L runs side by side.
    """
    if readings.rebased[s]:
        n = len(G)
        for i in range(n):
            origin = spread(lanes, 0.0)
            for j in range(n):
                origin += G[i, j] * load(lanes, readings.local, b, s, j)
            for h in range(y.shape[1]):
                store(lanes, y, b, h, i, load(lanes, y, b, h, i) - origin)
