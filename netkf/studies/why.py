"""``netkf.why``: why the covariance of one node at one instant was what it was."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.core.fields import integer, number
from netkf.core.printable import shorten
from netkf.scenario.scenario import Scenario
from netkf.studies.information import (
    OUTCOMES,
    USED,
    Flow,
    IntArray,
    MessageKey,
    Messages,
    Newest,
    Reach,
    Readings,
    at_once,
    find_flow,
    match_messages,
    newest_information,
    route,
    rows_until,
    search_back,
)
from netkf.studies.message_sets import Candidate, SmallestSet, smallest_set
from netkf.studies.replay import Replayer
from netkf.trace.run import Run

if TYPE_CHECKING:
    import pandas as pd

MOST, REPLAYS = 3, 1000
NEAR = 0.05
"""By default a set is good enough if it brings the trace of P as close as that, relatively, to the
one of the run in which every message came.
"""


@dataclass(frozen=True)
class Missing:
    """A message that was sent but not used: its ``outcome`` (of OUTCOMES), and when it was ``sent``
    and ``arrived`` (seconds, nan if it did not).
    """

    key: MessageKey
    outcome: str
    sent: float
    arrived: float

    def __str__(self) -> str:
        sender, receiver, count = self.key
        return f"{sender} -> {receiver} number {count} ({self.outcome}, sent at {self.sent:.6g} s)"


@dataclass(frozen=True)
class Source:
    """What had reached the node from one other, ``node``. Times are in seconds, nan if unknown.

    neighbour       it can send to the node directly
    heard, arrived  when the last message from it that was used was sent, and arrived
    unheard         messages from it that were sent since then and not used
    known           the last moment whose knowledge can have reached the node, over any way
    reading         its newest reading whose information can have reached the node
    route           the nodes on the way of that, this one first
    with_more       its newest reading that could have come with at most 1, 2, .. more messages
    without_losses  its newest reading that could have come if every message had
    missing         the fewest messages that had to come for a newer reading, of up to MOST
    """

    node: int
    sensor: bool
    neighbour: bool
    heard: float
    arrived: float
    unheard: int
    known: float
    reading: float
    route: tuple[int, ...]
    with_more: tuple[float, ...]
    without_losses: float
    missing: tuple[Missing, ...]


@dataclass(frozen=True)
class WhatIf:
    """A replay in which ``messages`` came, or all where that is None: the trace of P at the node,
    and the length of its error (nan without a known truth).
    """

    label: str
    messages: tuple[MessageKey, ...] | None
    trace: float
    error: float


@dataclass(frozen=True, eq=False, repr=False)
class Why:
    """Why ``node`` knew at ``at`` seconds what it knew, in one run of a scenario.

    ``trace`` is that of its covariance P and ``error`` the length of its error. ``sources`` tells
    what had reached it from whom, ``what_ifs`` what P would have been in replays, the run as it was
    first, and ``smallest`` which messages would have sufficed (None if the filter gives no P).
    """

    scenario: str
    node: int
    at: float
    seed: int
    replica: int
    sources: tuple[Source, ...]
    what_ifs: tuple[WhatIf, ...]
    smallest: SmallestSet | None
    missing: dict[MessageKey, Missing] = field(repr=False)
    notes: tuple[str, ...] = ()

    @property
    def trace(self) -> float:
        """The trace of P at the node."""
        return self.what_ifs[0].trace

    @property
    def error(self) -> float:
        """The length of x - xhat at the node, nan without a known truth."""
        return self.what_ifs[0].error

    @cached_property
    def table(self) -> pd.DataFrame:
        """A row for each other node, and the node itself if it has a sensor: ages in seconds."""
        from netkf.studies.why_text import source_table

        return source_table(self)

    def __str__(self) -> str:
        from netkf.studies.why_text import why_text

        return why_text(self)

    def __repr__(self) -> str:
        return (
            f"<netkf why: node {self.node} at {self.at:g} s of {self.scenario!r}, trace P "
            f"{self.trace:.4g}>"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON values."""
        from netkf.studies.why_text import why_document

        return why_document(self)


def why(
    run: Run | str | Path,
    node: int,
    at: float,
    *,
    scenario: Scenario | None = None,
    replica: int | None = None,
    below: float | None = None,
    most: int = MOST,
    replays: int = REPLAYS,
    trust: bool = False,
) -> Why:
    """Explain what ``node`` knew at ``at`` seconds in a run: whom it had heard, how old its
    information was, which messages were missing, and what its covariance would have been had they
    come, by replays of the run.

    ``run`` is a run in memory or the directory of one; of an ensemble with all traces ``replica``
    names one. ``below`` is the trace of P that the smallest set of messages has to reach; by
    default that of the run without losses, but for 5 %. The set has at most ``most`` messages, and
    at most ``replays`` replays look for it. ``trust`` imports classes of modules in the directory.

    Raises ScenarioError for a node, time or run that is not there, and for a run without events.
    """
    run, known = _given(run, scenario, replica, trust)
    at = _instant(known, node, at)
    most = integer(low=1, high=MOST)("most", most)
    limit = None if below is None else number(above=0.0)("below", below)
    replayer = Replayer(known, run.seed, run.replica, node, at)
    _same_events(rows_until(known, run.log, at), replayer.log)
    before = replayer.outcome(error=True)
    if not np.isfinite(before.xhat).all():
        raise ScenarioError(
            "at", "lies after the run had diverged", at, "ask about an earlier time"
        )
    evidence = _Evidence(replayer, node, most)
    sources = evidence.sources()
    found = None
    if math.isfinite(before.trace):
        target = (1.0 + NEAR) * replayer.outcome(None).trace if limit is None else limit
        found = smallest_set(replayer, evidence.candidates(), target, most, replays)
    return Why(
        scenario=known.name,
        node=node,
        at=at,
        seed=run.seed,
        replica=run.replica,
        sources=sources,
        what_ifs=_what_ifs(replayer, sources, found),
        smallest=found,
        missing=evidence.missing,
        notes=_notes(evidence),
    )


def _given(
    run: Run | str | Path, scenario: Scenario | None, replica: int | None, trust: bool
) -> tuple[Run, Scenario]:
    """Return a run with all its events, and its scenario; raises ScenarioError."""
    where = "run"
    if not isinstance(run, Run):
        where = shorten(run)
        run = _opened(Path(run), replica, trust)
    elif replica is not None and replica != run.replica:
        rule = f"is another one than that of the run, {run.replica}"
        raise ScenarioError("replica", rule, replica, "leave it out")
    known = scenario if scenario is not None else getattr(run, "scenario", None)
    if known is None:
        raise ScenarioError("scenario", "is not known", None, "give the scenario of the run")
    if run.nodes != known.nodes:
        raise ScenarioError("scenario", "has other nodes than the run", known, "give that of it")
    if not len(run.log):
        rule = "has no events, and they tell which messages came"
        raise ScenarioError(where, rule, None, "run it again with --trace full")
    return run, known


def _opened(directory: Path, replica: int | None, trust: bool) -> Run:
    """Return a run that is read back from its directory."""
    raise NotImplementedError(directory, replica, trust)


def _instant(scenario: Scenario, node: int, at: float) -> float:
    """Return the time that is asked about, in slots the start of its slot."""
    if node not in scenario.topology.index:
        listed = ", ".join(map(str, scenario.nodes[:8]))
        listed += ", ..." if len(scenario.nodes) > 8 else ""
        raise ScenarioError("node", "must be a node of the scenario", node, f"nodes: {listed}")
    time: float = number(low=0.0, high=scenario.horizon)("at", at)
    if not scenario.slotted:
        return time
    plant = scenario.slot_plant
    return plant.slot_time(int(plant.slots_of(np.array([time]))[0]))


def _same_events(kept: IntArray, again: IntArray) -> None:
    """Raise ScenarioError if a replay does not have the events of the run."""
    same = len(kept) == len(again) and all(
        np.array_equal(kept[name], again[name], equal_nan=kept[name].dtype.kind == "f")
        for name in kept.dtype.names or ()
    )
    if not same:
        rule = "has other events than its replay, so another scenario or version made it"
        raise ScenarioError("run", rule, None, "run the scenario again")


class _Evidence:
    """What the events of a run say about one node at one instant."""

    def __init__(self, replayer: Replayer, node: int, most: int) -> None:
        self._replayer, self._node, self._most = replayer, node, most
        self.scenario = replayer.scenario
        swaps, slotted = self.scenario.hosted.combination == "swap", self.scenario.slotted
        self.messages = match_messages(replayer.log, swaps, slotted)
        full = match_messages(replayer.full_log, swaps, slotted)
        # Filters may send something else, or nothing, after what they have heard.
        self.same_sends = len(full) == len(self.messages) and np.array_equal(
            full.sent, self.messages.sent
        )
        came = self.messages.outcome == USED
        # The replay of all messages shows when each of those that did not come would have.
        self._log = replayer.full_log if self.same_sends else replayer.log
        timed = full if self.same_sends else at_once(self.messages, self._log)
        self._flow: Flow = find_flow(self.scenario, self._log, timed, came)
        self._reach: Reach = search_back(self._flow, node, most)
        every = find_flow(self.scenario, replayer.full_log, full)
        self._every = replayer.full_log, search_back(every, node)
        self.missing: dict[MessageKey, Missing] = {
            self.messages.key(m): _missing(self.messages, m) for m in np.flatnonzero(~came).tolist()
        }

    def candidates(self) -> list[Candidate]:
        """Return the messages that did not come and could have mattered."""
        found = []
        for m in np.flatnonzero(self._flow.cost).tolist():
            needed = self._reach.needed(m)
            if needed is not None:
                sent = float(self.messages.sent[m])
                found.append(Candidate(self.messages.key(m), sent, needed))
        return found

    def sources(self) -> tuple[Source, ...]:
        """Return what had reached the node from every other node, and from its own sensor."""
        scenario, at = self.scenario, self._replayer.at
        readings = Readings(scenario, self._log, at)
        by_budget = [
            newest_information(self._reach, self._log, readings, budget)
            for budget in range(self._most + 1)
        ]
        log, reach = self._every
        every = newest_information(reach, log, Readings(scenario, log, at), 0)
        wanted = [n for n in scenario.nodes if n != self._node or n in scenario.placed]
        return tuple(self._source(n, [b.get(n) for b in by_budget], every.get(n)) for n in wanted)

    def _source(self, node: int, found: Sequence[Newest | None], every: Newest | None) -> Source:
        reading, *more = [math.nan if n is None else n.reading for n in found]
        last, unheard = self._direct(node)
        way: tuple[int, ...] = ()
        if found[0] is not None:
            way = route(self._reach, found[0].segment, 0)
        newer = next((b for b, r in enumerate(more, 1) if _is_newer(r, reading)), None)
        missing: tuple[Missing, ...] = ()
        if newer is not None:
            segment = found[newer]
            assert segment is not None
            passed = self._reach.messages_from(segment.segment, newer)
            missing = tuple(_missing(self.messages, m) for m in passed if self._flow.cost[m])
        return Source(
            node=node,
            sensor=node in self.scenario.placed,
            neighbour=(node, self._node) in self.scenario.topology.directions,
            heard=math.nan if last is None else float(self.messages.sent[last]),
            arrived=math.nan if last is None else float(self.messages.arrived[last]),
            unheard=unheard,
            known=self._replayer.at if node == self._node else _known(found[0]),
            reading=reading,
            route=way,
            with_more=tuple(more),
            without_losses=math.nan if every is None else every.reading,
            missing=missing,
        )

    def _direct(self, sender: int) -> tuple[int | None, int]:
        """Return the last message from a node that was used, and how many were sent since."""
        messages = self.messages
        mine = (messages.sender == sender) & (messages.receiver == self._node)
        came = np.flatnonzero(mine & (messages.outcome == USED))
        others = np.flatnonzero(mine & (messages.outcome != USED))
        if not len(came):
            return None, len(others)
        last = int(came[np.argmax(messages.used_row[came])])
        return last, int((messages.sent[others] > messages.sent[last]).sum())


def _known(newest: Newest | None) -> float:
    return math.nan if newest is None else newest.known


def _is_newer(reading: float, than: float) -> bool:
    return reading > than or (math.isnan(than) and not math.isnan(reading))


def _missing(messages: Messages, m: int) -> Missing:
    return Missing(
        messages.key(m),
        OUTCOMES[int(messages.outcome[m])],
        float(messages.sent[m]),
        float(messages.arrived[m]),
    )


def _what_ifs(
    replayer: Replayer, sources: Sequence[Source], smallest: SmallestSet | None
) -> tuple[WhatIf, ...]:
    """Return the run as it was, and the replays that the answer names."""
    sets: list[tuple[str, tuple[MessageKey, ...] | None]] = [("as it was", ())]
    newer: dict[tuple[MessageKey, ...], list[str]] = {}
    for source in sources:
        if source.missing:
            keys = tuple(m.key for m in source.missing)
            newer.setdefault(keys, []).append(str(source.node))
    for keys, nodes in newer.items():
        sets.append((f"newer readings of node {', '.join(nodes)}", keys))
    if len(newer) > 1:
        sets.append(("all of these", tuple(sorted({key for keys in newer for key in keys}))))
    if smallest is not None and smallest.messages:
        sets.append(("the smallest set", smallest.messages))
    elif smallest is not None and smallest.best:
        sets.append(("the best set tried", smallest.best))
    sets.append(("no message missing", None))
    return tuple(
        WhatIf(label, keys, outcome.trace, outcome.distance)
        for label, keys, outcome in ((a, b, replayer.outcome(b, error=True)) for a, b in sets)
    )


def _notes(evidence: _Evidence) -> tuple[str, ...]:
    notes = []
    if not evidence.same_sends:
        notes.append(
            "with this filter what is sent depends on what has arrived: the replays are exact, the "
            "ages with more messages take later messages as they were"
        )
    return tuple(notes)
