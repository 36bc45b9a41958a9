"""Filters as kernels: the verbs, and the record of a node that they change.

A filter whose verbs are kernels (``Filter.kernels``) says what a node knows, in arrays with names:
``Kernels.record`` returns their shapes. Engines make one *record* of H nodes, a struct with an axis
of nodes before each shape and an axis of L runs side by side after it, and call the verbs for one
node at a time, see ``algorithms.kernels.run``.
"""

from __future__ import annotations

import inspect
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from netkf.algorithms.kernels import run as standard
from netkf.algorithms.kernels.neighbours import combine_convex
from netkf.core.contracts import kernel_problem
from netkf.core.errors import quote
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.lanes import aligned
from netkf.linalg.structs import Struct, StructClass

Shapes = Mapping[str, Any]
"""Shape of each array by name; a pair (shape, dtype) where entries are no float64."""


FIELDS = ("node", "past", "link", "scratch", "settings")
"""Tables of a Record whose arrays and numbers are fields of one struct."""
HELD = ("xhat", "root", "payload", "kept", "room")
"""Fields that each such struct may have besides."""
RESERVED = ("address", "memory", "general", "struct_kinds", "struct_offsets", "_keep_alive", "view")
"""What structs read of themselves, and what numba allows of arrays only."""


@dataclass(frozen=True)
class Record:
    """The arrays of a filter besides ``xhat`` (n,) and ``root`` (n, n) of each node.

    node : shapes of what each node knows, by name
    transient : names of those of them whose values mean nothing to later events
    past : shapes of what a node keeps of each of its past events, such as the readings that it has
           used: arrays (H, E, *shape, L), of which the first ``kept`` (H, L) entries of a node
           count, which kernels set. Engines make E (``room``) larger where ``update``, ``shift`` or
           a message of ``absorb`` might find no free entry
    link : shapes of what a node knows for each of its incoming links
    link_start : values of these at time 0, where they are not 0
    payload : shapes of what a message carries
    numbers : of its fields whose entries are not one number each: which number an entry is, from 0;
              entries that have one number are equal, and those with -1 are not sent: they are 0
              where payloads are quantised. Of ``root`` by default the lower triangle
    scratch : shapes of arrays for intermediate results, shared by all nodes
    settings : numbers, arrays and structs that are the same in all runs
    """

    node: Shapes = field(default_factory=dict)
    transient: tuple[str, ...] = ()
    past: Shapes = field(default_factory=dict)
    link: Shapes = field(default_factory=dict)
    link_start: Mapping[str, Any] = field(default_factory=dict)
    payload: Shapes = field(default_factory=dict)
    numbers: Mapping[str, IntArray] = field(default_factory=dict)
    scratch: Shapes = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raise TypeError for what is no shape, by which memory would be shared out, and for names
        that mean something else.
        """
        own = Counter(name for table in FIELDS for name in getattr(self, table))
        for name in (*own, *self.payload):
            is_taken = name in RESERVED or own[name] > 1 or (name in HELD and name in own)
            if is_taken or not name.isidentifier():
                rule = "must be a name that nothing else in a record has"
                raise TypeError(f"Record: {quote(name)} {rule}; choose another one")
        for table in ("node", "past", "link", "payload", "scratch"):
            for name, shape in getattr(self, table).items():
                if not _is_shape(shape):
                    rule = "must be a tuple of whole numbers of at least 0"
                    raise TypeError(f"Record.{table}[{name!r}] {rule}, not {quote(shape)}")
        for name, value in self.settings.items():
            if value is None or isinstance(value, str):
                raise TypeError(f"Record.settings[{name!r}] must be a number, not {quote(value)}")


def _is_shape(shape: Any) -> bool:
    if isinstance(shape, tuple) and len(shape) == 2 and isinstance(shape[0], tuple):
        shape = shape[0]  # the other one is the dtype
    counts = (int, np.integer)
    return isinstance(shape, tuple) and all(isinstance(k, counts) and k >= 0 for k in shape)


def triangle_numbers(n: int, *count: int) -> IntArray:
    """Number the entries of a triangle (n, n), or ``count`` roots (n, n + 1); others are -1."""
    sent = np.ones((*count, n, n + len(count)), dtype=bool)
    sent[..., :n] = np.tri(n, dtype=bool)
    return np.where(sent, np.cumsum(sent).reshape(sent.shape) - 1, -1)


def packed_numbers(n: int, before: int, after: int = 0) -> IntArray:
    """Return the numbers of a vector with a symmetric matrix (n, n) by rows after ``before`` and
    before ``after`` other numbers.
    """
    lower = triangle_numbers(n)
    matrix, rest = before + np.maximum(lower, lower.T).ravel(), before + n * (n + 1) // 2
    return np.concatenate([np.arange(before), matrix, np.arange(rest, rest + after)])


def estimate_shapes(n: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of an estimate and the root of its covariance."""
    return {"xhat": (n,), "root": (n, n)}


def estimate_record(_filtering: Any, _infos: Sequence[Any], models: Sequence[Any]) -> Record:
    """Return the record of a filter whose messages are estimates with their roots."""
    return Record(payload=estimate_shapes(len(models[0].information)))


def begin_estimate(_filtering: Any, _node: Any, _info: Any, _model: Any) -> None:
    """Leave a node as it is at time 0."""


def prepare_nothing(_filtering: Any, _record: Any, *_: Any) -> None:
    """Set nothing: the record does not depend on the slots."""


VERBS = ("predict", "update", "emit", "absorb", "shift", "shift_payload", "observe", "interval")


@dataclass(frozen=True)
class Kernels:
    """The verbs of a filter as kernels, by default those of a Kalman filter on own readings, and
    plain functions that make its record; their first argument is the filter.

    record : ``record(filtering, infos, models)`` returns the ``Record`` of nodes with these infos
             and models
    begin : ``begin(filtering, node, info, model)`` sets the entries of one node in the arrays of
            its record at time 0: ``node`` has views by name, with xhat (n,) and root (n, n) set
    prepare : ``prepare(filtering, record, infos, models, first, count)`` sets the fields of a
              record that are known before the run for ``count`` slots from number ``first`` on,
              such as gains
    predict, update, absorb, shift : ``verb(record, h, run)`` for node h
    emit : ``emit(record, h, m, run)`` writes payload number m of node h
    shift_payload : ``shift_payload(record, m, run)``, of payload m
    observe : ``observe(record, h, run)`` is called where a sample is taken
    interval : ``interval(record, h, run)``, the seconds of increments that ``update`` may use at
               once from this state on
    decides : ``emit`` may write 0 into ``run.sends`` at a node that others hear
    sends_readings : a message brings the sender's reading of that instant, ``run.heard``
    keeps_pairs : name of the field of the record with the numbers of the readings of pairs that a
                  node keeps to linearise them later; "": it keeps none
    remembers : the record has a ``past``
    counts_sends : ``emit`` changes the record, so that it is called even if no message arrives
    slotwise : ``prepare`` is called for one slot at a time
    addressed : each receiver gets a payload of its own: ``emit`` writes payload m + k for the
                sender of its incoming link number k, and one after these for all nodes that it does
                not hear; where ``run.receiver`` is not ALL, only payload m, for the sender of that
                link, or where it is -1 for a node that it does not hear
    unrolled : kernels are compiled for each n up to 4 with unrolled loops: only where that makes
               runs a tenth faster
    under_clocks : the verbs under clocks, where they are others than in slots; the record is one
    means : names of the arrays of estimates, in the record and in payloads
    depends_on_data : whether who sends depends on readings or estimates; by default ``decides``
    """

    record: Callable[..., Record] = estimate_record
    begin: Callable[..., None] = begin_estimate
    prepare: Callable[..., None] = prepare_nothing
    predict: Any = standard.predict
    update: Any = standard.update
    emit: Any = standard.emit
    absorb: Any = standard.absorb
    shift: Any = standard.shift
    shift_payload: Any = standard.shift_payload
    observe: Any = standard.observe
    interval: Any = standard.max_increment_interval
    decides: bool = False
    sends_readings: bool = False
    keeps_pairs: str = ""
    remembers: bool = False
    counts_sends: bool = False
    slotwise: bool = False
    addressed: bool = False
    unrolled: bool = False
    under_clocks: Kernels | None = None
    means: tuple[str, ...] = ("xhat",)
    depends_on_data: bool | None = None

    def __post_init__(self) -> None:
        for name in VERBS:
            verb, due = getattr(self, name), getattr(type(self), name)
            if verb is due:
                continue
            names = inspect.signature(inspect.unwrap(getattr(due, "loops", due))).parameters
            if problem := kernel_problem(verb, [*names]):
                raise TypeError(f"Kernels.{name} {problem}")

    def record_of(self, filtering: Any, infos: Sequence[Any], models: Sequence[Any]) -> Record:
        """Return what ``record`` makes; raises TypeError if it is no Record."""
        record: Any = self.record(filtering, infos, models)
        if not isinstance(record, Record):
            raise TypeError(f"Kernels.record must return a Record, not {quote(record)}")
        return record

    @property
    def affine(self) -> bool:
        """True if estimates are affine in readings and messages: what is sent does not depend on
        them. By default not where ``emit`` decides.
        """
        return not (self.decides if self.depends_on_data is None else self.depends_on_data)

    @property
    def sends_whole_readings(self) -> bool:
        """True if messages have readings as they were taken, and not bits that follow from them."""
        return self.sends_readings and self.shift_payload is not standard.absorb

    @property
    def is_kalman(self) -> bool:
        """True if between exchanges nodes are Kalman filters on own readings."""
        return (self.predict, self.update) == (standard.predict, standard.update)

    @property
    def is_convex(self) -> bool:
        """True if nodes are Kalman filters that form convex combinations, and nothing else."""
        return replace(self, unrolled=False) == Kernels(absorb=combine_convex)

    def of(self, clocked: bool) -> Kernels:
        """Return the verbs under clocks, or in slots."""
        return self.under_clocks or self if clocked else self


FIRST_PAST = 16
"""Past events of a node for which there is room at first."""
_classes: dict[tuple[Any, ...], Any] = {}


def make_arrays(shapes: Shapes, leading: tuple[int, ...], lanes: int) -> dict[str, np.ndarray]:
    """Return arrays of zeros (*leading, *shape, L) by name."""
    made: dict[str, np.ndarray] = {}
    for name, given in shapes.items():
        has_type = len(given) == 2 and isinstance(given[0], tuple)
        shape, kind = given if has_type else (given, np.float64)
        made[name] = aligned((*leading, *shape, lanes), kind)
    return made


def record_class(name: str, values: Mapping[str, Any]) -> Any:
    """Return the class of records with these fields: one for each name and set of fields, so that
    filters of equal layout share compiled code.
    """
    # Structs of equal names may have other fields.
    kinds = ((type(v) if isinstance(v, Struct) else _kind(v)) for v in values.values())
    key = (name, *values, *kinds)
    if key not in _classes:
        annotations = {key: _kind(value) for key, value in values.items()}
        _classes[key] = StructClass(name, (Struct,), {"__annotations__": annotations})
    return _classes[key]


def _kind(value: Any) -> str:
    """Return "int", "float" or "array" with its type: what the layout of a field depends on."""
    if isinstance(value, bool | int | np.integer):
        return "int"
    if isinstance(value, float | np.floating):
        return "float"
    if isinstance(value, Struct):
        return type(value).__name__
    return f"{value.dtype}{value.ndim}"


@dataclass
class Records:
    """The records of H nodes in B blocks of L runs: the struct of the first block, and the arrays
    (B, ..., L) of all by name.

    struct : its fields are the arrays of the first block, ``payload`` and the settings
    arrays : of nodes (B, H, ..., L) and links (B, W, ..., L)
    begin : ``begin(h, node)`` sets the entries of node h, by name, from its estimate
    links, past : names of those of links, and of past events
    numbers : which numbers are sent of the fields of ``payload``, as ``Record.numbers``
    """

    struct: Any
    arrays: dict[str, np.ndarray]
    begin: Callable[[int, dict[str, np.ndarray]], None]
    links: tuple[str, ...] = ()
    past: tuple[str, ...] = ()
    numbers: Mapping[str, IntArray] = field(default_factory=dict)

    def place(self, name: str, h: int, first: IntArray) -> int | slice:
        """Return where the array ``name`` has what node ``h`` knows: its row, or the rows of its
        links, which begin with ``first[h]``.
        """
        return slice(first[h], first[h + 1]) if name in self.links else h

    def begin_elsewhere(
        self, arrays: Mapping[str, np.ndarray], h: int, lane: int, moved: FloatArray
    ) -> None:
        """Let node ``h``, which is at its start, begin ``moved`` (n',) away from it in a lane of
        the ``arrays`` of a block, by name.
        """
        # What refers to the start does too: no event moved the node from there.
        node = {name: arrays[name][h, ..., lane] for name in arrays if name not in self.links}
        node["xhat"][: len(moved)] += moved
        self.begin(h, node)

    def copied(self) -> Any:
        """Return the struct of the first block with its own arrays of nodes and links."""
        struct, cls = self.struct, type(self.struct)
        fields = {name: getattr(struct, name) for name in cls.struct_fields}
        return cls(**fields | {name: array[0].copy() for name, array in self.arrays.items()})

    @property
    def memories(self) -> np.ndarray:
        """(B, words) int64: the struct of each block, for ``struct_like``."""
        # Numbers of the struct may have changed, addresses have not.
        return np.asarray(self.struct.memory + self._steps)

    @cached_property
    def _steps(self) -> np.ndarray:
        """The words to add to those of the first block, for each block (B, words)."""
        blocks = np.arange(len(self.arrays["xhat"]), dtype=np.int64)
        steps = np.zeros((len(blocks), len(self.struct.memory)), dtype=np.int64)
        for name, array in self.arrays.items():
            steps[:, self.struct.struct_offsets[name]] = blocks * array.strides[0]
        return steps


def make_records(
    filtering: Any,
    starts: Sequence[tuple[FloatArray, FloatArray]],
    infos: Sequence[Any],
    models: Sequence[Any],
    links: int,
    messages: int,
    blocks: int = 1,
    lanes: int = 1,
) -> Records:
    """Return the records of H nodes at time 0 in B ``blocks`` of L ``lanes``, with W ``links`` and
    room for so many ``messages``; ``starts`` are estimates (n,) and roots (n, n) of the nodes.
    """
    n, count = len(starts[0][0]), len(starts)
    kernels = filtering.kernels
    record = kernels.record_of(filtering, infos, models)
    known = {**estimate_shapes(n), **record.node}
    if record.past:
        known["kept"] = ((), np.int64)
    nodes = make_arrays(known, (blocks, count), lanes)
    nodes |= make_arrays(record.past, (blocks, count, FIRST_PAST), lanes)
    per_link = make_arrays(record.link, (blocks, links), lanes)
    for name, value in record.link_start.items():
        per_link[name][...] = np.asarray(value)[..., None]

    def begin(h: int, node: dict[str, np.ndarray]) -> None:
        kernels.begin(filtering, node, infos[h], models[h])

    for h, (mean, root) in enumerate(starts):
        views = {name: array[0, h, ..., 0] for name, array in nodes.items()}
        views["xhat"][...], views["root"][...] = mean, root
        begin(h, views)
    for array in nodes.values():
        # All runs start alike.
        array[:] = array[:1, ..., :1].copy()
    payload = make_arrays({**record.payload}, (messages,), lanes)
    arrays = {**nodes, **per_link}
    values: dict[str, Any] = {name: array[0] for name, array in arrays.items()}
    # Filters of one record share its compiled code.
    name = re.sub(r"\W", "_", kernels.record.__name__)
    # A struct has at least one field.
    payload = payload or {"empty": np.zeros((1, 1))}
    values["payload"] = record_class(f"{name}_payload", payload)(**payload)
    values |= make_arrays(record.scratch, (), lanes)
    values |= record.settings
    if record.past:
        values["room"] = FIRST_PAST
    numbers = {
        **({"root": triangle_numbers(n)} if "root" in record.payload else {}),
        **record.numbers,
    }
    struct, past = record_class(name, values)(**values), tuple(record.past)
    return Records(struct, arrays, begin, tuple(per_link), past, numbers)


def double_past(record: Any, names: Sequence[str]) -> None:
    """Make room for twice as many past events in a record, whose fields of them have ``names``."""
    for name in names:
        array = getattr(record, name)
        setattr(record, name, np.concatenate([array, np.zeros_like(array)], axis=1))
    record.room *= 2


def resized(payload: Any, messages: int) -> Any:
    """Return a payload struct with room for so many messages, those of ``payload`` among them."""
    fields = {}
    for name in type(payload).struct_fields:
        old = getattr(payload, name)
        fields[name] = np.zeros((messages, *old.shape[1:]), dtype=old.dtype)
        fields[name][: len(old)] = old
    return type(payload)(**fields)
