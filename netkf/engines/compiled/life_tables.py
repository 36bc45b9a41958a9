"""Who is down when, as tables made before a run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from netkf.engines.compiled.moving_links import MovingLinks
from netkf.engines.compiled.senders import Senders
from netkf.engines.compiled.state import Instants
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.network.lives import lifetimes
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.trace.schema import CODES


class LifeTable(NamedTuple):
    """The K changes of one run by (time, node): when nodes go up or down.

    t, node, kind : (K,), seconds, index of the node, and kind of the event
    restarts : (K,) bool, whether the node goes up and begins again
    down : (N,), 1 for nodes that are down at first; (1,) without lives
    in_nodes : whether filters are in nodes, and down with them
    """

    t: FloatArray
    node: IntArray
    kind: IntArray
    restarts: np.ndarray
    down: np.ndarray
    in_nodes: bool = True

    @property
    def filters_down(self) -> np.ndarray:
        """1 for filters that are down at first."""
        return self.down if self.in_nodes else np.zeros(1, dtype=np.int64)

    def passed(self, nodes: Any, times: Any) -> IntArray:
        """Return how many changes of ``nodes`` (indices) came until the ``times``, both of any
        shapes that fit; changes of an instant come before all else.
        """
        nodes, times = np.broadcast_arrays(nodes, times)
        counts = np.zeros(nodes.shape, dtype=np.int64)
        for h in np.unique(self.node).tolist():
            own = nodes == h
            counts[own] = np.searchsorted(self.t[self.node == h], times[own], side="right")
        return counts

    def is_down(self, nodes: Any, times: Any) -> np.ndarray:
        """Return whether ``nodes`` (indices) are down at the ``times``, see ``passed``."""
        passed = self.passed(nodes, times)
        down: np.ndarray = (passed + self.down[np.minimum(nodes, len(self.down) - 1)]) % 2 == 1
        return down


_NOTHING: IntArray = np.zeros(0, dtype=np.int64)
NO_LIVES = LifeTable(
    np.zeros(0), _NOTHING, _NOTHING, np.zeros(0, dtype=bool), np.zeros(1, dtype=np.int64)
)


def life_table(scenario: Scenario, streams: Streams) -> LifeTable:
    """Return the lives of a run."""
    if not scenario.network.lives:
        return NO_LIVES
    index, lives = scenario.topology.index, lifetimes(scenario, streams)
    in_nodes = not scenario.node_filter.timing.pooled
    rows = sorted(
        (change.time, index[node], CODES[change.kind], change.up and life.forgets and in_nodes)
        for node, life in lives.items()
        for change in life.changes
    )
    t, nodes, kinds, restarts = zip(*rows, strict=True) if rows else ((),) * 4
    down = np.zeros(len(index), dtype=np.int64)
    down[[index[i] for i, life in lives.items() if not life.up]] = 1
    node, kind = (np.array(column, dtype=np.int64) for column in (nodes, kinds))
    changes = np.array(t, dtype=float), node, kind, np.array(restarts, dtype=bool)
    return LifeTable(*changes, down, in_nodes)


def remove_samples(instants: Instants, lives: LifeTable, index: dict[int, int]) -> None:
    """Take away the samples of nodes that are down, of a filter that reads all sensors: they are of
    no node, and of a sensor without rows; those of a whole instant become some of the one before.
    """
    if not len(instants.t):
        return  # all runs share one of these
    times = np.repeat(instants.t, np.diff(instants.first))
    nodes = np.array([index[node] for node in instants.node.tolist()], dtype=np.int64)
    down = lives.is_down(nodes, times)
    instants.node[down], instants.sensor[down] = -1, len(instants.rows)
    instants.rows = np.append(instants.rows, 0)
    instants.root = np.concatenate([instants.root, np.zeros((1, *instants.root.shape[1:]))])
    kept = np.logical_or.reduceat(~down, instants.first[:-1])
    instants.t, instants.index = instants.t[kept], instants.index[kept]
    instants.first = np.append(instants.first[:-1][kept], instants.first[-1])
    if len(instants.nonlinear.sensor):
        instants.nonlinear.first = instants.first
        instants.nonlinear.sensor[down] = -1


def links_of_lives(
    senders: Senders, listed: Sequence[FloatArray], lives: LifeTable, index: dict[int, int]
) -> MovingLinks:
    """Return which messages of ticks, ``listed`` by entity (s), are sent: of nodes that are up."""
    heard = [np.zeros(0, dtype=bool)] * len(senders.directions)
    for e, times in enumerate(listed):
        for w in senders.outgoing[senders.first[e] : senders.first[e + 1]].tolist():
            heard[w] = ~lives.is_down(index[senders.directions[w][0]], times)
    return MovingLinks(heard, [], _NOTHING, _NOTHING.reshape(0, 3))
