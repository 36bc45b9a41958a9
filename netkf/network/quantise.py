"""Payloads of few bits: numbers are quantised with subtractive dither."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from netkf.core.fields import Component, field, integer, positive
from netkf.linalg.arrays import FloatArray

MAX_BITS = 48
"""More would be beyond the digits of a float64."""


@dataclass(frozen=True, eq=False)
class Quantisation(Component):
    """The numbers of payloads are sent with ``bits`` each, for values from -``range`` to ``range``.

    bits   of a number
    range  largest size of a number; larger ones are clipped, and the run says how many were

    Both ends know a dither u, uniform over a step of ``2 range / 2^bits``: the sender rounds z + u,
    the receiver subtracts u. The error is then uniform over a step, whatever z is, and independent
    of it and of other errors (Roberts 1962; Schuchman 1964).
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
        return self.step**2 / 12.0

    def apply(self, values: FloatArray, random: np.random.Generator) -> tuple[FloatArray, int]:
        """Return what is received of ``values`` (K,), and how many were clipped."""
        dither = self.step * (random.random(values.shape) - 0.5)
        level = np.floor((values + dither + self.range) / self.step)
        kept = np.clip(level, 0.0, 2.0**self.bits - 1.0)
        received = (kept + 0.5) * self.step - self.range - dither
        return received, int((kept != level).sum())


class Encoder:
    """Quantises the payloads of a node with the dither of its stream ``random``."""

    def __init__(self, quantisation: Quantisation, random: np.random.Generator) -> None:
        self._quantisation, self._random = quantisation, random

    def encode(self, payload: Any) -> tuple[Any, int]:
        """Return the payload that is received, and how many numbers in it were clipped: those of
        its arrays, in tuples and messages of kernels alike.
        """
        if isinstance(payload, np.ndarray):
            return self._encode_array(payload)
        if hasattr(payload, "fields"):
            encoded, counts = self._encode_all(payload.fields.values())
            return payload.with_fields(dict(zip(payload.fields, encoded, strict=True))), counts
        if isinstance(payload, tuple):
            parts, count = self._encode_all(payload)
            make = getattr(payload, "_make", tuple)
            return make(parts), count
        return payload, 0

    def _encode_all(self, values: Any) -> tuple[list[Any], int]:
        pairs = [self.encode(value) for value in values]
        return [value for value, _ in pairs], sum(count for _, count in pairs)

    def _encode_array(self, values: np.ndarray) -> tuple[np.ndarray, int]:
        if values.dtype != np.float64:
            return values, 0
        sent = _sent_entries(values)
        received = values.copy()
        received[sent], count = self._quantisation.apply(values[sent], self._random)
        mirror = np.swapaxes(received, *_axes(values)) if _is_symmetric(values) else None
        return (received if mirror is None else np.where(sent, received, mirror)), count


def _axes(values: np.ndarray) -> tuple[int, int]:
    """Return the axes of matrices: those of messages of kernels are between two others."""
    return (1, 2) if values.ndim == 4 else (-2, -1)


def _is_matrix(values: np.ndarray) -> bool:
    first, second = _axes(values) if values.ndim > 1 else (0, 0)
    return values.ndim in (2, 4) and values.shape[first] == values.shape[second]


def _is_symmetric(values: np.ndarray) -> bool:
    return _is_matrix(values) and np.array_equal(values, np.swapaxes(values, *_axes(values)))


def _sent_entries(values: np.ndarray) -> np.ndarray:
    """Return a mask of the numbers that a message needs: of triangular and symmetric matrices those
    of a triangle.
    """
    if not _is_matrix(values):
        return np.ones(values.shape, dtype=bool)
    n = values.shape[_axes(values)[0]]
    lower = np.tri(n, dtype=bool)
    if values.ndim == 4:
        lower = lower[None, :, :, None]
    lower = np.broadcast_to(lower, values.shape)
    upper = np.swapaxes(lower, *_axes(values))
    if not values[~lower].any() or _is_symmetric(values):
        return lower
    return upper if not values[~upper].any() else np.ones(values.shape, dtype=bool)


def encoders(scenario: Any, streams: Any) -> dict[int, Encoder]:
    """Return the encoders of all nodes by id; {} without ``network.quantise``."""
    quantisation, nodes = scenario.network.quantise, scenario.nodes
    if quantisation is None:
        return {}
    return {node: Encoder(quantisation, streams.generator("dither", node)) for node in nodes}
