"""The stochastic event trigger: Han, Mo, Wu, Weerakkody, Sinopoli and Shi, "Stochastic
event-triggered sensor schedule for remote state estimation", IEEE Trans. Automatic Control 60,
2015; the closed-loop schedule.

After a reading y a node is silent with probability exp(-z' Y z / 2): z = y - H xbar is the
innovation, xbar the prediction, and the matrix Y the trigger. z' Y z is called the news of the
reading. To receivers silence is as informative as a reading H xbar with noise R + Y^-1.

Two filters implement this. ``ScheduledReadings`` sends readings, and receivers use silence.
``TriggeredMessages`` wraps any other filter in slots, which takes silence for a lost message.
``StochasticTrigger``, the class of scenario files, chooses between them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, wraps
from operator import attrgetter
from types import FunctionType
from typing import Any, NamedTuple, TypeVar

import numpy as np

from netkf.algorithms.filter import Exchange, Filter, Message, NodeInfo, Reading, compiled_kernels
from netkf.algorithms.intermittent import Intermittent
from netkf.algorithms.kernels.estimates import copy_vector, update_by_row
from netkf.algorithms.kernels.run import absorb as nothing
from netkf.algorithms.kernels.run import predict_estimate, shift_prior, use_reading
from netkf.algorithms.kernels.triggers import NO_READING, silence_probability, weigh_news
from netkf.algorithms.records import Kernels, Record
from netkf.algorithms.registry import built_in
from netkf.algorithms.traits import Analysis, Needs, Timing, unless_all_arrive
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
from netkf.linalg.lanes import any_lane, load, load_flags, select, spread, store, store_flags


def trigger_matrix(Y: float | FloatArray, rows: int) -> FloatArray:
    """Return Y (p, p) for a reading of p ``rows``; a number stands for a multiple of I."""
    return np.asarray(Y if isinstance(Y, np.ndarray) else Y * np.eye(rows))


def silence_noise(R: FloatArray, Y: float | FloatArray) -> FloatArray:
    """Return ``R + Y^-1`` (p, p), the noise covariance of the reading that silence is equivalent
    to, for R (p, p) and Y (p, p) or a number, that multiple of the identity.
    """
    return np.asarray(R + np.linalg.inv(trigger_matrix(Y, len(R))))


def whitened_triggers(models: Sequence[Any], p: int, Y: float | FloatArray) -> FloatArray:
    """Return ``L' Y L`` (H, p, p) with ``L L' = R`` for the whitened readings of H nodes with these
    ``models``, zeros beyond their rows, of which there are at most p.
    """
    weights = np.zeros((len(models), p, p))
    for k, model in enumerate(models):
        rows = len(model.R)
        if rows:
            # z' Y z for z = L u, where u is the whitened innovation.
            root = np.linalg.cholesky(model.R)
            weights[k, :rows, :rows] = root.T @ trigger_matrix(Y, rows) @ root
    return weights


def silence_whitening(weight: FloatArray) -> FloatArray:
    """Return C^-1 (p, p) with the Cholesky factor C of ``I + W^-1``: that is ``R + Y^-1`` after
    whitening by R, the noise of the reading that stands for silence, and C^-1 whitens it again.

    W = ``weight`` (p, p) is the trigger for whitened rows, with zeros beyond the node's.
    """
    # A trigger is positive definite: zeros on the diagonal are rows that the node does not have.
    rows, inverse = int((weight.diagonal() > 0.0).sum()), np.zeros(weight.shape)
    noise = np.eye(rows) + np.linalg.inv(weight[:rows, :rows])
    inverse[:rows, :rows] = np.linalg.inv(np.linalg.cholesky(noise))
    return inverse


@kernel
def predict_prior(record: Any, h: int, run: Any) -> None:
    """Predict node ``h``, and keep the prediction, to which news and silence refer."""
    predict_estimate(run.model, run, record.xhat, record.root, h, h)
    copy_vector(run.lanes, run.size, record.prior, h, record.xhat, h, True)
    store_flags(run.lanes, record.sent, h, spread(run.lanes, 0.0) > 0.0)


@kernel
def emit_reading(record: Any, h: int, m: int, run: Any) -> None:
    """Send the reading with probability 1 - exp(-z' Y z / 2), and the rows for later silence."""
    lanes, rows, matrix = run.lanes, run.rows[run.reading], run.first_H + run.matrix[run.reading]
    for k in range(rows):
        for i in range(len(run.size)):
            total = spread(lanes, 0.0)
            for j in range(k + 1):
                total += record.whitening[h, k, j] * load(lanes, run.H, matrix, j, i)
            store(lanes, record.payload.rows, m, k, i, total)
            store(lanes, record.own, h, k, i, total)
    weigh_news(run, record.prior, h, record.trigger, record.innovation, record.news, 0)
    for q in range(len(lanes)):
        # The first reading is always sent: receivers know the sensor then.
        probability = silence_probability(record.news[0, q])
        silent = record.known[h, q] == 1 and run.uniform[q] < probability
        if record.news[0, q] == NO_READING or silent:
            run.sends[q] = 0
    store_flags(lanes, record.sent, h, load_flags(lanes, run.sends))


@kernel
def use_silence(record: Any, h: int, run: Any, rows: FloatArray, k: int, silent: Any) -> None:
    """Update node ``h`` with a reading ``H xbar`` of noise ``R + Y^-1`` in the lanes that are
    ``silent``; ``rows[k]`` (p, n, L) is that H, whitened.
    """
    lanes = run.lanes
    for j in range(rows.shape[1]):
        # What would be read: the prediction.
        total = spread(lanes, 0.0)
        for i in range(len(run.size)):
            total += load(lanes, rows, k, j, i) * load(lanes, record.prior, h, i)
        store(lanes, record.innovation, 0, j, total)
        place, scratch = (0, k, j), (run.row, run.gains)
        update_by_row(
            lanes, run.size, record.xhat, record.root, h, record.innovation, rows, place, silent,
            scratch,
        )  # fmt: skip


@kernel
def absorb_readings(record: Any, h: int, run: Any) -> None:
    """Use the readings sent, the own one, and the silence of all other sensors that ``h`` knows."""
    lanes, payload = run.lanes, record.payload
    # The own reading counts only if it was sent: else all nodes would not hold one estimate.
    sent = load_flags(lanes, record.sent, h)
    use_reading(run, record.xhat, record.root, h, run.reading, sent)
    known = load_flags(lanes, record.known, h)
    silent = select(sent, 0.0, select(known, 1.0, 0.0)) > 0.0
    if any_lane(silent):
        use_silence(record, h, run, record.own, h, silent)
    store_flags(lanes, record.known, h, select(sent, 1.0, select(known, 1.0, 0.0)) > 0.0)
    first, stop = run.first[h], run.first[h + 1]
    for w in range(first, stop):
        store_flags(lanes, record.silent, w, load_flags(lanes, record.heard, w))
    for k in range(run.count):
        w, arrived = run.link[k], load_flags(lanes, run.arrived, k)
        use_reading(run, record.xhat, record.root, h, run.heard[k], arrived)
        for j in range(payload.rows.shape[1]):
            for i in range(len(run.size)):
                new = load(lanes, payload.rows, run.message[k], j, i)
                old = load(lanes, record.rows, w, j, i)
                store(lanes, record.rows, w, j, i, select(arrived, new, old))
        for q in range(len(lanes)):
            if run.arrived[k, q] == 1:
                record.heard[w, q], record.silent[w, q] = 1, 0
    # A sensor without any reading so far may not exist, and its silence has no meaning.
    for w in range(first, stop):
        silent = load_flags(lanes, record.silent, w)
        if any_lane(silent):
            use_silence(record, h, run, record.rows, w, silent)


def scheduled_readings_record(
    filtering: ScheduledReadings, infos: Sequence[NodeInfo], models: Sequence[Any]
) -> Record:
    """Return predictions, what was sent, and the sensors known: own, and of each link's sender."""
    n, p = len(models[0].information), infos[0].rows
    trigger = whitened_triggers(models, p, filtering.Y)
    flag = ((), np.uint8)
    return Record(
        node={"prior": (n,), "own": (p, n), "sent": flag, "known": flag},
        link={"rows": (p, n), "heard": flag, "silent": flag},
        payload={"rows": (p, n)},
        scratch={"innovation": (1, p), "news": (1,)},
        settings={
            "trigger": trigger,
            "whitening": np.stack([silence_whitening(one) for one in trigger]),
        },
    )


def begin_scheduled(_: Any, node: Mapping[str, np.ndarray], _info: NodeInfo, _model: Any) -> None:
    """Take the first estimate for a prediction."""
    node["prior"][:] = node["xhat"]


@dataclass(frozen=True, eq=False)
class ScheduledReadings(Filter):
    """Every node broadcasts its reading y or is silent, and its receivers use the silence, too.

    Silence is as informative as a reading ``H xbar`` with noise ``R + Y^-1``. A node uses its own
    reading like its receivers, only if it is sent: all have one estimate. The first is sent.
    """

    Y: float | FloatArray

    analysis = Analysis(paper="stochastic_trigger", payload_numbers=lambda _, rows, __: rows)
    timing = Timing(clocks=(), randomised=True)
    needs = Needs(
        one_way=True,
        fixed_sensors=True,
        every_reading=True,
        reads_what_it_sends=True,
        notes=unless_all_arrive(
            "event-triggered: messages may be lost, and a node takes that for silence; P may then "
            "be too small"
        ),
    )
    kernels = Kernels(
        predict=predict_prior,
        update=nothing,  # a reading is used in the exchange of its slot, if it is sent
        emit=emit_reading,
        absorb=absorb_readings,
        shift=shift_prior,  # innovations do not change
        shift_payload=nothing,
        sends_readings=True,
        decides=True,
        record=scheduled_readings_record,
        begin=begin_scheduled,
    )

    shift = Filter.shift  # innovations do not depend on the origin


F = TypeVar("F", bound=type[Filter])


def forwarding(cls: F) -> F:
    """Give a class the public attributes of its ``wrapped`` filter that it does not define."""
    for name in vars(Filter).keys() - vars(cls).keys():
        if not name.startswith("_"):
            setattr(cls, name, _forwarded(name, vars(Filter)[name]))
    return cls


def _forwarded(name: str, contract: Any) -> Any:
    """Return a method, or a property, with what ``wrapped`` has of that name."""
    find = attrgetter(f"wrapped.{name}")
    if isinstance(contract, FunctionType):
        return wraps(contract)(lambda self, *arguments: find(self)(*arguments))
    return property(find)


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


@kernel
def decide(record: Any, h: int, run: Any) -> None:
    """Decide whether node ``h`` is silent until its next reading, in the lanes in which it is asked
    for a message and that is undecided.
    """
    for q in range(len(run.lanes)):
        if run.sends[q] == 1 and record.trigger_undecided[h, q] == 1:
            # After its first reading a node always sends, and without a reading (negative news)
            # too.
            news = record.trigger_news[h, q]
            silent = record.trigger_has_sent[h, q] == 1 and run.uniform[q] < silence_probability(
                news
            )
            record.trigger_undecided[h, q], record.trigger_silent[h, q] = 0, silent
            if news >= 0.0:
                record.trigger_has_sent[h, q] = 1


def triggered_record(
    filtering: TriggeredMessages, infos: Sequence[NodeInfo], models: Sequence[Any]
) -> Record:
    """Return the record of the wrapped filter with news and decisions."""
    inner: Record = _kernels_inside(filtering).record(filtering.inner, infos, models)
    p, flag = infos[0].rows, ((), np.uint8)
    flags = dict.fromkeys(("trigger_undecided", "trigger_silent", "trigger_has_sent"), flag)
    return replace(
        inner,
        node={**inner.node, "trigger_news": (), **flags},
        scratch={**inner.scratch, "trigger_z": (1, p)},
        settings={**inner.settings, "trigger_Y": whitened_triggers(models, p, filtering.Y)},
    )


def begin_triggered(
    filtering: TriggeredMessages, node: Mapping[str, np.ndarray], info: NodeInfo, model: Any
) -> None:
    """Begin as the wrapped filter does, without a reading."""
    _kernels_inside(filtering).begin(filtering.inner, node, info, model)
    node["trigger_news"][...], node["trigger_undecided"][...] = NO_READING, 1


def prepare_triggered(filtering: TriggeredMessages, record: Any, *slots: Any) -> None:
    """Prepare the slots as the wrapped filter does."""
    _kernels_inside(filtering).prepare(filtering.inner, record, *slots)


def _kernels_inside(filtering: TriggeredMessages) -> Kernels:
    assert filtering.inner.kernels is not None
    return filtering.inner.kernels


@cache
def with_trigger(inner: Kernels) -> Kernels:
    """Return the kernels of a filter with a trigger before those of the filter ``inner``."""
    inner_update, inner_emit = inner.update, inner.emit

    @kernel
    def update(record: Any, h: int, run: Any) -> None:
        """Weigh the reading before the filter uses it, and decide anew."""
        weigh_news(run, record.xhat, h, record.trigger_Y, record.trigger_z, record.trigger_news, h)
        for q in range(len(run.lanes)):
            record.trigger_undecided[h, q], record.trigger_silent[h, q] = 1, 0
        inner_update(record, h, run)

    @kernel
    def emit(record: Any, h: int, m: int, run: Any) -> None:
        """Send what the filter sends, unless the node is silent."""
        decide(record, h, run)
        # The filter's state changes as if it had sent: silence is a lost message.
        inner_emit(record, h, m, run)
        for q in range(len(run.lanes)):
            if record.trigger_silent[h, q] == 1:
                run.sends[q] = 0

    return replace(
        inner, record=triggered_record, begin=begin_triggered, prepare=prepare_triggered,
        update=update, emit=emit, decides=True, under_clocks=None,
    )  # fmt: skip


@forwarding
@dataclass(frozen=True, eq=False)
class TriggeredMessages(Filter):
    """The filter ``inner`` with nodes that, after a reading, send nothing with probability
    exp(-z' Y z / 2), where z is its innovation.

    The filter takes a message that is not sent for one that is lost. Nodes always use their own
    readings, and those without a reading send.
    """

    Y: float | FloatArray
    inner: Filter

    @property
    def wrapped(self) -> Filter:
        """The filter that the trigger belongs to."""
        return self.inner

    @property
    def timing(self) -> Timing:
        """The timing of the wrapped filter in slots, whose nodes draw whether they send."""
        return replace(self.inner.timing, clocks=(), randomised=True, decides=True)

    @property
    def analysis(self) -> Analysis:
        """No paper, and what the filter conserves."""
        given = self.inner.analysis
        # Which messages are sent depends on data, so that no comparison of P is proved.
        return Analysis(
            swaps=given.swaps,
            tells_estimates=given.tells_estimates,
            payload_numbers=given.payload_numbers,
            conserved=lambda state: given.conserved(state.inner),
            stopped=lambda state: given.stopped(state.inner),
            wrapped=self.inner,
        )

    @property
    def kernels(self) -> Kernels | None:  # type: ignore[override]
        """The kernels of the wrapped filter with the trigger; None for one in plain Python."""
        inner = compiled_kernels(self.inner, clocked=False)
        return None if inner is None else with_trigger(inner)

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> WrappedState:
        """Return the wrapped filter's state from ``mean`` (n,), ``cov`` (n, n), and no decision."""
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
            z = reading.y - reading.H @ self.inner.estimate(state.inner)[0]
            news = max(0.0, float(z @ trigger_matrix(self.Y, len(z)) @ z))
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
            state = state._replace(silent=silent, has_sent=state.has_sent or state.news >= 0.0)
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

    def shift(self, state: Any, offset: FloatArray) -> Any:
        """Return the state, or a payload, with ``offset`` (n,) added to the wrapped filter's
        estimate, for a move of the origin: innovations, and the trigger's news, do not change.
        """
        if not isinstance(state, WrappedState):
            return self.inner.shift(state, offset)
        return state._replace(inner=self.inner.shift(state.inner, offset))


@built_in("event-triggered", trigger="stochastic")
@forwarding
@dataclass(frozen=True, eq=False)
class StochasticTrigger(Filter):
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

    @property
    def timing(self) -> Timing:
        """The timing of the filter that runs, in slots."""
        return replace(self.wrapped.timing, clocks=(), talks=True)

    @property
    def needs(self) -> Needs:
        """Its demands on a scenario."""
        return replace(self.wrapped.needs, check=self._check_scenario)

    @property
    def analysis(self) -> Analysis:
        """The facts of the filter that runs."""
        return replace(self.wrapped.analysis, wrapped=self.wrapped)

    def _check_scenario(self, scenario: Any) -> None:
        inner = self.inner
        if (
            inner.analysis.wrapped is not None
            or inner.timing.schedule is None
            or not inner.timing.talks
        ):
            raise ScenarioError(
                "filter.inner",
                "must be a filter in slots whose nodes send messages, without a trigger",
                type(inner).__name__,
                'write inner = { kind = "intermittent" }, or another one',
            )
        if inner.needs.check is not None:
            inner.needs.check(scenario)
        if scenario.network.lives and isinstance(self.wrapped, ScheduledReadings):
            raise ScenarioError(
                "network.lives",
                "must be empty where silence is used: a node that is down is silent too",
                f"{len(scenario.network.lives)} lives",
                "remove it, or choose another inner filter, which takes silence for a loss",
            )
        # A number fits readings of any number of rows.
        if not isinstance(self.Y, np.ndarray):
            return
        for node in scenario.nodes:
            placed = scenario.placed_sensors.get(node, ())
            sensors = [scenario.sensors[one.entry] for one in placed]
            rows = sum(len(sensor.R) for sensor in sensors)
            recorded = [isinstance(getattr(one, "path", None), SourceFile) for one in sensors]
            present = [one.record.present for one in sensors if one.record is not None]
            partial = any(bool((p.any(axis=1) & ~p.all(axis=1)).any()) for p in present)
            # Of several sensors one may have no reading, of one some values may be missing.
            if (len(sensors) > 1 and any(recorded)) or partial:
                raise ScenarioError(
                    "filter.Y",
                    f"must be a number, because some rows of the readings of node {node} may be "
                    "missing in a record",
                    "a matrix",
                    "write a number",
                )
            if rows not in (0, len(self.Y)):
                raise ScenarioError(
                    "filter.Y",
                    f"must be {rows} x {rows} for the readings of node {node}",
                    f"{len(self.Y)} x {len(self.Y)}",
                    "write a number, which is that times the identity",
                )
