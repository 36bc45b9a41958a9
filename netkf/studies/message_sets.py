"""The smallest set of messages whose arrival would have kept a covariance below a limit.

Every set that is named was replayed. Sets are tried by size, and those of one size in the order of
what their members do alone and in pairs, the most promising first.
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
"""Messages before some time are left out if the arrival of all of them would have changed the trace
by less than this part of what is missing.
"""
MAX_SETS = 300_000
"""Sets of one size that are put in order at once."""


@dataclass(frozen=True)
class Candidate:
    """A message that did not come, but from which information could have reached the node.

    ``needed`` counts the messages that have to come for that, this one included; ``sent`` is its
    time in seconds.
    """

    key: MessageKey
    sent: float
    needed: int


@dataclass(frozen=True)
class SmallestSet:
    """The answer: ``messages`` whose arrival brings the trace of P down to ``trace``, at most
    ``limit``; None if no such set was found. ``best`` is the set, of all that were tried, that
    brought it down most, to ``best_trace``.

    All sets of up to ``complete`` messages were tried, out of ``considered`` of the ``candidates``:
    those sent from ``since`` on (seconds). ``replays`` were made; if they did not suffice for all
    sets of up to ``most`` messages, ``complete`` is less than that.
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
    complete, found = 0, None
    for size in range(1, most + 1):
        # Half of the replays for single messages, a quarter for pairs, and so on.
        share = replays if size == most else replays - (replays >> size)
        found, all_tried = search.of_size(recent, size, first + share)
        if found is not None:
            break
        complete = size if all_tried and complete == size - 1 else complete
    return SmallestSet(
        messages=found,
        trace=math.nan if found is None else search.trace(found),
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
    """The traces of P that replays have shown, and what sets of messages gain by them."""

    def __init__(self, replayer: Replayer, limit: float) -> None:
        self._replayer, self._limit = replayer, limit
        self._gains: dict[tuple[MessageKey, ...], float] = {}

    def trace(self, keys: Sequence[MessageKey]) -> float:
        """Return the trace of P had these messages come."""
        return self._replayer.outcome(keys).trace

    @property
    def best(self) -> tuple[MessageKey, ...]:
        """The set that gained most, without messages if none gained anything."""
        found = max(self._gains, key=self._gains.__getitem__, default=())
        return found if self._gains.get(found, 0.0) > 0.0 else ()

    def recent(self, candidates: Sequence[Candidate]) -> list[Candidate]:
        """Return the candidates from the first on that matters, in the order of sending.

        All before it together would not have changed the trace by more than NEGLIGIBLE.
        """
        base = self.trace(())
        tolerance = NEGLIGIBLE * (base - self._limit)

        def negligible(count: int) -> bool:
            """Return True if the first ``count`` candidates change next to nothing."""
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
        """Return a set of that size that is good enough, of single messages the best one, None if
        none was found; and True if all sets of that size were tried.
        """
        best: tuple[float, tuple[MessageKey, ...]] | None = None
        sets, all_listed = self._in_order(candidates, size)
        for keys in sets:
            if self._replayer.count >= most_replays:
                return (None if best is None else best[1]), False
            trace = self.trace(keys)
            self._gains[keys] = self.trace(()) - trace
            if trace <= self._limit and (best is None or trace < best[0]):
                best = trace, keys
                if size > 1:
                    break
        return (None if best is None else best[1]), all_listed

    def _in_order(
        self, candidates: Sequence[Candidate], size: int
    ) -> tuple[Iterator[tuple[MessageKey, ...]], bool]:
        """Return sets of a size, those first that should lower the trace most, or of the latest
        messages; and False where there are too many to list.
        """
        alone = {c.key: self._gains.get((c.key,), 0.0) for c in candidates}
        ranked = sorted(candidates, key=lambda c: (-alone[c.key], -c.sent))
        kept = len(ranked)
        while math.comb(kept, size) > MAX_SETS:
            kept = max(size, int(0.9 * kept))
        numbers = itertools.chain.from_iterable(itertools.combinations(range(kept), size))
        chosen = np.fromiter(numbers, np.intp, math.comb(kept, size) * size).reshape(-1, size)
        needed = np.array([c.needed for c in ranked[:kept]], dtype=np.intp)
        chosen = chosen[_are_joined(needed[chosen])]
        keys = sorted(c.key for c in ranked[:kept])
        place = {key: k for k, key in enumerate(keys)}
        places = np.array([place[c.key] for c in ranked[:kept]], dtype=np.intp)
        members = np.sort(places[chosen], axis=1)
        order = np.argsort(-self._expected(members, place, alone), kind="stable")
        sets = (tuple(keys[k] for k in members[row].tolist()) for row in order.tolist())
        return sets, kept == len(ranked)

    def _expected(
        self,
        members: np.ndarray,
        place: Mapping[MessageKey, int],
        alone: Mapping[MessageKey, float],
    ) -> FloatArray:
        """Return the sum (S,) of what the messages of each set gain alone, and of what pairs gain
        beyond that; ``members`` (S, size) are numbers of messages, as in ``place``.
        """
        size = members.shape[1]
        single = np.array([alone[key] for key in place])
        gain = np.zeros(len(members))
        for column in members.T:
            gain += single[column]
        if size > 2:
            beyond = np.zeros((len(place), len(place)))
            for pair, together in self._gains.items():
                if len(pair) == 2 and set(pair) <= place.keys():
                    a, b = pair
                    beyond[place[a], place[b]] = together - alone[a] - alone[b]
            for i, j in itertools.combinations(range(size), 2):
                gain += beyond[members[:, i], members[:, j]]
        return gain


def _are_joined(needed: np.ndarray) -> np.ndarray:
    """Return a mask (S,) of the sets all of whose members can matter; ``needed`` (S, size) is
    ``Candidate.needed`` of their members.

    A member cannot matter if the set has too few other messages to carry it on to the node.
    """
    # A message that needs k messages, itself included, needs one of each lower number: sorted, the
    # numbers are at most 1, 2, 3, ...
    return np.asarray((np.sort(needed, axis=1) <= np.arange(1, needed.shape[1] + 1)).all(axis=1))
