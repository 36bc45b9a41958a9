"""Payloads of few bits in compiled code: ``network.quantise`` of records."""

from __future__ import annotations

import numpy as np

from netkf.algorithms.records import Records
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.generic import struct_like
from netkf.linalg.structs import Struct
from netkf.network.quantise import Quantisation, first_entries, quantise_number
from netkf.rng.draws import next_unit
from netkf.rng.streams import WIDTH, Streams
from netkf.scenario.scenario import Scenario


class QuantisedField(Struct):
    """A field of payloads.

    values : (M, E, L) of M payloads in L runs
    number : (E,) which number an entry is, -1 for one that is not sent
    first : (K,) the first entry of each of K numbers
    """

    values: FloatArray
    number: IntArray
    first: IntArray


class Quantiser(Struct):
    """What is received of payloads of few bits, see ``Quantisation``.

    fields : (F, words) the memory of each QuantisedField; (0, words) if numbers are sent exactly
    field : one of them
    states : (R N, WIDTH) the streams of dither of N nodes in R runs
    received : (K,) scratch
    """

    fields: IntArray
    field: QuantisedField
    states: np.ndarray
    received: FloatArray
    step: float
    range: float
    levels: float


class PayloadQuantiser:
    """Quantises payloads of ``records``; ``struct``, for kernels, has no streams set yet."""

    def __init__(
        self, quantisation: Quantisation | None = None, records: Records | None = None
    ) -> None:
        self._records = records if quantisation is not None else None
        empty = QuantisedField(
            values=np.zeros((0, 0, 0)), number=np.zeros(0, np.int64), first=np.zeros(0, np.int64)
        )
        self.struct = Quantiser(
            fields=np.zeros((0, len(empty.memory)), dtype=np.int64),
            field=empty,
            states=np.zeros((0, WIDTH), dtype=np.uint64),
            received=np.zeros(0),
            step=quantisation.step if quantisation else 1.0,
            range=quantisation.range if quantisation else 0.0,
            levels=quantisation.levels if quantisation else 1.0,
        )
        self.find_payload()

    def with_streams(self, states: np.ndarray | None) -> Quantiser:
        """Return the struct, with streams at the begin of a run, if there are any."""
        if states is not None:
            self.struct.states = states
        return self.struct

    def find_payload(self) -> None:
        """Take the arrays of payloads that the records have now."""
        if self._records is None:
            return
        payload, fields = self._records.struct.payload, []
        for name in type(payload).struct_fields:
            array = getattr(payload, name)
            if array.dtype == np.float64:
                values = array.reshape(len(array), -1, array.shape[-1])
                given = self._records.numbers.get(name, np.arange(values.shape[1])).ravel()
                number = np.ascontiguousarray(given, dtype=np.int64)
                first = first_entries(number)
                fields.append(QuantisedField(values=values, number=number, first=first))
        self._kept = fields
        self.struct.fields = np.stack([field.memory for field in fields])
        self.struct.received = np.zeros(max(len(field.first) for field in fields))


def dither_of(scenario: Scenario, streams: Streams) -> np.ndarray | None:
    """Return the streams (R N, WIDTH) of the dither of all nodes in R runs, None without any."""
    if scenario.network.quantise is None:
        return None
    return streams.states("dither", [(node,) for node in scenario.nodes])


def unquantised_messages(scenario: Scenario) -> str | None:
    """Return which messages should be quantised and cannot be by kernels; None without any."""
    kernels = scenario.node_filter.kernels
    if scenario.network.quantise is None or kernels is None:
        return None
    if scenario.origin_response is not None:
        return "messages of few bits beside an input that filters know"
    infos, models = scenario.node_infos, scenario.model_pieces[0]
    record = kernels.record_of(scenario.node_filter, infos, models)
    for name, given in record.payload.items():
        is_square = len(given) == 2 and given[0] == given[1]
        if is_square and name not in record.numbers and name != "root":
            return f"messages of few bits whose matrix {name!r} may be symmetric (Record.numbers)"
    return None


@kernel
def clear_payloads(quantiser: Quantiser, m: int, count: int) -> None:
    """Set the numbers of ``count`` payloads from ``m`` on to 0, of which ``emit`` may not write
    all: what an earlier message told must not take part.
    """
    for f in range(len(quantiser.fields)):
        for k in range(count):
            clear_field(struct_like(quantiser.field, quantiser.fields[f]), m + k)


@kernel
def clear_field(field: QuantisedField, m: int) -> None:
    """Set the numbers of a field of payload ``m`` to 0."""
    field.values[m] = 0.0


@kernel
def quantise_payloads(quantiser: Quantiser, stream: int, m: int, count: int, q: int) -> int:
    """Replace the numbers of ``count`` payloads from ``m`` on in lane ``q`` by those that are
    received, with dither of a ``stream``; return how many were clipped.
    """
    clipped = 0
    for f in range(len(quantiser.fields)):
        field = struct_like(quantiser.field, quantiser.fields[f])
        for k in range(count):
            clipped += quantise_field(quantiser, field, stream, m + k, q)
    return clipped


@kernel
def quantise_field(quantiser: Quantiser, field: QuantisedField, stream: int, m: int, q: int) -> int:
    """Quantise a field of payload ``m`` in lane ``q``; return how many numbers were clipped."""
    clipped, values, received = 0, field.values, quantiser.received
    step, limit, levels = quantiser.step, quantiser.range, quantiser.levels
    for k in range(len(field.first)):
        unit, value = next_unit(quantiser.states, stream), values[m, field.first[k], q]
        received[k], beyond = quantise_number(value, unit, step, limit, levels)
        clipped += beyond
    for e in range(len(field.number)):
        if field.number[e] >= 0:
            values[m, e, q] = received[field.number[e]]
        else:
            # In all lanes, also in those that are idle: hearers ask whether any has it.
            values[m, e] = 0.0
    return clipped
