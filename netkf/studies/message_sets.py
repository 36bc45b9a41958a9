"""The smallest set of messages whose arrival would have kept a covariance below a limit.

Sets are tried by size, and within a size in the order of the expected decrease of the trace, which
is estimated from replays of single messages and pairs. Every reported set was replayed.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.studies.information import MessageKey
from netkf.studies.replay import Replayer

NEGLIGIBLE = 1e-2
"""The oldest messages are left out if all of them together change the trace by less than this share
of its distance from the limit.
"""
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


def smallest_set(
    replayer: Replayer,
    candidates: Sequence[Candidate],
    limit: float,
    most: int,
    replays: int,
) -> SmallestSet:
    """Return the smallest set of at most ``most`` candidates whose arrival brings the trace of P to
    ``limit`` or below, with at most ``replays`` replays.
    """
    search = _Search(replayer, limit)
    first, base = replayer.count, search.trace(())
    if base <= limit:
        return SmallestSet((), base, limit, most, most, len(candidates), 0, math.nan, 0)
    recent = search.recent(sorted(candidates, key=lambda c: (c.sent, c.key)))
    complete, messages = 0, None
    for size in range(1, most + 1):
        # Half of the replays for single messages, a quarter for pairs, and so on.
        replay_budget = replays if size == most else replays - (replays >> size)
        messages, all_tried = search.of_size(recent, size, first + replay_budget)
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

    def recent(self, candidates: Sequence[Candidate]) -> list[Candidate]:
        """Return the candidates, in the order of sending, without the oldest ones.

        Those left out, found by bisection, change the trace together by less than NEGLIGIBLE times
        the decrease that the limit asks for.
        """
        base = self.trace(())
        tolerance = NEGLIGIBLE * (base - self._limit)

        def negligible(count: int) -> bool:
            """Return True if the first ``count`` candidates change the trace negligibly."""
            keys = [candidate.key for candidate in candidates[:count]]
            return abs(self.trace(keys) - base) <= tolerance

        low, high = 0, len(candidates)
        while low < high:
            middle = (low + high + 1) // 2
            if negligible(middle):
                low = middle
            else:
                high = middle - 1
        return list(candidates[low:])

    def of_size(
        self, candidates: Sequence[Candidate], size: int, most_replays: int
    ) -> tuple[tuple[MessageKey, ...] | None, bool]:
        """Return a set of ``size`` messages with which the trace is at most the limit, and whether
        all sets of this size were considered.

        Of single messages it is the one with the smallest trace, of larger sets the first that is
        tried; None if there is none. The search ends when the replayer's count of replays is
        ``most_replays``.
        """
        best_set: tuple[float, tuple[MessageKey, ...]] | None = None
        sets, all_listed = self._in_order(candidates, size)
        for keys in sets:
            if self._replayer.count >= most_replays:
                return (None if best_set is None else best_set[1]), False
            trace = self.trace(keys)
            self._gains[keys] = self.trace(()) - trace
            if trace <= self._limit and (best_set is None or trace < best_set[0]):
                best_set = trace, keys
                if size > 1:
                    break
        return (None if best_set is None else best_set[1]), all_listed

    def _in_order(
        self, candidates: Sequence[Candidate], size: int
    ) -> tuple[Iterator[tuple[MessageKey, ...]], bool]:
        """Return the sets of a size in decreasing order of expected gain, then of latest messages;
        and False if there are too many, so that the least promising messages are left out.
        """
        single_gains = {c.key: self._gains.get((c.key,), 0.0) for c in candidates}
        ranked = sorted(candidates, key=lambda c: (-single_gains[c.key], -c.sent))
        count = len(ranked)
        while math.comb(count, size) > MAX_SETS:
            count = max(size, int(0.9 * count))
        numbers = itertools.chain.from_iterable(itertools.combinations(range(count), size))
        chosen = np.fromiter(numbers, np.intp, math.comb(count, size) * size).reshape(-1, size)
        needed = np.array([c.needed for c in ranked[:count]], dtype=np.intp)
        chosen = chosen[_are_joined(needed[chosen])]
        keys = sorted(c.key for c in ranked[:count])
        place = {key: k for k, key in enumerate(keys)}
        places = np.array([place[c.key] for c in ranked[:count]], dtype=np.intp)
        members = np.sort(places[chosen], axis=1)
        order = np.argsort(-self._expected(members, place, single_gains), kind="stable")
        sets = (tuple(keys[k] for k in members[row].tolist()) for row in order.tolist())
        return sets, count == len(ranked)

    def _expected(
        self,
        members: np.ndarray,
        place: Mapping[MessageKey, int],
        single_gains: Mapping[MessageKey, float],
    ) -> FloatArray:
        """Return the expected gain (S,) of each set: the sum of the gains of its single messages,
        and of the interactions of its pairs as far as they are known.

        ``members`` (S, size) are indices of messages, as in ``place``.
        """
        size = members.shape[1]
        single = np.array([single_gains[key] for key in place])
        gain = np.zeros(len(members))
        for column in members.T:
            gain += single[column]
        if size > 2:
            pair_gains = np.zeros((len(place), len(place)))
            for pair, gain_of_pair in self._gains.items():
                if len(pair) == 2 and set(pair) <= place.keys():
                    a, b = pair
                    pair_gains[place[a], place[b]] = (
                        gain_of_pair - single_gains[a] - single_gains[b]
                    )
            for i, j in itertools.combinations(range(size), 2):
                gain += pair_gains[members[:, i], members[:, j]]
        return gain


def _are_joined(needed: np.ndarray) -> np.ndarray:
    """Return a mask (S,) of the sets all of whose members can matter; ``needed`` (S, size) is
    ``Candidate.needed`` of their members.

    A member cannot matter if the set has too few other messages to carry it on to the node.
    """
    # A message that needs k messages, itself included, needs one of each lower number: sorted, the
    # numbers are at most 1, 2, 3, ...
    return np.asarray((np.sort(needed, axis=1) <= np.arange(1, needed.shape[1] + 1)).all(axis=1))
