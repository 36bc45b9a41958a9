"""Exact errors of affine filters under clocks, from their own verbs.

The log of a run is repeated row by row. Given its events, all that filters compute is affine in the
first state and in all noises: their verbs, as linear maps (``linear_verbs``), are applied to forms
of these (``forms``). A filter needs no rule of its own for that.
"""

from __future__ import annotations

import bisect
from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import numpy as np

from netkf.engines.compiled.life_tables import life_table
from netkf.engines.compiled.samples import entries_of
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.network.node_clocks import node_times
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.theory.common.columns import LoggedColumns
from netkf.theory.common.forms import MEAN, Forms
from netkf.theory.common.increments import IncrementFlows, increment_flows
from netkf.theory.common.linear_verbs import LinearVerbs
from netkf.theory.common.observations import Observation, timed_observations
from netkf.trace.run import Run
from netkf.trace.schema import ABSORB, CRASH, DELIVER, JOIN, LEAVE, RESTART, SEND, SENSE, TRANSMIT

LARGE, CHECKS = 1e4, 256
"""Size of the true state, in standard deviations of an error, from which on the origin moves, and
how often that is checked at least.
"""


class Sent(NamedTuple):
    """A message under way: its number among the payloads, when and by whom (index) it was sent, its
    number on its link, and H (p, n) and the rows (p,) of the reading that goes with it, if any.
    """

    payload: int
    time: float
    sender: int
    number: int
    reading: tuple[FloatArray, IntArray] | None


class ClockColumns(LoggedColumns):
    """The errors of M estimators under clocks; the first n rows of the forms are the true state."""

    def __init__(self, scenario: Scenario, run: Run) -> None:
        self._scenario = scenario
        self._run = run
        columns = (run.log[name].tolist() for name in ("t", "kind", "node", "peer", "message"))
        self._log = list(zip(*columns, strict=True))
        self._forms_of_all = forms = Forms(scenario.plant.n * (len(scenario.nodes) + 1))
        plant = cast(Any, scenario.plant)
        self.n = plant.n
        self._x, self._entries = forms.take(self.n), entries_of(scenario)
        first = forms.inputs(plant.start_root.shape[1])
        forms.table[self._x, MEAN] = plant.start_mean
        forms.table[self._x, first : forms.used] = plant.start_root
        streams, self._index = Streams(run.seed, run.replica), scenario.topology.index
        self._lives = life_table(scenario, streams)
        self._samples = timed_observations(scenario, streams, is_up=self._is_up)
        rows = max((len(o.H) for s in self._samples.values() for o in s.values()), default=0)
        self._delivered = _delivered(self._log)
        self._filters = LinearVerbs(
            scenario, forms, _most_messages(self._log, self._delivered), rows
        )
        self.estimators = self._filters.estimators
        self._clocks = node_times(scenario, Streams(run.seed, run.replica))
        self._times = [self._clock_reading(h, 0.0) for h in range(self.estimators)]
        super().__init__()
        self._now = 0.0
        self._response = self._begin_response()
        self._free = list(range(self._filters.messages))[::-1]
        self._uses: Counter[int] = Counter()
        self._source: int | None = None
        self._sent: dict[tuple[int, int, int], Sent] = {}
        self._inboxes: dict[int, list[Sent]] = {}
        self._read: dict[int, tuple[float, FloatArray, IntArray]] = {}
        # The state grows by less than e in between; other filters do not commute with a shift.
        rate = max(np.abs(plant.A).sum(axis=0).max(), CHECKS / scenario.horizon)
        movable = not len(plant.changes) and np.array_equal(scenario.belief[0], plant.A)
        self._forgetful = frozenset(scenario.forgetful_nodes)
        # Those whose continuous sensors are silent at time 0, as their nodes are down.
        waking = [self._index[node] for node in scenario.waking_nodes]
        self._silent = {h for h in waking if self._lives.down[h]}
        # A node that begins again does so with a mean that does not move along, and one whose clock
        # is wrong is at another time.
        movable = movable and not (self._forgetful or self._clocks or scenario.views)
        self._checked, self._unit = 0.0, 1.0 / rate if movable else np.inf
        self._changes = plant.changes[plant.changes < scenario.horizon].tolist()
        self._followed = scenario.followed_changes.tolist()
        self._begin_piece(0)
        clock = cast(Any, scenario.network.activation)
        broadcasts = clock is not None and clock.at in ("nodes", "readings")
        self._shared = broadcasts and not self._filters.kernels.addressed
        links = self._filters.run
        self._link = {
            (int(links.sender[w]), h): w
            for h in range(len(links.first) - 1)
            for w in range(links.first[h], links.first[h + 1])
        }

    def _begin_response(self) -> Any:
        """Return the response that estimates are counted from, as the clock of their node shows,
        and let nodes begin there; None if it is that of the truth.
        """
        scenario, believed = self._scenario, self._scenario.origin_response
        if believed is None or not self._clocks:
            return None
        for h, shown in enumerate(self._times):
            if shown != 0.0:
                self._filters.restart(h, scenario.prior_shift(scenario.nodes[h], shown))
        return believed

    def _is_up(self, node: int, time: float) -> bool:
        lives = self._scenario.network.lives
        return not lives or not self._lives.is_down(self._index[node], time)

    def _begin_piece(self, piece: int) -> None:
        if piece < len(self._scenario.model_pieces):
            self._filters.clocked.begin_piece(piece)
        self._lay_laws(piece)
        clocks = [self._clocks.get(node) for node in self._scenario.nodes[: self.estimators]]
        paces = [1.0 if clock is None else clock.pace for clock in clocks]
        self._flows_of_all = increment_flows(self._scenario, self.estimators, piece, paces)
        self._begin_flows()

    def _begin_flows(self) -> None:
        """Let increments reach those that are not silent from now on."""
        for node in self._scenario.waking_nodes:
            h = self._index[node]
            self._filters.clocked.set_reading(h, h not in self._silent)
        self._flows: IncrementFlows | None = self._flows_of_all
        if self._silent and self._flows is not None:
            self._flows = self._flows.without(self._silent)

    def _change_life(self, node: int, time: float) -> None:
        """Let the continuous sensors of a node (id) fall silent at ``time`` (s), or read again."""
        h = self._index[node]
        self._move_truth(time)
        gap = self._gap(h, time)
        if gap > 0.0:
            self._filters.predict(h, gap)
        self._silent ^= {h}
        self._begin_flows()

    def _move_all(self, time: float) -> None:
        self._move_truth(time)
        self._move_increments(time)
        for h in range(self.estimators):
            gap = self._gap(h, time)
            if gap > 0.0:
                self._filters.predict(h, gap)

    def _apply(self, time: float, kind: int, node: int, peer: int, message: int) -> None:
        if kind == SENSE:
            self._sense(0 if self._scenario.node_filter.timing.pooled else self._index[node], time)
        elif kind == TRANSMIT and self._shared:
            h = self._index[node]
            gap = self._gap(h, time)
            self._release(self._source)
            self._source = self._take()
            self._filters.emit(h, gap, self._source)
        elif kind == SEND:
            self._send((node, peer, message), time)
        elif kind == DELIVER:
            self._inboxes.setdefault(node, []).append(self._sent.pop((peer, node, message)))
        elif kind == ABSORB and node in self._inboxes:
            self._absorb(node, time)
        elif kind in (CRASH, LEAVE, RESTART, JOIN) and node in self._scenario.waking_nodes:
            self._change_life(node, time)
        if kind in (RESTART, JOIN) and node in self._forgetful:
            h = self._index[node]
            shown = self._times[h] = self._clock_reading(h, time)
            self._filters.restart(h, self._scenario.prior_shift(node, shown))

    def _move_truth(self, time: float) -> None:
        """Move the true state to ``time``, with an input for each noise of the plant."""
        gap, forms = time - self._now, self._forms_of_all
        if gap <= 0.0 or self._flows is not None:
            return
        F, root = self._law(gap)
        first = forms.inputs(self.n)
        forms.table[self._x, : forms.used] = F @ forms.table[self._x, : forms.used]
        forms.table[self._x, first : first + self.n] = root
        if self._scenario.surprise is not None:
            before, after = self._scenario.surprise.states(np.array([self._now, time]))
            forms.table[self._x, MEAN] += after - F @ before
        self._now = time

    def _keep_digits(self, nodes: Sequence[int]) -> None:
        """Move the origin if the state is so large that errors of ``nodes`` lose digits."""
        if not self._now >= self._checked + self._unit:
            return
        self._checked, forms = self._now, self._forms_of_all
        x = forms.table[self._x, : forms.used]
        size, variance = (x * x).sum(axis=1), (self._filters.roots[nodes] ** 2).sum(axis=-1)
        if (size > LARGE**2 * variance).any():
            self._move_origin()

    def _move_origin(self) -> None:
        forms, scenario = self._forms_of_all, self._scenario
        offset = -forms.table[self._x, : forms.used]
        for h in range(self.estimators):
            self._filters.shift(h, self._gap(h, self._now), offset)
        under_way = [*self._sent.values(), *(m for inbox in self._inboxes.values() for m in inbox)]
        for payload, time in {m.payload: m.time for m in under_way}.items():
            back = [scenario.move_back(e, self._now - time) for e in np.eye(self.n)]
            self._filters.shift_message(payload, np.column_stack(back) @ offset)
        forms.table[self._x, : forms.used] = 0.0

    def _move_increments(self, time: float) -> None:
        flows, filters, forms = self._flows, self._filters, self._forms_of_all
        if flows is None or time <= self._now:
            return
        flows.advance(forms, self._x, filters.xhat_rows, filters.roots, (self._now, time))
        self._now = time
        for h in flows.reading:
            self._times[h] = self._clock_reading(h, time)
        self._keep_digits(flows.reading)

    def _gap(self, h: int, time: float) -> float:
        """Return the seconds, of its clock, over which to predict node h to ``time``."""
        self._move_increments(time)
        shown = self._clock_reading(h, time)
        self._filters.run.now = shown
        if self._clocks:
            # Its model changes when its clock shows the time of a change.
            self._filters.clocked.begin_piece(bisect.bisect_right(self._followed, shown))
        gap, self._times[h] = shown - self._times[h], shown
        return gap

    def _clock_reading(self, h: int, time: float) -> float:
        """Return what the clock of node h shows at ``time``, both in seconds."""
        clock = self._clocks.get(self._scenario.nodes[h])
        return time if clock is None else clock.shows(time)

    def _ahead(self, h: int, time: float) -> FloatArray:
        """Return by how much (n,) the origin of node h is ahead of the truth's at ``time``."""
        assert self._response is not None
        shown, true = self._response.states(np.array([self._clock_reading(h, time), time]))
        return np.asarray(shown - true)

    def _stamped_age(self, h: int, message: Sent, time: float) -> tuple[float, FloatArray | None]:
        """Return the age that the stamp of a message tells node h at ``time``, and by how much what
        it tells moves, (n,), if it is taken for one of another time than that of its stamp.
        """
        instant, shown = self._scenario.time_grid.instant, self._clock_reading(h, time)
        stamp = self._clock_reading(message.sender, message.time)
        age = min(max(instant(shown - stamp), 0.0), instant(shown - self._clock_reading(h, 0.0)))
        taken_for = instant(shown - age)
        if self._response is None or taken_for == stamp:
            return age, None
        origin, other = self._response.states(np.array([stamp, taken_for]))
        return age, np.asarray(origin - other)

    def _move_message(self, message: Sent, moved: FloatArray) -> None:
        """Let what a message tells be counted from an origin that has ``moved`` (n,) back."""
        offset = np.zeros((self.n, self._forms_of_all.used))
        offset[:, MEAN] = moved
        self._filters.shift_message(message.payload, offset)
        if message.reading is not None:
            H, rows = message.reading
            self._forms_of_all.table[rows, MEAN] += H @ moved

    def _sense(self, h: int, time: float) -> None:
        observation: Observation | None = self._samples.get(time, {}).pop(h, None)
        if observation is None or not len(observation.H):
            return
        self._move_truth(time)
        self._move_increments(time)
        self._keep_digits([h])
        forms = self._forms_of_all
        first = forms.inputs(observation.root.shape[1])
        H, noise = self._whiten(observation)
        y = H @ forms.table[self._x, : forms.used]
        y[:, first:] += noise
        if self._response is not None:
            y[:, MEAN] -= H @ self._ahead(h, time)
        if self._filters.kernels.sends_readings:
            _, _, old = self._read.pop(h, (0.0, H, self._x[:0]))
            forms.give(old)
            rows = forms.take(len(H))
            forms.table[rows, : forms.used] = y
            self._read[h] = time, H, rows
        self._filters.update(h, self._gap(h, time), H[:, self._entries[h]], y)

    def _send(self, key: tuple[int, int, int], time: float) -> None:
        node, peer, number = key
        h, filters, forms = self._index[node], self._filters, self._forms_of_all
        arrives = key in self._delivered
        if not (arrives or (filters.kernels.counts_sends and not self._shared)):
            return
        if self._shared:
            assert self._source is not None
            m = self._source
        else:
            gap, m = self._gap(h, time), self._take()
            if filters.kernels.addressed:
                filters.run.receiver = self._link.get((self._index[peer], h), -1)
            filters.emit(h, gap, m)
        if not arrives:
            self._release(m)
            return
        if self._shared:
            self._uses[m] += 1
        reading = None
        if h in self._read and self._read[h][0] == time:
            _, H, rows = self._read[h]
            copied = forms.take(len(rows))
            forms.table[copied, : forms.used] = forms.table[rows, : forms.used]
            reading = H, copied
        self._sent[key] = Sent(m, time, h, number, reading)

    def _take(self) -> int:
        m = self._free.pop()
        self._uses[m] = 1
        return m

    def _release(self, m: int | None) -> None:
        """Give back a message if nobody else waits for it."""
        if m is None:
            return
        self._uses[m] -= 1
        if self._uses[m] == 0:
            self._filters.forget(m)
            self._free.append(m)

    def _absorb(self, node: int, time: float) -> None:
        h, filters, scenario = self._index[node], self._filters, self._scenario
        run, forms = filters.run, self._forms_of_all
        gap = self._gap(h, time)
        all_heard = sorted(self._inboxes.pop(node), key=lambda m: (m.sender, m.time, m.number))
        inbox = all_heard
        if scenario.node_filter.timing.newest_only:
            inbox = list({message.sender: message for message in inbox}.values())
        readings, moved = [], list[tuple[Sent, FloatArray]]()
        for k, message in enumerate(inbox):
            run.message[k] = message.payload
            run.age[k], offset = self._stamped_age(h, message, time)
            if offset is not None:
                self._move_message(message, offset)
                moved.append((message, offset))
            run.link[k] = self._link[message.sender, h]
            run.message_weight[k] = run.weight[run.link[k]]
            run.heard[k] = -1
            if message.reading is not None:
                readings.append(message.reading)
                run.heard[k] = len(readings)
        run.count = len(inbox)
        filters.absorb(h, gap, [message.payload for message in inbox], readings)
        for message, offset in moved:
            # Others take it for what it is to them.
            self._move_message(message, -offset)
        for message in all_heard:
            self._release(message.payload)
            if message.reading is not None:
                forms.give(message.reading[1])

    def _forms(self) -> FloatArray:
        table, used = self._forms_of_all.table, self._forms_of_all.used
        estimates = table[self._filters.xhat_rows.reshape(-1), :used]
        errors = np.asarray(table[self._x[self._entries.ravel()], :used] - estimates)
        if self._response is not None:
            ahead = [self._ahead(h, self._now) for h in range(self.estimators)]
            errors[:, MEAN] -= np.concatenate(ahead)
        return errors

    def covariances(self) -> FloatArray:
        """Return P (M, n, n) of the estimators."""
        S = np.tril(self._filters.roots)
        return np.asarray(S @ np.swapaxes(S, 1, 2))

    def keep(self) -> None:
        """Store the present errors for ``law``."""
        self._kept.append(self._forms_of_all.freeze(self._forms()))


def _delivered(log: list[tuple[Any, ...]]) -> set[tuple[int, int, int]]:
    return {(peer, node, message) for _, kind, node, peer, message in log if kind == DELIVER}


def _most_messages(log: list[tuple[Any, ...]], delivered: set[tuple[int, int, int]]) -> int:
    """Return a number of messages that are never under way at once."""
    under_way, most, waiting = 0, 0, Counter[int]()
    for _, kind, node, peer, message in log:
        if kind == SEND and (node, peer, message) in delivered:
            under_way += 1
            most = max(most, under_way)
        elif kind == DELIVER:
            waiting[node] += 1
        elif kind == ABSORB:
            under_way -= waiting.pop(node, 0)
    return most + 3
