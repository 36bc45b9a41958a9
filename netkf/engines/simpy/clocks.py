"""Clocks of the network in continuous time: one SimPy process for each clock."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import partial
from typing import Any

from netkf.core.clock import ClockPosition, next_ticks
from netkf.engines.base import Rank
from netkf.engines.simpy.nodes import ClockedNode
from netkf.engines.simpy.timeline import Process, Timeline
from netkf.engines.simpy.transmission import DirectedLink, LinkExchange, Transmitter, stream
from netkf.network.clocks import LinkClock
from netkf.network.node_clocks import node_time, owner_of
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import NAN, Recorder
from netkf.trace.schema import TICK, TRANSMIT

FIRST_BLOCK, MAX_BLOCK = 8, 1024  # ticks of a clock that are drawn at once: at first, and at most

Activation = Callable[[float], None]
"""A callback for the tick of a clock, called with its time in seconds."""


def clock_processes(
    scenario: Scenario,
    streams: Streams,
    timeline: Timeline,
    recorder: Recorder,
    transmitter: Transmitter,
    nodes: dict[int, ClockedNode],
) -> list[Process]:
    """Return a process for each entity with a clock; none if nodes transmit after samples."""
    activation = scenario.network.activation
    if not scenario.node_filter.timing.talks or not isinstance(activation, LinkClock):
        return []
    shared = (scenario, recorder, transmitter, nodes)
    if activation.at == "readings":
        _transmit_after_samples(timeline, *shared)
        return []
    make_activations = {
        "links": _link_activations,
        "directions": _direction_activations,
        "nodes": _node_activations,
    }
    activations = make_activations[activation.at](*shared)
    return [
        _tick_process(scenario, streams, timeline, recorder, entity, k, activate)
        # The index of an entity orders simultaneous ticks.
        for k, (entity, activate) in enumerate(activations)
    ]


def _tick_process(
    scenario: Scenario,
    streams: Streams,
    timeline: Timeline,
    recorder: Recorder,
    entity: tuple[int, ...],
    tick_order: int,
    activate: Activation,
) -> Process:
    clock = scenario.network.activation
    assert isinstance(clock, LinkClock)
    # A stream of its own: the ticks of one entity never depend on those of another.
    random = streams.generator("clock", *entity)
    own = node_time(scenario, streams, owner_of(clock, entity))
    ahead = own.ahead(clock)
    # A random phase is drawn from a stream of its own, and only if the clock asks for one.
    origin = clock.origin(entity, partial(stream, streams, entity, "phase"))
    now, index, count = 0.0, 0, FIRST_BLOCK
    while True:
        # Ticks are drawn in blocks; their times do not depend on the length of a block.
        times = next_ticks(clock, entity, ClockPosition(origin, index, now), random, count)
        # The clock goes on from its own times, and the ticks are the instants nearest to them.
        for time in own.instants(times, ahead).tolist():
            # Half open: a tick at the horizon does not happen.
            if time >= scenario.horizon:
                return
            yield timeline.at(time, Rank.TICK, tick_order)
            activate(time)
        # An empty block: the clock has no more ticks.
        if not len(times):
            return
        recorder.flush_if_full()
        index, now = index + len(times), float(times[-1])
        # Blocks double in length: a slow clock wastes few numbers, a fast one soon draws many at
        # once.
        count = min(2 * count, MAX_BLOCK)


Activations = list[tuple[tuple[int, ...], Activation]]


def _link_activations(
    scenario: Scenario, recorder: Recorder, transmitter: Transmitter, nodes: dict[int, ClockedNode]
) -> Activations:
    """Return for each link what happens at a tick: both ends exchange."""

    def activate(exchange: LinkExchange, i: int, j: int, now: float) -> None:
        if transmitter.up(i, j):
            recorder.append((now, TICK, i, j, -1, -1, NAN))
        # The channel takes its step even where nothing is sent.
        transmitter.begin((i,) if scenario.topology.directed else (i, j))
        payloads: tuple[Any, Any] = (None, None)
        if transmitter.up(i, j) and transmitter.connects(i, j):
            # Both payloads are computed before either end receives.
            first, second = (
                nodes[sender].emit(now, (receiver,)) if transmitter.up(sender) else None
                for sender, receiver in ((i, j), (j, i))
            )
            payloads = first, second
        exchange.exchange(payloads)

    # The index of a link orders simultaneous arrivals.
    return [
        (link, partial(activate, LinkExchange(scenario, transmitter, nodes, link, k), *link))
        for k, link in enumerate(scenario.topology.links)
    ]


def _direction_activations(
    scenario: Scenario, recorder: Recorder, transmitter: Transmitter, nodes: dict[int, ClockedNode]
) -> Activations:
    """Return for each direction what happens at a tick: the sender sends."""

    def activate(direction: DirectedLink, now: float) -> None:
        i, j = direction.link
        if transmitter.up(i):
            recorder.append((now, TICK, i, j, -1, -1, NAN))
        # Drawn in any case: even if nothing is sent, the channel takes its step.
        outcome = direction.sampler.draw()
        transmitter.begin((i,))
        if transmitter.up(i) and transmitter.connects(i, j):
            transmitter.send(direction, nodes[i].emit(now, (j,)), outcome)

    links = _directed_links(scenario, transmitter, nodes)
    return [(direction.link, partial(activate, direction)) for direction in links]


def _directed_links(
    scenario: Scenario, transmitter: Transmitter, nodes: dict[int, ClockedNode]
) -> list[DirectedLink]:
    return [
        DirectedLink(
            scenario, transmitter.first(link), k, nodes[link[1]], transmitter.sampler(link)
        )
        for k, link in enumerate(scenario.topology.directions)
    ]


def broadcasts(
    scenario: Scenario, recorder: Recorder, transmitter: Transmitter, nodes: dict[int, ClockedNode]
) -> dict[int, Activation]:
    """Return for each node, by id, a function of the time that broadcasts one payload to all its
    receivers, to each with an outcome of its own.
    """
    directions: dict[int, list[DirectedLink]] = {node: [] for node in scenario.nodes}
    for direction in _directed_links(scenario, transmitter, nodes):
        directions[direction.link[0]].append(direction)
    sent = dict.fromkeys(scenario.nodes, 0)

    def transmit(node: int, now: float) -> None:
        # Drawn even if the filter sends nothing, so that the network does not depend on it.
        outcomes = [direction.sampler.draw() for direction in directions[node]]
        transmitter.begin((node,))
        if not transmitter.up(node):
            return
        heard = [transmitter.connects(*direction.link) for direction in directions[node]]
        receivers = tuple(d.link[1] for d in itertools.compress(directions[node], heard))
        payload = nodes[node].emit(now, receivers)
        if payload is None:
            return
        # A broadcast is one transmission, numbered by sender; its messages are numbered by link.
        recorder.append((now, TRANSMIT, node, -1, sent[node], -1, NAN))
        sent[node] += 1
        transmitter.occupy(node)
        sends = zip(directions[node], outcomes, strict=True)
        for direction, outcome in itertools.compress(sends, heard):
            transmitter.send(direction, payload, outcome)

    return {node: partial(transmit, node) for node in scenario.nodes}


def _node_activations(
    scenario: Scenario, recorder: Recorder, transmitter: Transmitter, nodes: dict[int, ClockedNode]
) -> Activations:
    """Return for each node, as (id,), what happens at a tick: it broadcasts."""
    transmit = broadcasts(scenario, recorder, transmitter, nodes)

    def activate(node: int, now: float) -> None:
        # The tick has its own row; transmit() adds that of the broadcast if there is one.
        if transmitter.up(node):
            recorder.append((now, TICK, node, -1, -1, -1, NAN))
        transmit[node](now)

    return [((node,), partial(activate, node)) for node in scenario.nodes]


def _transmit_after_samples(
    timeline: Timeline,
    scenario: Scenario,
    recorder: Recorder,
    transmitter: Transmitter,
    nodes: dict[int, ClockedNode],
) -> None:
    """Make nodes broadcast after each sample that they use, without clocks."""
    transmit = broadcasts(scenario, recorder, transmitter, nodes)
    # Only nodes with sampled sensors have samples to transmit after.
    for node in scenario.sampled_sensors:
        clocked_node = nodes[node]

        def transmit_now(now: float, node: int = node, entity: int = clocked_node.entity) -> None:
            # At the rank of ticks: by then all nodes have used their samples of this instant.
            timeline.call_at(now, Rank.TICK, entity, lambda _: transmit[node](now))

        clocked_node.after_sample = transmit_now
