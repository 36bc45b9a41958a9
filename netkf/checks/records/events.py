"""The events of one run held against the rules of its record, each by a plain formula.

Every fault is one line about the first event that breaks a rule. Ticks and readings are compared
with times that are drawn again from the streams of the run; the order of events of one instant,
the numbers of messages and what becomes of each follow from the scenario.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np

from netkf.algorithms.filter import may_be_silent
from netkf.checks.parts.events import redraw_ticks
from netkf.linalg.arrays import IntArray
from netkf.network.clocks import LinkClock, OnReadings
from netkf.network.matchings import RecordedSlots
from netkf.plants.recorded import RecordedSensor
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run
from netkf.trace.schema import CODES, KINDS, rows_of

SENSE, TICK, SEND, DELIVER, LOST, LATE = (
    CODES[kind] for kind in ("sense", "tick", "send", "deliver", "lost", "late")
)
ABSORB, SWAP, ROUND, STOP, TRANSMIT = (
    CODES[kind] for kind in ("absorb", "swap", "round", "stop", "transmit")
)
CLOCK_RANKS = np.full(len(KINDS), 6)
"""Order of the kinds of events at one instant under clocks: samples, ticks with what they send,
arrivals, absorptions; an arrival without delay is part of its tick.
"""
CLOCK_RANKS[[SENSE, TICK, TRANSMIT, SEND, LOST, DELIVER, LATE, ABSORB]] = 1, 2, 2, 2, 2, 3, 3, 4
STEP_RANKS = np.full(len(KINDS), 1)
"""The same in one step of an exchange of a slot: its round, messages, absorptions."""
STEP_RANKS[[ROUND, ABSORB, SWAP, STOP]] = 0, 2, 2, 2
TIME_TOLERANCE = 1e-9
"""Relative rounding error of times that are computed here by another formula than in the run."""


def event_fault(scenario: Scenario, run: Run) -> str:
    """Return one line about the first fault of the record of a run's events; empty without one."""
    # Links are looked at at ticks and at samples, before or after other events of the instant;
    # gates and quantisers stand between the events of several nodes.
    others = {"link", "crash", "restart", "join", "leave", "refuse", "clip"}
    rules = [_ordered, _numbered, _decided, _absorbed]
    rules += [_read_in_slots, _sent_in_slots] if scenario.slotted else [_read, _ticked, _caused]
    if scenario.network.lives:
        # What is read, sent, lost and absorbed depends on who is up.
        others, rules = others | {"lost"}, rules[:2]
    log = rows_of(run.log, *set(KINDS) - others)
    for rule in rules:
        for fault in rule(scenario, run, log):
            return fault
    return ""


def _describe(log: IntArray, row: int) -> str:
    event = log[row]
    names = [f"node {event['node']}"] if event["node"] >= 0 else []
    names += [f"peer {event['peer']}"] if event["peer"] >= 0 else []
    return f"event {row}, {KINDS[event['kind']]} of {', '.join(names)} at {event['t']:.9g} s"


def _first(wrong: np.ndarray) -> int | None:
    return int(np.argmax(wrong)) if wrong.any() else None


def _ordered(scenario: Scenario, run: Run, log: Any) -> Iterator[str]:
    if (row := _first(~np.isfinite(log["t"]) | (log["t"] < 0.0))) is not None:
        yield f"{_describe(log, row)} has no time of the run"
    if (row := _first(np.diff(log["t"]) < 0.0)) is not None:
        yield f"{_describe(log, row + 1)} comes after a later one"
    if scenario.slotted:
        yield from _ordered_steps(log)
        return
    kinds = log["kind"]
    inside_tick = np.isin(kinds, (DELIVER, LATE)) & (log["age"] == 0.0)
    rank = np.where(inside_tick, CLOCK_RANKS[TICK], CLOCK_RANKS[kinds])
    same = np.diff(log["t"]) == 0.0
    if (row := _first(same & (np.diff(rank) < 0))) is not None:
        yield f"{_describe(log, row + 1)} comes after {KINDS[kinds[row]]} of the same instant"
    # All absorptions of an instant are in the order of nodes.
    absorbs = np.flatnonzero(kinds == ABSORB)
    order = np.diff(log["node"][absorbs])
    if (k := _first((np.diff(log["t"][absorbs]) == 0.0) & (order <= 0))) is not None:
        yield f"{_describe(log, int(absorbs[k + 1]))} is out of the order of nodes"


def _ordered_steps(log: Any) -> Iterator[str]:
    # A message that takes time may arrive in a later exchange, where it is late.
    rows = np.flatnonzero((log["phase"] >= 0) & (log["kind"] != LATE))
    steps = np.cumsum(log["kind"][rows] == ROUND)
    rank = STEP_RANKS[log["kind"][rows]]
    # Without rounds (matchings) a phase of one slot is one step, which ends with its swaps.
    same = (np.diff(steps) == 0) & (np.diff(log["phase"][rows]) == 0)
    same &= (np.diff(log["t"][rows]) == 0.0) | (steps[1:] > 0)
    if (k := _first(same & (np.diff(rank) < 0))) is not None:
        yield f"{_describe(log, int(rows[k + 1]))} comes after the end of its exchange"


def _numbered(scenario: Scenario, run: Run, log: Any) -> Iterator[str]:
    import pandas as pd

    links = set(scenario.topology.directions)
    for kind in (SEND, TRANSMIT):
        rows = np.flatnonzero(log["kind"] == kind)
        ends = pd.DataFrame({name: log[name][rows] for name in ("node", "peer")})
        for row in rows[~ends.duplicated()].tolist() if kind == SEND else ():
            if (int(log["node"][row]), int(log["peer"][row])) not in links:
                yield f"{_describe(log, row)} is on no link"
        expected = ends.groupby(["node", "peer"]).cumcount().to_numpy()
        if (k := _first(log["message"][rows] != expected)) is not None:
            row = int(rows[k])
            yield f"{_describe(log, row)} has number {log['message'][row]}, not {expected[k]}"


def _decided(scenario: Scenario, run: Run, log: Any) -> Iterator[str]:
    import pandas as pd

    # A message is sent and lost by the node of its row, but arrives there.
    arrives, node, peer = np.isin(log["kind"], (DELIVER, LATE)), log["node"], log["peer"]
    table = pd.DataFrame({"row": np.arange(len(log)), "message": log["message"]})
    table["sender"], table["receiver"] = np.where(arrives, (peer, node), (node, peer))
    sends = table[log["kind"] == SEND]
    ends, keys = table[arrives | (log["kind"] == LOST)], ["sender", "receiver", "message"]
    joined = ends.merge(sends, on=keys, how="left", suffixes=("", "_sent"))
    rows, last = ends["row"].to_numpy(), log[ends["row"]]
    if (k := _first(joined["row_sent"].isna().to_numpy())) is not None:
        yield f"{_describe(log, int(rows[k]))} is of message {last['message'][k]}, never sent"
        return
    places = joined["row_sent"].to_numpy(dtype=np.int64)
    sent, is_lost = log[places], last["kind"] == LOST
    if (k := _first(ends.duplicated(keys).to_numpy())) is not None:
        yield f"{_describe(log, int(rows[k]))} is a second end of message {last['message'][k]}"
    if (k := _first(rows < places)) is not None:
        yield f"{_describe(log, int(rows[k]))} comes before message {last['message'][k]} is sent"
    age = np.where(is_lost, 0.0, last["age"])
    taken = scenario.time_grid.snap(last["t"] - sent["t"])
    if (k := _first(~(taken == age) | (last["phase"] != sent["phase"]))) is not None:
        yield (
            f"{_describe(log, int(rows[k]))} is {taken[k]:.9g} s after its "
            f"message was sent in phase {sent['phase'][k]}, not {age[k]:.9g} s"
        )
    is_open = log["kind"] == SEND
    is_open[places] = False
    waiting = log["t"][is_open]
    longest = scenario.longest_delay
    limit = scenario.horizon * (1.0 - TIME_TOLERANCE)
    if run.status == "complete" and (waiting + longest < limit).any():
        yield (
            f"{int((waiting + longest < limit).sum()):,} messages are neither delivered nor lost, "
            f"the first sent at {waiting.min():.9g} s"
        )


def _absorbed(scenario: Scenario, run: Run, log: Any) -> Iterator[str]:
    import pandas as pd

    kinds = log["kind"]
    if scenario.slotted and scenario.node_filter.timing.pairwise:
        swaps, arrivals = (np.flatnonzero(kinds == kind) for kind in (SWAP, DELIVER))
        fields = ["node", "peer", "message", "phase"]
        one, other = (np.sort(log[rows][fields]) for rows in (swaps, arrivals))
        # Messages of the last exchange may arrive in a slot that is not recorded to its end.
        if not np.array_equal(one, other):
            yield f"{len(swaps):,} swaps for {len(arrivals):,} messages delivered in pairs"
        return
    step = np.cumsum(kinds == ROUND) if scenario.slotted else log["t"]
    table = pd.DataFrame({"step": step, "node": log["node"]})
    reached, absorbed = (
        table[kinds == kind].value_counts(sort=False).sort_index() for kind in (DELIVER, ABSORB)
    )
    for (_, node), count in absorbed[absorbed > 1].items():
        yield f"node {node} absorbs {count} times in one exchange"
    for at, node in reached.index.difference(absorbed.index) if run.status == "complete" else ():
        yield f"node {node} never absorbs what reaches it at {at:.9g}"
    for at, node in absorbed.index.difference(reached.index):
        yield f"node {node} absorbs what never reached it at {at:.9g}"


def _read(scenario: Scenario, run: Run, log: Any) -> Iterator[str]:
    if run.status != "complete":
        return
    sampled = scenario.sample_times(Streams(run.seed, run.replica))
    period = (scenario.diffusion.sensing_period if scenario.plant.linear else None) or math.inf
    senses, tolerance = log[log["kind"] == SENSE], TIME_TOLERANCE * scenario.horizon
    for node in scenario.sensing_nodes:
        times = [times for (owner, _), times in sampled.items() if owner == node]
        expected = np.unique(np.concatenate([np.empty(0), *times]))
        if node in scenario.increment_sensors:
            count = math.ceil(scenario.horizon / period * (1.0 + TIME_TOLERANCE))
            grid = period * np.arange(1, count + 1)
            expected = np.sort(np.concatenate([expected, grid[grid < scenario.horizon]]))
        taken = senses["t"][senses["node"] == node]
        # Rounding may put the last one on either side of the horizon.
        inside = expected < scenario.horizon - tolerance
        if len(taken) not in (int(inside.sum()), len(expected)):
            yield f"node {node} has {len(taken):,} sense events, not {len(expected):,}"
        elif (k := _first(~(np.abs(taken - expected[: len(taken)]) <= tolerance))) is not None:
            yield f"sense of node {node} at {taken[k]:.9g} s should be at {expected[k]:.9g} s"


def _ticked(scenario: Scenario, run: Run, log: Any) -> Iterator[str]:
    clock = scenario.network.activation
    silent = not scenario.node_filter.timing.talks or run.status != "complete"
    if silent or not isinstance(clock, LinkClock) or isinstance(clock, OnReadings):
        return
    entities = list(clock.entities(scenario.topology))
    times = redraw_ticks(scenario, entities, run.seed, run.replica)
    owner = np.repeat(np.arange(len(entities)), [len(part) for part in times])
    drawn = np.concatenate([np.empty(0), *times])
    order = np.lexsort((owner, drawn))
    ends = np.array([(*entity, -1)[:2] for entity in entities]).reshape(-1, 2)[owner[order]]
    rows = np.flatnonzero(log["kind"] == TICK)
    if len(rows) != len(drawn):
        yield f"{len(rows):,} ticks, not the {len(drawn):,} of the clocks"
        return
    ticks = log[rows]
    wrong = (ticks["t"] != drawn[order]) | (ticks["node"] != ends[:, 0])
    wrong |= ticks["peer"] != ends[:, 1]
    if (k := _first(wrong)) is not None:
        yield (
            f"{_describe(log, int(rows[k]))} should be that of {ends[k].tolist()} at "
            f"{drawn[order][k]:.9g} s"
        )


def _caused(scenario: Scenario, run: Run, log: Any) -> Iterator[str]:
    kinds = log["kind"]
    clock: Any = scenario.network.activation
    by_link = getattr(clock, "at", "links") in ("links", "directions")
    causes = np.flatnonzero(kinds == (TICK if by_link else TRANSMIT))
    sends = np.flatnonzero(kinds == SEND)
    if not len(sends) and not len(causes):
        return
    block = np.searchsorted(causes, sends) - 1
    if len(sends) and (not len(causes) or (block < 0).any()):
        yield f"{_describe(log, int(sends[0]))} follows no tick of its sender"
        return
    cause, sent = log[causes[block]], log[sends]
    fits = (cause["t"] == sent["t"]) & (cause["node"] == sent["node"])
    if by_link:
        forth = fits & (cause["peer"] == sent["peer"])
        back = (cause["node"] == sent["peer"]) & (cause["peer"] == sent["node"])
        fits = forth | (back & (cause["t"] == sent["t"]) & (clock.at == "links"))
    if (k := _first(~fits)) is not None:
        yield f"{_describe(log, int(sends[k]))} follows no tick of its sender"
    if by_link:
        both = clock.at == "links" and not scenario.topology.directed
        expected = np.full(len(causes), 2 if both else 1)
    else:
        receivers = Counter(sender for sender, _ in scenario.topology.directions)
        expected = np.array([receivers[node] for node in log["node"][causes].tolist()], dtype=int)
    counts = np.bincount(block, minlength=len(causes))
    # A link of which neither end sends anything is silent by design; half an exchange is not. A
    # broadcast goes to those in range.
    in_range = not by_link and scenario.topology.radius is not None
    wrong = counts > expected if in_range else (counts != expected) & (counts > 0)
    if (k := _first(wrong)) is not None:
        yield f"{_describe(log, int(causes[k]))} sends {counts[k]} messages, not {expected[k]}"


def _slots(scenario: Scenario) -> int:
    return math.ceil(scenario.horizon / scenario.slot_plant.period * (1.0 - 1e-12) - 1e-9)


def _read_in_slots(scenario: Scenario, run: Run, log: Any) -> Iterator[str]:
    if run.status != "complete" or "sense" not in (scenario.node_filter.timing.schedule or ()):
        return
    expected = np.arange(0 if scenario.node_filter.timing.predicts else 1, _slots(scenario))
    senses = log[log["kind"] == SENSE]
    slots = scenario.slot_plant.slots_of(senses["t"])
    for node in scenario.placed_sensors:
        taken = slots[senses["node"] == node]
        if not np.array_equal(taken, expected):
            yield f"node {node} senses {len(taken):,} times, not once in {len(expected):,} slots"


def _sent_in_slots(scenario: Scenario, run: Run, log: Any) -> Iterator[str]:
    algorithm, activation = scenario.node_filter, scenario.network.activation
    if run.status != "complete" or not algorithm.timing.talks or may_be_silent(algorithm):
        return
    kinds = log["kind"]
    if algorithm.timing.pairwise:
        ticks, messages = (int((kinds == kind).sum()) for kind in (TICK, SEND))
        # Pairs that are out of range send nothing.
        if messages > 2 * ticks or (messages < 2 * ticks and scenario.topology.radius is None):
            yield f"{messages:,} messages of {ticks:,} pairs"
        return
    is_recorded = any(isinstance(sensor, RecordedSensor) for sensor in scenario.sensors)
    # What a gate refuses is not sent where messages have readings.
    unsure = is_recorded or isinstance(activation, RecordedSlots) or scenario.filter.gate
    if not unsure:
        yield from _sent_in_rounds(scenario, log)


def _sent_in_rounds(scenario: Scenario, log: Any) -> Iterator[str]:
    algorithm, kinds = scenario.node_filter, log["kind"]
    phases = range(algorithm.timing.exchanges)
    steps = [algorithm.timing.steps(phase) for phase in phases]
    rounds = log["phase"][kinds == ROUND]
    slots = _slots(scenario) - algorithm.timing.first_exchange
    expected = np.tile(np.repeat(np.array(phases, dtype=int), steps), max(slots, 0))
    if not np.array_equal(rounds, expected):
        yield f"{len(rounds):,} rounds of exchanges, not {len(expected):,} in order"
        return
    if scenario.topology.radius is not None:
        return
    sends = np.flatnonzero(kinds == SEND)
    step = np.searchsorted(np.flatnonzero(kinds == ROUND), sends) - 1
    senders = [
        [
            direction
            for direction in scenario.topology.directions
            if algorithm.timing.sends(phase, direction[0] in scenario.placed_sensors)
        ]
        for phase in phases
    ]
    wanted = np.array([len(listed) for listed in senders], dtype=int)[expected]
    sent = np.bincount(step, minlength=len(rounds))
    if (row := _first(sent != wanted)) is not None:
        yield f"{sent[row]} messages in round {row} of the run, not {wanted[row]}"
