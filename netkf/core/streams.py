"""Random streams: one generator for each (purpose, entity), derived by name from the root seed.

Adding a node, losing a message or drawing more of one thing never shifts another stream,
because a stream depends on nothing but the seed, the replica and its own name.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cache

import numpy as np


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
        key = (self.replica, _code(purpose), *entity)
        sequence = np.random.SeedSequence(entropy=self.seed, spawn_key=key)
        return np.random.Generator(np.random.PCG64DXSM(sequence))


@cache
def _code(purpose: str) -> int:
    return int.from_bytes(hashlib.sha256(purpose.encode()).digest()[:4], "little")
