"""The smallest set of messages whose arrival would have kept a covariance below a limit.

Sets are tried by size, and within a size in the order of the expected decrease of the trace, which
is estimated from replays of single messages and pairs. Every reported set was replayed.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.network.deliveries import MessageKey
from netkf.studies.replay import Replayer

NEGLIGIBLE = 1e-2
"""Share of the distance from the limit below which the oldest messages are left out."""
COARSENESS = 16
"""At most one of so many candidates stays though it and all older ones are negligible together."""
MAX_SETS = 300_000
"""Largest number of sets of one size that are sorted at once."""


@dataclass(frozen=True)
class Candidate:
    """A message that was not used, but from which information could have reached the node.

    ``sent`` is its time in seconds, ``needed`` the number of missing messages, this one included,
    that must be delivered for that.
    """

    key: MessageKey
    sent: float
    needed: int


@dataclass(frozen=True)
class SmallestSet:
    """The result of the search.

    messages   : set whose delivery brings the trace of P down to ``trace`` <= ``limit``, or None
    most       : largest size of the sets in the search
    complete   : size up to which all sets were tried
    candidates : number of messages that could matter
    considered : number of them in the search: those sent from ``since`` (seconds) on
    replays    : number of replays; with too few of them ``complete`` is below ``most``
    best, best_trace : the tried set with the smallest trace
    """

    messages: tuple[MessageKey, ...] | None
    trace: float
    limit: float
    most: int
    complete: int
    candidates: int
    considered: int
    since: float
    replays: int
    best: tuple[MessageKey, ...] = ()
    best_trace: float = math.nan

    @property
    def proven(self) -> bool:
        """True if no smaller set exists, or none of up to ``most`` messages if none was found."""
        size = self.most + 1 if self.messages is None else len(self.messages)
        return self.complete >= size - 1


def find_smallest_set(
    replayer: Replayer, candidates: Sequence[Candidate], limit: float, most: int, replays: int
) -> SmallestSet:
    """Return the smallest set (up to ``most``) that brings trace P to ``limit``, by replays."""
    search = _Search(replayer, limit)
    first, base = replayer.count, search.trace(())  # replays before; trace of the run as it was
    if base <= limit:
        return SmallestSet((), base, limit, most, most, len(candidates), 0, math.nan, replays=0)
    recent = search.drop_oldest(sorted(candidates, key=lambda c: (c.sent, c.key)))
    # ``complete``: the size up to which all sets were tried without success.
    complete, messages = 0, None
    for size in range(1, most + 1):
        # Half of the replays for single messages, a quarter for pairs, and so on.
        replay_budget = replays if size == most else replays - (replays >> size)
        messages, all_tried = search.find_set(recent, size, first + replay_budget)
        if messages is not None:
            break
        complete = size if all_tried and complete == size - 1 else complete
    return SmallestSet(
        messages=messages,
        trace=math.nan if messages is None else search.trace(messages),
        limit=limit,
        most=most,
        complete=complete,
        candidates=len(candidates),
        considered=len(recent),
        since=recent[0].sent if recent else math.nan,
        replays=replayer.count - first,
        best=search.best,
        best_trace=search.trace(search.best),
    )


class _Search:
    """Traces of P by replays, and the gains (decreases of the trace) of sets of messages."""

    def __init__(self, replayer: Replayer, limit: float) -> None:
        self._replayer, self._limit = replayer, limit
        self._gains: dict[tuple[MessageKey, ...], float] = {}

    def trace(self, keys: Sequence[MessageKey]) -> float:
        """Return the trace of P with these messages delivered."""
        return self._replayer.outcome(keys).trace

    @property
    def best(self) -> tuple[MessageKey, ...]:
        """The set with the largest gain; empty if no set decreased the trace."""
        largest = max(self._gains, key=self._gains.__getitem__, default=())
        return largest if self._gains.get(largest, 0.0) > 0.0 else ()

    def drop_oldest(self, candidates: Sequence[Candidate]) -> list[Candidate]:
        """Return ``candidates`` without the oldest, which change the trace by a NEGLIGIBLE part."""
        base = self.trace(())
        tolerance = NEGLIGIBLE * (base - self._limit)
        low, high = 0, len(candidates)
        # To the message if they are few: with a long run's, the replays serve better in the search.
        while high - low > len(candidates) // COARSENESS:
            middle = (low + high + 1) // 2
            oldest = [candidate.key for candidate in candidates[:middle]]
            if abs(self.trace(oldest) - base) <= tolerance:
                low = middle
            else:
                high = middle - 1
        return list(candidates[low:])

    def find_set(
        self, candidates: Sequence[Candidate], size: int, max_count: int
    ) -> tuple[tuple[MessageKey, ...] | None, bool]:
        """Return a set of ``size`` that reaches the limit, or None, and whether all were tried."""
        best_set: tuple[MessageKey, ...] | None = None
        best_trace = math.inf
        if self._replayer.count >= max_count and len(candidates) >= size:
            return None, False
        sets, all_listed = self._list_sets(candidates, size)
        for keys in sets:
            if self._replayer.count >= max_count:
                return best_set, False
            trace = self.trace(keys)
            self._gains[keys] = self.trace(()) - trace
            if trace <= self._limit and trace < best_trace:
                best_set, best_trace = keys, trace
                if size > 1:
                    break
        return best_set, all_listed

    def _list_sets(
        self, candidates: Sequence[Candidate], size: int
    ) -> tuple[Iterator[tuple[MessageKey, ...]], bool]:
        """Return sets by decreasing expected gain (at most MAX_SETS), and whether these are all."""
        single_gains = {c.key: self._gains.get((c.key,), 0.0) for c in candidates}
        times = np.array([c.sent for c in candidates])
        gains = np.array(list(single_gains.values()))
        ranked = [candidates[k] for k in np.lexsort((-times, -gains)).tolist()]
        count = len(ranked)
        while math.comb(count, size) > MAX_SETS:
            count = max(size, int(0.9 * count))
        # All sets, as rows of indices into ``ranked``; those that cannot matter are dropped.
        numbers = itertools.chain.from_iterable(combinations(range(count), size))
        chosen = np.fromiter(numbers, np.intp, math.comb(count, size) * size).reshape(-1, size)
        needed = np.array([c.needed for c in ranked[:count]], dtype=np.intp)
        # A message that needs k messages, itself included, needs one of each lower number: sorted,
        # the numbers are at most 1, 2, 3, ...
        chosen = chosen[(np.sort(needed[chosen], axis=1) <= np.arange(1, size + 1)).all(axis=1)]
        # Keys in sorted order, so that a set has one form whatever the ranks of its members.
        keys = sorted(c.key for c in ranked[:count])
        index_of_key = {key: k for k, key in enumerate(keys)}
        indices = np.array([index_of_key[c.key] for c in ranked[:count]], dtype=np.intp)
        members = np.sort(indices[chosen], axis=1)
        gains = self._expected_gains(members, index_of_key, single_gains)
        order = np.argsort(-gains, kind="stable")
        sets = (tuple(keys[k] for k in members[row].tolist()) for row in order.tolist())
        return sets, count == len(ranked)

    def _expected_gains(
        self,
        members: np.ndarray,
        index_of_key: Mapping[MessageKey, int],
        single_gains: Mapping[MessageKey, float],
    ) -> FloatArray:
        """Return the expected gains (S,): of single messages, plus what replayed pairs add."""
        size, messages = members.shape[1], len(index_of_key)
        single = np.array([single_gains[key] for key in index_of_key])
        gains = np.zeros(len(members))
        for column in members.T:
            gains += single[column]
        # Pairs are known only when larger sets are tried.
        if size > 2:
            # Gain of a pair less those of its two messages, by their indices.
            interactions = np.zeros((messages, messages))
            for pair, pair_gain in self._gains.items():
                if len(pair) == 2 and set(pair) <= index_of_key.keys():
                    a, b = pair
                    interaction = pair_gain - single_gains[a] - single_gains[b]
                    interactions[index_of_key[a], index_of_key[b]] = interaction
            for i, j in combinations(range(size), 2):
                gains += interactions[members[:, i], members[:, j]]
        return gains
