"""Many slots made at once, where messages arrive at once or never and nothing depends on states.

What ``Exchanges`` does a message at a time, with the same numbers from the same streams.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from netkf.engines.compiled.exchanges import (
    ABSORB,
    DELIVER,
    EXCHANGING,
    LOST,
    MOST_ROWS,
    ROUND,
    SEND,
    SENSE,
    SWAP,
    TICK,
    Exchanges,
    Programme,
    Slots,
    silent,
)
from netkf.engines.compiled.masses import stopping
from netkf.linalg.arrays import FloatArray
from netkf.network.channels import identical_per_link
from netkf.network.graphs import Link
from netkf.network.matchings import Broadcast, Matching
from netkf.rng.draws import StreamBatch
from netkf.rng.streams import ReplicaStreams, Streams
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import NAN
from netkf.trace.schema import EVENT


def way_chances(scenario: Scenario, ways: Sequence[Sequence[Link]]) -> FloatArray:
    """(ways, L): the delivery probability of all messages of each direction of each link."""
    loss = scenario.network.channel.loss
    return np.array(
        [
            [
                loss.delivery_probability(way, 0, False, scenario.table_probability(way))
                for way in some
            ]
            for some in ways
        ]
    )


def way_luck(
    scenario: Scenario, streams: Streams | ReplicaStreams, ways: Sequence[Sequence[Link]]
) -> list[StreamBatch]:
    """What decides about them: of both ways together where they share their fate, and nothing where
    nothing is left to decide.
    """
    channel = scenario.network.channel
    drawn = ways[:1] if channel.symmetric else ways
    return (
        [] if channel.loss.deterministic else [StreamBatch(streams, "loss", some) for some in drawn]
    )


def is_plain(scenario: Scenario) -> bool:
    """Whether the slots of a scenario can be made so."""
    network = scenario.network
    return (
        identical_per_link(network.channel.loss)
        and network.channel.delay.fixed == 0.0
        and isinstance(network.activation, Matching | Broadcast)
        and stopping(scenario) is None
    )


def make_exchanges(scenario: Scenario, streams: Streams) -> Exchanges | PlainExchanges:
    """The faster of the two that can do it."""
    return (PlainExchanges if is_plain(scenario) else Exchanges)(scenario, streams)


class Exchange(NamedTuple):
    """One step of an exchange: which ``item`` of what is done it is, when it begins and closes,
    which phase it is, whether fates are drawn anew, and whether its events are recorded.
    """

    item: int
    now: float
    end: float
    phase: int
    fresh: bool
    noted: bool


class PlainExchanges(Programme):
    """Makes the slots of one run."""

    def __init__(self, scenario: Scenario, streams: Streams) -> None:
        super().__init__(scenario)
        algorithm, topology = self._algorithm, scenario.topology
        self._random = streams.generator("matching")
        links = topology.links if algorithm.talks else ()
        self._place = {link: k for k, link in enumerate(links)}
        self._nodes = np.array(scenario.nodes, dtype=np.int64)
        ends = np.array([[topology.index[i], topology.index[j]] for i, j in links], dtype=np.int64)
        ends = ends.reshape(-1, 2)
        ways = [links] if topology.directed else [links, tuple((j, i) for i, j in links)]
        self._sender = ends[:, : len(ways)]
        self._receiver = ends[:, ::-1][:, : len(ways)]
        self._weight = np.array([[scenario.weight(j, i) for i, j in some] for some in ways]).T
        self._chance = way_chances(scenario, ways).T
        self._draws = way_luck(scenario, streams, ways)
        self._luck = np.zeros((len(links), max(1, len(self._draws))))
        self._known = np.zeros(len(links), dtype=bool)
        self._sent = np.zeros(self._sender.shape, dtype=np.int64)
        quiet = silent(scenario)
        phases = range((algorithm.schedule or ()).count("exchange"))
        talks = [[(node, phase) not in quiet for node in scenario.nodes] for phase in phases]
        self._talks = np.array(talks, dtype=bool).reshape(len(phases), len(scenario.nodes))
        steps = sum(algorithm.steps(phase) for phase in phases)
        rows = len(scenario.sensing) + steps * (2 * self._sender.size + len(scenario.nodes))
        self._together = max(1, MOST_ROWS // max(rows, 1))

    def following(self) -> Slots | None:
        """The next slots; None when all is done."""
        if self._over:
            return None
        self._begin()
        self._exchanges: list[Exchange] = []
        self._pairs: list[list[int]] = []
        self._sensed: list[tuple[int, float]] = []
        while not self._over and len(self._slots) < self._together:
            self._over = self._one_slot()
        return self._made()

    def _arrivals(self, until: float) -> None:
        """Everything arrives when it is sent."""

    def _sense(self, now: float) -> None:
        if self._noted:
            self._sensed.append((len(self._done), now))

    def _reached(self) -> int:
        return len(self._done)

    def _exchange(self, now: float, end: float, slot: int, phase: int, step: int) -> None:
        fresh, activation = (
            self._algorithm.redraws_links(phase, step),
            self._scenario.network.activation,
        )
        made = Exchange(len(self._done), now, end, phase, fresh, self._noted)
        self._exchanges.append(made)
        if isinstance(activation, Matching):
            pairs = activation.draw(self._scenario.topology, self._random)
            self._pairs.append([self._place[pair] for pair in pairs])
        self._done.append([EXCHANGING, phase, 0, 0])

    def _made(self) -> Slots:
        item, now, end, phase, fresh, noted = (
            np.array(column, dtype=dtype)
            for column, dtype in zip(
                zip(*self._exchanges, strict=True) if self._exchanges else [()] * 6,
                (np.int64, np.float64, np.float64, np.int64, bool, bool),
                strict=True,
            )
        )
        count, links = len(item), len(self._place)
        if isinstance(self._scenario.network.activation, Matching):
            at = np.repeat(np.arange(count), [len(pairs) for pairs in self._pairs])
            link = np.array([k for pairs in self._pairs for k in pairs], dtype=np.int64)
        else:
            at, link = np.divmod(np.arange(count * links), max(links, 1))
        sends = self._talks[phase[at, None], self._sender[link]]
        lost, number = self._fates(link, fresh[at], sends)
        arrived = sends & ~lost
        which, way = np.nonzero(arrived)
        receiver, sender = self._receiver[link[which], way], self._sender[link[which], way]
        order = np.lexsort((sender, receiver, at[which]))
        which, way, receiver, sender = (part[order] for part in (which, way, receiver, sender))
        first = np.searchsorted(at[which], np.arange(count))
        after = np.searchsorted(at[which], np.arange(count), side="right")
        for k, place in enumerate(item.tolist()):
            self._done[place][2:] = int(first[k]), int(after[k])
        parts = [self._senses(), self._messages(item, now, phase, at, link, sends, lost, number)]
        node, peer, message = self._nodes[receiver], self._nodes[sender], number[which, way]
        e = at[which]
        if self._algorithm.pairwise:
            parts.append(_rows(item[e], 2, end[e], SWAP, node, peer, message, phase[e], 0.0))
        else:
            new = (np.diff(receiver, prepend=-1) != 0) | (np.diff(e, prepend=-1) != 0)
            e, node = e[new], node[new]
            parts.append(_rows(item[e], 2, end[e], ABSORB, node, -1, -1, phase[e], 0.0))
            parts.append(_rows(item, 0, now, ROUND, -1, -1, -1, phase, NAN))
        heard = np.ones(len(self._done), dtype=bool)
        heard[item] = noted
        items, turns, rows = (np.concatenate(column) for column in zip(*parts, strict=True))
        kept = heard[items]
        items, turns, rows = items[kept], turns[kept], rows[kept]
        order = np.lexsort((turns, items))
        before = np.searchsorted(items[order], [place for _, _, place in self._sampled])
        done = np.array(self._done, dtype=np.int64).reshape(-1, 4).T.copy()
        return Slots(
            done[0],
            done[1],
            done[2],
            done[3],
            receiver,
            sender,
            self._weight[link[which], way],
            self._slots,
            [
                (slot, time, int(row))
                for (slot, time, _), row in zip(self._sampled, before, strict=True)
            ],
            rows[order],
        )

    def _fates(
        self, link: np.ndarray, fresh: np.ndarray, sends: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Whether messages are lost and their numbers, (A, ways) each, of the activations of these
        links (A,) one after the other.
        """
        order = np.argsort(link, kind="stable")
        links, fresh = link[order], fresh[order].copy()
        starts = np.diff(links, prepend=-1) != 0
        begin = np.flatnonzero(starts)
        group = np.cumsum(starts) - 1
        fresh |= starts & ~self._known[links]
        made = np.cumsum(fresh)
        here = made - (made - fresh)[begin][group]  # how many of the link so far
        counts = np.bincount(links[fresh], minlength=len(self._known))
        luck = self._luck[links]
        for k, draws in enumerate(self._draws):
            drawn = draws.units(np.arange(len(counts)), counts)
            luck[here > 0, k] = drawn[made[here > 0] - 1]
        sent = np.cumsum(sends[order], axis=0)
        sent -= sends[order]  # before each
        numbers = sent - sent[begin][group] + self._sent[links]
        lasts = np.append(begin[1:], len(links)) - 1 if len(links) else begin
        self._known[links], self._luck[links[lasts]] = True, luck[lasts]
        self._sent[links[lasts]] = numbers[lasts] + sends[order][lasts]
        lost = np.empty(sends.shape, dtype=bool)
        number = np.empty(sends.shape, dtype=np.int64)
        lost[order], number[order] = luck >= self._chance[links], numbers
        return lost, number

    def _senses(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        sensing = np.array(self._scenario.sensing, dtype=np.int64)
        item, now = (
            np.repeat(np.array([sensed[k] for sensed in self._sensed]), len(sensing))
            for k in range(2)
        )
        node = np.tile(sensing, len(self._sensed))
        return _rows(item.astype(np.int64), 0, now, SENSE, node, -1, -1, -1, NAN)

    def _messages(
        self,
        item: np.ndarray,
        now: FloatArray,
        phase: np.ndarray,
        at: np.ndarray,
        link: np.ndarray,
        sends: np.ndarray,
        lost: np.ndarray,
        number: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of each activation the tick of a pair, and what is sent each way, delivered or lost."""
        ways, pairwise = sends.shape[1], self._algorithm.pairwise
        size = len(link), pairwise + 2 * ways
        there, rows = np.zeros(size, dtype=bool), np.empty(size, dtype=EVENT)
        rows["t"], rows["phase"] = now[at, None], phase[at, None]
        rows["message"], rows["age"] = -1, NAN
        if pairwise:
            there[:, 0] = True
            rows["kind"][:, 0] = TICK
            rows["node"][:, 0] = self._nodes[self._sender[link, 0]]
            rows["peer"][:, 0] = self._nodes[self._receiver[link, 0]]
        for way in range(ways):
            out, back = pairwise + 2 * way, pairwise + 2 * way + 1
            one = self._nodes[self._sender[link, way]]
            other = self._nodes[self._receiver[link, way]]
            gone = lost[:, way]
            there[:, out] = there[:, back] = sends[:, way]
            rows["message"][:, out] = rows["message"][:, back] = number[:, way]
            rows["kind"][:, out], rows["kind"][:, back] = SEND, np.where(gone, LOST, DELIVER)
            rows["node"][:, out], rows["peer"][:, out] = one, other
            rows["node"][:, back] = np.where(gone, one, other)
            rows["peer"][:, back] = np.where(gone, other, one)
            rows["age"][:, back] = np.where(gone, NAN, 0.0)
        items = np.broadcast_to(item[at, None], size)[there]
        return items, np.ones(len(items), dtype=np.int64), rows[there]


def _rows(
    item: np.ndarray,
    turn: int,
    t: FloatArray,
    kind: int,
    node: np.ndarray | int,
    peer: np.ndarray | int,
    message: np.ndarray | int,
    phase: np.ndarray | int,
    age: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, to which item of what is done each belongs, and its turn in it."""
    rows = np.empty(len(item), dtype=EVENT)
    rows["t"], rows["kind"], rows["node"], rows["peer"] = t, kind, node, peer
    rows["message"], rows["phase"], rows["age"] = message, phase, age
    return item, np.full(len(item), turn, dtype=np.int64), rows
