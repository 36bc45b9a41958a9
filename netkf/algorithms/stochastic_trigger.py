"""The stochastic event trigger: Han, Mo, Wu, Weerakkody, Sinopoli and Shi, "Stochastic
event-triggered sensor schedule for remote state estimation", IEEE Trans. Automatic Control 60,
2015; the closed-loop schedule.

After a reading y a node is silent with probability exp(-z' Y z / 2): z = y - H xbar is the
innovation, xbar the prediction, and the matrix Y the trigger. z' Y z is called the news of the
reading. To receivers silence is as informative as a reading H xbar with noise R + Y^-1.

Two filters implement this. ``ScheduledReadings`` sends readings, and receivers use silence.
``TriggeredMessages`` wraps any other filter in slots, which takes silence for a lost message.
``StochasticTrigger``, the class of scenario files, chooses between them.

Kernels simulate L runs at once (lanes, the last axis) in B blocks, with the structs of
``kernels.slots``: ``nodes`` (estimates and roots of H filters), ``readings`` (whitened, so that
noise has variance 1), ``plan`` (the events of S slots), ``links``, ``samples`` (output) and
``scratch``. Estimates are relative to an origin near the true state, which moves in some slots
(``rebase``, ``shift``), so that large states cost no digits. A kernel ``*_single`` runs one node
in one run, so that the SimPy engine rounds like the compiled one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np

from netkf.algorithms.delegate import FORWARDED, Delegate, forwarded
from netkf.algorithms.filter import Exchange, Filter, Message, NodeInfo, Reading
from netkf.algorithms.intermittent import Intermittent
from netkf.algorithms.kernels.slots import (
    ARRIVING,
    SENDING,
    WHOLE,
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
    transform_mean,
    update_by_reading,
    whiten_reading,
)
from netkf.algorithms.kernels.triggers import NO_READING, silence_probability, weigh_news
from netkf.algorithms.models import first_root, sample_update
from netkf.algorithms.registry import built_in, built_in_filters
from netkf.core.errors import ScenarioError
from netkf.core.fields import (
    SourceFile,
    definite_covariance,
    either,
    field,
    has_depth,
    instance_of,
    positive,
)
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import (
    LANES,
    ONE,
    aligned,
    any_lane,
    blocks_of,
    load,
    load_flags,
    select,
    spread,
    store,
    store_flags,
)

NOWHERE = np.zeros(1, dtype=bool)
"""Flags (1,) of a plan of one slot: what they flag does not happen in it."""


def trigger_matrix(Y: float | FloatArray, rows: int) -> FloatArray:
    """Return Y (p, p) for a reading of p ``rows``; a number stands for that multiple of the
    identity.
    """
    return np.asarray(Y if isinstance(Y, np.ndarray) else Y * np.eye(rows))


def entries_at(scenario: Any, node: int) -> list[int]:
    """Return the indices, in the ``sensors`` of a ``netkf.Scenario``, of the sensors of the node
    with the id ``node``.
    """
    return [placed_sensor.entry for placed_sensor in scenario.placed_sensors.get(node, ())]


def whitened_trigger(Y: float | FloatArray, R: FloatArray) -> FloatArray:
    """Return ``L' Y L`` (p, p) with ``L L' = R`` (p, p), the trigger for whitened readings; Y is
    (p, p) or a number, that multiple of the identity.
    """
    # z' Y z for z = L u, where u is the whitened innovation.
    root = np.linalg.cholesky(R)
    return np.asarray(root.T @ trigger_matrix(Y, len(R)) @ root)


def silence_noise(R: FloatArray, Y: float | FloatArray) -> FloatArray:
    """Return ``R + Y^-1`` (p, p), the noise covariance of the reading that silence is equivalent
    to, for R (p, p) and Y (p, p) or a number, that multiple of the identity.
    """
    return np.asarray(R + np.linalg.inv(trigger_matrix(Y, len(R))))


def news_of(reading: Reading, xhat: FloatArray, Y: float | FloatArray) -> float:
    """Return the news ``z' Y z`` of a reading with p > 0 rows, for its innovation
    ``z = y - H xhat`` (p,); ``xhat`` is (n,), Y (p, p) or a number, that multiple of the identity.
    """
    y, H = whiten_reading(*reading[:3])
    p, n = H.shape
    readings = block_of_reading(y, H)
    trigger = np.ascontiguousarray(whitened_trigger(Y, reading.R))[None]
    return weigh_news_single(
        np.ascontiguousarray(xhat).reshape(1, 1, n, 1), readings, trigger, np.empty((p, 1))
    )


@kernel
def weigh_news_single(x: FloatArray, readings: ReadingBlock, Y: FloatArray, z: FloatArray) -> float:
    """Return the news ``z' Y z`` of one whitened reading in one run, for its innovation
    z = y - H x and the estimate x (1, 1, n, 1); Y (1, p, p) is for whitened rows, ``z`` (p, 1) is
    scratch.
    """
    news: float = weigh_news(ONE, x, readings, (0, 0, 0), len(z), Y, z)
    return news


def whitened_triggers(models: Sequence[Any], Y: float | FloatArray) -> FloatArray:
    """Return ``L' Y L`` (H, p, p) with ``L L' = R`` for the readings of H nodes with these
    ``models``, zeros beyond their rows; p is the largest number of rows.
    """
    p = max(1, *(len(model.R) for model in models))
    weights = np.zeros((len(models), p, p))
    for k, model in enumerate(models):
        rows = len(model.R)
        if rows:
            weights[k, :rows, :rows] = whitened_trigger(Y, model.R)
    return weights


def silence_whitening(weight: FloatArray) -> FloatArray:
    """Return C^-1 (p, p) with the Cholesky factor C of ``I + W^-1``: that is ``R + Y^-1`` after
    whitening by R, the noise of the reading that stands for silence, and C^-1 whitens it again.

    W = ``weight`` (p, p) is the trigger for whitened rows, with zeros beyond the rows of the node,
    as the result has.
    """
    # A trigger is positive definite: zeros on the diagonal are rows that the node does not have.
    rows, inverse = int((weight.diagonal() > 0.0).sum()), np.zeros(weight.shape)
    noise = np.eye(rows) + np.linalg.inv(weight[:rows, :rows])
    inverse[:rows, :rows] = np.linalg.inv(np.linalg.cholesky(noise))
    return inverse


class ScheduledArrays(NamedTuple):
    """What ``scheduled_slots`` keeps for B blocks of L runs of H nodes, among it tables of W + H
    sensors: that of the sender of each of W directed links, as its receiver knows it from
    messages, then each node's own.

    trigger : (H, p, p), Y for whitened rows
    silence : (H, p, p), see ``silence_whitening``
    H : whitened rows (B, W + H, p, n, L) of the last reading of each sensor
    known : (B, W + H, L), 1 once a reading of the sensor has arrived
    prior : predictions (B, H, n, L) of the slot, to which news and silence refer
    z, row : (p, L) and (n, L), scratch
    """

    trigger: FloatArray
    silence: FloatArray
    H: FloatArray
    known: np.ndarray
    prior: FloatArray
    z: FloatArray
    row: FloatArray


@kernel
def scheduled_slots(
    nodes: SlotNodes,
    readings: ReadingBlock,
    plan: SlotPlan,
    links: SlotLinks,
    samples: SlotSamples,
    scratch: SlotScratch,
    arrays: ScheduledArrays,
) -> None:
    """Simulate H filters that broadcast readings over the S slots of a plan, Han et al. (2015), in
    B blocks of L runs: in each slot they predict, decide whether to send, and use readings and
    silence.

    Changes ``nodes.xhat`` (B, H, n, L), ``nodes.root`` (B, H, n, n, L) and the known sensors in
    ``arrays`` in place, writes 0 into ``plan.sent`` and ``plan.up`` for messages that are not sent,
    and writes ``samples``. ``plan.part`` says which part of a slot is simulated: up to the
    decisions to send (SENDING), from the arrivals on (ARRIVING), or both.
    """
    for b in range(plan.up.shape[0]):
        for s in range(plan.up.shape[1]):
            if plan.part != ARRIVING and plan.sensed[s]:
                predict_all(nodes, scratch, b)
                # Silence is about the prediction, which readings replace in ``nodes``.
                for h in range(len(nodes.rows)):
                    for i in range(nodes.xhat.shape[2]):
                        x = load(scratch.lanes, nodes.xhat, b, h, i)
                        store(scratch.lanes, arrays.prior, b, h, i, x)
            if plan.part != ARRIVING and plan.exchanged[s]:
                for h in range(len(nodes.rows)):
                    schedule_reading(nodes, readings, plan, links, scratch, arrays, b, s, h)
                drop_silent(plan, links, b, s, 0)
            if plan.part != SENDING:
                if plan.exchanged[s]:
                    for h in range(len(nodes.rows)):
                        update_by_sensors(nodes, readings, plan, links, scratch, arrays, b, s, h)
                store_sample_of_slot(nodes, plan, samples, scratch, b, s)
                rebase(nodes, readings, scratch, b, s)


@kernel
def schedule_reading(
    nodes: SlotNodes,
    readings: ReadingBlock,
    plan: SlotPlan,
    links: SlotLinks,
    scratch: SlotScratch,
    arrays: ScheduledArrays,
    b: int,
    s: int,
    h: int,
) -> None:
    """Decide whether node ``h`` of block ``b`` sends its reading of slot ``s``, in each of L runs:
    with probability 1 - exp(-z' Y z / 2), where z is its innovation with respect to the prediction
    in ``arrays.prior``. Writes 0 into ``plan.sent[b, s, 0, h]`` (L,) where it is silent or has no
    reading.
    """
    lanes = scratch.lanes
    news = weigh_news(
        lanes, arrays.prior, readings, (b, s, h), nodes.rows[h], arrays.trigger, arrays.z
    )
    # Through memory, since each lane (run) decides by itself.
    store(lanes, scratch.row, 0, news)
    for q in range(len(lanes)):
        # The first reading is always sent: receivers learn H from it, and know the sensor then.
        probability = silence_probability(scratch.row[0, q])
        known = arrays.known[b, len(links.sender) + h, q] == 1
        silent = known and plan.uniform[b, s, 0, h, q] < probability
        if scratch.row[0, q] == NO_READING or silent:
            plan.sent[b, s, 0, h, q] = 0


@kernel
def update_by_sensors(
    nodes: SlotNodes,
    readings: ReadingBlock,
    plan: SlotPlan,
    links: SlotLinks,
    scratch: SlotScratch,
    arrays: ScheduledArrays,
    b: int,
    s: int,
    h: int,
) -> None:
    """Update filter ``h`` of block ``b`` with the readings that arrive in slot ``s``, its own
    first, and with the silence of the other sensors that it knows: changes ``nodes.xhat[b, h]``
    (n, L) and ``nodes.root[b, h]`` (n, n, L), and marks the sensors of these readings as known in
    ``arrays``.

    Axes: L runs side by side.
    """
    # The own reading counts only if it was sent: else all nodes would not hold one estimate.
    sent = load_flags(scratch.lanes, plan.sent, b, s, 0, h)
    own = len(links.sender) + h
    update_by_sensor(nodes, readings, scratch, arrays, b, s, h, h, own, sent)
    for m in range(links.first[h], links.first[h + 1]):
        arrived = load_flags(scratch.lanes, plan.up, b, s, 0, links.direction[m])
        update_by_sensor(nodes, readings, scratch, arrays, b, s, h, links.sender[m], m, arrived)


@kernel
def update_by_sensor(
    nodes: SlotNodes,
    readings: ReadingBlock,
    scratch: SlotScratch,
    arrays: ScheduledArrays,
    b: int,
    s: int,
    h: int,
    sender: int,
    index: int,
    arrived: Any,
) -> None:
    """Update filter ``h`` of block ``b`` by the sensor of filter ``sender``: with its reading of
    slot ``s`` in the lanes where that has ``arrived`` (flags (L,)), else with its silence.

    ``index`` is the entry of the sensor among the W + H known ones: those of the senders of W
    directions, then the own ones of H filters. Changes ``nodes.xhat[b, h]`` (n, L) and
    ``nodes.root[b, h]`` (n, n, L), and where a reading arrived ``arrays.H`` and ``arrays.known`` of
    this sensor.
    """
    lanes, rows = scratch.lanes, nodes.rows[sender]
    known = load_flags(lanes, arrays.known, b, index)
    if any_lane(arrived):
        # A fixed H has one block and one slot.
        d, t = min(b, readings.H.shape[0] - 1), min(s, readings.H.shape[1] - 1)
        # Store H: later silence is equivalent to a reading with it.
        for k in range(rows):
            for i in range(nodes.xhat.shape[2]):
                former = load(lanes, arrays.H, b, index, k, i)
                present = load(lanes, readings.H, d, t, sender, k, i)
                store(lanes, arrays.H, b, index, k, i, select(arrived, present, former))
        update_by_reading(nodes, readings, scratch, b, s, h, sender, arrived)
    # Silence: lanes without an arrival in which the sensor is known. One without any reading so far
    # may not exist, and its silence has no meaning.
    silent = select(arrived, 0.0, select(known, 1.0, 0.0)) > 0.0
    if any_lane(silent):
        use_silence(nodes, scratch, arrays, b, h, sender, index, silent)
    store_flags(lanes, arrays.known, b, index, select(arrived, 1.0, select(known, 1.0, 0.0)) > 0.0)


@kernel
def use_silence(
    nodes: SlotNodes,
    scratch: SlotScratch,
    arrays: ScheduledArrays,
    b: int,
    h: int,
    sender: int,
    index: int,
    silent: Any,
) -> None:
    """Update filter ``h`` of block ``b`` with a reading ``H xbar`` of noise ``R + Y^-1``, to which
    the silence of filter ``sender`` is equivalent, in the lanes flagged in ``silent`` (L,): changes
    ``nodes.xhat[b, h]`` (n, L) and ``nodes.root[b, h]`` (n, n, L).

    ``arrays.H[b, index]`` (p, n, L) is the sender's whitened H, and ``arrays.prior[b, h]`` (n, L)
    the prediction xbar.
    """
    lanes, n = scratch.lanes, nodes.xhat.shape[2]
    for k in range(nodes.rows[sender]):
        innovation = spread(lanes, 0.0)
        for i in range(n):
            # Row k of C^-1 H, which has noise of variance 1, see silence_whitening.
            total = spread(lanes, 0.0)
            for j in range(k + 1):
                total += arrays.silence[sender, k, j] * load(lanes, arrays.H, b, index, j, i)
            store(lanes, arrays.row, i, total)
            # The innovation H xbar - H xhat: zero until other readings of the slot move xhat.
            difference = load(lanes, arrays.prior, b, h, i) - load(lanes, nodes.xhat, b, h, i)
            innovation += total * difference
        # Row k of C^-1 H S with the root S of P: zeros, which change nothing, in other lanes.
        for j in range(n):
            total = spread(lanes, 0.0)
            for i in range(j, n):
                total += load(lanes, arrays.row, i) * load(lanes, nodes.root, b, h, i, j)
            store(lanes, scratch.row, j, select(silent, total, 0.0))
        # Kalman update by this row; the gain is ``gains`` times the factor that is returned.
        gains = scratch.gains
        step = innovation * rotate_lanes(lanes, scratch.size, nodes.root, b, h, scratch.row, gains)
        for i in range(n):
            x = load(lanes, nodes.xhat, b, h, i)
            store(lanes, nodes.xhat, b, h, i, x + load(lanes, gains, i) * step)


class ScheduledState(NamedTuple):
    """The state of a node of ``ScheduledReadings``.

    xhat, root : estimate (n,) and root (n, n) of its covariance
    model : of the plant and the node's sensors
    prior : prediction (n,) of this slot
    reading : own reading of this slot, or None
    sent : whether it was sent in this slot
    senders, sensors : ids of the nodes whose sensors are known from a reading that arrived (-1:
                       the node itself), and (H, R) of each
    """

    xhat: FloatArray
    root: FloatArray
    model: Any
    prior: FloatArray
    reading: Reading | None = None
    sent: bool = False
    senders: tuple[int, ...] = ()
    sensors: tuple[tuple[FloatArray, FloatArray], ...] = ()

    @property
    def P(self) -> FloatArray:
        """The covariance ``root root'`` (n, n) of the estimate."""
        return self.root @ self.root.T


@dataclass(frozen=True, eq=False)
class ScheduledReadings(Filter):
    """Every node broadcasts its reading y or is silent, and its receivers use the silence, too.

    Silence is as informative as a reading ``H xbar`` with noise ``R + Y^-1``. A node uses its own
    reading like its receivers, only if it is sent, so that all have one estimate; the first is
    always sent.
    """

    Y: float | FloatArray

    paper: ClassVar[str] = "stochastic_trigger"
    combination: ClassVar[str] = "scheduled readings"
    clocks: ClassVar[tuple[str, ...]] = ()
    one_way: ClassVar[bool] = True
    randomised: ClassVar[bool] = True
    fixed_sensors: ClassVar[bool] = True
    every_reading: ClassVar[bool] = True
    reads_what_it_sends: ClassVar[bool] = True
    slot_kernel = staticmethod(scheduled_slots)

    def decides_in_slots(self) -> bool:
        """Return True: a node may keep its reading to itself, and the compiled ``slot_kernel``
        writes which nodes send.
        """
        return True

    def slot_arrays(
        self, states: Sequence[Any], infos: Sequence[NodeInfo], runs: int
    ) -> tuple[ScheduledArrays]:
        """Return the arrays of the compiled ``slot_kernel`` for ``runs`` runs of H nodes that start
        in these ``states``, with W directed links, counted from ``infos``: triggers, and empty
        tables of the W + H sensors that nodes know of each other and of themselves.
        """
        models, blocks = [state.model for state in states], blocks_of(runs)
        (H, n), W = (len(models), len(states[0].xhat)), sum(info.degree for info in infos)
        weights = whitened_triggers(models, self.Y)
        p, entries = weights.shape[1], W + H
        return (
            ScheduledArrays(
                trigger=weights,
                silence=np.stack([silence_whitening(one) for one in weights]),
                H=aligned((blocks, entries, p, n, LANES)),
                known=np.zeros((blocks, entries, LANES), dtype=np.uint8),
                prior=aligned((blocks, H, n, LANES)),
                z=aligned((p, LANES)),
                row=aligned((n, LANES)),
            ),
        )

    def scenario_notes(self, scenario: Any) -> tuple[str, ...]:
        """Return a note for the user where messages of a ``netkf.Scenario`` may be lost, which
        makes P too small; else nothing.
        """
        if scenario.delivers_all:
            return ()
        return (
            "event-triggered: messages may be lost, and a node takes that for silence; P may then "
            "be too small",
        )

    def payload_numbers(self, n: int, rows: int, phase: int) -> int:
        """Return the size of a message in numbers of 64 bits: the ``rows`` of a reading; sensors do
        not change and are not counted.
        """
        return rows

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> ScheduledState:
        """Return the first state of a node, with estimate ``mean`` (n,) and covariance ``cov``
        (n, n), which knows no sensor yet, not even its own.
        """
        return ScheduledState(mean, first_root(cov), model, mean)

    def predict(self, state: ScheduledState, gap: float) -> ScheduledState:
        """Return the state ``gap`` seconds later; the prediction is kept as ``prior``, to which all
        decisions of the slot refer.
        """
        xhat, root = state.model.predict(state.xhat, state.root, gap)
        return state._replace(xhat=xhat, root=root, prior=xhat, reading=None, sent=False)

    def update(self, state: ScheduledState, reading: Reading) -> ScheduledState:
        """Return the state with the reading stored for the exchange of the slot."""
        return state._replace(reading=reading if len(reading.y) else None)

    def emit(
        self, state: ScheduledState, exchange: Exchange
    ) -> tuple[ScheduledState, Reading | None]:
        """Return the state and the payload: the reading, or with probability exp(-z' Y z / 2)
        None, nothing is sent.
        """
        reading = state.reading
        if reading is None:
            return state, None
        # -1, the node itself, is among the known sensors once it has sent its first reading.
        if -1 in state.senders:
            probability = silence_probability(news_of(reading, state.prior, self.Y))
            if exchange.uniform < probability:
                return state, None
        return state._replace(sent=True), reading

    def absorb(
        self, state: ScheduledState, messages: Sequence[Message], exchange: Exchange
    ) -> ScheduledState:
        """Return the state after the readings that were sent, and after the silence of all other
        known sensors.
        """
        arrived = {message.sender: message.payload for message in messages}
        if state.sent and state.reading is not None:
            arrived[-1] = state.reading
        sensors = dict(zip(state.senders, state.sensors, strict=True))
        sensors.update({j: (reading.H, reading.R) for j, reading in arrived.items()})
        xhat, root = state.xhat, state.root
        for sender, (H, R) in sorted(sensors.items()):
            if sender in arrived:
                xhat, root = sample_update(xhat, root, arrived[sender].y, H, R)
            else:
                # Silence: a reading that equals its prediction, of larger noise.
                noise = silence_noise(R, self.Y)
                xhat, root = sample_update(xhat, root, H @ state.prior, H, noise)
        senders = tuple(sorted(sensors))
        return state._replace(
            xhat=xhat, root=root, senders=senders, sensors=tuple(sensors[j] for j in senders)
        )

    def shift(self, state: ScheduledState, offset: FloatArray) -> ScheduledState:
        """Return the state with ``offset`` (n,) added to estimate and prediction, for a move of the
        origin, and ``H offset`` to the reading: innovations do not change.
        """
        reading = state.reading
        if reading is not None:
            reading = reading._replace(y=reading.y + reading.H @ offset)
        return state._replace(xhat=state.xhat + offset, prior=state.prior + offset, reading=reading)

    def shift_payload(self, payload: Reading, offset: FloatArray) -> Reading:
        """Return the reading under way with ``H offset`` added, for a move of the origin by which
        estimates change by ``offset`` (n,).
        """
        return payload._replace(y=payload.y + payload.H @ offset)


class TriggerArrays(NamedTuple):
    """Decisions of H nodes of ``TriggeredMessages`` for B blocks of L runs.

    trigger : (H, p, p), Y for whitened rows
    news : (B, H, L), z' Y z of the last reading
    undecided : (B, H, L), 1 until it is decided whether the node sends after this reading
    silent : (B, H, L), 1 if it sends nothing until the next reading
    has_sent : (B, H, L), 1 once the node has sent after a reading
    x, z : scratch, predictions (B, H, n, L) and an innovation (p, L)
    """

    trigger: FloatArray
    news: FloatArray
    undecided: np.ndarray
    silent: np.ndarray
    has_sent: np.ndarray
    x: FloatArray
    z: FloatArray


def trigger_arrays(models: Sequence[Any], Y: float | FloatArray, runs: int) -> TriggerArrays:
    """Return the arrays of H nodes with these ``models`` in ``runs`` runs, before they have read
    anything; the trigger Y is (p, p) or a number, that multiple of the identity.
    """
    trigger, shape = whitened_triggers(models, Y), (blocks_of(runs), len(models))
    return TriggerArrays(
        trigger,
        np.full((*shape, LANES), NO_READING),
        undecided=np.ones((*shape, LANES), dtype=np.uint8),
        silent=np.zeros((*shape, LANES), dtype=np.uint8),
        has_sent=np.zeros((*shape, LANES), dtype=np.uint8),
        x=aligned((*shape, len(models[0].F), LANES)),
        z=aligned((trigger.shape[1], LANES)),
    )


class TriggerPlan(NamedTuple):
    """The order of events in the slots of a wrapped filter: news are computed outside of its
    kernel, and need the prediction that the kernel will have at the reading.

    first : index of the first exchange step after the reading
    predict_first : whether estimates are predicted before the reading
    rebase_first : whether the origin of estimates moves (``rebase``) before the reading, as in
                   filters that sample their predictions; else it moves at the end of the slot
    split : whether an exchange before the reading changes estimates; the kernel is then called
            twice a slot, up to the reading and from it on
    """

    first: int
    predict_first: bool
    rebase_first: bool
    split: bool


def trigger_plan(inner: Filter) -> TriggerPlan | None:
    """Return the order of events in the slots of the filter ``inner``; None if its innovations
    cannot be computed outside of its kernel.
    """
    schedule = inner.schedule or ()
    before = schedule[: schedule.index("sense")]
    # The number of exchanges before the reading, and whether they change estimates.
    early = before.count("exchange")
    moves = any(inner.moves_estimates(phase) for phase in range(early))
    # If exchanges change estimates before the reading, the kernel is called twice a slot: for the
    # exchanges alone, then for the rest. Its plan cannot leave out only the exchanges before the
    # reading, nor separate a prediction from the reading.
    if moves and (early < schedule.count("exchange") or "predict" in before):
        return None
    first = sum(inner.exchange_steps(phase) for phase in range(early))
    return TriggerPlan(first, "predict" in before, inner.predicts, moves)


@kernel
def decide_senders(
    nodes: SlotNodes,
    readings: ReadingBlock,
    plan: SlotPlan,
    links: SlotLinks,
    scratch: SlotScratch,
    arrays: TriggerArrays,
    order: TriggerPlan,
    s: int,
) -> None:
    """Decide which nodes send in slot ``s``, in all B blocks: in exchange steps before the reading
    by the news of the slot before, then by those of this one; ``order`` says which come before.

    Writes 0 into ``plan.sent[:, s]`` (B, E, H, L) and ``plan.up[:, s]`` (B, E, W, L) for messages
    that are not sent, and stores news and decisions in ``arrays``. Axes: E exchange steps, W
    directed links, H filters, L runs side by side.
    """
    for b in range(plan.sent.shape[0]):
        # Exchanges before the reading: the decisions after the reading of the slot before hold.
        for e in range(order.first):
            decide_step(plan, arrays, b, s, e)
        if plan.sensed[s] and not order.split:
            store_news(
                nodes, readings, arrays, scratch, b, s, order.predict_first, order.rebase_first
            )
        for e in range(order.first, plan.sent.shape[2]):
            decide_step(plan, arrays, b, s, e)
        for e in range(plan.sent.shape[2]):
            drop_silent(plan, links, b, s, e)


@kernel
def decide_step(plan: SlotPlan, arrays: TriggerArrays, b: int, s: int, e: int) -> None:
    """Decide which of the nodes of block ``b`` that are asked in step ``e`` of slot ``s`` send: a
    decision holds until the next reading. Writes 0 into ``plan.sent[b, s, e]`` (H, L) for silent
    ones, and new decisions into ``arrays``.

    Axes: H filters, L runs side by side.
    """
    for h in range(plan.sent.shape[3]):
        for q in range(plan.sent.shape[4]):
            if plan.sent[b, s, e, h, q] == 0:
                continue
            if arrays.undecided[b, h, q] == 1:
                # After its first reading a node always sends, and without a reading (negative
                # news) too.
                news, u = arrays.news[b, h, q], plan.uniform[b, s, e, h, q]
                silent = arrays.has_sent[b, h, q] == 1 and u < silence_probability(news)
                arrays.undecided[b, h, q], arrays.silent[b, h, q] = 0, silent
                if news >= 0.0:
                    arrays.has_sent[b, h, q] = 1
            if arrays.silent[b, h, q] == 1:
                plan.sent[b, s, e, h, q] = 0


@kernel
def store_news(
    nodes: SlotNodes,
    readings: ReadingBlock,
    arrays: TriggerArrays,
    scratch: SlotScratch,
    b: int,
    s: int,
    predict_first: bool,
    rebase_first: bool,
) -> None:
    """Store the news ``z' Y z`` of the readings of all H nodes of block ``b`` in slot ``s`` in
    ``arrays.news[b]`` (H, L), and mark each node as undecided, so that it decides anew whether to
    send.

    The innovation z = y - H x needs the estimate x at the reading, while ``nodes.xhat`` (unchanged)
    is that before the filter's kernel has simulated the slot. So do in a copy, ``arrays.x``, what
    the kernel does before the reading: move the origin that estimates are relative to
    (``rebase_first``), and predict (``predict_first``). Axes: L runs side by side.
    """
    lanes = scratch.lanes
    for h in range(len(nodes.rows)):
        for i in range(nodes.xhat.shape[2]):
            x = load(lanes, nodes.xhat, b, h, i)
            if rebase_first and readings.rebased[s]:
                # As ``rebase`` does: the true state of this slot becomes the origin.
                x -= load(lanes, readings.local, b, s, i)
            store(lanes, arrays.x, b, h, i, x)
        if predict_first:
            transform_mean(scratch, arrays.x, b, h, nodes.F)
        news = weigh_news(
            lanes, arrays.x, readings, (b, s, h), nodes.rows[h], arrays.trigger, arrays.z
        )
        store(lanes, arrays.news, b, h, news)
        for q in range(len(lanes)):
            arrays.undecided[b, h, q], arrays.silent[b, h, q] = 1, 0


@kernel
def store_news_of_slot(
    nodes: SlotNodes, readings: ReadingBlock, arrays: TriggerArrays, scratch: SlotScratch
) -> None:
    """Store the news ``z' Y z`` of the readings of all nodes and blocks of one slot in
    ``arrays.news`` (B, H, L), and mark the nodes as undecided. All that precedes the reading in
    the slot is done: ``nodes.xhat`` holds the predictions.

    Axes: B blocks of L runs, H filters.
    """
    for b in range(nodes.xhat.shape[0]):
        store_news(nodes, readings, arrays, scratch, b, 0, False, False)


class TriggeredSlots:
    """The ``slot_kernel`` of ``TriggeredMessages``, called like any other: in each slot it decides
    which nodes send, and runs the kernel of the ``inner`` filter with their messages.
    """

    def __init__(self, inner: Filter, order: TriggerPlan) -> None:
        """Take the wrapped filter, which has a kernel, and its ``trigger_plan``."""
        self._inner = inner
        self._kernel = inner.slot_kernel
        self._order = order
        self._decides = inner.decides_in_slots()
        # The engine looks for the compiled code of a kernel by its name.
        self.__name__ = self._kernel.__name__

    def __call__(
        self,
        nodes: SlotNodes,
        readings: ReadingBlock,
        plan: SlotPlan,
        links: SlotLinks,
        samples: SlotSamples,
        scratch: SlotScratch,
        arrays: TriggerArrays,
        states: Sequence[Any],
        *more: Any,
    ) -> None:
        """Simulate the filters over the S slots of a plan in place: changes ``nodes``, the
        decisions in ``arrays``, ``plan.sent`` and ``plan.up``, and writes ``samples``. ``states``
        are those in which nodes start, ``more`` the arrays of the inner filter's kernel.

        ``plan.part`` says whether only the decisions are wanted (SENDING), only what follows from
        the messages that arrive (ARRIVING), or both. ``plan.sent`` flags the nodes that are asked
        for a message, and then those that send one. If the order of a slot is ``split``, news
        refer to the estimates between the exchange and the reading: the inner kernel is called
        once for the exchange, then for the reading and all that follows.
        """
        # Innovations refer to the estimates with which nodes go on, not to those they report.
        carried_nodes = nodes._replace(xhat=self._inner.carried_estimates(nodes.xhat, more))
        for s in range(plan.up.shape[1]):
            asked = plan.sent[:, s : s + 1].copy()
            if plan.part != ARRIVING:
                decide_senders(
                    carried_nodes, readings, plan, links, scratch, arrays, self._order, s
                )
            # The trigger alone decides who sends: the inner kernel runs when messages have arrived.
            if plan.part == SENDING and not self._decides:
                continue
            slot_readings, slot_plan, slot_samples = single_slot(readings, plan, samples, s)
            if self._decides:
                # The filter decides on all that are asked; below, a message needs both decisions.
                slot_plan = slot_plan._replace(sent=asked, part=plan.part)
            arguments = (
                links,
                slot_samples,
                scratch,
                *self._inner.slot_gains(states, more, plan.first + s, 1),
            )
            if self._order.split:
                self._kernel(nodes, slot_readings, slot_plan._replace(sensed=NOWHERE), *arguments)
                if plan.sensed[s]:
                    store_news_of_slot(carried_nodes, slot_readings, arrays, scratch)
                # The first call has written the sample and moved the origin: not again.
                slot_readings, no_sample = slot_readings._replace(rebased=NOWHERE), np.full(1, -1)
                slot_plan = slot_plan._replace(exchanged=NOWHERE, sample=no_sample)
            self._kernel(nodes, slot_readings, slot_plan, *arguments)
            if self._decides:
                plan.sent[:, s : s + 1] &= slot_plan.sent
                plan.up[:, s : s + 1] = slot_plan.up


def single_slot(
    readings: ReadingBlock, plan: SlotPlan, samples: SlotSamples, s: int
) -> tuple[ReadingBlock, SlotPlan, SlotSamples]:
    """Return ``readings``, ``plan`` and ``samples`` of slot ``s`` alone, with S = 1, for
    ``TriggeredSlots``, which calls a kernel slot by slot. The plan's ``sent`` and ``uniform`` are
    empty, for filters that do not decide who sends.
    """
    at = slice(s, s + 1)

    def at_slot(values: Any) -> Any:
        """Return the values (B, 1, ...) of slot ``s`` from those of all slots (B, S, ...)."""
        return np.ascontiguousarray(values[:, at])

    # A fixed H has one slot already.
    local, fixed = at_slot(readings.local), readings.H.shape[1] == 1
    H = readings.H if fixed else at_slot(readings.H)
    alone = ReadingBlock(at_slot(readings.y), H, local, readings.rebased[at])
    nothing = np.zeros((0,) * 5, dtype=np.uint8), np.zeros((0,) * 5)
    slot_plan = SlotPlan(
        plan.first + s, plan.sensed[at], plan.exchanged[at], plan.sample[at],
        at_slot(plan.up), *nothing, WHOLE,
    )  # fmt: skip
    slot_samples = samples._replace(
        absolute=at_slot(samples.absolute), local=at_slot(samples.local)
    )
    return alone, slot_plan, slot_samples


class WrappedState(NamedTuple):
    """The state of a filter with a trigger.

    inner : state of the wrapped filter
    news : z' Y z of the last reading, NO_READING without one
    has_sent : whether the node has sent after a reading
    silent : whether it sends nothing until the next reading, None before that is decided
    """

    inner: Any
    news: float = NO_READING
    has_sent: bool = False
    silent: bool | None = None

    @property
    def xhat(self) -> FloatArray:
        """The estimate (n,) of the wrapped filter."""
        return np.asarray(self.inner.xhat)

    @property
    def root(self) -> FloatArray:
        """The root (n, n) of the covariance of the wrapped filter's estimate."""
        return np.asarray(self.inner.root)


@dataclass(frozen=True, eq=False)
class TriggeredMessages(Filter):
    """The filter ``inner`` with nodes that, after a reading, send nothing with probability
    exp(-z' Y z / 2), where z is its innovation.

    The filter takes a message that is not sent for one that is lost. Nodes always use their own
    readings, and those without a reading send.
    """

    Y: float | FloatArray
    inner: Filter

    clocks: ClassVar[tuple[str, ...]] = ()
    randomised: ClassVar[bool] = True
    paper: ClassVar[str] = ""
    combination: ClassVar[str] = ""
    # Which messages are sent depends on data, so that no comparison is proved.
    P_by_design: ClassVar[tuple[str, str]] = ("", "")

    @property
    def wrapped(self) -> Filter:
        """The filter that the trigger belongs to."""
        return self.inner

    @cached_property
    def slot_kernel(self) -> TriggeredSlots | None:
        """The compiled simulation of slots with the trigger, or None where the wrapped filter has
        none or its innovations cannot be computed from outside.
        """
        inner, plan = self.inner, trigger_plan(self.inner)
        # A user's class inherits the kernel of its base, which ignores what it overrides.
        is_compiled = type(inner) in built_in_filters().values() and inner.slot_kernel is not None
        return TriggeredSlots(inner, plan) if is_compiled and plan is not None else None

    def decides_in_slots(self) -> bool:
        """Return True: a node may send nothing after a reading, and the compiled ``slot_kernel``
        writes which nodes send.
        """
        return True

    def slot_arrays(
        self, states: Sequence[Any], infos: Sequence[NodeInfo], runs: int
    ) -> tuple[Any, ...]:
        """Return the arguments of the compiled ``slot_kernel`` for ``runs`` runs of H nodes that
        start in these ``states``: the arrays of the trigger, the wrapped filter's states, and the
        arrays of its kernel.
        """
        inner = [state.inner for state in states]
        arrays = trigger_arrays([state.model for state in inner], self.Y, runs)
        return (arrays, inner, *self.inner.slot_arrays(inner, infos, runs))

    def slot_gains(
        self, states: Sequence[Any], arrays: tuple[Any, ...], first: int, count: int
    ) -> tuple[Any, ...]:
        """Return the ``arrays`` of ``slot_arrays`` unchanged, whatever the slots: ``slot_kernel``
        asks the wrapped filter for the gains of each slot.
        """
        return arrays

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> WrappedState:
        """Return the state of the wrapped filter at time 0 from ``mean`` (n,) and ``cov`` (n, n),
        without a decision yet.
        """
        return WrappedState(self.inner.init(model, mean, cov, node))

    def predict(self, state: WrappedState, gap: float) -> WrappedState:
        """Return the state ``gap`` seconds later, in which the wrapped filter has predicted."""
        return state._replace(inner=self.inner.predict(state.inner, gap))

    def update(self, state: WrappedState, reading: Reading) -> WrappedState:
        """Return the state after a reading, which the wrapped filter uses; its news is kept for
        ``emit``, which decides anew whether the node sends.
        """
        news = NO_READING
        if len(reading.y):
            # Before the filter uses the reading: news is relative to the prediction.
            news = news_of(reading, self.inner.estimate(state.inner)[0], self.Y)
        # The field ``silent`` is None again, that is undecided.
        return WrappedState(self.inner.update(state.inner, reading), news, state.has_sent)

    def emit(self, state: WrappedState, exchange: Exchange) -> tuple[WrappedState, Any]:
        """Return the state after sending, with the decision whether the node is silent until its
        next reading, and the payload of the wrapped filter, or None if it is silent.
        """
        silent = state.silent
        if silent is None:
            # After its first reading a node always sends.
            silent = state.has_sent and exchange.uniform < silence_probability(state.news)
            has_sent = state.has_sent or state.news >= 0.0
            state = state._replace(silent=silent, has_sent=has_sent)
        # The wrapped filter's state changes as if it had sent: silence is a lost message.
        inner, payload = self.inner.emit(state.inner, exchange)
        return state._replace(inner=inner), None if silent else payload

    def absorb(
        self, state: WrappedState, messages: Sequence[Message], exchange: Exchange
    ) -> WrappedState:
        """Return the state after the messages, which the wrapped filter absorbs."""
        return state._replace(inner=self.inner.absorb(state.inner, messages, exchange))

    def estimate(self, state: WrappedState) -> tuple[FloatArray, FloatArray | None]:
        """Return estimate (n,) and covariance (n, n) of the wrapped filter."""
        return self.inner.estimate(state.inner)

    def shift(self, state: WrappedState, offset: FloatArray) -> WrappedState:
        """Return the state with ``offset`` (n,) added to the wrapped filter's estimate, for a move
        of the origin: innovations do not change, and so the trigger's news neither.
        """
        return state._replace(inner=self.inner.shift(state.inner, offset))

    def stopped(self, state: WrappedState) -> bool:
        """Return True once the wrapped filter has frozen its network estimate."""
        return self.inner.stopped(state.inner)

    def conserved(self, state: WrappedState) -> Any:
        """Return by name the quantities of the wrapped filter whose sums over all nodes exchanges
        conserve.
        """
        return self.inner.conserved(state.inner)


# All else that a filter says of itself is what the wrapped filter says.
for _name in set(FORWARDED) - vars(TriggeredMessages).keys():
    setattr(TriggeredMessages, _name, forwarded(_name))


@built_in("event-triggered", trigger="stochastic")
@dataclass(frozen=True, eq=False)
class StochasticTrigger(Delegate):
    """A node is silent after a reading with probability ``exp(-z' Y z / 2)``, with the innovation
    ``z = y - H xbar``, Han et al. 2015, closed loop; never after its first reading.

    inner  the filter, which runs in slots and sends. With "intermittent" silence is used: it is as
           informative as a reading `H xbar` with noise `R + Y^-1`. Others take it for a loss
    Y      positive definite, of as many rows as each reading; a number is that times the identity

    With "intermittent" errors stay Gaussian with covariance P, and a node sends with probability
    ``1 - det(I + Pi Y)^-1/2``, ``Pi = H Pbar H' + R``, if all nodes receive all messages: a node
    that misses one takes it for silence. Own readings count when they are sent. With other filters
    a node always uses its reading, and is silent until the next one.
    """

    clocks: ClassVar[tuple[str, ...]] = ()
    talks: ClassVar[bool] = True

    inner: Filter = field(instance_of(Filter))
    Y: float | FloatArray = field(either(positive, definite_covariance, has_depth(1)))

    @cached_property
    def wrapped(self) -> Filter:
        """The filter that runs: one that uses silence if ``inner`` is "intermittent", else
        ``inner`` with a trigger.
        """
        if type(self.inner) is Intermittent:
            return ScheduledReadings(self.Y)
        return TriggeredMessages(self.Y, self.inner)

    def check_scenario(self, scenario: Any) -> None:
        """Raise ScenarioError if the filter that sends does not run in slots, sends nothing or has
        a trigger itself, or if Y is a matrix that does not fit the readings of each node of a
        ``netkf.Scenario``.
        """
        inner = self.inner
        if isinstance(inner, Delegate) or inner.schedule is None or not inner.talks:
            raise ScenarioError(
                "filter.inner",
                "must be a filter in slots whose nodes send messages, without a trigger",
                type(inner).__name__,
                'write inner = { kind = "intermittent" }, or another one',
            )
        inner.check_scenario(scenario)
        # A number fits readings of any number of rows.
        if not isinstance(self.Y, np.ndarray):
            return
        for node in scenario.nodes:
            sensors = [scenario.sensors[k] for k in entries_at(scenario, node)]
            rows = sum(len(sensor.R) for sensor in sensors)
            recorded = [isinstance(getattr(one, "path", None), SourceFile) for one in sensors]
            # One sensor lacks all of its rows or none: only with several may some be missing.
            if len(sensors) > 1 and any(recorded):
                raise ScenarioError(
                    "filter.Y",
                    f"must be a number, because some rows of the readings of node {node} may be "
                    "missing in a record",
                    "a matrix",
                    "write a number, or use one sensor",
                )
            if rows not in (0, len(self.Y)):
                raise ScenarioError(
                    "filter.Y",
                    f"must be {rows} x {rows} for the readings of node {node}",
                    f"{len(self.Y)} x {len(self.Y)}",
                    "write a number, which is that times the identity",
                )
