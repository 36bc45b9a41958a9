"""Random streams: one generator for each (purpose, entity), derived by name from the root seed.

Adding a node, losing a message or drawing more of one thing never shifts another stream,
because a stream depends on nothing but the seed, the replica and its own name.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from numpy.random.bit_generator import ISeedSequence


@dataclass(frozen=True)
class Streams:
    """The source of every generator of one run.

    ``seed`` and ``replica`` are non-negative integers; equal pairs give equal runs.
    """

    seed: int
    replica: int = 0

    def generator(self, purpose: str, *entity: int) -> np.random.Generator:
        """The generator of ``purpose`` for ``entity`` (node ids, a link's two ends,
        ...: integers that are not negative).
        """
        return np.random.Generator(np.random.PCG64DXSM(self._sequence(purpose, *entity)))

    def _sequence(self, purpose: str, *entity: int) -> Any:
        key = (self.replica, _code(purpose), *entity)
        return np.random.SeedSequence(entropy=self.seed, spawn_key=key)

    @property
    def per_replica(self) -> tuple[Streams, ...]:
        """As of several runs, see ``ReplicaStreams``."""
        return (self,)

    def seed_words(self, purpose: str, entities: Sequence[tuple[int, ...]]) -> np.ndarray:
        """(K, 4) words of 64 bits that seed the generators of K entities."""
        return ReplicaStreams(self.seed, self.replica, 1).seed_words(purpose, entities)

    def generators(
        self, purpose: str, entities: Sequence[tuple[int, ...]]
    ) -> list[np.random.Generator]:
        """``generator`` of each of them, in order; see ``seeded``."""
        return ReplicaStreams(self.seed, self.replica, 1).generators(purpose, entities)

    def seeded(self, purposes: Sequence[str], entities: Sequence[tuple[int, ...]]) -> Streams:
        """The same streams, with the seeds of these purposes and entities made all at once: numpy
        takes some 30 microseconds for one. Entities have as many numbers each.
        """
        made: dict[tuple[str, tuple[int, ...]], _Words] = {}
        if entities and _small(entities):
            for purpose in purposes:
                words = self.seed_words(purpose, entities)
                made |= {(purpose, e): _Words(w) for e, w in zip(entities, words, strict=True)}
        return _Seeded(self.seed, self.replica, made)


@dataclass(frozen=True)
class _Seeded(Streams):
    made: dict[tuple[str, tuple[int, ...]], _Words] = field(default_factory=dict)

    def _sequence(self, purpose: str, *entity: int) -> Any:
        known = self.made.get((purpose, entity))
        return super()._sequence(purpose, *entity) if known is None else known


@dataclass(frozen=True)
class ReplicaStreams:
    """The sources of ``count`` runs of one seed, the first of which is ``replica``; what they draw
    is what each would draw for itself.
    """

    seed: int
    replica: int
    count: int

    @property
    def per_replica(self) -> tuple[Streams, ...]:
        """The source of each run."""
        return tuple(Streams(self.seed, self.replica + k) for k in range(self.count))

    def seed_words(self, purpose: str, entities: Sequence[tuple[int, ...]]) -> np.ndarray:
        """(count K, 4) words of 64 bits that seed the generators of K entities, run by run."""
        if not entities:
            return np.empty((0, 4), dtype=np.uint64)
        replicas = range(self.replica, self.replica + self.count)
        few = self.count * len(entities) < FEW
        if few or replicas[-1] >= WORD or not _small(entities):
            some = [s._sequence(purpose, *entity) for s in self.per_replica for entity in entities]
            return np.array([sequence.generate_state(4, np.uint64) for sequence in some])
        keys = np.empty((self.count, len(entities), 2 + len(entities[0])), dtype=np.uint32)
        keys[:, :, 0] = np.array(replicas, dtype=np.uint32)[:, None]
        keys[:, :, 1], keys[:, :, 2:] = _code(purpose), np.array(entities, dtype=np.uint32)
        return _all_words(self.seed, keys.reshape(-1, keys.shape[2]))

    def generators(
        self, purpose: str, entities: Sequence[tuple[int, ...]]
    ) -> list[np.random.Generator]:
        """The generators that these words seed."""
        made: list[Any] = [_Words(words) for words in self.seed_words(purpose, entities)]
        return [np.random.Generator(np.random.PCG64DXSM(words)) for words in made]


class _Words(ISeedSequence):
    """Four words of seed that are known already."""

    def __init__(self, words: np.ndarray) -> None:
        self._words = words

    def generate_state(self, n_words: int, dtype: Any = np.uint32) -> np.ndarray:
        assert (n_words, np.dtype(dtype)) == (4, np.uint64)
        return self._words


def _small(entities: Sequence[tuple[int, ...]]) -> bool:
    """Whether all are of numbers of one word."""
    return max(max(entity, default=0) for entity in entities) < WORD


FEW = 16  # seeds, which numpy makes faster one by one
POOL, WORD, MASK = 4, 1 << 32, (1 << 32) - 1


def _all_words(seed: int, keys: np.ndarray) -> np.ndarray:
    """(N, 4) what SeedSequence(seed, spawn_key=key) gives PCG64DXSM for all keys (N, k): numpy's
    algorithm, which its policy keeps as it is (M. E. O'Neill's seed_seq_fe).
    """
    root = _words_of(seed)
    root += [0] * (POOL - len(root))
    columns = [np.full(len(keys), word, dtype=np.uint32) for word in root]
    columns += list(keys.T.copy())
    constant = 0x43B0D7E5

    def hashed(value: np.ndarray) -> np.ndarray:
        nonlocal constant
        value = value ^ np.uint32(constant)
        constant = constant * 0x931E8875 & MASK
        value = value * np.uint32(constant)
        return np.asarray(value ^ (value >> np.uint32(16)))

    def mixed(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        value: Any = np.uint32(0xCA01F9DD) * x - np.uint32(0x4973F715) * y
        return np.asarray(value ^ (value >> np.uint32(16)))

    pool = [hashed(column) for column in columns[:POOL]]
    for source in range(POOL):
        for target in range(POOL):
            if source != target:
                pool[target] = mixed(pool[target], hashed(pool[source]))
    for column in columns[POOL:]:
        for target in range(POOL):
            pool[target] = mixed(pool[target], hashed(column))
    out, constant = np.empty((len(keys), 2 * POOL), dtype=np.uint32), 0x8B51F9DD
    for k in range(2 * POOL):
        value = pool[k % POOL] ^ np.uint32(constant)
        constant = constant * 0x58F38DED & MASK
        value = value * np.uint32(constant)
        out[:, k] = value ^ (value >> np.uint32(16))
    return out.astype("<u4").view("<u8").astype(np.uint64)


def _words_of(number: int) -> list[int]:
    words = [number & MASK]
    while number := number >> 32:
        words.append(number & MASK)
    return words


@cache
def _code(purpose: str) -> int:
    return int.from_bytes(hashlib.sha256(purpose.encode()).digest()[:4], "little")
