"""Belief propagation in the event loop: the kernels of algorithms/belief_propagation.

Each node holds the evidence of its own readings and the evidence that each neighbour sent last.
"""

from __future__ import annotations

import math

import numpy as np

from netkf.algorithms.kernels.beliefs import (
    add_part,
    add_reading_to_part,
    copy_part,
    predict_part,
    predict_part_single,
    recentre_part,
    set_growing,
    write_prior_single,
)
from netkf.algorithms.kernels.constant_gains import fill_inverse_transition
from netkf.algorithms.kernels.intersection import finish_lanes
from netkf.algorithms.kernels.root_flow import transform_root
from netkf.algorithms.modes import flow_frame
from netkf.engines.compiled.instant_updates import copy_state
from netkf.engines.compiled.state import Simulation
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import ONE
from netkf.linalg.small import multiply_square
from netkf.linalg.structs import Struct


class EvidenceArrays(Struct):
    """Evidence of N nodes, W directed links and C messages, relative to the estimate of the node
    that holds it. Evidence is a root [Z, z] (n, n + 1, 1) of an information matrix Z' Z and vector
    Z' z, see kernels.beliefs; the last axis is the one run that is simulated. It is about the e of
    a state ``x = W e``, see ``algorithms.modes.ModeFrame``.

    prior, own : (N, ...), priors, and evidence of own readings
    received, sent_at : (W, ...), evidence that was received last on each link, and the time (W,) at
                        which it was sent; -inf: none yet
    carried : (C, ...), evidence in messages
    belief, carried_belief : (N, n, 1) and (C, n, 1), the estimates of nodes, and those in messages,
                             as an e
    frames : W of each node (N, n, n)
    inverse, growing : of the ModeFrame
    forward, back : of the ModeFrame, with a minus
    first, direction : the incoming links of node h are ``direction[first[h]:first[h + 1]]``, in the
                       order of senders
    lanes, roots : views of the estimates (1, N, n, 1) and roots (1, N, n, n, 1) of the Simulation

    Scratch: ``before`` (n, 1), ``step`` (1, N, n, 1), ``origin`` (N, n, 1), zeros, whitened
    readings y (1, 1, 1, p, 1) and H (1, 1, 1, p, n, 1), ``total`` and ``work`` (n, n + 1, 1),
    ``maps`` (3, n, n).
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
    belief: FloatArray
    carried_belief: FloatArray
    frames: FloatArray
    inverse: FloatArray
    growing: int
    forward: FloatArray
    back: FloatArray
    before: FloatArray
    step: FloatArray
    origin: FloatArray
    y: FloatArray
    H: FloatArray
    total: FloatArray
    work: FloatArray
    maps: FloatArray


def empty_evidence(state: Simulation, A: FloatArray, roots: FloatArray) -> EvidenceArrays:
    """Return the arrays of belief propagation for N nodes at time 0, with space for the messages of
    ``state``. Evidence is information about the state, a root [Z, z] (n, n + 1, 1) of its matrix
    and vector: at time 0 there are priors only, from the roots of P of all nodes, ``roots`` (1, N,
    n, n, 1). ``A`` (n, n) is the plant's matrix in 1/s.
    """
    N, n = state.xhat.shape
    directions, p, shape = state.directions, len(state.scratch.y), (n, n + 1, 1)
    frame, total, work = flow_frame(A), np.zeros(shape), np.zeros(shape)
    # Directed links by receiver, then by sender (lexsort sorts by its last key first), so that the
    # incoming links of a node are neighbours.
    incoming = np.lexsort((directions["sender"], directions["receiver"]))
    prior = np.zeros((N, *shape))
    for h in range(N):
        write_prior_single(roots, h, prior[h])
        predict_part_single(prior[h], frame.basis, total, work)
    return EvidenceArrays(
        prior=prior,
        own=np.zeros((N, *shape)),
        received=np.zeros((len(directions), *shape)),
        sent_at=np.full(len(directions), -math.inf),
        carried=np.zeros((len(state.pool), *shape)),
        first=np.searchsorted(directions["receiver"][incoming], np.arange(N + 1)).astype(np.int64),
        direction=incoming.astype(np.int64),
        lanes=state.xhat.reshape(1, N, n, 1),
        roots=roots,
        belief=np.ascontiguousarray((state.xhat @ frame.inverse.T)[..., None]),
        carried_belief=np.zeros((len(state.pool), n, 1)),
        frames=np.array([frame.basis] * N),
        inverse=frame.inverse,
        growing=frame.growing,
        forward=-frame.forward,
        back=-frame.back,
        before=np.zeros((n, 1)),
        step=np.zeros((1, N, n, 1)),
        origin=np.zeros((N, n, 1)),
        y=np.zeros((1, 1, 1, p, 1)),
        H=np.zeros((1, 1, 1, p, n, 1)),
        total=total,
        work=work,
        maps=np.zeros((3, n, n)),
    )


def enlarge_evidence(evidence: EvidenceArrays, capacity: int) -> None:
    """Enlarge ``evidence.carried`` and ``carried_belief``, of messages under way, with the pool of
    messages: to arrays (capacity, ...) for ``capacity`` messages, which begin with the present
    ones.
    """
    more = capacity - len(evidence.carried)
    evidence.carried, evidence.carried_belief = (
        np.concatenate([old, np.zeros((more, *old.shape[1:]))])
        for old in (evidence.carried, evidence.carried_belief)
    )


@kernel
def predict_node_evidence(evidence: EvidenceArrays, h: int, gap: float) -> None:
    """Predict all evidence of node ``h`` (index), information about the state, by ``gap`` seconds
    without process noise, in place: its ``prior``, its ``own`` from readings, and what it has
    ``received`` from each neighbour. That about modes that do not grow stays as it is, and W of the
    node moves instead.
    """
    n, maps, W, work = len(evidence.inverse), evidence.maps, evidence.frames[h], evidence.work
    if evidence.growing < n:
        fill_inverse_transition(evidence.forward, gap, maps)
        multiply_square(maps[1], W, maps[0])
        for i in range(n):
            for j in range(n):
                W[i, j] = maps[1, i, j]
    if evidence.growing > 0:
        # The inverse transition of the modes that grow, which takes information forward in time.
        fill_inverse_transition(evidence.back, gap, maps)
        back, total = maps[0], evidence.total
        predict_part(ONE, evidence.prior[h], back, total, work)
        predict_part(ONE, evidence.own[h], back, total, work)
        for k in range(evidence.first[h], evidence.first[h + 1]):
            predict_part(ONE, evidence.received[evidence.direction[k]], back, total, work)


@kernel
def update_belief(state: Simulation, evidence: EvidenceArrays, h: int) -> None:
    """Compute the belief of node ``h`` (index), the sum of its prior and all evidence (information
    from its own readings and from each neighbour), and write its estimate and root to
    ``state.xhat[h]`` and ``root[h]``. Moves the centre, the state relative to which the vectors of
    all this evidence are kept, to the new estimate.
    """
    total, work, n = evidence.total, evidence.work, state.xhat.shape[1]
    copy_part(ONE, evidence.prior[h], total)
    add_part(ONE, total, evidence.own[h], work)
    for k in range(evidence.first[h], evidence.first[h + 1]):
        add_part(ONE, total, evidence.received[evidence.direction[k]], work)
    # The root Z^-1 of the covariance of e and its step Z^-1 z; False: the one lane takes both.
    finish_lanes(
        ONE, evidence.roots[0], evidence.step[0], h, evidence.origin, total, work, False
    )  # fmt: skip
    W, step, origin = evidence.frames[h], evidence.step[0, h], evidence.origin[h]
    values, noise = state.flow_scratch.values, state.flow_scratch.T
    for i in range(n):
        for j in range(n):
            state.xhat[h, i] += W[i, j] * step[j, 0]
            values[i * n + j], noise[i, j] = W[i, j], 0.0
        if i >= evidence.growing:
            evidence.belief[h, i, 0] += step[i, 0]
    # W Z^-1, made triangular.
    transform_root(ONE, state.size, state.root[h], values, 0, state.flow_scratch.wide, noise)
    recentre_part(ONE, evidence.prior[h], origin, step, evidence.prior[h])
    recentre_part(ONE, evidence.own[h], origin, step, evidence.own[h])
    for k in range(evidence.first[h], evidence.first[h + 1]):
        received = evidence.received[evidence.direction[k]]
        recentre_part(ONE, received, origin, step, received)


@kernel
def add_samples(state: Simulation, evidence: EvidenceArrays, h: int, instant: int) -> None:
    """Add the samples of an ``instant`` (index in ``state.instants``) to ``evidence.own[h]``, the
    information that node ``h`` has from its own readings, and update its belief in
    ``state.xhat[h]`` and ``root[h]``.
    """
    instants, n = state.instants, state.xhat.shape[1]
    for s in range(instants.first[instant], instants.first[instant + 1]):
        sensor, matrix = instants.sensor[s], instants.matrix[s]
        rows = instants.rows[sensor]
        # L^-1 y and L^-1 H with L L' = R, by forward substitution: their noise is white.
        for i in range(rows):
            scale, y = 1.0 / instants.root[sensor, i, i], instants.y[s, i]
            for m in range(i):
                y -= instants.root[sensor, i, m] * evidence.y[0, 0, 0, m, 0]
            evidence.y[0, 0, 0, i, 0] = scale * y
            for j in range(n):
                entry = instants.H[matrix, i, j]
                for m in range(i):
                    entry -= instants.root[sensor, i, m] * evidence.H[0, 0, 0, m, j, 0]
                evidence.H[0, 0, 0, i, j, 0] = scale * entry
        add_reading_to_part(
            ONE, evidence.own[h], evidence.y, evidence.H, (0, 0, 0), rows,
            evidence.lanes[0, h : h + 1], evidence.frames[h], evidence.work,
        )  # fmt: skip
    update_belief(state, evidence, h)


@kernel
def send_evidence(state: Simulation, evidence: EvidenceArrays, m: int, h: int) -> None:
    """Write what node ``h`` sends in belief propagation to ``evidence.carried[m]`` of message ``m``
    (index in the pool): the sum of its evidence without what the receiver itself sent, which would
    otherwise count twice. The node's estimate, to which the sum is relative, goes to
    ``state.pool_x[m]``.
    """
    receiver = state.directions[state.pool[m].direction].receiver
    copy_state(state.size, state.pool_x, state.pool_root, m, state.xhat, state.root, h)
    copy_part(ONE, evidence.own[h], evidence.carried[m])
    for i in range(len(evidence.inverse)):
        evidence.carried_belief[m, i, 0] = evidence.belief[h, i, 0]
    for k in range(evidence.first[h], evidence.first[h + 1]):
        w = evidence.direction[k]
        if state.directions[w].sender != receiver:
            add_part(ONE, evidence.carried[m], evidence.received[w], evidence.work)


@kernel
def absorb_evidence(state: Simulation, evidence: EvidenceArrays, h: int, now: float) -> None:
    """Let node ``h`` (index) absorb the evidence (information about the state) that messages in its
    inbox carry: replace ``evidence.received`` of each sender, unless the present one was sent
    later; then update the belief in ``state.xhat[h]`` and ``root[h]``. The estimates in the
    messages, to which their evidence is relative, are predicted to ``now`` (seconds) already.
    """
    m, maps = state.nodes[h].inbox, evidence.maps
    while m != -1:
        message = state.pool[m]
        w, age = message.direction, now - message.sent
        if evidence.sent_at[w] <= message.sent:
            # Predict what a late message says of growing modes to now.
            if age > 0.0 and evidence.growing > 0:
                fill_inverse_transition(evidence.back, age, maps)
                predict_part(ONE, evidence.carried[m], maps[0], evidence.total, evidence.work)
            # Its evidence becomes relative to this node's estimate.
            for i in range(state.xhat.shape[1]):
                evidence.before[i, 0] = state.pool_x[m, i]
            before, after = evidence.carried_belief[m], evidence.belief[h]
            set_growing(ONE, before, evidence.before, evidence.inverse, evidence.growing)
            set_growing(ONE, after, evidence.lanes[0, h], evidence.inverse, evidence.growing)
            recentre_part(ONE, evidence.carried[m], before, after, evidence.received[w])
            evidence.sent_at[w] = message.sent
        m = message.next
    update_belief(state, evidence, h)
