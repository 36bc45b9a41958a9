"""One node of a filter whose verbs are kernels, for Python: what the SimPy engine calls.

A state is a :class:`NodeState`, whose record holds one node of one run. Each verb copies the arrays
that it may change, so that states are values as those of filters in plain Python.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.kernels.at_rest import run_at_rest
from netkf.algorithms.kernels.gains import stack_gains
from netkf.algorithms.kernels.maps import SingleMapRun
from netkf.algorithms.kernels.rates import RateRun
from netkf.algorithms.kernels.root_flow import stack_tables
from netkf.algorithms.kernels.run import (
    ClockRun,
    SingleSlotRun,
    SlotModelArrays,
    clock_tables,
    size_of,
)
from netkf.algorithms.models import (
    ChangingFlowModel,
    ChangingSlotModel,
    FlowModel,
    MapModel,
    RateModel,
    as_floats,
    first_root,
    lower,
    whiten_reading,
)
from netkf.algorithms.python_pairs import NOTHING_KEPT, Kept, PythonPairs
from netkf.algorithms.records import Kernels, Records, double_past, make_records
from netkf.core.contracts import ContractError
from netkf.linalg.addresses import call_kernel
from netkf.linalg.arrays import FloatArray, IntArray, array_address
from netkf.linalg.lanes import ONE


class Whitened(NamedTuple):
    """A reading of a node's own states, y (p,) and H (p, n), whitened, and those of pairs, whose
    rows may stand behind the first ``rows``, by default all.
    """

    y: FloatArray
    H: FloatArray
    pairs: tuple[Any, ...] = ()
    rows: int | None = None


_NO_READING = Whitened(np.zeros(0), np.zeros((0, 0)))


class Payload:
    """A message of a kernel filter: its ``fields`` by name, and the ``reading``, Whitened, that the
    sender had taken at that instant, or None.
    """

    def __init__(self, fields: dict[str, np.ndarray], reading: Any, sender: NodeState) -> None:
        self.fields, self.reading, self.sender = fields, reading, sender

    def __getattr__(self, name: str) -> Any:
        """Return a field without its axes of messages and lanes."""
        try:
            return self.__dict__["fields"][name][0, ..., 0]
        except KeyError:
            raise AttributeError(name) from None

    @property
    def _fields(self) -> tuple[str, ...]:
        return (*self.fields, "reading")

    @property
    def P(self) -> FloatArray:
        """The covariance ``root root'`` (n, n) of the estimate."""
        root: FloatArray = self.root
        return root @ root.T

    def number_to(self, receiver: int) -> int:
        """Return which of its messages is for a ``receiver`` (id): the last one is for nodes that
        the sender does not hear, or the only one.
        """
        last = len(next(iter(self.fields.values()))) - 1
        link: int = self.sender.run.links.get(receiver, last)
        return min(link, last)

    def message_to(self, receiver: int) -> Payload:
        """Return the message for a ``receiver`` (id) alone."""
        k = self.number_to(receiver)
        return self.with_fields({name: rows[k : k + 1] for name, rows in self.fields.items()})

    def with_fields(self, fields: dict[str, np.ndarray]) -> Payload:
        """Return a payload with these ``fields``, of the axes of those here."""
        return Payload(fields, self.reading, self.sender)

    def with_moved_reading(self, offset: FloatArray) -> Payload:
        """Return a payload whose reading is of states to which ``offset`` (n,) was added."""
        if self.reading is None:
            return self
        y, H = self.reading.y, self.reading.H
        return self.with_reading(self.reading._replace(y=y + H @ offset))

    def with_reading(self, reading: Whitened) -> Payload:
        """Return a payload with another reading."""
        return Payload(self.fields, reading, self.sender)

    def _replace(self, **fields: Any) -> Payload:
        arrays = {
            name: np.array(_as_read(name, v), self.fields[name].dtype, order="C")[None, ..., None]
            for name, v in fields.items()
        }
        return Payload({**self.fields, **arrays}, self.reading, self.sender)


class NodeState:
    """The state of a node: a record of one node, and what surrounds it in its run.

    ``xhat`` (n,), ``root`` (n, n) and the fields of the filter's record are attributes.
    """

    def __init__(self, kernels: Kernels, record: Any, changing: tuple[str, ...], run: Any) -> None:
        self.kernels, self.record, self.changing, self.run = kernels, record, changing, run
        self.reading: Any = None
        self.held: Kept = {}

    def __getattr__(self, name: str) -> Any:
        """Return a field of the record for this node, without its axis of lanes."""
        if name in self.__dict__.get("changing", ()):
            value = getattr(self.record, name)
            # Fields of links have an axis of links in place of that of nodes.
            return value[0, ..., 0] if name in self.__dict__["run"].node_fields else value[..., 0]
        raise AttributeError(name)

    @property
    def P(self) -> FloatArray:
        """The covariance ``root root'`` (n, n) of the estimate."""
        root: FloatArray = self.root
        return root @ root.T

    @property
    def _fields(self) -> tuple[str, ...]:
        return (*self.changing, "reading")

    def __reduce__(self) -> tuple[Any, ...]:
        run, values = self.run, {name: getattr(self.record, name) for name in self.changing}
        return _restored, (run.filtering, run.model, run.info, values, self.reading, self.held)

    @property
    def model(self) -> Any:
        """The model of the plant and the node's sensors."""
        return self.run.model

    def _replace(self, **fields: Any) -> NodeState:
        new = self.copied()
        for name, value in fields.items():
            getattr(new, name)[...] = _as_read(name, value)
        return new

    def copied(self, events: int = 0) -> NodeState:
        """Return a state with arrays of its own, with room for so many more past events."""
        record, cls = self.record, type(self.record)
        new: Any = object.__new__(cls)
        memory = record.memory.copy()
        object.__setattr__(new, "memory", memory)
        object.__setattr__(new, "address", array_address(memory))
        for name, value in record.__dict__.items():
            if name in self.changing:
                array = value.copy()
                new.__dict__[name] = array
                memory[cls.struct_offsets[name]] = array_address(array)
            elif name not in ("memory", "address"):
                new.__dict__[name] = value
        while self.run.past and int(new.kept[0, 0]) + events > new.room:
            double_past(new, self.run.past)
        state = NodeState(self.kernels, new, self.changing, self.run)
        state.reading, state.held = self.reading, self.held
        return state


class Surroundings:
    """The run of one node: the struct that kernels take, and how Python fills it."""

    def __init__(
        self,
        filtering: Any,
        model: Any,
        info: Any,
        node_fields: tuple[str, ...],
        past: tuple[str, ...],
    ) -> None:
        self.filtering, self.past = filtering, past
        self.sends, self._prepare = filtering.timing.sends, filtering.kernels.prepare
        n, self.info, self.node_fields = len(model.information), info, node_fields
        self.model, self.period = model, getattr(model, "period", 0.0)
        self.clocked = isinstance(model, FlowModel)
        self._piece = 0
        self.numbers: Mapping[str, IntArray] = {}
        self._pairs = PythonPairs(info, n) if filtering.needs.blocks else None
        # Not unrolled: one compiled kernel serves all n.
        size, cls = size_of(n, unrolled=False), _run_class(model)
        degree = max(1, info.degree, len(info.senders))
        self.links = {sender: k for k, sender in enumerate(info.senders)}
        fields = run_at_rest(n, 1, degree)
        if self._pairs is not None:
            fields["pairs"] = self._pairs.none()
        self.struct = cls(
            **fields | {"message": np.arange(degree)},
            size=size,
            lanes=ONE,
            model=_tables_of(model),
            first=np.array([0, info.degree]),
            sender=np.arange(degree),
            opposite=np.full(degree, -1),
            weight=np.zeros(degree),
            y=np.zeros((1, 1, 1)),
            H=np.zeros((1, 1, n if self._pairs is None else self._pairs.columns, 1)),
            rows=np.zeros(1, dtype=np.int64),
            matrix=np.arange(1),
        )

    def follow(self) -> None:
        """Take the matrices of the present piece of a model that changes."""
        model, tables = self.model, self.struct.model
        if isinstance(model, ChangingFlowModel):
            self.struct.now, tables.piece = model.now, model.piece
            own = 0 if model.reads else tables.stride - 1
            tables.models[0] = own + model.piece * tables.stride
        elif isinstance(model, RateModel):
            self.struct.now = model.now
        elif isinstance(model, ChangingSlotModel) and self._piece != model.piece:
            self._piece = model.piece
            tables.F[:], tables.root_Q[:] = model.F, model.root_Q

    def set_readings(
        self, readings: Sequence[Whitened], senders: Sequence[Any] = (), kept: Kept = NOTHING_KEPT
    ) -> None:
        """Make these readings the numbers 0, 1, ... of the run; ``senders`` are the payloads that
        bring those after the first, and the node has ``kept`` readings of pairs.
        """
        if self._pairs is not None:
            self.struct.pairs, readings = self._pairs.take(readings, senders, kept)
        run, most = self.struct, max((len(y) for y, *_ in readings), default=0)
        count, p = run.y.shape[:2]
        if len(readings) > count or most > p:
            count, p = max(count, len(readings)), max(p, most)
            run.y, run.H = np.zeros((count, p, 1)), np.zeros((count, p, run.H.shape[2], 1))
            run.rows, run.matrix = np.zeros(count, dtype=np.int64), np.arange(count)
        for k, (y, H, _, rows) in enumerate(readings):
            run.y[k, : len(y), 0] = y
            run.H[k] = 0.0
            run.H[k, : len(H), : H.shape[1], 0] = H
            run.rows[k] = len(H) if rows is None else rows

    def set_inbox(self, own: Any, messages: Sequence[Any], slotted: bool) -> None:
        """Make these messages the inbox; readings are numbered after the ``own`` one, if any."""
        run, count = self.struct, len(messages)
        if count > len(run.message):
            run.message, run.age = np.arange(count), np.zeros(count)
            run.message_weight = np.ones(count)
            run.link, run.heard = (np.zeros(count, dtype=np.int64) for _ in range(2))
            run.arrived = np.ones((count, 1), dtype=np.uint8)
        run.count = count
        readings: list[Any] = [own or _NO_READING]
        brought: list[Any] = []
        for k, message in enumerate(messages):
            # A sender that was not announced gets the next link.
            run.link[k] = self.links.setdefault(message.sender, len(self.links))
            run.message_weight[k] = message.weight
            run.age[k] = 0.0 if slotted else message.age
            reading = getattr(message.payload, "reading", None)
            run.heard[k] = -1
            if reading is not None:
                run.heard[k] = len(readings)
                readings.append(reading)
                brought.append(message.payload)
        self.set_readings(readings, brought)

    def know_pairs(self, new: NodeState, messages: Sequence[Any] = ()) -> None:
        """Let kernels linearise what the node and the senders of ``messages`` have kept."""
        if self._pairs is not None:
            senders = [getattr(message.payload, "sender", new) for message in messages]
            self._pairs.know(new.held, *(sender.held for sender in senders))

    def keep_pairs(self, new: NodeState) -> None:
        """Keep readings of pairs, of those that the node has just taken too, as its record does."""
        if self._pairs is not None and (name := new.kernels.keeps_pairs):
            new.held = self._pairs.keep(new.held, getattr(new.record, name).ravel().tolist())

    def raise_error(self) -> None:
        """Raise the error of what linearises a reading of a pair, if a call has failed."""
        if self._pairs is not None:
            self._pairs.raise_error()

    def prepare(self, record: Any, slot: int) -> None:
        """Let the filter set what it knows of a slot before the run."""
        if slot >= 0:
            self._prepare(self.filtering, record, [self.info], [self.model], slot, 1)

    def set_exchange(self, exchange: Any) -> None:
        """Set the circumstances of ``emit`` or ``absorb``."""
        run = self.struct
        run.slot, run.phase, run.step = exchange.slot, exchange.phase, exchange.step
        run.now = exchange.time
        run.uniform[0], run.sends[0] = exchange.uniform, 1


def _run_class(model: Any) -> Any:
    if isinstance(model, MapModel):
        return SingleMapRun
    if isinstance(model, RateModel):
        return RateRun
    return ClockRun if isinstance(model, FlowModel) else SingleSlotRun


def _tables_of(model: Any) -> Any:
    """Return the model of one node as kernels take it."""
    if isinstance(model, MapModel | RateModel):
        return model.tables()
    if not isinstance(model, FlowModel):
        F, root_Q = (np.array(part, order="C") for part in (model.F, model.root_Q))
        return SlotModelArrays(F=F, root_Q=root_Q)
    # A node that follows changes has them in its tables; other nodes of one model share theirs.
    make = _clock_tables if isinstance(model, ChangingFlowModel) else _shared_clock_tables
    return make(model)


def _clock_tables(model: FlowModel) -> Any:
    size = size_of(len(model.A), unrolled=False)
    pieces = model.pieces if isinstance(model, ChangingFlowModel) else [model]
    table = stack_tables([flow for m in pieces for flow in (m.flow, m.unobserved_flow)])
    # As many of gains: those beside tables without readings are not used.
    gains = stack_gains([m.gains for m in pieces for _ in range(min(2, len(pieces)))])
    changes = np.array(getattr(model, "changes", ()), dtype=np.float64)
    return clock_tables(size, table, np.zeros(1, dtype=np.int64), gains, changes)


_shared_clock_tables = lru_cache(maxsize=8)(_clock_tables)


def begin_node(
    filtering: Any, model: Any, mean: FloatArray, cov: FloatArray, info: Any
) -> NodeState:
    """Return the state of a node at time 0, with estimate ``mean`` (n,) and ``cov`` (n, n)."""
    degree = max(1, info.degree, len(info.senders))
    start = np.asarray(mean, dtype=np.float64), first_root(cov)
    records: Records = make_records(filtering, [start], [info], [model], degree, 1)
    fields = tuple(records.arrays)
    nodes = tuple(name for name in fields if name not in records.links)
    kernels = filtering.kernels.of(isinstance(model, FlowModel))
    run = Surroundings(filtering, model, info, nodes, records.past)
    run.numbers = records.numbers
    return NodeState(kernels, records.struct, fields, run)


def _restored(
    filtering: Any, model: Any, info: Any, values: dict[str, Any], reading: Any, held: Kept
) -> Any:
    n = values["xhat"].shape[1]
    state = begin_node(filtering, model, np.zeros(n), np.eye(n), info)
    for name, array in values.items():
        setattr(state.record, name, array)
    if state.run.past:
        state.record.room = values[state.run.past[0]].shape[1]
    state.reading, state.held = reading, held
    return state


def predict(state: NodeState, gap: float) -> NodeState:
    """Return the state ``gap`` seconds later."""
    new = state.copied()
    new.reading = None
    state.run.follow()
    run, model = state.run.struct, state.model
    run.gap = gap
    for k in range(1 if state.run.clocked else round(gap / state.run.period)):
        if isinstance(model, MapModel):
            run.slot = model.slot + k
        call_kernel(state.kernels.predict, new.record, 0, run=run)
    if isinstance(model, MapModel | RateModel):
        model.raise_error()
    return new


def update(state: NodeState, reading: Any) -> NodeState:
    """Return the state after a reading or increments."""
    new, surroundings = state.copied(events=1), state.run
    surroundings.follow()
    run = surroundings.struct
    if hasattr(reading, "moments"):
        run.model.moments = np.array(reading.moments)
        run.model.increments, run.gap = 1, reading.gap
        call_kernel(state.kernels.update, new.record, 0, run=run)
        run.model.increments = 0
        return new
    whitened = _NO_READING
    if len(reading.y):
        whitened = Whitened(*whiten_reading(reading.y, reading.H, reading.R))
    whitened = whitened._replace(pairs=reading.pairs)
    # In slots a node without a sensor gets readings without rows.
    surroundings.set_readings([whitened], kept=state.held)
    if surroundings.clocked:
        surroundings.struct.now = reading.time
    elif math.isfinite(reading.time):
        surroundings.struct.slot = round(reading.time / surroundings.period)
    call_kernel(state.kernels.update, new.record, 0, run=run)
    surroundings.keep_pairs(new)
    new.reading = whitened if len(whitened.y) or whitened.pairs else None
    return new


def emit(state: NodeState, exchange: Any) -> tuple[NodeState, Payload | None]:
    """Return the state after sending, and the payload, None if the node sends nothing."""
    new, surroundings = state.copied(), state.run
    record, run = new.record, surroundings.struct
    surroundings.follow()
    surroundings.set_exchange(exchange)
    surroundings.prepare(record, exchange.slot)
    surroundings.set_readings([new.reading or _NO_READING])
    # An addressed filter writes one for each node that it hears, and one more.
    count = surroundings.info.degree + 1 if state.kernels.addressed else 1
    cls = type(record.payload)
    former = {name: getattr(record.payload, name) for name in cls.struct_fields}
    payload = cls(**{k: np.zeros((count, *a.shape[1:]), a.dtype) for k, a in former.items()})
    record.payload = payload
    call_kernel(state.kernels.emit, record, 0, 0, run=run)
    has_reading = new.reading is not None
    if exchange.slot >= 0 and not surroundings.sends(exchange.phase, has_reading):
        return new, None
    if not run.sends[0]:
        if not state.kernels.decides and (exchange.slot >= 0 or exchange.receivers):
            raise ContractError("emit writes 0 into run.sends: write Kernels(decides=True)")
        return new, None
    fields = {name: getattr(payload, name) for name in cls.struct_fields}
    return new, Payload(fields, new.reading, new)


def absorb(state: NodeState, messages: Sequence[Any], exchange: Any) -> NodeState:
    """Return the state after all messages of this instant."""
    new, surroundings = state.copied(events=len(messages)), state.run
    record, run = new.record, surroundings.struct
    surroundings.follow()
    surroundings.set_exchange(exchange)
    surroundings.prepare(record, exchange.slot)
    surroundings.set_inbox(new.reading, messages, exchange.slot >= 0)
    surroundings.know_pairs(new, messages)
    if messages:
        fields = {}
        for name in type(record.payload).struct_fields:
            shape = getattr(record.payload, name).shape[1:]
            parts = [_field(message.payload, name, surroundings.info.node) for message in messages]
            fields[name] = np.concatenate([_fitted(part, shape) for part in parts])
        record.payload = type(record.payload)(**fields)
    call_kernel(state.kernels.absorb, record, 0, run=run)
    surroundings.raise_error()
    return new


def interval(state: NodeState) -> float:
    """Return the seconds of increments that ``update`` may use at once; inf in slots."""
    if not state.run.clocked:
        return math.inf
    state.run.follow()
    run, interval = state.run.struct, state.kernels.interval
    return float(call_kernel(interval, state.record, 0, run=run, number=True))


def shift(state: Any, offset: FloatArray) -> Any:
    """Return a state, or a payload under way, after the origin of coordinates moved by ``-offset``
    (n,), of a payload at its sending.
    """
    of_payload = isinstance(state, Payload)
    new = state.sender.copied() if of_payload else state.copied(events=1)
    record, run = new.record, new.run.struct
    run.offset[:, 0] = offset
    if not of_payload:
        call_kernel(new.kernels.shift, record, 0, run=run)
        return new
    fields = {name: array.copy() for name, array in state.fields.items()}
    record.payload = type(record.payload)(**fields)
    for m in range(len(next(iter(fields.values())))):
        call_kernel(new.kernels.shift_payload, record, m, run=run)
    # A reading keeps the coordinates of its time.
    return Payload(fields, state.reading, state.sender)


def _fitted(field: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return a field of one message (1, ...) of a node of more or fewer states in a ``shape``."""
    if field.shape[1:] == shape:
        return field
    made = np.zeros((1, *shape), dtype=field.dtype)
    least = tuple(slice(min(sizes)) for sizes in zip(field.shape, made.shape, strict=True))
    made[least] = field[least]
    return made


def _field(payload: Any, name: str, receiver: int) -> np.ndarray:
    """Return a field of a payload, which may be a user's own, with axes of messages and lanes."""
    if isinstance(payload, Payload):
        k = payload.number_to(receiver)
        return payload.fields[name][k : k + 1]
    return as_floats(_as_read(name, getattr(payload, name)))[None, ..., None]


def _as_read(name: str, value: Any) -> Any:
    """Return the ``value`` of a field that Python has set, with a root as kernels read it."""
    return lower(value) if name == "root" else value
