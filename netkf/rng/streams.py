"""Random streams: one for each (purpose, entity), derived by name from the root seed.

A stream depends only on the seed, the replica and its own name. Hence another node, a lost message
or more draws from one stream never change the numbers of another.

A stream is a range of counters of Philox4x64-10 (Salmon, Moraes, Dror, Shaw, Supercomputing 2011),
numpy's ``Generator(Philox(seed, counter=[0, a, b, c]))``: the key is the one that numpy makes of
the seed, ``a`` and ``b`` are the two ids of the entity plus 1 (0: it has fewer), and ``c`` is
2^32 times the code of the purpose plus the replica. So making a stream costs nothing, and kernels
hold only its counters (``rng.draws``).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any, cast

import numpy as np
from numpy.random.bit_generator import ISeedSequence

COUNTER, KEY, BUFFER, USED, HALF = 0, 4, 6, 10, 11
"""Columns of the state of a stream for kernels: four of the counter, two of the key, the four words
of the present block, how many of these are used, and half of a word that is left over from the last
32-bit draw (plus HAS_HALF; 0 without one).
"""
WIDTH, BLOCK_WORDS = 12, 4
WORD, LONG = 1 << 32, 1 << 64
Generators = Callable[[str], np.random.Generator]
"""Function from a purpose, a short text, to the random stream of one entity for it."""


@dataclass(frozen=True)
class Streams:
    """The source of every generator of one run, or of several ``runs`` of one seed: replicas
    ``replica``, ``replica + 1``, ...

    ``seed`` and ``replica`` are non-negative integers; equal pairs give equal runs.
    """

    seed: int
    replica: int = 0
    runs: int = 1

    def generator(self, purpose: str, *entity: int) -> np.random.Generator:
        """Return the generator, in the first run, of ``purpose`` for ``entity``: non-negative
        integers, such as a node id or the two ends of a link.
        """
        key, counter = _key_and_counter(self.seed, self.replica, _purpose_code(purpose), entity)
        return np.random.Generator(cast(Any, np.random.Philox)(_Key(key), counter=counter))

    @property
    def per_replica(self) -> tuple[Streams, ...]:
        """The streams of each run."""
        return tuple(Streams(self.seed, self.replica + k) for k in range(self.runs))

    def states(self, purpose: str, entities: Sequence[tuple[int, ...]]) -> np.ndarray:
        """Return the states (runs K, WIDTH) at the start, of 64-bit words, of the streams of K
        ``entities`` (ids of each) for ``purpose``, run by run, for kernels.
        """
        states = np.zeros((self.runs, len(entities), WIDTH), dtype=np.uint64)
        states[:, :, USED] = BLOCK_WORDS
        code, replicas = _purpose_code(purpose), range(self.replica, self.replica + self.runs)
        ids = _ids_in_counter(tuple(entities)) if entities else None
        if ids is not None and replicas[-1] < WORD:
            states[:, :, KEY:BUFFER], states[:, :, 1:3] = _key(self.seed), ids
            numbers = np.arange(replicas.start, replicas.stop, dtype=np.uint64)
            states[:, :, 3] = (code << 32) + numbers[:, None]
        else:
            for run, replica in zip(states, replicas, strict=True):
                for state, entity in zip(run, entities, strict=True):
                    key, counter = _key_and_counter(self.seed, replica, code, entity)
                    state[KEY:BUFFER], state[COUNTER:KEY] = key, counter
        return states.reshape(-1, WIDTH)


def state_of(random: np.random.Generator) -> np.ndarray:
    """Return the state (1, WIDTH) for kernels, at its start, of the stream of a generator."""
    bits: Any = random.bit_generator
    assert isinstance(bits, np.random.Philox), "a stream is a generator of Streams"
    state = np.zeros((1, WIDTH), dtype=np.uint64)
    state[0, COUNTER + 1 : KEY] = bits.state["state"]["counter"][1:]
    state[0, KEY:BUFFER], state[0, USED] = bits.state["state"]["key"], BLOCK_WORDS
    return state


class _Key(ISeedSequence):
    """The two 64-bit ``words`` (2,) of a key, in the form in which numpy's Philox takes them."""

    def __init__(self, words: np.ndarray) -> None:
        self._words = words

    def generate_state(self, n_words: int, dtype: Any = np.uint32) -> np.ndarray:
        """Return the two words (2,) of uint64; Philox asks for no others."""
        assert (n_words, np.dtype(dtype)) == (2, np.uint64)
        return self._words


def _key_and_counter(
    seed: int, replica: int, code: int, entity: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the key (2,) of a stream and its counter (4,) at the start."""
    if replica < WORD and len(entity) <= 2 and max(entity, default=0) < LONG - 1:
        ids = [*(id_ + 1 for id_ in entity), 0, 0]
        counter = [0, ids[0], ids[1], (code << 32) + replica]
        return _key(seed), np.array(counter, dtype=np.uint64)
    # No room in the counter: the key is made of the whole name.
    return _key(seed, (replica, code, *entity)), np.zeros(4, dtype=np.uint64)


@lru_cache(maxsize=1024)
def _key(seed: int, name: tuple[int, ...] = ()) -> np.ndarray:
    """Return the key (2,) that numpy makes of a seed and the ``name`` of a stream."""
    return np.asarray(np.random.SeedSequence(seed, spawn_key=name).generate_state(2, np.uint64))


@lru_cache(maxsize=32)
def _ids_in_counter(entities: tuple[tuple[int, ...], ...]) -> np.ndarray | None:
    """Return words 1 and 2 (K, 2) of the counters of K entities; None if one has no room there."""
    if any(len(entity) > 2 or max(entity, default=0) >= LONG - 1 for entity in entities):
        return None
    words = [[id_ + 1 for id_ in entity] + [0] * (2 - len(entity)) for entity in entities]
    return np.array(words, dtype=np.uint64)


@cache
def _purpose_code(purpose: str) -> int:
    """Return the number of a purpose: 4 bytes of its SHA-256, so that no list of them is needed."""
    return int.from_bytes(hashlib.sha256(purpose.encode()).digest()[:4], "little")
