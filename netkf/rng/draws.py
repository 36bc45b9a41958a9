"""Random numbers of many streams at once, in compiled code: words, uniforms and exponentials.

The numbers are, bit for bit, those of numpy's ``Generator(PCG64DXSM)``. A network of 1e5 links has
as many streams, and to make a numpy generator for each takes longer than to draw from it; here the
states of all streams are one array. Words follow PCG64DXSM (M. E. O'Neill's permuted congruential
generator with the output function of numpy's issue 13635), which numpy's policy on streams keeps
unchanged. Exponentials come from the ziggurat of Marsaglia and Tsang (2000) with numpy's tables
(``ziggurat_constants.h``, BSD-3-Clause), stored in ``ziggurat.npz``.

A state is a row (high, low, high of the increment, low of the increment) of 64-bit words: a 128-bit
number ``state = 2^64 high + low``, and the odd increment that tells streams apart. All arithmetic
is modulo 2^64. ``states`` (K, >= 4) may have more columns: ``rng.numbers`` keeps two there.

Batched engines draw for L runs at once with SIMD instructions (``linalg.lanes``): runs are in
blocks of L, one in each lane, and their states are (B, K, 4, L).
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
# HALF masks the lower 32 bits of a word, LAYER the 8 bits that choose a layer of the ziggurat.
ZERO, ONE, HALF, LAYER = _U(0), _U(1), _U(0xFFFFFFFF), _U(0xFF)
# Shift counts, unsigned like the words that they shift.
S3, S8, S11, S32, S48, S63 = _U(3), _U(8), _U(11), _U(32), _U(48), _U(63)
TO_UNIT = 2.0**-53  # spacing of numpy's uniform numbers
EXPONENTIAL_TAIL = 7.69711747013104972  # where numpy's exponential ziggurat begins its tail


class Ziggurat(NamedTuple):
    """The 256 layers of the ziggurat under exp(-x), (256,) each.

    height  exp(-x) at the edge of the layer
    width   x at the edge, divided by 2^53
    inside  integers below this are inside the curve without a test
    """

    height: FloatArray
    width: FloatArray
    inside: np.ndarray


@cache
def ziggurat() -> Ziggurat:
    """Return the tables of numpy's ziggurat for exponential numbers of mean 1, loaded once; "fe",
    "we" and "ke" are numpy's names of heights, widths and inside limits.
    """
    with np.load(Path(__file__).with_name("ziggurat.npz")) as tables:
        return Ziggurat(tables["fe"], tables["we"], tables["ke"])


@kernel
def high_word_by_halves(a: Any, b: Any) -> Any:
    """Return the upper 64 bits of the product of two 64-bit words a and b, from 32-bit halves.

    It equals ``linalg.words.high_word``, but compilers can vectorise it.
    """
    # a = 2^32 a1 + a0 and b = 2^32 b1 + b0: the four partial products with their carries.
    a1, a0, b1, b0 = a >> S32, a & HALF, b >> S32, b & HALF
    low, cross = a0 * b0, a1 * b0
    middle = (low >> S32) + (cross & HALF) + a0 * b1
    return a1 * b1 + (cross >> S32) + (middle >> S32)


@kernel
def scramble(high: Any, low: Any) -> Any:
    """Return the 64-bit output word of a state (high, low), two 64-bit words: the DXSM permutation
    of PCG.
    """
    word = high ^ (high >> S32)
    word *= CHEAP
    word ^= word >> S48
    return word * (low | ONE)


@kernel
def following(
    high: Any, low: Any, upper: Any, increment_high: Any, increment_low: Any
) -> tuple[Any, Any]:
    """Return the state after (high, low): ``state <- state * CHEAP + increment`` modulo 2^128, all
    as 64-bit words.

    ``increment_high, increment_low`` are the increment; ``upper`` is the upper word of ``low *
    CHEAP``.
    """
    step = low * CHEAP + increment_low
    carry = ONE if step < increment_low else ZERO
    return high * CHEAP + upper + increment_high + carry, step


@kernel
def next_word(states: np.ndarray, k: int) -> Any:
    """Return the next 64-bit word of stream ``k`` of the ``states`` (K, >= 4) of K streams, and
    step its state.
    """
    high, low = states[k, 0], states[k, 1]
    upper = high_word(low, CHEAP)
    states[k, 0], states[k, 1] = following(high, low, upper, states[k, 2], states[k, 3])
    return scramble(high, low)


@kernel
def next_unit(states: np.ndarray, k: int) -> float:
    """Return the next number of stream ``k`` of the ``states`` (K, >= 4) of K streams, uniform on
    [0, 1), and step its state.
    """
    # The upper 53 bits: as many as a float64 holds exactly.
    return float(next_word(states, k) >> S11) * TO_UNIT


@kernel
def next_units(lanes: Lanes, states: np.ndarray, b: int, k: int, units: FloatArray) -> None:
    """Write the next uniform number of stream ``k`` for the L runs of block ``b`` into ``units[b,
    k]`` (L,) of ``units`` (B, K, L), from ``states`` (B, K, 4, L), which it steps. There are K
    streams in each run, and B blocks. ``lanes`` is a tuple of length L.
    """
    # No branch depends on a word, so that the compiler computes several lanes with one instruction.
    for q in range(len(lanes)):
        high, low = states[b, k, 0, q], states[b, k, 1, q]
        units[b, k, q] = float(scramble(high, low) >> S11) * TO_UNIT
        upper = high_word_by_halves(low, CHEAP)
        states[b, k, 0, q], states[b, k, 1, q] = following(
            high, low, upper, states[b, k, 2, q], states[b, k, 3, q]
        )


@kernel
def next_unit_of_lane(states: np.ndarray, b: int, k: int, q: int) -> float:
    """Return the next uniform number of stream ``k`` for the run in lane ``q`` of block ``b``, from
    ``states`` (B, K, 4, L), which it steps. There are K streams in each run, and B blocks of L
    runs.
    """
    high, low = states[b, k, 0, q], states[b, k, 1, q]
    states[b, k, 0, q], states[b, k, 1, q] = following(
        high, low, high_word(low, CHEAP), states[b, k, 2, q], states[b, k, 3, q]
    )
    return float(scramble(high, low) >> S11) * TO_UNIT


@kernel(inlined=True)
def next_stream_state(
    high: Any, low: Any, increment_high: Any, increment_low: Any
) -> tuple[Any, Any]:
    """Return the state of a stream after (high, low), given its increment, all as 64-bit words:
    ``state <- state * CHEAP + increment`` modulo 2^128.
    """
    return following(high, low, high_word(low, CHEAP), increment_high, increment_low)


@kernel(inlined=True)
def exponential_of(
    states: np.ndarray, k: int, high: Any, low: Any, ziggurat: Ziggurat
) -> tuple[float, Any, Any]:
    """Return the next exponential number of mean 1 of stream ``k`` of the ``states`` (K, >= 4) of K
    streams, and the state after it, for a loop that keeps the state (high, low) in registers.

    Each number of a stream waits for the state after the one before; a state in memory would take
    longer. ``states[k]`` is only read and written for the rare numbers outside the fast path.
    """
    # As in next_exponential: 8 bits choose a layer, 53 bits a point across it.
    word = scramble(high, low) >> S3
    layer = int(word & LAYER)
    word >>= S8
    if word < ziggurat.inside[layer]:
        high, low = next_stream_state(high, low, states[k, 2], states[k, 3])
        return float(word) * ziggurat.width[layer], high, low
    # The slow path draws the same word again, from the state before it.
    states[k, 0], states[k, 1] = high, low
    x = next_exponential(states, k, ziggurat)
    return x, states[k, 0], states[k, 1]


@kernel
def next_exponential(states: np.ndarray, k: int, ziggurat: Ziggurat) -> float:
    """Return the next number of stream ``k`` of the ``states`` (K, >= 4) of K streams from the
    exponential law of mean 1 (ziggurat), and step its state.
    """
    while True:
        # 8 bits choose a layer, 53 bits a point across it.
        word = next_word(states, k) >> S3
        layer = int(word & LAYER)
        word >>= S8
        x: float = float(word) * ziggurat.width[layer]
        if word < ziggurat.inside[layer]:
            return x
        # The tail of an exponential law is the same law, shifted.
        if layer == 0:
            return EXPONENTIAL_TAIL - math.log1p(-next_unit(states, k))
        # At the edge of a layer: accept x if a uniform height in the layer is below exp(-x).
        above, height = ziggurat.height[layer - 1], ziggurat.height[layer]
        if (above - height) * next_unit(states, k) + height < math.exp(-x):
            return x


@kernel
def seed_states(words: np.ndarray, states: np.ndarray) -> None:
    """Write the ``states`` (K, 4) of K streams that are seeded with four 64-bit ``words`` (K, 4)
    each.

    As numpy: words 0 and 1 are the initial state s, words 2 and 3 the stream number i. The
    increment is 2 i + 1, and the first state (s + increment) * FULL + increment modulo 2^128.
    """
    for k in range(len(words)):
        # increment = 2 i + 1
        high = (words[k, 2] << ONE) | (words[k, 3] >> S63)
        low = (words[k, 3] << ONE) | ONE
        states[k, 2], states[k, 3] = high, low
        # (upper, start) = s + increment
        start = low + words[k, 1]
        carry = ONE if start < low else ZERO
        upper = high + words[k, 0] + carry
        # (product_high, product_low) = (upper, start) * FULL
        product_low = start * FULL_LOW
        product_high = high_word(start, FULL_LOW) + upper * FULL_LOW + start * FULL_HIGH
        states[k, 1] = product_low + low
        carry = ONE if states[k, 1] < low else ZERO
        states[k, 0] = product_high + high + carry


@kernel
def fill_units(states: np.ndarray, which: np.ndarray, counts: np.ndarray, out: FloatArray) -> None:
    """Write the next ``counts[m]`` uniform numbers of stream ``which[m]`` of the ``states``
    (K, >= 4) of K streams into ``out``, for each of M entries m in turn; ``counts`` and ``which``
    are (M,), ``out`` (sum of counts,). Steps the states.
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
    """Write the next ``counts[m]`` exponential numbers of mean 1 of stream ``which[m]`` of the
    ``states`` (K, >= 4) of K streams into ``out``, for each of M entries m in turn; ``counts`` and
    ``which`` are (M,), ``out`` (sum of counts,). Steps the states.
    """
    index = 0
    for m in range(len(which)):
        for _ in range(counts[m]):
            out[index] = next_exponential(states, which[m], ziggurat)
            index += 1


class StreamBatch:
    """The streams of one purpose for many entities: ``states`` (K, 4), which drawing changes.

    With ReplicaStreams of R runs, K is R times the number of entities, run by run.
    """

    def __init__(
        self, streams: Streams | ReplicaStreams, purpose: str, entities: Sequence[tuple[int, ...]]
    ) -> None:
        """Seed one stream of ``purpose`` for each of ``entities``: tuples of ids, such as (node,)
        or (sender, receiver).
        """
        words = streams.seed_words(purpose, entities)
        self.states = np.empty(words.shape, dtype=np.uint64)
        seed_states(words, self.states)

    def in_lanes(self, runs: int) -> np.ndarray:
        """Return the states (B, K, 4, L) of the K streams of each of ``runs`` runs, side by side in
        B blocks of L lanes, as ``next_units`` takes them; idle lanes are 0.
        """
        count = len(self.states) // runs
        by_lane = np.zeros((blocks_of(runs) * LANES, count, 4), dtype=np.uint64)
        by_lane[:runs] = self.states.reshape(runs, count, 4)
        lanes: np.ndarray = aligned((blocks_of(runs), count, 4, LANES), np.uint64)
        lanes[:] = np.moveaxis(by_lane.reshape(-1, LANES, count, 4), 1, -1)
        return lanes

    def units(self, which: np.ndarray, counts: np.ndarray) -> FloatArray:
        """Return the next ``counts[m]`` uniforms of stream ``which[m]``, concatenated over m
        (sum of counts,); both arguments are (M,), for M entries m.

        They equal ``Generator.random(counts[m])`` of that stream.
        """
        out = np.empty(int(counts.sum()))
        fill_units(self.states, which, counts, out)
        return out

    def exponentials(self, which: np.ndarray, counts: np.ndarray) -> FloatArray:
        """Return the next ``counts[m]`` exponential numbers of mean 1 of stream ``which[m]``,
        concatenated over m (sum of counts,); both arguments are (M,), for M entries m.

        They equal ``Generator.standard_exponential(counts[m])`` of that stream.
        """
        out = np.empty(int(counts.sum()))
        fill_exponentials(self.states, which, counts, ziggurat(), out)
        return out
