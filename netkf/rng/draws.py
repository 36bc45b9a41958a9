"""Numbers of many streams at once: those that numpy's ``Generator(PCG64DXSM)`` draws, compiled.

A network of 1e5 links has as many streams, and a generator of numpy for each costs more than what
is drawn from it. So the state of all of them is one array here. The words follow PCG64DXSM (M. E.
O'Neill's permuted congruential generator with the output of numpy's issue 13635), which numpy's
policy keeps as it is; exponentials come from the ziggurat of Marsaglia and Tsang (2000) with
numpy's tables (``ziggurat_constants.h``, BSD-3-Clause), kept in ``ziggurat.npz``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import LANES, Lanes, aligned, blocks_of
from netkf.linalg.words import high_word
from netkf.rng.streams import ReplicaStreams, Streams

_U = np.uint64
CHEAP = _U(0xDA942042E4DD58B5)  # the multiplier of PCG64DXSM, see numpy/random/src/pcg64
# The multiplier of 128 bits that PCG64DXSM seeds with.
FULL_HIGH, FULL_LOW = _U(0x2360ED051FC65DA4), _U(0x4385DF649FCCF645)
ZERO, ONE, HALF, LAYER = _U(0), _U(1), _U(0xFFFFFFFF), _U(0xFF)
S3, S8, S11, S32, S48, S63 = _U(3), _U(8), _U(11), _U(32), _U(48), _U(63)
TO_UNIT = 2.0**-53  # the spacing of numpy's uniform numbers
EXPONENTIAL_TAIL = 7.69711747013104972  # where numpy's exponential ziggurat begins its tail


class Ziggurat(NamedTuple):
    """256 layers under exp(-x): heights, widths / 2^53, and the integers that are surely inside."""

    height: FloatArray
    width: FloatArray
    inside: np.ndarray


@cache
def ziggurat() -> Ziggurat:
    """Return the tables of numpy's ziggurat for exponential numbers."""
    with np.load(Path(__file__).with_name("ziggurat.npz")) as kept:
        return Ziggurat(kept["fe"], kept["we"], kept["ke"])


@kernel
def high_word_by_halves(a: Any, b: Any) -> Any:
    """Return ``high_word(a, b)`` from products of halves, which compilers can vectorise."""
    a1, a0, b1, b0 = a >> S32, a & HALF, b >> S32, b & HALF
    low, cross = a0 * b0, a1 * b0
    middle = (low >> S32) + (cross & HALF) + a0 * b1
    return a1 * b1 + (cross >> S32) + (middle >> S32)


@kernel
def scramble(high: Any, low: Any) -> Any:
    """Return the output word of a state (high, low): the DXSM permutation."""
    made = high ^ (high >> S32)
    made *= CHEAP
    made ^= made >> S48
    return made * (low | ONE)


@kernel
def following(high: Any, low: Any, upper: Any, more_high: Any, more_low: Any) -> tuple[Any, Any]:
    """Return the state of a stream after (high, low), given its increment; ``upper`` is
    ``high_word(low, CHEAP)``.
    """
    step = low * CHEAP + more_low
    carry = ONE if step < more_low else ZERO
    return high * CHEAP + upper + more_high + carry, step


@kernel
def next_word(states: np.ndarray, k: int) -> Any:
    """Return the next word of stream ``k`` of states (K, 4): state and increment, high
    words first.
    """
    high, low = states[k, 0], states[k, 1]
    upper = high_word(low, CHEAP)
    states[k, 0], states[k, 1] = following(high, low, upper, states[k, 2], states[k, 3])
    return scramble(high, low)


@kernel
def next_unit(states: np.ndarray, k: int) -> float:
    """Return the next number of stream ``k``, uniform on [0, 1)."""
    return float(next_word(states, k) >> S11) * TO_UNIT


@kernel
def next_units(lanes: Lanes, states: np.ndarray, b: int, k: int, units: FloatArray) -> None:
    """Write the next uniform number of stream ``k`` of each run of block ``b`` into ``units[b, k]``
    (L,), from states (B, K, 4, L).
    """
    # One instruction for several lanes: all do the same to words of their own.
    for q in range(len(lanes)):
        high, low = states[b, k, 0, q], states[b, k, 1, q]
        units[b, k, q] = float(scramble(high, low) >> S11) * TO_UNIT
        upper = high_word_by_halves(low, CHEAP)
        states[b, k, 0, q], states[b, k, 1, q] = following(
            high, low, upper, states[b, k, 2, q], states[b, k, 3, q]
        )


@kernel
def next_unit_of_lane(states: np.ndarray, b: int, k: int, q: int) -> float:
    """Return the next uniform number of stream ``k`` of the run of lane ``q`` of block ``b``."""
    high, low = states[b, k, 0, q], states[b, k, 1, q]
    states[b, k, 0, q], states[b, k, 1, q] = following(
        high, low, high_word(low, CHEAP), states[b, k, 2, q], states[b, k, 3, q]
    )
    return float(scramble(high, low) >> S11) * TO_UNIT


@kernel(inlined=True)
def next_stream_state(high: Any, low: Any, more_high: Any, more_low: Any) -> tuple[Any, Any]:
    """Return the state of a stream after (high, low); its increment is ``more``."""
    return following(high, low, high_word(low, CHEAP), more_high, more_low)


@kernel(inlined=True)
def exponential_of(
    states: np.ndarray, k: int, high: Any, low: Any, ziggurat: Ziggurat
) -> tuple[float, Any, Any]:
    """Return ``next_exponential`` of stream ``k``, whose state is in registers; return the state
    after it too. Numbers of one stream wait for each other's state, and memory makes them wait
    longer.
    """
    word = scramble(high, low) >> S3
    layer = int(word & LAYER)
    word >>= S8
    if word < ziggurat.inside[layer]:
        high, low = next_stream_state(high, low, states[k, 2], states[k, 3])
        return float(word) * ziggurat.width[layer], high, low
    states[k, 0], states[k, 1] = high, low
    x = next_exponential(states, k, ziggurat)
    return x, states[k, 0], states[k, 1]


@kernel
def next_exponential(states: np.ndarray, k: int, ziggurat: Ziggurat) -> float:
    """Return the next number of stream ``k`` from the exponential law of mean 1."""
    while True:
        word = next_word(states, k) >> S3
        layer = int(word & LAYER)
        word >>= S8
        x: float = float(word) * ziggurat.width[layer]
        if word < ziggurat.inside[layer]:
            return x
        if layer == 0:
            return EXPONENTIAL_TAIL - math.log1p(-next_unit(states, k))
        above, height = ziggurat.height[layer - 1], ziggurat.height[layer]
        if (above - height) * next_unit(states, k) + height < math.exp(-x):
            return x


@kernel
def seed_states(words: np.ndarray, states: np.ndarray) -> None:
    """Write the states (K, 4) that follow from four words of seed (K, 4) each."""
    for k in range(len(words)):
        high = (words[k, 2] << ONE) | (words[k, 3] >> S63)
        low = (words[k, 3] << ONE) | ONE
        states[k, 2], states[k, 3] = high, low
        start = low + words[k, 1]
        carry = ONE if start < low else ZERO
        upper = high + words[k, 0] + carry
        made = start * FULL_LOW
        product = high_word(start, FULL_LOW) + upper * FULL_LOW + start * FULL_HIGH
        states[k, 1] = made + low
        carry = ONE if states[k, 1] < low else ZERO
        states[k, 0] = product + high + carry


@kernel
def fill_units(states: np.ndarray, which: np.ndarray, counts: np.ndarray, out: FloatArray) -> None:
    """Write the next ``counts`` uniform numbers of each of the streams ``which``, one stream after
    the other.
    """
    index = 0
    for m in range(len(which)):
        for _ in range(counts[m]):
            out[index] = next_unit(states, which[m])
            index += 1


@kernel
def fill_exponentials(
    states: np.ndarray, which: np.ndarray, counts: np.ndarray, ziggurat: Ziggurat, out: FloatArray
) -> None:
    """Write the next ``counts`` exponential numbers of mean 1 of each of the streams ``which``."""
    index = 0
    for m in range(len(which)):
        for _ in range(counts[m]):
            out[index] = next_exponential(states, which[m], ziggurat)
            index += 1


class StreamBatch:
    """The streams of one purpose of many entities, in order, run by run: their ``states`` (K, 4),
    which drawing changes; needs numba.
    """

    def __init__(
        self, streams: Streams | ReplicaStreams, purpose: str, entities: Sequence[tuple[int, ...]]
    ) -> None:
        words = streams.seed_words(purpose, entities)
        self.states = np.empty(words.shape, dtype=np.uint64)
        seed_states(words, self.states)

    def in_lanes(self, runs: int) -> np.ndarray:
        """Return the states (B, K, 4, L) of the K streams of each of so many runs, by blocks of
        lanes.
        """
        count = len(self.states) // runs
        by_lane = np.zeros((blocks_of(runs) * LANES, count, 4), dtype=np.uint64)
        by_lane[:runs] = self.states.reshape(runs, count, 4)
        made: np.ndarray = aligned((blocks_of(runs), count, 4, LANES), np.uint64)
        made[:] = np.moveaxis(by_lane.reshape(-1, LANES, count, 4), 1, -1)
        return made

    def units(self, which: np.ndarray, counts: np.ndarray) -> FloatArray:
        """Return ``Generator.random(count)`` of each of the entities in these places, one after the
        other.
        """
        out = np.empty(int(counts.sum()))
        fill_units(self.states, which, counts, out)
        return out

    def exponentials(self, which: np.ndarray, counts: np.ndarray) -> FloatArray:
        """Return ``Generator.standard_exponential(count)`` of each entity, as ``units``."""
        out = np.empty(int(counts.sum()))
        fill_exponentials(self.states, which, counts, ziggurat(), out)
        return out
