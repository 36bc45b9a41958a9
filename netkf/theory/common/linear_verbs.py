"""The verbs of an affine filter as linear maps, found by running its kernels.

Given the events of a run, everything that filters compute is affine in readings and means. A verb
of one node changes only what that node, its incoming links and its messages hold: it is run once as
things are without noise, and once more for each number that depends on noise, with 1 added to that.
The differences are the columns of its linear map, which is applied to the *forms* of these numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.filter import compiled_kernels
from netkf.algorithms.kernels.run import ClockRun
from netkf.algorithms.models import changing_models
from netkf.algorithms.records import Kernels, make_records, record_class
from netkf.core.errors import TheoryError
from netkf.engines.compiled.clock_filters import ClockFilters
from netkf.engines.compiled.state import filters_at_start
from netkf.linalg.addresses import NOTHING, address_of, any_struct, call_at, call_at_two
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.generic import struct_like
from netkf.scenario.scenario import Scenario
from netkf.theory.common.forms import MEAN, Forms

PAYLOAD = "payload "
"""Prefix of names of arrays of messages."""


class Given(NamedTuple):
    """Numbers beside the words of a node that a verb depends on.

    places : (k, 2), for each of them (r, i): entry i of reading r, or of the offset for r = -1
    forms : (k, C), their forms
    readings : H (p, n) of each reading
    """

    places: IntArray = np.zeros((0, 2), dtype=np.int64)
    forms: FloatArray = np.zeros((0, 0))
    readings: Sequence[FloatArray] = ()


NOTHING_GIVEN = Given()


@kernel
def run_in_blocks(
    record: Any, memories: np.ndarray, run: ClockRun, offsets: FloatArray, count: int,
    predict: int, act: int, h: int, m: int, gap: float,
) -> None:  # fmt: skip
    """Predict node ``h`` over ``gap`` seconds, if that is not 0, and run a verb, by their addresses
    ``predict`` and ``act``, in each of B blocks: with its ``memories`` (B, words), its ``offsets``
    (B, n) and its ``count`` readings. With a message ``m`` >= 0 the verb is ``emit``.
    """
    for b in range(len(offsets)):
        for i in range(len(run.size)):
            run.offset[i, 0] = offsets[b, i]
        run.first_y = run.first_H = b * count
        if gap > 0.0:
            run.gap = gap
            call_at(predict, struct_like(record, memories[b]), h, run)
        if m >= 0:
            call_at_two(act, struct_like(record, memories[b]), h, m, run)
        elif act != NOTHING:
            call_at(act, struct_like(record, memories[b]), h, run)


class LinearVerbs:
    """The filters of a run: what they hold without noise, and the forms of what depends on it.

    Arrays of all nodes, links and messages lie in one row of 8-byte words; ``_row`` (W,) is the row
    of each word in ``forms``, -1 for those that do not depend on noise.
    """

    def __init__(self, scenario: Scenario, forms: Forms, messages: int, rows: int) -> None:
        """Make the filters at time 0, with room for ``messages`` and readings of ``rows``."""
        kernels = compiled_kernels(scenario.node_filter, clocked=True)
        assert kernels is not None
        self.kernels: Kernels = kernels
        self.forms, start = forms, filters_at_start(scenario)
        self.estimators, self.n = start.xhat.shape
        with_means = ClockFilters(scenario, kernels, start, messages)
        self.clocked, self.run, self._p = with_means, with_means.run, max(1, rows)
        self.messages = len(self.run.message)
        # All records and runs are of one class.
        self._addresses: dict[Any, int] = {}
        pooled = scenario.node_filter.timing.pooled
        records = make_records(
            scenario.node_filter,
            [(np.zeros(self.n), root) for root in start.root],
            scenario.node_infos[:1] if pooled else scenario.node_infos,
            changing_models(scenario.model_pieces, scenario.followed_changes.tolist()),
            links=len(self.run.sender),
            messages=messages,
        )
        self._template, self._links, self._past = records.struct, records.links, records.past
        arrays = {name: array[0] for name, array in records.arrays.items()}
        payload = self._template.payload
        for name in type(payload).struct_fields:
            arrays[PAYLOAD + name] = getattr(payload, name)
        for name, array in arrays.items():
            if array.dtype.itemsize != 8:
                rule = "exact errors need records of int64 and float64"
                raise TheoryError(f"{rule}, and {name} is {array.dtype}; declare it as one of them")
        self._lay_out(arrays, {})
        self._start = {name: array.copy() for name, array in arrays.items()}
        self._begun = {name: array[0].copy() for name, array in with_means.records.arrays.items()}
        self._set_means()
        self._offset_places = np.column_stack([np.full(self.n, -1), np.arange(self.n)])
        self._own_places = np.column_stack([np.zeros(self._p, dtype=np.int64), np.arange(self._p)])
        self._y, self._H = np.zeros((0, self._p, 1)), np.zeros((0, self._p, self.n, 1))
        self._rows = np.zeros(1 + self.messages, dtype=np.int64)
        self.run.rows, self.run.matrix = self._rows, np.arange(len(self._rows))

    def _lay_out(self, arrays: dict[str, np.ndarray], rows: dict[str, np.ndarray]) -> None:
        """Store these ``arrays``; ``rows`` are rows in the forms by name, by default none."""
        ends = np.cumsum([array.size for array in arrays.values()]).tolist()
        self._begin = dict(zip(arrays, [0, *ends], strict=False))
        self._shapes = {name: array.shape for name, array in arrays.items()}
        self._row = np.full(ends[-1], -1, dtype=np.int64)
        self._stored = np.zeros(ends[-1])
        self._is_float = np.zeros(ends[-1], dtype=bool)
        self._dtypes = {name: array.dtype for name, array in arrays.items()}
        for name, array in arrays.items():
            self._view(name)[...] = array
            place = slice(self._begin[name], self._begin[name] + array.size)
            self._is_float[place] = array.dtype == np.float64
            if name in rows:
                self._row[place] = rows[name].reshape(-1)
        self._node_words: dict[int, IntArray] = {}
        self._message_words: dict[int, IntArray] = {}
        self._blocks = np.zeros((0, 0))
        self._fit_blocks(8)

    def _view(self, name: str) -> np.ndarray:
        shape, begin = self._shapes[name], self._begin[name]
        words = self._stored[begin : begin + math.prod(shape)]
        return words.view(self._dtypes[name]).reshape(shape)

    def _set_means(self) -> None:
        for name, begun in self._begun.items():
            difference = (begun - self._start[name]).reshape(-1)
            words = self._begin[name] + np.flatnonzero(difference)
            rows = self._row[words] = self.forms.take(len(words))
            self.forms.table[rows, MEAN] = difference[difference != 0]
        begin = self._begin["xhat"]
        words = np.arange(begin, begin + self.estimators * self.n)
        missing = words[self._row[words] < 0]
        self._row[missing] = self.forms.take(len(missing))
        self.xhat_rows = self._row[words].reshape(self.estimators, self.n)

    @property
    def roots(self) -> FloatArray:
        """Roots (M, n, n) of the covariances, a view."""
        view: FloatArray = self._view("root")[..., 0]
        return view

    def _fit_blocks(self, count: int) -> None:
        """Make the records of ``count`` blocks."""
        if count <= len(self._blocks):
            return
        self._blocks = blocks = np.zeros((2 * count, len(self._stored)))
        self._no_offsets = np.zeros((2 * count, self.n))
        first, views = self._template, {}
        for name, begin in self._begin.items():
            shape = self._shapes[name]
            words = blocks[0, begin : begin + math.prod(shape)]
            views[name] = words.view(self._dtypes[name]).reshape(shape)
        payload = {k.removeprefix(PAYLOAD): v for k, v in views.items() if k.startswith(PAYLOAD)}
        made = record_class(type(first.payload).__name__, payload)(**payload)
        values = {name: views.get(name, getattr(first, name)) for name in type(first).struct_fields}
        self._record = type(first)(**values | {"payload": made})
        steps = np.arange(len(blocks), dtype=np.int64) * blocks.strides[0]
        self._payloads = _memories(made, payload, steps)
        own = {name: view for name, view in views.items() if not name.startswith(PAYLOAD)}
        self._memories = _memories(self._record, own, steps)
        places = np.arange(len(blocks)) * self._payloads.strides[0]
        offset = self._record.struct_offsets["payload"]
        self._memories[:, offset] = self._payloads.ctypes.data + places

    def node_words(self, h: int, events: int = 0) -> IntArray:
        """Return the words of node ``h`` and its links; its past with room for ``events``."""
        if h not in self._node_words:
            first, parts = self.run.first, []
            for name, begin in self._begin.items():
                if name in self._past or name.startswith(PAYLOAD):
                    continue
                is_link = name in self._links
                ends = (first[h], first[h + 1]) if is_link else (h, h + 1)
                size = math.prod(self._shapes[name][1:])
                parts.append(np.arange(begin + ends[0] * size, begin + ends[1] * size))
            self._node_words[h] = np.concatenate(parts)
        words = self._node_words[h]
        if not self._past:
            return words
        last, parts = int(self._view("kept")[h, 0]) + events, [words]
        if last > self._shapes[self._past[0]][1]:
            self._double_past()
            return self.node_words(h, events)
        for name in self._past:
            _, room, *shape = self._shapes[name]
            size = math.prod(shape)
            begin = self._begin[name] + h * room * size
            parts.append(np.arange(begin, begin + last * size))
        return np.concatenate(parts)

    def _double_past(self) -> None:
        arrays = {name: self._view(name).copy() for name in self._begin}
        rows = {
            name: self._row[begin : begin + math.prod(self._shapes[name])].reshape(
                self._shapes[name]
            )
            for name, begin in self._begin.items()
        }
        for name in self._past:
            arrays[name] = np.concatenate([arrays[name], np.zeros_like(arrays[name])], axis=1)
            rows[name] = np.concatenate([rows[name], np.full_like(rows[name], -1)], axis=1)
        self._template.room *= 2
        self._lay_out(arrays, rows)

    def message_words(self, m: int) -> IntArray:
        """Return the words of message ``m``."""
        if m not in self._message_words:
            parts = []
            for name, begin in self._begin.items():
                if name.startswith(PAYLOAD):
                    size = math.prod(self._shapes[name][1:])
                    parts.append(np.arange(begin + m * size, begin + (m + 1) * size))
            self._message_words[m] = np.concatenate(parts)
        return self._message_words[m]

    def forget(self, m: int) -> None:
        """Give back the rows of message ``m``."""
        words = self.message_words(m)
        rows = self._row[words]
        self.forms.give(rows[rows >= 0])
        self._row[words] = -1

    def _set_readings(self, matrices: Sequence[FloatArray], blocks: int) -> None:
        """Make readings of 0 with these H (p, n) those of the run, in so many ``blocks``."""
        run, count = self.run, len(matrices)
        size = blocks * count
        if size > len(self._y):
            self._y = np.zeros((2 * size, self._p, 1))
            self._H = np.zeros((2 * size, self._p, self.n, 1))
            run.y, run.H = self._y, self._H
        self._y[:size] = 0.0
        for r, H in enumerate(matrices):
            self._H[r:size:count, : len(H), :, 0] = H
            self._rows[r] = len(H)

    def predict(self, h: int, gap: float) -> None:
        """Predict node ``h`` by ``gap`` seconds."""
        self._apply(None, self.node_words(h), h, gap)

    def update(self, h: int, gap: float, H: FloatArray, y: FloatArray) -> None:
        """Predict node ``h`` and update it with a reading ``y`` (p, C), whitened with ``H``."""
        self.run.reading = 0
        given = Given(self._own_places[: len(H)], y, [H])
        self._apply(self.kernels.update, self.node_words(h, 1), h, gap, given)

    def emit(self, h: int, gap: float, m: int) -> None:
        """Predict node ``h`` and write its payload into message ``m``."""
        self.run.sends[0] = 1
        words, sent = self.node_words(h), self.message_words(m)
        words, written = np.concatenate([words, sent]), len(sent)
        self._apply(self.kernels.emit, words, h, gap, m=m, written=written)

    def absorb(self, h: int, gap: float, messages: Sequence[int], readings: Sequence[Any]) -> None:
        """Predict node ``h`` and let it absorb ``messages``, with their ``readings``, pairs of H
        (p, n) and rows (p,); the inbox of the run is set.
        """
        words, heard = self.node_words(h, len(readings)), map(self.message_words, set(messages))
        # Reading 0 is the own one.
        given = Given(readings=[np.zeros((0, self.n)), *(H for H, _ in readings)])
        if readings:
            pairs = [(r, i) for r, H in enumerate(given.readings) for i in range(len(H))]
            places = np.array(pairs, dtype=np.int64).reshape(-1, 2)
            rows = np.concatenate([rows for _, rows in readings])
            given = given._replace(places=places, forms=self.forms.table[rows])
        keep, words = len(words), np.concatenate([words, *heard])
        self._apply(self.kernels.absorb, words, h, gap, given, keep=keep)

    def shift(self, h: int, gap: float, offset: FloatArray) -> None:
        """Predict node ``h`` and move it with the origin, by ``offset`` (n, C)."""
        given = Given(self._offset_places, offset)
        self._apply(self.kernels.shift, self.node_words(h, 1), h, gap, given)

    def restart(self, h: int, moved: FloatArray) -> None:
        """Let node ``h`` begin again, in coordinates that have ``moved`` (n,) since time 0."""
        first, forms = self.run.first, self.forms
        forms.table[self.xhat_rows[h]] = 0.0
        begun_elsewhere = {name: array.copy() for name, array in self._begun.items()}
        self.clocked.records.begin_elsewhere(begun_elsewhere, h, 0, moved)
        for name, array in begun_elsewhere.items():
            shape, place = self._shapes[name], slice(h, h + 1)
            if name in self._links:
                place = slice(first[h], first[h + 1])
            means = array[place] - self._start[name][place]
            words = self._begin[name] + np.arange(math.prod(shape)).reshape(shape)[place]
            rows = self._row[words]
            if name != "xhat":
                forms.give(rows[rows >= 0])
                self._row[words] = -1
            # The past may have grown.
            begun = words[:, : means.shape[1]]
            self._stored[begun] = self._start[name][place].view(np.float64)
            linear = begun[means != 0.0]
            missing = linear[self._row[linear] < 0]
            self._row[missing] = forms.take(len(missing))
            forms.table[self._row[linear], MEAN] = means[means != 0.0]

    def shift_message(self, m: int, offset: FloatArray) -> None:
        """Move message ``m`` with the origin, by ``offset`` (n, C) at the time of sending."""
        given = Given(self._offset_places, offset)
        self._apply(self.kernels.shift_payload, self.message_words(m), m, 0.0, given)

    def _address(self, verb: Any, integers: int = 1) -> int:
        if verb not in self._addresses:
            self._addresses[verb] = address_of(verb, self._record, self.run, integers)
        return self._addresses[verb]

    def _apply(
        self,
        verb: Any,
        words: IntArray,
        h: int,
        gap: float,
        given: Given = NOTHING_GIVEN,
        m: int = -1,
        keep: int | None = None,
        written: int = 0,
    ) -> None:
        """Predict, run a ``verb``, if any, on ``words`` (w,), and apply its map to the forms."""
        # The first ``keep`` words may change, or all; the last ``written`` are only written. With
        # ``m`` the verb is ``emit``.
        places, others, readings = given
        predict = self._address(self.kernels.predict)
        act = NOTHING if verb is None else self._address(verb, 1 if m < 0 else 2)
        kept, forms, rows = words[:keep], self.forms, self._row[words]
        # Block 0 is as things are without noise; in each other one 1 is added to one number.
        inputs = np.flatnonzero(rows[: len(words) - written] >= 0)
        changes, count = 1 + len(inputs) + len(places), len(readings)
        self._fit_blocks(changes)
        if readings:
            self._set_readings(readings, changes)
        blocks, offsets = self._blocks[:changes], self._no_offsets[:changes]
        blocks[:, words] = self._stored[words]
        if len(inputs):
            blocks[np.arange(1, 1 + len(inputs)), words[inputs]] += 1.0
        if len(places):
            number, (r, i) = np.arange(1 + len(inputs), changes), places.T
            if readings:
                self._y[number * count + r, i, 0] = 1.0
            else:
                offsets = offsets.copy()
                offsets[number, i] = 1.0
        run_in_blocks(
            any_struct(self._record), self._memories, self.run.general, offsets, count, predict,
            act, h, m, gap,
        )  # fmt: skip
        self._stored[kept] = blocks[0, kept]
        if changes == 1:
            return
        floats = np.flatnonzero(self._is_float[kept])
        values, own = blocks[:, kept[floats]], rows[floats]
        linear = (values[1:] - values[0]).T
        sources = forms.table[rows[inputs], : forms.used]
        if len(others):
            sources = np.concatenate([sources, others[:, : forms.used]])
        # Some words depend on noise now that did not before.
        new = np.flatnonzero((own < 0) & linear.any(axis=1))
        if len(new):
            own[new] = self._row[kept[floats[new]]] = forms.take(len(new))
        targets = own >= 0
        forms.table[own[targets], : forms.used] = linear[targets] @ sources


def _memories(struct: Any, arrays: dict[str, np.ndarray], steps: IntArray) -> np.ndarray:
    """Return the memories (B, words) of structs whose ``arrays`` lie ``steps`` (B,) further on."""
    memories = np.tile(struct.memory, (len(steps), 1))
    for name in arrays:
        memories[:, struct.struct_offsets[name]] += steps
    return memories
