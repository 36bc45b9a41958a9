"""Random streams: one generator for each (purpose, entity), derived by name from the root seed.

A stream depends only on the seed, the replica and its own name. Hence another node, a lost message
or more draws from one stream never change the numbers of another.
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
        """Return the generator of ``purpose`` for ``entity``: non-negative integers, such as a node
        id or the two ends of a link.
        """
        return np.random.Generator(np.random.PCG64DXSM(self._seed_sequence(purpose, *entity)))

    def _seed_sequence(self, purpose: str, *entity: int) -> Any:
        """Return numpy's seed sequence of a purpose and an entity."""
        key = (self.replica, _purpose_code(purpose), *entity)
        return np.random.SeedSequence(entropy=self.seed, spawn_key=key)

    @property
    def runs(self) -> int:
        """Number of runs: 1; ``ReplicaStreams`` has several."""
        return 1

    @property
    def per_replica(self) -> tuple[Streams, ...]:
        """The streams of each run: these."""
        return (self,)

    def seed_words(self, purpose: str, entities: Sequence[tuple[int, ...]]) -> np.ndarray:
        """Return the 64-bit words (K, 4) that seed the generators of K ``entities`` (ids of each)
        for ``purpose``.
        """
        return ReplicaStreams(self.seed, self.replica, 1).seed_words(purpose, entities)

    def generators(
        self, purpose: str, entities: Sequence[tuple[int, ...]]
    ) -> list[np.random.Generator]:
        """Return the generators of K ``entities`` (ids of each) for ``purpose``, in order: those of
        ``generator(purpose, *entity)``.
        """
        return ReplicaStreams(self.seed, self.replica, 1).generators(purpose, entities)

    def with_seeds(self, purposes: Sequence[str], entities: Sequence[tuple[int, ...]]) -> Streams:
        """Return the same streams, with the seeds of these purposes and entities computed ahead.

        One call for all is faster than numpy, which takes 30 microseconds for each. All entities
        must have the same length.
        """
        seeds: dict[tuple[str, tuple[int, ...]], _Words] = {}
        if entities and _small_ids(tuple(entities)) is not None:
            for purpose in purposes:
                words = self.seed_words(purpose, entities)
                seeds |= {(purpose, e): _Words(w) for e, w in zip(entities, words, strict=True)}
        return _Seeded(self.seed, self.replica, seeds)


@dataclass(frozen=True)
class _Seeded(Streams):
    """Streams with ``seeds`` computed ahead, by purpose and entity."""

    seeds: dict[tuple[str, tuple[int, ...]], _Words] = field(default_factory=dict)

    def _seed_sequence(self, purpose: str, *entity: int) -> Any:
        """Return the seed that was computed ahead, else numpy's seed sequence."""
        seed = self.seeds.get((purpose, entity))
        return super()._seed_sequence(purpose, *entity) if seed is None else seed


@dataclass(frozen=True)
class ReplicaStreams:
    """The streams of ``count`` runs of one seed: replicas ``replica``, ``replica + 1``, ...

    They give the same numbers as the ``Streams`` of each run.
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
        """The streams of each run."""
        return tuple(Streams(self.seed, self.replica + k) for k in range(self.count))

    def seed_words(self, purpose: str, entities: Sequence[tuple[int, ...]]) -> np.ndarray:
        """Return the 64-bit words (count K, 4) that seed the generators of K entities for
        ``purpose``, run by run.
        """
        if not entities:
            return np.empty((0, 4), dtype=np.uint64)
        last = self.replica + self.count - 1
        ids = _small_ids(tuple(entities))
        # The kernel takes keys of 32-bit words; numpy splits larger numbers into several.
        if last >= WORD or ids is None:
            sequences = [
                s._seed_sequence(purpose, *entity) for s in self.per_replica for entity in entities
            ]
            return np.array([sequence.generate_state(4, np.uint64) for sequence in sequences])
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
        """Return the ``count`` K generators of K entities for ``purpose``, run by run."""
        seeds: list[Any] = [_Words(words) for words in self.seed_words(purpose, entities)]
        return [np.random.Generator(np.random.PCG64DXSM(seed)) for seed in seeds]


class _Words(ISeedSequence):
    """A seed sequence of numpy with four 64-bit ``words`` (4,) that were computed ahead."""

    def __init__(self, words: np.ndarray) -> None:
        self._words = words

    def generate_state(self, n_words: int, dtype: Any = np.uint32) -> np.ndarray:
        """Return the four words (4,) of uint64; PCG64DXSM asks for no others."""
        assert (n_words, np.dtype(dtype)) == (4, np.uint64)
        return self._words


@lru_cache(maxsize=32)
def _small_ids(entities: tuple[tuple[int, ...], ...]) -> np.ndarray | None:
    """Return the ids of K entities, m ids each, as 32-bit words (K, m); None if an id needs more
    bits.
    """
    if max(max(entity, default=0) for entity in entities) >= WORD:
        return None
    return np.array(entities, dtype=np.uint32)


WORD, MASK = 1 << 32, (1 << 32) - 1
"""Number of values of a 32-bit word, and the largest."""


@cache
def _entropy_words(seed: int) -> np.ndarray:
    """Return the 32-bit words (>= POOL,) of a seed, lowest first, padded with zeros to POOL
    words.
    """
    words = [seed & MASK]
    while seed := seed >> 32:
        words.append(seed & MASK)
    words += [0] * (POOL - len(words))
    return np.array(words, dtype=np.uint32)


@cache
def _purpose_code(purpose: str) -> int:
    """Return the number of a purpose: 4 bytes of its SHA-256, so that no list of them is needed."""
    return int.from_bytes(hashlib.sha256(purpose.encode()).digest()[:4], "little")
