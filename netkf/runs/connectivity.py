"""How often links and nodes are up, and in how many parts the network falls."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar, Literal

import numpy as np
import scipy

from netkf.linalg.arrays import FloatArray
from netkf.network.clocks import RecordedClock
from netkf.network.contacts import Contacts
from netkf.network.graphs import node_columns
from netkf.network.lives import Lifetime
from netkf.network.matchings import RecordedSlots
from netkf.network.recorded import RecordedLoss
from netkf.network.spectra import connected_parts
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import Sink
from netkf.trace.schema import CODES, join_rows, rows_of

RECENT = 5.0
"""Mean intervals between messages for which a link is up after one was heard, by messages."""
MAX_AT_ONCE = 1 << 24
"""Links times samples that are looked at together."""
MAX_FULL = 64
"""Nodes up to which parts are found in a full matrix: importing scipy.sparse takes longer."""


class ConnectivitySink(Sink):
    """Looks at the samples of a run which links are up, and in how many parts the nodes that are up
    fall.

    A link is up while both ends are and it is in range (``range`` graphs) or in contact
    (``contacts``), and where activations or losses are recorded while its newest message heard is
    RECENT. Parts are joined by links in both directions, or by some in either direction if the
    whole graph has no more. ``lives`` are those of the run, by node; with ``by_messages`` its
    messages say which links are up as if they were recorded.
    """

    thread_safe: ClassVar[bool] = True

    def __init__(
        self, scenario: Scenario, lives: Mapping[int, Lifetime], by_messages: bool = False
    ) -> None:
        self._scenario, self._lives, topology = scenario, lives, scenario.topology
        network = scenario.network
        self._contacts = network.activation if isinstance(network.activation, Contacts) else None
        recorded = isinstance(network.activation, RecordedClock | RecordedSlots)
        recorded = recorded or isinstance(network.channel.loss, RecordedLoss)
        self.by_messages = recorded or by_messages
        parts = topology.radius, self._contacts
        self.changes = bool(lives) or self.by_messages or parts != (None, None)
        self._ends = topology.direction_ends
        number = {link: k for k, link in enumerate(topology.links)}
        # The link of each direction: its own of a directed graph.
        links = [number.get((i, j), number.get((j, i))) for i, j in topology.directions]
        self._links = np.array(links, dtype=int)
        self._strength: Literal["strong", "weak"] = "strong"
        if self._parts(np.ones(len(self._ends), dtype=bool))[0] > 1:
            self._strength = "weak"
        self._heard: list[np.ndarray] = []
        self._sent, self._samples = 0, list[tuple[FloatArray, np.ndarray]]()
        self._alike = 0
        self.count = self.connected = self.components = 0
        self.up = np.zeros(len(self._ends), dtype=np.int64)
        self.nodes_connected = np.zeros(len(topology.nodes), dtype=np.int64)

    def events(self, rows: np.ndarray) -> None:
        """Keep the messages heard, where they say which links are up."""
        if self.by_messages:
            self._sent += int((rows["kind"] == CODES["send"]).sum())
            self._heard.append(rows_of(rows, "deliver"))

    def states(
        self, t: FloatArray, x: FloatArray, xhat: FloatArray, P: FloatArray, error: FloatArray
    ) -> None:
        """Look at all links at T times t (T,) in seconds with the true states x (T, n)."""
        if not self.changes:
            self._alike += len(t)
            return
        at_once = max(1, MAX_AT_ONCE // max(1, len(self._ends)))
        for k in range(0, len(t), at_once):
            part = slice(k, k + at_once)
            links = self._links_up(t[part], x[part])
            if self.by_messages:
                self._samples.append((t[part], links))
            else:
                self._look(t[part], links)

    def _links_up(self, t: FloatArray, x: FloatArray) -> np.ndarray:
        """Return the links (T, D) that are in range and in contact."""
        topology, positions = self._scenario.topology, self._scenario.positions
        up = np.ones((len(t), len(self._ends)), dtype=bool)
        if topology.radius is not None:
            for time, state, row in zip(t.tolist(), x, up, strict=True):
                distances = [positions.distance(link, time, state) for link in topology.links]
                row[:] = np.array(distances, dtype=np.float64)[self._links] <= topology.radius
        if self._contacts is not None:
            for d, (i, j) in enumerate(topology.directions):
                entity = (i, j) if self._contacts.at == "directions" else (min(i, j), max(i, j))
                up[:, d] &= self._contacts.in_contact(entity, t)
        return up

    def _parts(self, up: np.ndarray) -> tuple[int, np.ndarray]:
        """Return in how many parts the links ``up`` (D,) join the nodes, and that of each (N,)."""
        size, ends, topology = len(self._scenario.nodes), self._ends[up].T, self._scenario.topology
        if up.all() and not topology.directed:  # known without scipy, whose import takes its time
            labels = np.empty(size, dtype=int)
            for k, part in enumerate(topology.components):
                labels[[topology.index[node] for node in part]] = k
            return len(topology.components), labels
        if size <= MAX_FULL:
            graph: Any = np.zeros((size, size))
            graph[ends[0], ends[1]] = 1.0
        else:
            graph = scipy.sparse.coo_array((np.ones(len(ends[0])), tuple(ends)), shape=(size, size))
        return connected_parts(graph, self._strength)

    def _look(self, t: FloatArray, links: np.ndarray) -> None:
        """Count the samples at ``t`` (T,), when these ``links`` (T, D) are up if their ends are."""
        nodes = np.ones((len(t), len(self.nodes_connected)), dtype=bool)
        for node, life in self._lives.items():
            # A change takes effect before the sample of its instant.
            changes = np.searchsorted([change.time for change in life.changes], t, side="right")
            nodes[:, self._scenario.topology.index[node]] = life.up ^ (changes % 2 == 1)
        links &= nodes[:, self._ends[:, 0]] & nodes[:, self._ends[:, 1]]
        states = np.packbits(np.concatenate([links, nodes], axis=1), axis=1)
        _, first, weights = np.unique(states, axis=0, return_index=True, return_counts=True)
        for k, weight in zip(first.tolist(), weights.tolist(), strict=True):
            self._add(links[k], nodes[k], weight)

    def _add(self, up: np.ndarray, alive: np.ndarray, weight: int) -> None:
        """Count ``weight`` samples with the links ``up`` (D,) and the nodes ``alive`` (N,)."""
        _, labels = self._parts(up)
        sizes = np.bincount(labels[alive], minlength=1)
        parts = int((sizes > 0).sum())
        self.count += weight
        self.connected += weight * (parts == 1)
        self.components += weight * parts
        self.up += weight * up
        self.nodes_connected[alive] += weight * (sizes[labels[alive]] == sizes.max())

    def finish(self) -> None:
        """Look at the samples that waited for all messages, or are alike."""
        if self._alike:
            nodes = np.ones(len(self.nodes_connected), dtype=bool)
            self._add(np.ones(len(self._ends), dtype=bool), nodes, self._alike)
            self._alike = 0
        for t, links in self._samples:
            newest = np.stack([*self.newest_heard(t)], axis=1) if len(self._ends) else links * 1.0
            interval = self._scenario.horizon * len(self._ends) / max(self._sent, 1)
            is_recent = (t[:, None] - newest <= RECENT * interval) & (newest > 0.0)
            self._look(t, links & is_recent)
        self._samples = []

    def newest_heard(self, t: FloatArray) -> Iterator[FloatArray]:
        """Yield for each directed link when its newest message heard was sent (T,), 0 without."""
        rows, size = join_rows(self._heard), len(self._scenario.nodes)
        sender, receiver = (
            np.searchsorted(self._scenario.nodes, rows[n]) for n in ("peer", "node")
        )
        order = np.argsort(sender * size + receiver, kind="stable")
        rows, link = rows[order], (sender * size + receiver)[order]
        for i, j in self._ends.tolist():
            first, last = np.searchsorted(link, [i * size + j, i * size + j + 1])
            yield newest_heard(rows["t"][first:last], sent_at(rows[first:last]), t)

    def entry(self) -> dict[str, Any]:
        """Return the entry of summary.json: share of samples connected, mean number of components,
        and, unless messages tell it, by link the share of samples at which it is up.
        """
        count, topology = max(self.count, 1), self._scenario.topology
        shares = dict(zip(topology.directions, (self.up / count).tolist(), strict=True))
        entry: dict[str, Any] = {
            "samples": self.count,
            "connected": self.connected / count if self.count else None,
            "components": self.components / count if self.count else None,
        }
        if self.by_messages:
            return entry
        entry["links"] = [
            {
                **node_columns(i),
                "peer": j,
                "up": shares[i, j] if topology.directed else min(shares[i, j], shares[j, i]),
            }
            for i, j in topology.links
        ]
        return entry

    def shares(self) -> FloatArray:
        """Return shares (N + 1,) of samples with each node in a largest part, and all in one."""
        with np.errstate(invalid="ignore"):
            return np.append(self.nodes_connected, self.connected) / np.float64(self.count)


def sent_at(arrivals: np.ndarray) -> FloatArray:
    """Return when the messages of EVENT rows (K,) of kind deliver were sent, in seconds."""
    return np.asarray(arrivals["t"] - np.nan_to_num(arrivals["age"]))


def newest_heard(arrived: FloatArray, sent: FloatArray, t: FloatArray) -> FloatArray:
    """Return when the newest message that arrived by ``t`` (T,) was sent (s), 0 without one, of
    messages in the order in which they ``arrived`` (K,).
    """
    # A message that overtakes others makes them old before they arrive.
    newest = np.concatenate([[0.0], np.maximum.accumulate(sent)])
    return np.asarray(newest[np.searchsorted(arrived, t, side="right")])
