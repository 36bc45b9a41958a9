"""The smallest set of messages whose arrival would have kept a covariance below a limit.

Sets are tried by size, and within a size in the order of the expected decrease of the trace, which
is estimated from replays of single messages and pairs. Every reported set was replayed.

The scenario, the seed and all draws of a replay are those of the run. Only chosen messages differ:
they are delivered after their drawn delay, or without delay if they were late. True states and
readings do not depend on the network, so that they are the same. (With continuous readings, a
message that is newly delivered between two grid times may split the reading of that interval at
another moment; its parts are then drawn anew, given the same whole.)
"""

from __future__ import annotations

import copy
import dataclasses
import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.network.channels import Channel
from netkf.network.delays import NoDelay
from netkf.network.deliveries import (
    Chosen,
    DelayUnlessWaived,
    Deliveries,
    DeliveringLoss,
    MessageKey,
)
from netkf.runs.simulate import simulate
from netkf.scenario.scenario import Scenario
from netkf.studies.information import (
    LATE,
    REFUSED,
    UNDER_WAY,
    IntArray,
    match_messages,
    message_keys,
    rows_until,
)


class Outcome(NamedTuple):
    """The state of a node at an instant.

    xhat  : (n,) estimate
    P     : (n, n) covariance, nan if the filter gives none
    error : (n,) x - xhat, nan without ground truth
    """

    xhat: FloatArray
    P: FloatArray
    error: FloatArray

    @property
    def trace(self) -> float:
        """The trace of P."""
        return float(np.trace(self.P))

    @property
    def distance(self) -> float:
        """The length of the error."""
        return float(np.linalg.norm(self.error))


class Replayer:
    """Replays a run up to ``at`` seconds for the state of ``node``; ``count`` replays were made."""

    def __init__(self, scenario: Scenario, seed: int, replica: int, node: int, at: float) -> None:
        self.scenario, self._seed, self._replica = scenario, seed, replica
        self._node, self.at, self.count = scenario.nodes.index(node), at, 0
        self._deliveries = Deliveries()
        self._short, self._full = (
            delivering(_shorten(scenario, at, to_horizon), self._deliveries)
            for to_horizon in (False, True)
        )
        self._outcomes: dict[tuple[Chosen | None, bool], Outcome] = {}

    @cached_property
    def log(self) -> IntArray:
        """The E EVENT rows (E,) of the unchanged run, up to the state at ``at``."""
        return self._replay(frozenset(), to_horizon=False)

    @cached_property
    def delayed(self) -> Chosen:
        """Messages not lost but unused because of their delay; replays deliver them at once."""
        scenario = self.scenario
        messages = match_messages(self.log, scenario.node_filter.analysis.swaps, scenario.slotted)
        unused = np.isin(messages.outcome, (LATE, REFUSED, UNDER_WAY))
        return frozenset(message_keys(messages[unused]))

    @cached_property
    def full_log(self) -> IntArray:
        """The EVENT rows (E,) of the run with all messages delivered, up to ``at``."""
        return self._replay(None, to_horizon=False)

    def outcome(self, chosen: Iterable[MessageKey] | None = (), error: bool = False) -> Outcome:
        """Return the node's state at ``at`` with the ``chosen`` messages delivered, all for None.

        Without ``error``, which may replay the whole run, x - xhat may not be that of the run.
        """
        keys = None if chosen is None else frozenset(chosen)
        # The true state between two samples of sensors depends on the later one too.
        to_horizon = error and bool(self.scenario.sampled_sensors)
        if (keys, to_horizon) not in self._outcomes:
            if keys is None and not to_horizon:
                _ = self.full_log  # this replay also keeps its log
            elif keys == frozenset() and not to_horizon:
                _ = self.log
            else:
                self._replay(keys, to_horizon)
        return self._outcomes[keys, to_horizon]

    def _replay(self, chosen: Chosen | None, to_horizon: bool) -> IntArray:
        """Simulate with ``chosen`` (None: all) messages delivered; return EVENT rows to ``at``."""
        self.count += 1
        without_delay: Chosen = frozenset()
        if chosen is None or chosen:
            without_delay = self.delayed if chosen is None else chosen & self.delayed
        # The channel models of both scenarios read these when messages are sent.
        self._deliveries.choose(chosen, without_delay)
        run = simulate(self._full if to_horizon else self._short, self._seed, self._replica)
        k, n = self._node, int(self.scenario.sizes[self._node])
        outcome = Outcome(run.xhat[-1, k, :n], run.P[-1, k, :n, :n], run.error[-1, k, :n])
        if run.times[-1] != self.at:  # it diverged before
            outcome = Outcome(*(np.full_like(part, np.nan) for part in outcome))
        self._outcomes[chosen, to_horizon] = outcome
        return rows_until(self.scenario, run.log, self.at)


def delivering(scenario: Scenario, deliveries: Deliveries) -> Scenario:
    """Return the scenario whose channel delivers what ``deliveries`` names, else as drawn."""
    network, channel_of_run = scenario.network, scenario.network.channel
    loss = DeliveringLoss(channel_of_run.loss, deliveries, channels=channel_of_run.channels)
    delay = channel_of_run.delay
    # Without delays no message is late, and the engines have a faster path.
    if type(delay) is not NoDelay:
        delay = DelayUnlessWaived(delay, deliveries)
    channel = Channel(loss=loss, delay=delay, symmetric=channel_of_run.symmetric)
    return _with(scenario, network=dataclasses.replace(network, channel=channel))


def _shorten(scenario: Scenario, at: float, to_horizon: bool) -> Scenario:
    """Return the scenario whose last sample is at ``at`` s; it ends there or at the horizon."""
    times = scenario.times
    # Earlier samples stay: they decide where continuous readings of an interval are split.
    probe = np.append(times[times < at], at)
    # Events at ``at`` itself, and in slots those of its slot, belong to the state: a replay ends a
    # slot, a tick or 1e-9 s later.
    grid = scenario.time_grid
    later = scenario.slot_plant.period if scenario.slotted else max(1e-9, 1.0 / grid.per_second)
    end = scenario.horizon if to_horizon else min(scenario.horizon, grid.instant(at + later))
    return _with(scenario, probe=probe, horizon=end)


def _with(scenario: Scenario, **changes: Any) -> Scenario:
    changed = copy.copy(scenario)  # without derived values
    for name, value in changes.items():
        object.__setattr__(changed, name, value)
    return changed


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
