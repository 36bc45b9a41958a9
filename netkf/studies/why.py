"""``netkf.why``: why the covariance of one node at one instant was what it was."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.core.fields import integer, number
from netkf.core.printable import list_some, shorten
from netkf.ensembles.stored import StoredEnsemble
from netkf.network.deliveries import MessageKey
from netkf.runs.outcomes import downtimes
from netkf.scenario.scenario import Scenario
from netkf.studies.explanation import (
    GOOD_ENOUGH,
    InformationSource,
    Missing,
    WhatIf,
    Why,
    list_items,
)
from netkf.studies.information import (
    NEVER,
    OUTCOMES,
    USED,
    BackwardSearch,
    Flow,
    KeptReadings,
    Newest,
    at_once,
    find_flow,
    match_messages,
    message_keys,
    newest_information,
    route,
    rows_until,
    search_back,
)
from netkf.studies.message_sets import Candidate, Outcome, Replayer, SmallestSet, find_smallest_set
from netkf.studies.opening import open as open_directory
from netkf.trace.run import Run
from netkf.trace.schema import CODES

MAX_MISSING = 3  # largest size of a set of missing messages that is searched
MIN_REPLAYS, MAX_REPLAYS, MAX_EVENTS = 10, 1000, 5_000_000
"""The default number of replays is MAX_EVENTS over the events of one replay, within the two limits.
It holds for those that search the smallest set, and again for those with newer readings of nodes.
"""


def why(
    run: Run | str | Path,
    node: int | str,
    at: float,
    *,
    scenario: Scenario | None = None,
    replica: int | None = None,
    below: float | None = None,
    most: int = MAX_MISSING,
    replays: int | None = None,
    trust: bool = False,
) -> Why:
    """Explain the estimate of ``node`` (id or name) at ``at`` seconds in a run: which messages it
    had used, how old its information was, which messages were missing, and, by replays of the run,
    its covariance with missing messages delivered.

    ``run`` is a run in memory or the directory of one; of an ensemble with all traces ``replica``
    (default 0) names one. ``scenario`` is only needed for a run that does not know its own.
    ``below`` is the trace of P that the smallest set of missing messages has to reach, by default
    1.05 times that with every message delivered. The set has at most ``most`` messages, and at most
    ``replays`` replays search it, by default 10 to 1000. ``trust`` imports classes of modules in
    the directory.

    Raises ScenarioError for a node, time or run that does not exist, and for a run without events.
    """
    run, run_scenario = _check_run(run, scenario, replica, trust)
    found = run_scenario.topology.find(str(node))
    if found is None:
        remedy = f"nodes: {list_some(run_scenario.nodes, 8)}"
        raise ScenarioError("node", "must be a node of the scenario", node, remedy)
    at = _check_instant(run, run_scenario, at)
    # Keyword names are those of the command line: --most, --below, --replays.
    most = integer(low=1, high=MAX_MISSING)("most", most)
    limit = None if below is None else number(above=0.0)("below", below)
    replayer = Replayer(run_scenario, run.seed, run.replica, found, at)
    outcome = _check_replay(run, replayer)
    evidence = _Evidence(replayer, found, most)
    sources = evidence.sources()
    smallest = None
    if math.isfinite(outcome.trace):
        # outcome(None): the state with every message delivered.
        target = (1.0 + GOOD_ENOUGH) * replayer.outcome(None).trace if limit is None else limit
        wanted = _default_replays(len(replayer.log)) if replays is None else replays
        count = integer(low=1)("replays", wanted)
        smallest = find_smallest_set(replayer, evidence.candidates(), target, most, count)
    what_ifs, left_out = _make_what_ifs(replayer, sources, smallest)
    down = downtimes(run_scenario, run.seed, run.replica)
    return Why(
        scenario=run_scenario.name,
        node=found,
        at=at,
        seed=run.seed,
        replica=run.replica,
        sources=sources,
        what_ifs=what_ifs,
        smallest=smallest,
        missing=evidence.missing,
        down=tuple(one for one in down if one.begin <= at < one.end),
        notes=_replay_notes(evidence, left_out),
        unit=run_scenario.common_unit,
    )


def _check_run(
    run: Run | str | Path, scenario: Scenario | None, replica: int | None, trust: bool
) -> tuple[Run, Scenario]:
    name = "run" if isinstance(run, Run) else shorten(run)
    if not isinstance(run, Run):
        stored = open_directory(run, trust=trust)
        if isinstance(stored, StoredEnsemble):
            stored = stored.replica(replica or 0)
        if not isinstance(stored, Run):
            rule = f"holds no run with events, but {stored!r}"
            raise ScenarioError(name, rule, None, "name what netkf run left")
        run = stored
    if replica is not None and replica != run.replica:
        rule = f"is another one than that of the run, {run.replica}"
        raise ScenarioError("replica", rule, replica, "leave it out")
    run_scenario = run.scenario if scenario is None else scenario
    if run_scenario is None:
        raise ScenarioError("scenario", "is not known", None, "give the scenario of the run")
    if run.nodes != run_scenario.nodes:
        raise ScenarioError(
            "scenario", "has other nodes than the run", run_scenario, "give that of it"
        )
    if not len(run.log):
        rule = "has no events, and they tell which messages came"
        raise ScenarioError(name, rule, None, "run it again with --trace full")
    return run, run_scenario


def _check_replay(run: Run, replayer: Replayer) -> Outcome:
    """Return the state of the node in the replay; raises ScenarioError unless it is that run."""
    logs = rows_until(replayer.scenario, run.log, replayer.at), replayer.log
    # Links that come and go are looked at at samples, and a replay has one more.
    logged, replayed = (log[log["kind"] != CODES["link"]] for log in logs)
    if len(logged) != len(replayed) or not all(
        np.array_equal(logged[name], replayed[name], equal_nan=logged[name].dtype.kind == "f")
        for name in logged.dtype.names or ()
    ):
        rule = "has other events than its replay, so another scenario or version made it"
        raise ScenarioError("run", rule, None, "run the scenario again")
    outcome = replayer.outcome(error=True)
    if not np.isfinite(outcome.xhat).all() or np.isinf(outcome.P).any():
        rule, remedy = "lies after the run had diverged", "ask about an earlier time"
        raise ScenarioError("at", rule, replayer.at, remedy)
    return outcome


def _default_replays(events: int) -> int:
    """Return the default number of replays: fewer for long logs, to bound the time they take."""
    return min(MAX_REPLAYS, max(MIN_REPLAYS, MAX_EVENTS // max(1, events)))


def _check_instant(run: Run, scenario: Scenario, at: float) -> float:
    """Return ``at`` (seconds), in slots the start of its slot; raises ScenarioError."""
    time = scenario.time_grid.instant(number(low=0.0, high=scenario.horizon)("at", at))
    if run.status not in ("complete", "diverged") and not time <= max(run.times, default=-1.0):
        rule = f"lies beyond what was kept of a run that ended as {run.status}"
        raise ScenarioError("at", rule, time, "finish it with netkf run --resume")
    if not scenario.slotted:
        return time
    plant = scenario.slot_plant
    return plant.slot_time(int(plant.slots_of(np.array([time]))[0]))


class _Evidence:
    """The evidence in the events of a run about one node at one instant."""

    def __init__(self, replayer: Replayer, node: int, max_missing: int) -> None:
        self._replayer, self._node, self._max_missing = replayer, node, max_missing
        self.scenario = replayer.scenario
        talks, links = self.scenario.node_filter.timing.talks, self.scenario.topology.directions
        self._links = frozenset(links if talks else ())
        swaps, slotted = self.scenario.node_filter.analysis.swaps, self.scenario.slotted
        self.messages = match_messages(replayer.log, swaps, slotted)
        full = match_messages(replayer.full_log, swaps, slotted)
        # What some filters send depends on the messages that they have received.
        self.same_sends = len(full) == len(self.messages) and np.array_equal(
            full.sent, self.messages.sent
        )
        was_used = self.messages.outcome == USED
        # The replay with all messages shows when each missing one would have been used.
        self._log = replayer.full_log if self.same_sends else replayer.log
        usable = full if self.same_sends else at_once(self.messages, self._log)
        self._flow: Flow = find_flow(self.scenario, self._log, usable, was_used)
        self._reach: BackwardSearch = search_back(self._flow, node, max_missing)
        # The same search in the replay with all messages tells what the node could have had at
        # best.
        full_flow = find_flow(self.scenario, replayer.full_log, full)
        self._full_search = replayer.full_log, search_back(full_flow, node)
        unused = self.messages[~was_used]
        named = {n: self.scenario.topology.named(n) for n in self.scenario.nodes}
        columns = unused.outcome.tolist(), unused.sent.tolist(), unused.ended.tolist()
        self.missing: dict[MessageKey, Missing] = {
            key: Missing(named[key[0]], named[key[1]], key[2], OUTCOMES[outcome], *times)
            for key, outcome, *times in zip(message_keys(unused), *columns, strict=True)
        }

    def candidates(self) -> list[Candidate]:
        """Return the unused messages whose information could have reached the node."""
        # The cost of a message is 1 if it was not used in the run, else 0.
        unused = np.flatnonzero(self._flow.cost)
        needed = self._reach.needed(unused)
        unused, counts = unused[needed != NEVER], needed[needed != NEVER].tolist()
        times, keys = self.messages.sent[unused].tolist(), message_keys(self.messages[unused])
        return list(map(Candidate, keys, times, counts))

    def sources(self) -> tuple[InformationSource, ...]:
        """Return what had reached the node from every other node and its own sensor."""
        scenario, at = self.scenario, self._replayer.at
        readings = KeptReadings(scenario, self._log, at)
        # Newest information of each node with at most 0, 1, ... missing messages delivered.
        by_budget = [
            newest_information(self._reach, self._log, readings, budget)
            for budget in range(self._max_missing + 1)
        ]
        log, reach = self._full_search
        without_losses = newest_information(reach, log, KeptReadings(scenario, log, at), 0)
        nodes = [n for n in scenario.nodes if n != self._node or n in scenario.placed_sensors]
        return tuple(
            self._make_source(n, [newest.get(n) for newest in by_budget], without_losses.get(n))
            for n in nodes
        )

    def _make_source(
        self, node: int, newest_by_budget: Sequence[Newest | None], without_losses: Newest | None
    ) -> InformationSource:
        """Return what the estimate has from ``node``, and what missing messages would add."""
        reading, *with_more = [math.nan if n is None else n.reading for n in newest_by_budget]
        last, unheard = self._find_last_message(node)
        path_nodes: tuple[int, ...] = ()
        known = math.nan
        if newest_by_budget[0] is not None:
            known = newest_by_budget[0].known
            path = route(self._reach, newest_by_budget[0].segment, 0)
            path_nodes = tuple(map(self.scenario.topology.named, path))
        # The fewest missing messages with which a newer reading would have come, if any.
        known_reading = -math.inf if math.isnan(reading) else reading
        budget = next((b for b, r in enumerate(with_more, 1) if r > known_reading), None)
        missing: tuple[Missing, ...] = ()
        if budget is not None:
            newest = newest_by_budget[budget]
            assert newest is not None
            taken = self._reach.messages_from(newest.segment, budget)
            unused = self.messages[[m for m in taken if self._flow.cost[m]]]
            missing = tuple(self.missing[key] for key in message_keys(unused))
        return InformationSource(
            node=node,
            sensor=node in self.scenario.placed_sensors,
            neighbour=(node, self._node) in self._links,
            heard=math.nan if last is None else float(self.messages.sent[last]),
            arrived=math.nan if last is None else float(self.messages.ended[last]),
            unheard=unheard,
            known=self._replayer.at if node == self._node else known,
            reading=reading,
            route=path_nodes,
            with_more=tuple(with_more),
            without_losses=math.nan if without_losses is None else without_losses.reading,
            missing=missing,
        )

    def _find_last_message(self, sender: int) -> tuple[int | None, int]:
        """Return the last used message of ``sender``, or None, and how many are unused since."""
        messages = self.messages
        # Messages are sorted by sender. Ids of its type: others would be compared in a copy.
        ids = np.array([sender, sender + 1], dtype=messages.sender.dtype)
        first, after = np.searchsorted(messages.sender, ids)
        direct = first + np.flatnonzero(messages.receiver[first:after] == self._node)
        is_used = messages.outcome[direct] == USED
        used, unused = direct[is_used], direct[~is_used]
        if not len(used):
            return None, len(unused)
        # Of those that were used at one instant the newest.
        last = int(used[np.lexsort((messages.sent[used], messages.used_row[used]))[-1]])
        return last, int((messages.sent[unused] > messages.sent[last]).sum())


def _make_what_ifs(
    replayer: Replayer, sources: Sequence[InformationSource], smallest: SmallestSet | None
) -> tuple[tuple[WhatIf, ...], int]:
    """Return the replays that answer "what if", and how many were left out in a long run."""
    # Label and messages of each replay; None stands for every message.
    delivered_sets: list[tuple[str, tuple[MessageKey, ...] | None]] = [("as it was", ())]
    newer: dict[tuple[MessageKey, ...], list[InformationSource]] = {}
    for source in sources:
        if source.missing:
            newer.setdefault(tuple(m.key for m in source.missing), []).append(source)

    def time_gained(keys: tuple[MessageKey, ...]) -> float:
        gains = [s.with_more[len(s.missing) - 1] - s.reading for s in newer[keys]]
        return max(math.inf if math.isnan(gain) else gain for gain in gains)

    # If there are too many, replay those that make a reading newer by the most time; ``sorted`` is
    # stable.
    count = _default_replays(len(replayer.log))
    replayed = set(sorted(newer, key=time_gained, reverse=True)[:count])
    for keys, sources_of_keys in newer.items():
        if keys in replayed:
            # Nodes of different keys differ, so that a label names one set.
            nodes = list_items([source.node for source in sources_of_keys])
            delivered_sets.append((f"newer readings of node {nodes}", keys))
    if len(newer) > 1:
        together = tuple(sorted({key for keys in newer for key in keys}))
        delivered_sets.append(("all of these", together))
    if smallest is not None and smallest.messages:
        delivered_sets.append(("the smallest set", smallest.messages))
    elif smallest is not None and smallest.best:
        delivered_sets.append(("the best set tried", smallest.best))
    delivered_sets.append(("no message missing", None))
    what_ifs = []
    for label, delivered in delivered_sets:
        outcome = replayer.outcome(delivered, error=True)
        what_ifs.append(WhatIf(label, delivered, outcome.trace, outcome.distance))
    return tuple(what_ifs), len(newer) - len(replayed)


def _replay_notes(evidence: _Evidence, left_out: int) -> tuple[str, ...]:
    """Return sentences on the limits of the replays, of which ``left_out`` were not made."""
    notes = []
    if left_out:
        notes.append(
            f"the run is long: {left_out} more replays with newer readings of a node were left out,"
            " those whose readings would be newer by the shortest times"
        )
    if not evidence.same_sends:
        notes.append(
            "with this filter what is sent depends on what has arrived: the replays are exact, the "
            "ages with more messages take later messages as they were"
        )
    return tuple(notes)
