"""Exact errors of affine filters under clocks with sampled sensors, from their own verbs.

As in slots (``columns``), each independent noise is a column, on which the filter's own kernels
run; here the log of the run is repeated, row by row, for all columns at once.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any, cast

import numpy as np

from netkf.algorithms.filter import commutes, compiled_kernels
from netkf.algorithms.records import Kernels, Records, make_records, record_class
from netkf.engines.compiled.clock_filters import ClockFilters
from netkf.engines.compiled.state import filters_at_start
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.generic import copy_row, struct_like
from netkf.plants.transitions import Transitions
from netkf.scenario.scenario import Scenario
from netkf.theory.common.columns import MEAN, NOISE, ZERO, ErrorColumns
from netkf.theory.common.observations import timed_observations
from netkf.theory.numerics.updates import Observation
from netkf.trace.run import Run
from netkf.trace.schema import CODES

SENSE, SEND, DELIVER, ABSORB, TRANSMIT = (
    CODES[kind] for kind in ("sense", "send", "deliver", "absorb", "transmit")
)
SPARE = 8
"""Columns, as multiples of the entries that depend on noise, before they are compressed."""


def has_clock_columns(scenario: Scenario) -> bool:
    """Return True if the errors of a scenario under clocks follow from the verbs of its filter."""
    kernels = compiled_kernels(scenario.node_filter, clocked=True)
    # The past of nodes would have to grow here, too, and each link have a payload.
    if kernels is None or not kernels.affine or kernels.remembers or kernels.addressed:
        return False
    if not commutes(scenario.node_filter):
        return False
    return not any(scenario.increment_sensors.values())


@cache
def column_verbs(kernels: Kernels) -> tuple[Any, Any, Any, Any, Any]:
    """Return kernels that call ``predict``, ``update``, ``emit`` and ``absorb`` for one node in all
    columns, ``verb(record, memories, run, h, ...)``, and one that copies a payload in all.
    """
    predict, update, emit, absorb = kernels.predict, kernels.update, kernels.emit, kernels.absorb

    @kernel
    def predict_all(record: Any, memories: np.ndarray, run: Any, h: int) -> None:
        for c in range(len(memories)):
            predict(struct_like(record, memories[c]), h, run)

    @kernel
    def update_all(record: Any, memories: np.ndarray, run: Any, h: int) -> None:
        for c in range(len(memories)):
            run.first_y = run.first_H = c * len(run.rows)
            update(struct_like(record, memories[c]), h, run)

    @kernel
    def emit_all(record: Any, memories: np.ndarray, run: Any, h: int, m: int) -> None:
        for c in range(len(memories)):
            emit(struct_like(record, memories[c]), h, m, run)

    @kernel
    def absorb_all(record: Any, memories: np.ndarray, run: Any, h: int) -> None:
        for c in range(len(memories)):
            run.first_y = run.first_H = c * len(run.rows)
            absorb(struct_like(record, memories[c]), h, run)

    @kernel
    def copy_all(record: Any, memories: np.ndarray, k: int, m: int) -> None:
        for c in range(len(memories)):
            copy_row(struct_like(record, memories[c]).payload, k, m)

    return predict_all, update_all, emit_all, absorb_all, copy_all


class ClockColumns(ErrorColumns):
    """The errors of M estimators under clocks, as columns."""

    def __init__(self, scenario: Scenario, run: Run) -> None:
        kernels = compiled_kernels(scenario.node_filter, clocked=True)
        assert kernels is not None
        self._scenario, self._run, self._kernels = scenario, run, kernels
        start = filters_at_start(scenario)
        self.estimators, self.n = start.xhat.shape
        self._one = ClockFilters(scenario, kernels, start, 1)
        self._start, self._kept = start, []
        self._now, self._times = 0.0, np.zeros(self.estimators)
        self._readings: dict[tuple[float, int], tuple[FloatArray, FloatArray]] = {}
        self._sent: dict[tuple[int, int, int], tuple[int, float, int]] = {}
        self._free: list[int] = []
        plant = cast(Any, scenario.plant)
        self._transitions = Transitions(plant.A, plant.B)
        self._x = np.column_stack([np.zeros(self.n), plant.start_mean, plant.start_root])
        self._records, self._payload = self._make(self._x.shape[1], 64)
        self._set_means()

    def _make(self, columns: int, messages: int) -> tuple[Records, dict[str, np.ndarray]]:
        """Return records with zero means for so many columns, and their payloads (C, M, ...)."""
        scenario, start = self._scenario, self._start
        pooled = scenario.node_filter.pooled
        infos = scenario.node_infos[:1] if pooled else scenario.node_infos
        models = (scenario.pooled_model,) if pooled else scenario.models
        zeros = np.zeros(start.xhat.shape)
        records = make_records(
            scenario.node_filter,
            list(zip(zeros, start.root, strict=True)),
            infos,
            models,
            links=len(self._one.run.sender),
            messages=messages,
            blocks=columns,
        )
        first = records.struct.payload
        payload = {
            name: np.zeros((columns, *(a := getattr(first, name)).shape), dtype=a.dtype)
            for name in type(first).struct_fields
        }
        self._free = list(range(messages))[::-1]
        return records, payload

    def _set_means(self) -> None:
        """Give the column of means the means of the filters."""
        for name, array in self._records.arrays.items():
            array[MEAN] = self._one.records.arrays[name][0]

    def _refresh(self) -> None:
        """Compute the memory of the record of each column, with a payload of its own."""
        record, payload = self._records.struct, self._payload
        cls = record_class(type(record.payload).__name__, {k: v[0] for k, v in payload.items()})
        first = cls(**{name: array[0] for name, array in payload.items()})
        columns = len(self._records.arrays["xhat"])
        self._payload_memory = np.tile(first.memory, (columns, 1))
        for name, array in payload.items():
            steps = np.arange(columns, dtype=np.int64) * array.strides[0]
            self._payload_memory[:, first.struct_offsets[name]] += steps
        record.payload, self._payload_struct = first, first
        self._memories = self._records.memories
        base = self._payload_memory.ctypes.data
        words = base + np.arange(columns) * self._payload_memory.strides[0]
        self._memories[:, record.struct_offsets["payload"]] = words
        self._verbs = column_verbs(self._kernels)

    def _fit(self, columns: int) -> None:
        """Give the filters so many columns; new ones are as the column without noise."""
        arrays = self._records.arrays
        old = len(arrays["xhat"])
        if columns <= old <= 2 * columns:
            return
        made, _ = self._make_like(columns)
        for name, array in made.arrays.items():
            kept = min(old, columns)
            array[:kept], array[kept:] = arrays[name][:kept], arrays[name][ZERO]
        for name, array in self._payload.items():
            kept = min(old, columns)
            wide = np.empty((columns, *array.shape[1:]), dtype=array.dtype)
            wide[:kept], wide[kept:] = array[:kept], array[ZERO]
            self._payload[name] = wide
        self._records = made
        self._refresh()

    def _make_like(self, columns: int) -> tuple[Records, dict[str, np.ndarray]]:
        """Return records for so many columns; the messages under way stay."""
        free = self._free
        made = self._make(columns, self._messages)
        self._free = free
        return made

    @property
    def _messages(self) -> int:
        """Messages for which there is room."""
        return int(next(iter(self._payload.values())).shape[1])

    def replay(self) -> Iterator[None]:
        """Repeat the log of the run; yield at each of ``run.times``."""
        self._refresh()
        scenario, run = self._scenario, self._run
        self._samples = timed_observations(scenario, run)
        self._index = scenario.topology.index
        clock = cast(Any, scenario.network.activation)
        self._broadcasts = clock.at in ("nodes", "readings")
        self._delivered = self._arrivals()
        log, k = run.log, 0
        times = log["t"].tolist()
        for until in run.times.tolist():
            while k < len(log) and times[k] <= until:
                self._apply(log[k])
                k += 1
            self._move_truth(until)
            for h in range(self.estimators):
                self._predict(h)
            yield

    def _arrivals(self) -> set[tuple[int, int, int]]:
        """Return the messages that arrive: sender, receiver and number of each."""
        rows = self._run.log[self._run.log["kind"] == DELIVER]
        columns = (rows[name].tolist() for name in ("peer", "node", "message"))
        return set(zip(*columns, strict=True))

    def _apply(self, row: Any) -> None:
        """Repeat one row of the log."""
        kind, time, node = int(row["kind"]), float(row["t"]), int(row["node"])
        self._move_truth(time)
        if kind == SENSE:
            h = 0 if self._scenario.node_filter.pooled else self._index[node]
            self._sense(h, time)
        elif kind == TRANSMIT:
            self._predict(self._index[node])
            self._source = self._take()
            self._emit(self._index[node], self._source)
            self._free.append(self._source)
        elif kind == SEND:
            self._send(node, int(row["peer"]), int(row["message"]), time)
        elif kind == DELIVER:
            key = int(row["peer"]), node, int(row["message"])
            self._inboxes.setdefault(node, []).append((*self._sent.pop(key), key[0]))
        elif kind == ABSORB and node in self._inboxes:
            self._absorb(node, time)

    @property
    def _inboxes(self) -> dict[int, list[tuple[int, float, int, int]]]:
        """Messages of this instant by receiver: payload, time of sending, number, sender."""
        found: dict[int, list[tuple[int, float, int, int]]] = self.__dict__.setdefault("_inbox", {})
        return found

    def _move_truth(self, time: float) -> None:
        """Move the true state to ``time``, with a column for each noise of the plant."""
        gap = time - self._now
        if gap <= 0.0:
            return
        self._compress_if_many()
        (F,), (root,) = self._transitions.laws(np.array([gap]))
        self._x, self._now = np.column_stack([F @ self._x, root]), time
        self._fit(self._x.shape[1])

    def _predict(self, h: int) -> None:
        """Predict node h to the present."""
        gap = self._now - self._times[h]
        if gap > 0.0:
            self._times[h] = self._now
            run = self._one.run
            run.gap = gap
            self._verbs[0](self._records.struct, self._used(), run, h)

    def _used(self) -> np.ndarray:
        """Return the memories of the columns that are used."""
        return self._memories[: self._x.shape[1]]

    def _take(self) -> int:
        """Return a free message."""
        if not self._free:
            room = self._messages
            for name, array in self._payload.items():
                self._payload[name] = np.concatenate([array, np.zeros_like(array)], axis=1)
            self._free = list(range(room, 2 * room))[::-1]
            self._refresh()
        return self._free.pop()

    def _sense(self, h: int, time: float) -> None:
        """Update node h with all its samples of this instant, once."""
        observation: Observation | None = self._samples.get(time, {}).pop(h, None)
        if observation is None:
            return
        first, noises = self._x.shape[1], observation.root.shape[1]
        self._x = np.column_stack([self._x, np.zeros((self.n, noises))])
        self._fit(first + noises)
        self._predict(h)
        parts = np.column_stack([observation.H, observation.root])
        whitened = np.linalg.solve(np.linalg.cholesky(observation.R), parts)
        y = whitened[:, : self.n] @ self._x
        y[:, first:] += whitened[:, self.n :]
        H = whitened[:, : self.n]
        if self._kernels.sends_readings:
            self._readings[time, h] = y, H
        self._set_readings([(y, H)])
        run = self._one.run
        run.reading = 0
        self._verbs[1](self._records.struct, self._used(), run, h)

    def _set_readings(self, readings: list[tuple[FloatArray, FloatArray]]) -> None:
        """Make these the readings of the run: y (p, C) and H (p, n) of each."""
        run, count, columns = self._one.run, len(readings), self._x.shape[1]
        p = max(1, *(len(y) for y, _ in readings))
        ys, Hs = np.zeros((columns, count, p, 1)), np.zeros((columns, count, p, self.n, 1))
        for r, (y, H) in enumerate(readings):
            ys[:, r, : len(y), 0], Hs[:, r, : len(y), :, 0] = y.T, H
        run.y, run.H = ys.reshape(-1, p, 1), Hs.reshape(-1, p, self.n, 1)
        run.rows = np.array([len(y) for y, _ in readings], dtype=np.int64)
        run.matrix = np.arange(count)

    def _emit(self, h: int, m: int) -> None:
        """Write the payload of node h into message m."""
        run = self._one.run
        run.sends[0] = 1
        self._verbs[2](self._records.struct, self._used(), run, h, m)

    def _send(self, node: int, peer: int, number: int, time: float) -> None:
        """Send one message, if it will arrive."""
        key, h = (node, peer, number), self._index[node]
        if key not in self._delivered:
            return
        self._predict(h)
        m = self._take()
        if self._broadcasts:
            self._verbs[4](self._records.struct, self._used(), m, self._source)
        else:
            self._emit(h, m)
        self._sent[key] = m, time, number

    def _absorb(self, node: int, time: float) -> None:
        """Let a node absorb all messages of this instant."""
        h, run, scenario = self._index[node], self._one.run, self._scenario
        self._predict(h)
        inbox = sorted(self._inboxes.pop(node), key=lambda m: (self._index[m[3]], m[1], m[2]))
        released = [m for m, *_ in inbox]
        if scenario.node_filter.newest_only:
            inbox = list({message[3]: message for message in inbox}.values())
        count = len(inbox)
        links = run.sender[run.first[h] : run.first[h + 1]].tolist()
        empty = np.zeros((0, self._x.shape[1])), np.zeros((0, self.n))
        readings, heard = [empty], []
        for _, sent, _, sender in inbox:
            reading = self._readings.get((sent, self._index[sender]))
            heard.append(-1 if reading is None else len(readings))
            readings += [] if reading is None else [reading]
        self._set_readings([(self._wide(y), H) for y, H in readings])
        run.message = np.array([m for m, *_ in inbox], dtype=np.int64)
        run.link = np.array(
            [run.first[h] + links.index(self._index[s]) for *_, s in inbox], dtype=np.int64
        )
        run.message_weight = np.array([scenario.weight(node, s) for *_, s in inbox], dtype=float)
        run.age = scenario.time_grid.snap(np.array([time - sent for _, sent, _, _ in inbox]))
        run.heard, run.arrived = np.array(heard), np.ones((count, 1), dtype=np.uint8)
        run.count = count
        self._verbs[3](self._records.struct, self._used(), run, h)
        self._free += released

    def _wide(self, y: FloatArray) -> FloatArray:
        """Return the columns of a reading, with zeros in those that came after it."""
        return np.pad(y, ((0, 0), (0, self._x.shape[1] - y.shape[1])))

    def _compress_if_many(self) -> None:
        """Compress the columns if there are many more than their rank can be."""
        if self._x.shape[1] < NOISE + SPARE * self.n * (self.estimators + len(self._sent)):
            return
        keys, Hs = list(self._readings), [H for _, H in self._readings.values()]
        ys = self._compress([self._wide(y) for y, _ in self._readings.values()])
        self._readings = dict(zip(keys, zip(ys, Hs, strict=True), strict=True))

    def _matrices(self) -> dict[str, FloatArray]:
        """Return all arrays of the filters as matrices (entries, C), by name."""
        columns, arrays = self._x.shape[1], {**self._records.arrays}
        arrays |= {f"payload {name}": array for name, array in self._payload.items()}
        return {
            name: array[:columns].reshape(columns, -1).T
            for name, array in arrays.items()
            if array.dtype == np.float64
        }

    def _write(self, values: dict[str, FloatArray], columns: int) -> None:
        """Give the filters so many columns, with these matrices (entries, columns)."""
        self._fit(columns)
        for name, whole in values.items():
            is_payload = name.startswith("payload ")
            arrays = self._payload if is_payload else self._records.arrays
            array = arrays[name.removeprefix("payload ")]
            array[:columns] = whole.T.reshape(columns, *array.shape[1:])
            array[columns:] = array[ZERO]
