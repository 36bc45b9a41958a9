"""Belief propagation in the event loop (algorithms/belief_propagation, in loops): evidence that
nodes keep of their own readings and of what each neighbour sent last.
"""

from __future__ import annotations

import math

import numpy as np

from netkf.algorithms.kernels.beliefs import (
    add_part,
    copy_part,
    predict_part,
    recentre_part,
    write_prior_single,
)
from netkf.algorithms.kernels.constant_gains import fill_inverse_transition
from netkf.algorithms.kernels.information import add_reading_pair
from netkf.algorithms.kernels.intersection import finish_lanes
from netkf.engines.compiled.late_readings import copy_state
from netkf.engines.compiled.state import Simulation
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import ONE
from netkf.linalg.structs import Struct


class EvidenceArrays(Struct):
    """Evidence (n, n + 1, 1) that counts from the beliefs of nodes: priors and own readings
    (N, ...), what was received last on each of W directed links, and when that was sent
    (``sent_at``, (W,); never: -inf), and what messages carry (C, ...). The links that node h hears
    are ``direction[k]`` from ``first[h]`` up to ``first[h + 1]``, in the order of senders.

    The estimates of the Simulation as ``lanes`` (1, N, n, 1) and its roots (1, N, n, n, 1); the
    plant's ``A`` (n, n). Scratch: ``centre`` (N, n, 1), ``before`` and ``after`` (n, 1), whitened
    readings y (1, 1, 1, p, 1) and H (1, 1, 1, p, n, 1), ``total`` and ``work`` (n, n + 1, 1),
    ``maps`` (6, n, n).
    """

    prior: FloatArray
    own: FloatArray
    received: FloatArray
    sent_at: FloatArray
    carried: FloatArray
    first: IntArray
    direction: IntArray
    lanes: FloatArray
    roots: FloatArray
    A: FloatArray
    centre: FloatArray
    before: FloatArray
    after: FloatArray
    y: FloatArray
    H: FloatArray
    total: FloatArray
    work: FloatArray
    maps: FloatArray


def empty_evidence(state: Simulation, A: FloatArray, roots: FloatArray) -> EvidenceArrays:
    """Return that of nodes that have read and heard nothing; ``roots`` (1, N, n, n, 1)."""
    N, n = state.xhat.shape
    directions, p, part = state.directions, len(state.scratch.y), (n, n + 1, 1)
    heard = np.lexsort((directions["sender"], directions["receiver"]))
    prior = np.zeros((N, *part))
    for h in range(N):
        write_prior_single(roots, h, prior[h])
    return EvidenceArrays(
        prior=prior,
        own=np.zeros((N, *part)),
        received=np.zeros((len(directions), *part)),
        sent_at=np.full(len(directions), -math.inf),
        carried=np.zeros((len(state.pool), *part)),
        first=np.searchsorted(directions["receiver"][heard], np.arange(N + 1)).astype(np.int64),
        direction=heard.astype(np.int64),
        lanes=state.xhat.reshape(1, N, n, 1),
        roots=roots,
        A=np.array(A),
        centre=np.zeros((N, n, 1)),
        before=np.zeros((n, 1)),
        after=np.zeros((n, 1)),
        y=np.zeros((1, 1, 1, p, 1)),
        H=np.zeros((1, 1, 1, p, n, 1)),
        total=np.zeros(part),
        work=np.zeros(part),
        maps=np.zeros((6, n, n)),
    )


def more_evidence(evidence: EvidenceArrays, capacity: int) -> None:
    """Enlarge the arrays of evidence under way to ``capacity`` messages."""
    grown = np.zeros((capacity, *evidence.carried.shape[1:]))
    grown[: len(evidence.carried)] = evidence.carried
    evidence.carried = grown


@kernel
def predict_node_evidence(evidence: EvidenceArrays, h: int, gap: float) -> None:
    """Let all evidence of node ``h`` speak about the state ``gap`` seconds later."""
    fill_inverse_transition(evidence.A, gap, evidence.maps)
    back, total, work = evidence.maps[0], evidence.total, evidence.work
    predict_part(ONE, evidence.prior[h], back, total, work)
    predict_part(ONE, evidence.own[h], back, total, work)
    for k in range(evidence.first[h], evidence.first[h + 1]):
        predict_part(ONE, evidence.received[evidence.direction[k]], back, total, work)


@kernel
def update_belief(state: Simulation, evidence: EvidenceArrays, h: int) -> None:
    """Make the belief of node ``h`` from its prior and all evidence, which counts from it then."""
    total, work, centre = evidence.total, evidence.work, evidence.centre
    for i in range(state.xhat.shape[1]):
        centre[h, i, 0] = state.xhat[h, i]
    copy_part(ONE, evidence.prior[h], total)
    add_part(ONE, total, evidence.own[h], work)
    for k in range(evidence.first[h], evidence.first[h + 1]):
        add_part(ONE, total, evidence.received[evidence.direction[k]], work)
    finish_lanes(ONE, evidence.roots, evidence.lanes, 0, h, centre, total, work, False)
    before, after = centre[h], evidence.lanes[0, h]
    recentre_part(ONE, evidence.prior[h], before, after, evidence.prior[h])
    recentre_part(ONE, evidence.own[h], before, after, evidence.own[h])
    for k in range(evidence.first[h], evidence.first[h + 1]):
        received = evidence.received[evidence.direction[k]]
        recentre_part(ONE, received, before, after, received)


@kernel
def add_samples(state: Simulation, evidence: EvidenceArrays, h: int, instant: int) -> None:
    """Add the samples of an instant to the own evidence of node ``h``."""
    given, n = state.instants, state.xhat.shape[1]
    for i in range(n):
        evidence.centre[h, i, 0] = state.xhat[h, i]
    for s in range(given.first[instant], given.first[instant + 1]):
        sensor, matrix = given.sensor[s], given.matrix[s]
        rows = given.rows[sensor]
        # L^-1 y and L^-1 H with L L' = R.
        for i in range(rows):
            scale, y = 1.0 / given.root[sensor, i, i], given.y[s, i]
            for m in range(i):
                y -= given.root[sensor, i, m] * evidence.y[0, 0, 0, m, 0]
            evidence.y[0, 0, 0, i, 0] = scale * y
            for j in range(n):
                entry = given.H[matrix, i, j]
                for m in range(i):
                    entry -= given.root[sensor, i, m] * evidence.H[0, 0, 0, m, j, 0]
                evidence.H[0, 0, 0, i, j, 0] = scale * entry
        add_reading_pair(
            ONE, evidence.own[h], 1.0, evidence.y, evidence.H, (0, 0, 0), rows,
            evidence.centre[h : h + 1], evidence.work,
        )  # fmt: skip
    update_belief(state, evidence, h)


@kernel
def send_evidence(state: Simulation, evidence: EvidenceArrays, m: int, h: int) -> None:
    """Write the evidence of node ``h`` into message ``m``, without that of its receiver."""
    receiver = state.directions[state.pool[m].direction].receiver
    copy_state(state.size, state.pool_x, state.pool_root, m, state.xhat, state.root, h)
    copy_part(ONE, evidence.own[h], evidence.carried[m])
    for k in range(evidence.first[h], evidence.first[h + 1]):
        w = evidence.direction[k]
        if state.directions[w].sender != receiver:
            add_part(ONE, evidence.carried[m], evidence.received[w], evidence.work)


@kernel
def absorb_evidence(state: Simulation, evidence: EvidenceArrays, h: int, now: float) -> None:
    """Replace the earlier evidence of each sender to node ``h``, unless that was sent later; the
    centres of what they carry are predicted to now.
    """
    m, maps = state.nodes[h].inbox, evidence.maps
    while m != -1:
        message = state.pool[m]
        w, age = message.direction, now - message.sent
        if evidence.sent_at[w] <= message.sent:
            if age > 0.0:
                fill_inverse_transition(evidence.A, age, maps)
                predict_part(ONE, evidence.carried[m], maps[0], evidence.total, evidence.work)
            for i in range(state.xhat.shape[1]):
                evidence.before[i, 0] = state.pool_x[m, i]
                evidence.after[i, 0] = state.xhat[h, i]
            recentre_part(
                ONE, evidence.carried[m], evidence.before, evidence.after, evidence.received[w]
            )
            evidence.sent_at[w] = message.sent
        m = message.next
    update_belief(state, evidence, h)
