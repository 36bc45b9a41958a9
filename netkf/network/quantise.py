"""Payloads of few bits: numbers are quantised with subtractive dither."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from netkf.core.contracts import is_netkf_class
from netkf.core.fields import Component, field, integer, positive
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel

MAX_BITS = 48
"""More would be beyond the digits of a float64."""
NOTHING = 1e-6
"""Share of a step up to which a number is received as 0."""


@dataclass(frozen=True, eq=False)
class Quantisation(Component):
    """The numbers of payloads are sent with ``bits`` each, for values from -``range`` to ``range``.

    bits   of a number
    range  numbers that are larger with their dither are clipped, and the run says how many were

    Both ends know a dither u, uniform over a step of ``2 range / 2^bits``: the sender rounds z + u,
    the receiver subtracts u. Up to half a step below ``range`` nothing is clipped: the error is
    uniform over a step, whatever z is, and independent of it and of other errors (Roberts 1962;
    Schuchman 1964). Zeros, also those that rounding makes of 0, are received as 0.
    """

    bits: int = field(integer(low=1, high=MAX_BITS))
    range: float = field(positive)

    @property
    def step(self) -> float:
        """The distance of two neighbouring values."""
        return 2.0 * self.range / 2.0**self.bits

    @property
    def variance(self) -> float:
        """The variance ``step^2 / 12`` of the error of a number."""
        return self.step * self.step / 12.0

    @property
    def levels(self) -> float:
        """The number of values that are sent."""
        return 2.0**self.bits

    def apply(self, values: FloatArray, random: np.random.Generator) -> tuple[FloatArray, int]:
        """Return what is received of ``values`` (K,), and how many were clipped."""
        received = np.array(values, dtype=np.float64, order="C")
        units, scale = random.random(values.shape), (self.step, self.range, self.levels)
        return received, int(quantise_numbers(received, units, *scale))


@kernel
def quantise_number(
    value: float, unit: float, step: float, limit: float, levels: float
) -> tuple[float, bool]:
    """Return what is received of a number for ``unit`` in [0, 1), and if it was clipped."""
    dither = step * (unit - 0.5)
    level = np.floor((value + dither + limit) / step)
    kept = min(max(level, 0.0), levels - 1.0)
    # A mass of 0 is received as 0, since receivers divide by masses; so is one that is 0 but for
    # rounding, which is not the same in both engines.
    received = 0.0 if abs(value) <= NOTHING * step else (kept + 0.5) * step - limit - dither
    return received, kept != level


@kernel
def quantise_numbers(
    values: FloatArray, units: FloatArray, step: float, limit: float, levels: float
) -> int:
    """Replace ``values`` (K,) by what is received of them; return how many were clipped."""
    clipped = 0
    for k in range(len(values)):
        values[k], beyond = quantise_number(values[k], units[k], step, limit, levels)
        clipped += beyond
    return clipped


def first_entries(numbers: IntArray) -> IntArray:
    """Return the place (K,) of the first entry of each of K numbers, see ``Record.numbers``."""
    number, first = np.unique(numbers, return_index=True)
    return np.asarray(first[number >= 0])


class Encoder:
    """Quantises the payloads of a node with the dither of its stream ``random``."""

    def __init__(self, quantisation: Quantisation, random: np.random.Generator) -> None:
        self._quantisation, self._random = quantisation, random

    def encode(self, payload: Any) -> tuple[Any, int]:
        """Return the payload that is received, and how many of its numbers were clipped: floats,
        and arrays of them, in tuples, lists, dicts and a user's dataclasses too.
        """
        if isinstance(payload, float | np.floating):
            received, count = self._encode_array(np.array(payload, dtype=np.float64))
            return received[()], count
        if isinstance(payload, np.ndarray):
            if not np.issubdtype(payload.dtype, np.floating):
                return payload, 0
            return self._encode_array(payload.astype(np.float64, copy=False))
        if hasattr(payload, "fields"):
            # Messages of kernels: rows of single payloads, with an axis of lanes behind.
            numbers = payload.sender.run.numbers
            rows = {
                name: [self._encode_field(row[..., 0], numbers.get(name)) for row in values]
                for name, values in payload.fields.items()
            }
            arrays = {k: np.array([row for row, _ in v])[..., None] for k, v in rows.items()}
            return payload.with_fields(arrays), sum(n for v in rows.values() for _, n in v)
        if isinstance(payload, tuple | list):
            parts = [self.encode(part) for part in payload]
            make = getattr(payload, "_make", type(payload))
            return make([part for part, _ in parts]), sum(count for _, count in parts)
        return self._encode_names(payload)

    def _encode_names(self, payload: Any) -> tuple[Any, int]:
        """Quantise the values of a dict or of a user's dataclass; other things stay."""
        is_object = dataclasses.is_dataclass(payload) and not isinstance(payload, type)
        if isinstance(payload, dict):
            values = payload
        elif is_object and not is_netkf_class(type(payload)):  # a model in a state is not sent
            fields = dataclasses.fields(payload)
            values = {one.name: getattr(payload, one.name) for one in fields if one.init}
        else:
            return payload, 0
        named = {name: self.encode(value) for name, value in values.items()}
        made: Any = {name: value for name, (value, _) in named.items()}
        if values is not payload:
            made = dataclasses.replace(payload, **made)
        return made, sum(count for _, count in named.values())

    def _encode_field(self, values: np.ndarray, numbers: IntArray | None) -> tuple[Any, int]:
        """Quantise an array whose entries are these ``numbers``, see ``Record.numbers``."""
        if numbers is None or values.dtype != np.float64:
            return self.encode(values)
        sent, count = self._quantisation.apply(values.ravel()[first_entries(numbers)], self._random)
        return np.append(sent, 0.0)[numbers], count

    def _encode_array(self, values: FloatArray) -> tuple[FloatArray, int]:
        is_square = values.ndim == 2 and values.shape[0] == values.shape[1]
        is_symmetric = is_square and np.array_equal(values, values.T)
        sent: np.ndarray = np.ones(values.shape, dtype=bool)
        # Of triangular and symmetric matrices a message needs a triangle.
        if is_square and (is_symmetric or not np.triu(values, 1).any()):
            sent = np.tri(len(values), dtype=bool)
        elif is_square and not np.tril(values, -1).any():
            sent = np.tri(len(values), dtype=bool).T
        received = values.copy()
        received[sent], count = self._quantisation.apply(values[sent], self._random)
        return np.where(sent, received, received.T) if is_symmetric else received, count


def encoders(scenario: Any, streams: Any) -> dict[int, Encoder]:
    """Return the encoders of all nodes by id; {} without ``network.quantise``."""
    quantisation, nodes = scenario.network.quantise, scenario.nodes
    if quantisation is None:
        return {}
    return {node: Encoder(quantisation, streams.generator("dither", node)) for node in nodes}
