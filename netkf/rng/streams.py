"""Random streams: one generator for each (purpose, entity), derived by name from the root seed.

Adding a node, losing a message or drawing more of one thing never shifts another stream,
because a stream depends on nothing but the seed, the replica and its own name.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.random.bit_generator import ISeedSequence

from netkf.rng.seeding import POOL
from netkf.rng.seeding import seed_words as fill_seed_words


@dataclass(frozen=True)
class Streams:
    """The source of every generator of one run.

    ``seed`` and ``replica`` are non-negative integers; equal pairs give equal runs.
    """

    seed: int
    replica: int = 0

    def generator(self, purpose: str, *entity: int) -> np.random.Generator:
        """Return the generator of ``purpose`` for ``entity`` (node ids, a link's two ends, ...:
        integers that are not negative).
        """
        return np.random.Generator(np.random.PCG64DXSM(self._seed_sequence(purpose, *entity)))

    def _seed_sequence(self, purpose: str, *entity: int) -> Any:
        """Return the seed sequence of a purpose and an entity."""
        key = (self.replica, _purpose_code(purpose), *entity)
        return np.random.SeedSequence(entropy=self.seed, spawn_key=key)

    @property
    def runs(self) -> int:
        """Number of runs, of which ``ReplicaStreams`` has several."""
        return 1

    @property
    def per_replica(self) -> tuple[Streams, ...]:
        """The source of each run."""
        return (self,)

    def seed_words(self, purpose: str, entities: Sequence[tuple[int, ...]]) -> np.ndarray:
        """Return words (K, 4) of 64 bits that seed the generators of K entities."""
        return ReplicaStreams(self.seed, self.replica, 1).seed_words(purpose, entities)

    def generators(
        self, purpose: str, entities: Sequence[tuple[int, ...]]
    ) -> list[np.random.Generator]:
        """Return ``generator`` of each of them, in order; see ``with_seeds``."""
        return ReplicaStreams(self.seed, self.replica, 1).generators(purpose, entities)

    def with_seeds(self, purposes: Sequence[str], entities: Sequence[tuple[int, ...]]) -> Streams:
        """Return the same streams, with the seeds of these purposes and entities made all at once:
        numpy takes some 30 microseconds for one. Entities have as many numbers each.
        """
        made: dict[tuple[str, tuple[int, ...]], _Words] = {}
        if entities and _small_ids(tuple(entities)) is not None:
            for purpose in purposes:
                words = self.seed_words(purpose, entities)
                made |= {(purpose, e): _Words(w) for e, w in zip(entities, words, strict=True)}
        return _Seeded(self.seed, self.replica, made)


@dataclass(frozen=True)
class _Seeded(Streams):
    made: dict[tuple[str, tuple[int, ...]], _Words] = field(default_factory=dict)

    def _seed_sequence(self, purpose: str, *entity: int) -> Any:
        """Return the seed sequence, or the seed words if they are known already."""
        known = self.made.get((purpose, entity))
        return super()._seed_sequence(purpose, *entity) if known is None else known


@dataclass(frozen=True)
class ReplicaStreams:
    """The sources of ``count`` runs of one seed, the first of which is ``replica``; what they draw
    is what each would draw for itself.
    """

    seed: int
    replica: int
    count: int

    @property
    def runs(self) -> int:
        """Number of runs."""
        return self.count

    @property
    def per_replica(self) -> tuple[Streams, ...]:
        """The source of each run."""
        return tuple(Streams(self.seed, self.replica + k) for k in range(self.count))

    def seed_words(self, purpose: str, entities: Sequence[tuple[int, ...]]) -> np.ndarray:
        """Return words (count K, 4) of 64 bits that seed the generators of K entities,
        run by run.
        """
        if not entities:
            return np.empty((0, 4), dtype=np.uint64)
        last = self.replica + self.count - 1
        ids = _small_ids(tuple(entities))
        if last >= WORD or ids is None:
            some = [
                s._seed_sequence(purpose, *entity) for s in self.per_replica for entity in entities
            ]
            return np.array([sequence.generate_state(4, np.uint64) for sequence in some])
        keys = np.empty((self.count, len(entities), 2 + len(entities[0])), dtype=np.uint32)
        keys[:, :, 0] = np.arange(self.replica, last + 1, dtype=np.uint32)[:, None]
        keys[:, :, 1], keys[:, :, 2:] = _purpose_code(purpose), ids
        words = np.empty((self.count * len(entities), 4), dtype=np.uint64)
        pool = np.empty(POOL, dtype=np.uint32)
        fill_seed_words(_entropy_words(self.seed), keys.reshape(len(words), -1), pool, words)
        return words

    def generators(
        self, purpose: str, entities: Sequence[tuple[int, ...]]
    ) -> list[np.random.Generator]:
        """Return the generators that these words seed."""
        made: list[Any] = [_Words(words) for words in self.seed_words(purpose, entities)]
        return [np.random.Generator(np.random.PCG64DXSM(words)) for words in made]


class _Words(ISeedSequence):
    """Four words of seed that are known already."""

    def __init__(self, words: np.ndarray) -> None:
        self._words = words

    def generate_state(self, n_words: int, dtype: Any = np.uint32) -> np.ndarray:
        """Return the four words, whatever numpy's bit generators ask for."""
        assert (n_words, np.dtype(dtype)) == (4, np.uint64)
        return self._words


@lru_cache(maxsize=32)
def _small_ids(entities: tuple[tuple[int, ...], ...]) -> np.ndarray | None:
    """Return the ids of entities as words of 32 bits (K, ids); None if one of them needs more."""
    if max(max(entity, default=0) for entity in entities) >= WORD:
        return None
    return np.array(entities, dtype=np.uint32)


WORD, MASK = 1 << 32, (1 << 32) - 1


@cache
def _entropy_words(seed: int) -> np.ndarray:
    """Return the words of a seed, lowest first, at least as many as the pool has."""
    words = [seed & MASK]
    while seed := seed >> 32:
        words.append(seed & MASK)
    words += [0] * (POOL - len(words))
    return np.array(words, dtype=np.uint32)


@cache
def _purpose_code(purpose: str) -> int:
    """Return the number of a purpose: 4 bytes of its SHA-256, so that purposes need no register."""
    return int.from_bytes(hashlib.sha256(purpose.encode()).digest()[:4], "little")
