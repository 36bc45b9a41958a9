"""Random streams: one generator for each (purpose, entity), derived by name from the root seed.

Adding a node, losing a message or drawing more of one thing never shifts another stream,
because a stream depends on nothing but the seed, the replica and its own name.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Streams:
    """The source of every generator of one run.

    ``seed`` and ``replica`` are non-negative integers; equal pairs give equal runs.
    """

    seed: int
    replica: int = 0

    def generator(self, purpose: str, *entity: int) -> np.random.Generator:
        """The generator of ``purpose`` for ``entity`` (node ids, a link's two ends, ...)."""
        code = int.from_bytes(hashlib.sha256(purpose.encode()).digest()[:4], "little")
        key = (self.replica, code, *entity)
        return np.random.Generator(np.random.PCG64DXSM(_sequence(self.seed, key)))


def _sequence(seed: int, key: tuple[int, ...]) -> np.random.SeedSequence:
    # Spawn keys are unsigned; node ids may be negative, so the sign gets a place of its own.
    spawn = tuple(part for k in key for part in (abs(k), int(k < 0)))
    return np.random.SeedSequence(entropy=seed, spawn_key=spawn)
