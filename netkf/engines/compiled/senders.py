"""Which entities have clocks, and on which directed links each of them sends."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.core.clock import Entity
from netkf.engines.compiled.per_scenario import once_per_scenario
from netkf.network.clocks import LinkClock
from netkf.network.graphs import Link
from netkf.scenario.scenario import Scenario


class Senders(NamedTuple):
    """The clocks of a network and the directed links on which each tick sends.

    at : kind of clock: "links", "directions", "nodes" or "readings"
    entities : the E entities with a clock; nodes for "readings"
    directions : the W directed links, in the order in which simultaneous messages arrive
    first, outgoing : (E + 1,) and (W,), entity e sends on the directed links with the indices
                      ``outgoing[first[e]:first[e + 1]]``
    sources, source : keys of the random streams of losses and delays, and the index (W,) of the
                      stream of each direction; directions that share a stream share a draw at each
                      tick
    """

    at: str
    entities: tuple[Entity, ...]
    directions: tuple[Link, ...]
    first: np.ndarray
    outgoing: np.ndarray
    sources: tuple[Link, ...]
    source: np.ndarray


@once_per_scenario
def senders_of(scenario: Scenario) -> Senders:
    """Return the senders of a scenario; none if the filter sends no messages."""
    topology, clock = scenario.topology, scenario.network.activation
    # In slots there is no link clock.
    if not scenario.node_filter.timing.talks or not isinstance(clock, LinkClock):
        no_links = np.zeros(0, dtype=np.int64)
        return Senders("links", (), (), np.zeros(1, dtype=np.int64), no_links, (), no_links)
    if clock.at == "links":
        return link_senders(topology.links, topology.directed, scenario.network.channel.symmetric)
    directions = topology.directions
    indices = np.arange(len(directions))
    # Each direction has a clock, and sends on itself only.
    if clock.at == "directions":
        first = np.arange(len(directions) + 1)
        return Senders(clock.at, directions, directions, first, indices, directions, indices)
    # Nodes have clocks: each sends on all directed links that leave it.
    senders = np.array([topology.index[i] for i, _ in directions], dtype=np.int64)
    counts = np.bincount(senders, minlength=len(topology.nodes))
    first = np.concatenate([[0], np.cumsum(counts)])
    entities = tuple((node,) for node in topology.nodes)
    # Stable, so that the links of a node keep the order in which messages arrive.
    outgoing = np.argsort(senders, kind="stable")
    return Senders(clock.at, entities, directions, first, outgoing, directions, indices)


def link_senders(links: tuple[Link, ...], directed: bool, symmetric: bool) -> Senders:
    """Return the senders where both ends of a link send at a time, or, if links are ``directed``,
    the first one. ``symmetric``: both share a stream.
    """
    if directed:
        indices = np.arange(len(links))
        return Senders("links", links, links, np.arange(len(links) + 1), indices, links, indices)
    # Both directions of a link are neighbours, forth and back, so that 2 k and 2 k + 1 belong to
    # link k.
    directions = tuple(direction for i, j in links for direction in ((i, j), (j, i)))
    indices = np.arange(len(directions))
    first = np.arange(0, len(directions) + 1, 2)
    # Both directions share the stream of their link.
    if symmetric:
        return Senders("links", links, directions, first, indices, links, indices // 2)
    return Senders("links", links, directions, first, indices, directions, indices)
