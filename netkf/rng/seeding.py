"""The seeds of many streams at once: numpy's ``SeedSequence`` as one kernel.

The algorithm is M. E. O'Neill's ``seed_seq_fe``, which numpy's policy on streams keeps unchanged. A
``SeedSequence`` object for each stream would cost 30 microseconds.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from netkf.linalg.compiling import kernel

POOL = 4  # words of the pool of numpy's SeedSequence
_U, _L = np.uint32, np.uint64
# The constants of SeedSequence, see numpy/random/bit_generator.pyx.
MIX_LEFT, MIX_RIGHT, S16 = _U(0xCA01F9DD), _U(0x4973F715), _U(16)
START_A, FACTOR_A = _U(0x43B0D7E5), _U(0x931E8875)
START_B, FACTOR_B = _U(0x8B51F9DD), _U(0x58F38DED)
S32 = _L(32)


@kernel
def _scramble(value: Any, constant: Any, factor: Any) -> Any:
    """Return the hash of one 32-bit word ``value``, as ``hashmix`` of numpy's SeedSequence.

    The caller replaces ``constant`` by ``constant * factor`` after each call, as numpy's does.
    """
    mixed = _U(_U(value ^ constant) * _U(constant * factor))
    return _U(mixed ^ (mixed >> S16))


@kernel
def _mix(x: Any, y: Any) -> Any:
    """Return one 32-bit word mixed from two, x and y, as ``mix`` of numpy's SeedSequence."""
    mixed = _U(_U(MIX_LEFT * x) - _U(MIX_RIGHT * y))
    return _U(mixed ^ (mixed >> S16))


@kernel
def seed_words(entropy: np.ndarray, keys: np.ndarray, pool: np.ndarray, words: np.ndarray) -> None:
    """Write ``SeedSequence(seed, spawn_key=key).generate_state(4, uint64)`` into ``words`` (K, 4)
    for each of K ``keys`` (K, m) of m words.

    ``entropy`` (at least 4,) holds the words of the seed, lowest first, padded with zeros; ``pool``
    (4,) is scratch; all but ``words`` are uint32.
    """
    entropy_words = len(entropy)
    for row in range(len(keys)):
        constant = START_A
        # Fill the pool with the first words of the seed.
        for i in range(POOL):
            pool[i] = _scramble(entropy[i], constant, FACTOR_A)
            constant = _U(constant * FACTOR_A)
        # Mix every word of the pool into every other.
        for source in range(POOL):
            for target in range(POOL):
                if source != target:
                    hashed = _scramble(pool[source], constant, FACTOR_A)
                    constant = _U(constant * FACTOR_A)
                    pool[target] = _mix(pool[target], hashed)
        # Mix the remaining words of the seed, then those of the key, into all words of the pool.
        for i in range(POOL, entropy_words + keys.shape[1]):
            value = entropy[i] if i < entropy_words else keys[row, i - entropy_words]
            for target in range(POOL):
                hashed = _scramble(value, constant, FACTOR_A)
                constant = _U(constant * FACTOR_A)
                pool[target] = _mix(pool[target], hashed)
        # Hash the pool again, in turn, to 8 words of 32 bits: generate_state.
        constant = START_B
        for i in range(4):
            low = _scramble(pool[(2 * i) % POOL], constant, FACTOR_B)
            constant = _U(constant * FACTOR_B)
            high = _scramble(pool[(2 * i + 1) % POOL], constant, FACTOR_B)
            constant = _U(constant * FACTOR_B)
            words[row, i] = _L(low) | (_L(high) << S32)
