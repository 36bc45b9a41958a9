"""Extra state of some combinations in the event loop, besides estimates and messages.

These are fusion with the optimal weight (BEST, INVERSE), constant gains (GAINS) and consensus on
predictions (PREDICTIONS). For other combinations it is None, and none of this is compiled.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from netkf.algorithms.closed_loops import closed_loop, gain_rate, sample_maps
from netkf.algorithms.kernels.constant_gains import correct_by_innovation, correct_by_moments
from netkf.algorithms.kernels.neighbours import scale_by_covariance
from netkf.algorithms.kernels.pair_fusion import fuse_pair
from netkf.algorithms.kernels.root_flow import (
    FlowScratch,
    FlowTable,
    flow_scratch,
    propagate_root,
    stack_tables,
)
from netkf.algorithms.kernels.slots import predict_root
from netkf.engines.compiled.increments import fill_readings, next_interval
from netkf.engines.compiled.instant_updates import copy_state, use_instant
from netkf.engines.compiled.state import (
    BEST,
    GAINS,
    INVERSE,
    PREDICTIONS,
    Simulation,
)
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import ONE
from netkf.linalg.structs import Struct
from netkf.scenario.scenario import Scenario


class CombinationState(Struct):
    """Arrays of one run, for N nodes, n states and p rows of readings.

    kind    : combination of the Simulation (BEST, INVERSE, GAINS or PREDICTIONS)
    trace   : 1 where the best weight minimises the trace, 0 where it minimises the determinant

    Consensus on predictions:

    share, epsilon : whether readings are sent too; strength of the consensus term
    prior, prior_root : predictions before any reading of this instant, (N, n) and (N, n, n)
    prior_lanes : (1, N, n, n, 1), a view of ``prior_root``
    consensus_term : (N, n, 1)

    Constant gains:

    A, L, H : plant (n, n), gains (N, n, p), rows (N, p, n) of increment sensors
    closed, table, model, rate : closed loops A - L H (N, n, n), tabulated, the row (N,) of each
              node, and the rate in 1/s at which its error changes
    sampled, noise : (N, n, n) I - L H and a root of L R L' of sampled sensors
    lanes   : (1, N, n, n, 1), a view of the roots of the Simulation

    Scratch: ``pair`` (2 n + 2, n), ``x`` (1, n), ``root`` (1, n, n), ``maps`` (6, n, n), ``work``
    (2, n, n, 1), ``flow_scratch``.
    """

    kind: int
    trace: int
    share: int
    epsilon: float
    prior: FloatArray
    prior_root: FloatArray
    prior_lanes: FloatArray
    consensus_term: FloatArray
    A: FloatArray
    L: FloatArray
    H: FloatArray
    closed: FloatArray
    sampled: FloatArray
    noise: FloatArray
    rate: FloatArray
    model: IntArray
    table: FlowTable
    lanes: FloatArray
    pair: FloatArray
    x: FloatArray
    root: FloatArray
    maps: FloatArray
    work: FloatArray
    flow_scratch: FlowScratch


def combination_state_of(scenario: Scenario, state: Simulation) -> CombinationState | None:
    """Return the arrays that the filter's way of combining estimates needs besides those of the
    event loop ``state``, at time 0; None for most combinations, which need none. ``lanes``
    is a view of ``state.root``: the loop and the combination see the same estimates.
    """
    if state.combination_kind not in (BEST, INVERSE, GAINS, PREDICTIONS):
        return None
    algorithm: Any = scenario.node_filter
    # ``lanes`` must be a view of the roots: a copy would miss what the loop changes.
    (N, n), root = state.xhat.shape, np.ascontiguousarray(state.root)
    assert root is state.root or np.shares_memory(root, state.root)
    prior_root = state.root.copy()
    gains = _make_gains(scenario, state)
    return CombinationState(
        kind=state.combination_kind,
        trace=getattr(algorithm, "minimise", "") == "trace",
        share=getattr(algorithm, "share_readings", False),
        epsilon=getattr(algorithm, "epsilon", 0.0),
        prior=state.xhat.copy(),
        prior_root=prior_root,
        prior_lanes=prior_root.reshape(1, N, n, n, 1),
        consensus_term=np.zeros((N, n, 1)),
        lanes=root.reshape(1, N, n, n, 1),
        pair=np.zeros((2 * n + 2, n)),
        x=np.zeros((1, n)),
        root=np.zeros((1, n, n)),
        maps=np.zeros((6, n, n)),
        work=np.zeros((2, n, n, 1)),
        flow_scratch=flow_scratch(gains["table"]),
        **gains,
    )


def _make_gains(scenario: Scenario, state: Simulation) -> dict[str, Any]:
    """Return the fields of a CombinationState for filters with constant gains L, by name, from
    ``A`` (n, n) to ``model`` (N,): the closed loop A - L H of each node that reads increments, and
    I - L H of each that takes samples. They are zeros for filters of other combinations, since
    compiled code needs arrays of the same types.
    """
    N, n = state.xhat.shape
    algorithm: Any = scenario.node_filter
    node_gains = [
        algorithm.gain_of(k) if state.combination_kind == GAINS else np.zeros((n, 0))
        for k in range(N)
    ]
    p = max(1, *(one.shape[1] for one in node_gains))
    fields: dict[str, Any] = {
        "A": np.array(scenario.models[0].A),
        "L": np.zeros((N, n, p)),
        "H": np.zeros((N, p, n)),
        "closed": np.zeros((N, n, n)),
        "sampled": np.zeros((N, n, n)),
        "noise": np.zeros((N, n, n)),
        "rate": np.zeros(N),
        "model": np.zeros(N, dtype=np.int64),
    }
    tables: list[FlowTable] = []
    for k, (node, model) in enumerate(zip(scenario.nodes, scenario.models, strict=True)):
        rows = len(model.H)
        fields["L"][k, :, : node_gains[k].shape[1]] = node_gains[k]
        if state.combination_kind == GAINS and rows:
            loop = closed_loop(model, node_gains[k])
            fields["H"][k, :rows], fields["closed"][k] = model.H, loop.A
            fields["rate"][k] = gain_rate(node_gains[k], model.H)
            fields["model"][k] = len(tables)
            tables.append(loop.flow)
        elif state.combination_kind == GAINS and node in scenario.sampled_sensors:
            # A node that takes samples has one sensor.
            (placed_sensor,) = scenario.sampled_sensors[node]
            H, R = (
                scenario.sensors[placed_sensor.entry].H,
                scenario.noise_covariance(placed_sensor.entry, believed=True),
            )
            fields["sampled"][k], fields["noise"][k] = sample_maps(node_gains[k], H, R)
    # Without closed loops any table will do, as no node uses it.
    fields["table"] = stack_tables(tables) if tables else state.table
    return fields


@kernel
def keep_prediction(state: Simulation, combination: CombinationState, h: int) -> None:
    """Store the estimate and root of node ``h`` (index), its prediction before any reading of this
    instant is used, in ``prior`` and ``prior_root`` of ``combination``: consensus on predictions
    sends these and not the updated estimate. Sets ``nodes[h].reading``, the newest sample of the
    node, to -1.
    """
    copy_state(state.size, combination.prior, combination.prior_root, h, state.xhat, state.root, h)
    # A reading of an earlier instant is not sent any more.
    state.nodes[h].reading = -1


@kernel
def predict_with_gain(
    state: Simulation, combination: CombinationState, h: int, now: float, time: float
) -> None:
    """Predict node ``h`` (index) from ``now`` to ``time`` (seconds) and correct it by its
    increments with the constant gain L (n, p) of its filter. The gap is divided into intervals that
    are short against the rate of the error in the closed loop, over which readings are used at
    once. Changes row ``h`` of ``state.xhat`` and ``state.root``.
    """
    piece, m, least = state.piece, combination.model[h], 0.0
    while now < time:
        end, least = next_interval(combination.rate[h], now, time, least)
        gap = end - now
        # The mean moves open loop, and P by the closed loop A - L H, which includes the readings.
        for i in range(combination.x.shape[1]):
            combination.x[0, i] = state.xhat[h, i]
            for j in range(combination.x.shape[1]):
                combination.root[0, i, j] = 0.0
        # The last model of the table has no sensors. The root is 0, as only the mean is needed.
        unobserved = len(state.table.unit) - 1
        propagate_root(
            state.table, unobserved, combination.root, combination.x, 0, gap, state.flow_scratch
        )
        propagate_root(
            combination.table, m, state.root, state.xhat, h, gap, combination.flow_scratch
        )
        for i in range(combination.x.shape[1]):
            state.xhat[h, i] = combination.x[0, i]
        readings = state.scratch.moments[: state.gains.moments[state.nodes[h].model]]
        fill_readings(state, state.run, h, piece, now, end, readings)
        A, closed, H, L = (
            combination.A, combination.closed[h], combination.H[h], combination.L[h]
        )  # fmt: skip
        correct_by_moments(state.xhat, h, A, closed, H, L, readings, gap, combination.maps)
        now = end


@kernel
def sample_with_gain(
    state: Simulation, combination: CombinationState, h: int, instant: int
) -> None:
    """Update node ``h`` with its sample of an instant (index in ``state.instants``) by its constant
    gain L (n, p): ``xhat += L (y - H xhat)`` and ``P <- (I - L H) P (I - L H)' + L R L'``. Changes
    row ``h`` of ``state.xhat`` and ``state.root``, with P = root root'.
    """
    instants = state.instants
    s = instants.first[instant]
    p = instants.rows[instants.sensor[s]]
    correct_by_innovation(
        state.xhat,
        h,
        instants.H[instants.matrix[s]],
        combination.L[h],
        instants.y[s, :p],
        combination.x[0],
    )
    # The update of P has the form F P F' + Q of a prediction, with F = I - L H and Q = L R L'.
    predict_root(
        ONE,
        state.size,
        combination.lanes,
        0,
        h,
        combination.sampled[h],
        combination.noise[h],
        combination.work[0],
        combination.work[1],
    )


@kernel
def fuse_inbox(state: Simulation, combination: CombinationState, h: int) -> None:
    """Fuse the estimate of node ``h`` (index) with each one in its inbox, one after the other, by
    covariance intersection, or by inverse covariance intersection if the combination is INVERSE.
    The weight of each fusion minimises the trace or the determinant of the fused covariance.
    Changes row ``h`` of ``state.xhat`` (N, n) and ``state.root`` (N, n, n), lower triangular roots
    of P.
    """
    # The inbox is a linked list of messages in the pool; -1 ends it.
    m = state.nodes[h].inbox
    while m != -1:
        fuse_pair(
            state.xhat[h], state.root[h], state.pool_x[m], state.pool_root[m],
            # Whether by inverse intersection; whether the trace is minimised; scratch.
            combination.kind == INVERSE, combination.trace == 1, combination.pair,
        )  # fmt: skip
        m = state.pool[m].next


@kernel
def send_prediction(state: Simulation, combination: CombinationState, m: int, h: int) -> None:
    """Copy the prior of node ``h``, its prediction before the readings of this instant, into
    message ``m`` (index in the pool of messages), as consensus on predictions sends it. If readings
    are shared too, the ``tag`` of the message is the instant (index) of the node's newest sample,
    otherwise -1.
    """
    copy_state(
        state.size, state.pool_x, state.pool_root, m, combination.prior, combination.prior_root, h
    )
    state.pool[m].tag = state.nodes[h].reading if combination.share == 1 else -1


@kernel
def use_readings_heard(state: Simulation, h: int, now: float) -> None:
    """Update node ``h`` (index) with the samples of other nodes that messages in its inbox refer
    to, at ``now`` (seconds), as if it had taken them itself; only samples of this very instant are
    used. Changes row ``h`` of ``state.xhat`` and ``state.root``.
    """
    m = state.nodes[h].inbox
    while m != -1:
        message = state.pool[m]
        # The tag is the instant of the sample, -1 if none was sent. A late one belongs to the past.
        if message.tag >= 0 and now - message.sent <= 0.0:
            # 1.0: the noise of the sample is not scaled.
            use_instant(state, message.tag, state.root, state.xhat, h, 1.0)
        m = message.next


@kernel
def add_consensus(state: Simulation, combination: CombinationState, h: int) -> None:
    """Add the consensus term of consensus on predictions, ``gamma P sum_j (xbar_j - xbar)``, to
    ``state.xhat[h]``: xbar and P are the prior of node ``h`` (index), its prediction before the
    readings of this instant, the xbar_j the priors that messages in its inbox carry, and gamma is
    ``epsilon / (norm of P + 1)``.
    """
    n = state.xhat.shape[1]
    for i in range(n):
        total, m = 0.0, state.nodes[h].inbox
        while m != -1:
            total += state.pool_x[m, i] - combination.prior[h, i]
            m = state.pool[m].next
        combination.consensus_term[h, i, 0] = total
    scale_by_covariance(
        ONE,
        combination.prior_lanes,
        0,
        h,
        combination.epsilon,
        combination.consensus_term,
        combination.work[0, 0],
    )
    for i in range(n):
        state.xhat[h, i] += combination.consensus_term[h, i, 0]
