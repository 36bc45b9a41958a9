"""The push-sum filter along the messages of a run: in slots P Fig. 1 with the corrected update of
the mass, under clocks broadcast rounds by running sums.

Under clocks an estimate is a ratio of masses: a node of weight w among N holds the information
``(w / N) (P^-1, P^-1 xhat)``. Every total (U, u) that was sent has an error ``u - U x``. Totals
refer to now: as time passes ``U -> s F^-T U F^-1``, and the error becomes ``s F^-T`` times itself
less ``U w``, s the factor with which old information fades. A node that gains (U, u) and then has
the weight w goes to ``xhat + (N / w) P (u - U xhat)``, and its error to ``e - (N / w) P (U e + u -
U x)``: errors are closed, whatever became of x itself.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg

from netkf.algorithms.push_sum import PushSum
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.observed import Observed
from netkf.theory.common.rules import Rule, Sent
from netkf.theory.common.stacked_errors import Errors
from netkf.theory.numerics.moves import informed
from netkf.trace.run import Run
from netkf.trace.schema import CODES

Up = dict[tuple[int, int, int], FloatArray]


def known_sums(scenario: Scenario, run: Run) -> None:
    """Raise TheoryError where the errors in slots are not known: for frozen or asymptotic gains,
    where the filters' F differs from the plant's, and at the horizon, since the exchanges of a slot
    that begins there are not in the trace.
    """
    algorithm, plant = scenario.filter.algorithm, scenario.slot_plant
    assert isinstance(algorithm, PushSum)
    if algorithm.stop != "never" or algorithm.asymptotic:
        raise TheoryError("the exact errors are known while mass is exchanged in every slot")
    if not np.array_equal(scenario.slot_belief[0], plant.F):
        raise TheoryError("the exact errors are known for filters that have the plant's F")
    if any(sensor.varying for sensor in scenario.sensors):
        raise TheoryError("the exact errors are known for sensors whose H is fixed")
    slots = np.round(run.times / plant.period).astype(int).tolist()
    if slots and plant.over(slots[-1], scenario.horizon):
        words = "the exchanges of the slot at the horizon are not in the trace"
        raise TheoryError(f"{words}: sample before it")


class Averages(Rule):
    """Slots: masses exchanged once, estimates averaged in gamma steps."""

    def __init__(self, scenario: Scenario, errors: Errors, run: Run) -> None:
        super().__init__(scenario, errors)
        algorithm = scenario.filter.algorithm
        assert isinstance(algorithm, PushSum)
        self._gamma, self._delta = int(algorithm.gamma or 1), float(algorithm.delta or math.nan)
        self._up = _arrived(scenario, run, self._gamma)
        self._N, n = len(scenario.nodes), errors.n
        self._nu = np.array([scenario.topology.degrees[node] + 1 for node in scenario.nodes])
        models = scenario.slot_models
        self._own = np.array([m.H.T @ np.linalg.solve(m.R, m.H) for m in models])
        own = self._own.reshape(self._N, n * n)
        self._z = np.concatenate([np.zeros((self._N, 1)), np.ones((self._N, 1)), own], axis=1)
        self._z[scenario.topology.index[algorithm.leader], 0] = 1.0

    def exchange(self, slot: int, phase: int, messages: Sequence[Sent]) -> None:
        """P (3)-(5), and step 5."""
        if phase == 0:
            received = self._received(slot, 0, 0)
            shares = self._z / self._nu[:, None]
            kept = (self._nu - received.sum(axis=1))[:, None]
            self._z = kept * shares + received @ shares
            return
        mixing, hosts = np.eye(self._N), range(self._N)
        for step in range(self._gamma):
            received = self._received(slot, 1, step)
            laplacian = np.diag(received.sum(axis=1)) - received
            mixing = mixing - laplacian @ mixing / self._delta
        forms = self.errors.stack.forms(hosts)
        mixed = np.tensordot(mixing, forms, 1)
        self.errors.stack.put_all(dict(zip(hosts, mixed, strict=True)))

    def _received(self, slot: int, phase: int, step: int) -> FloatArray:
        return self._up.get((slot, phase, step), np.zeros((self._N, self._N)))

    def sense(self, time: float, seen: Observed) -> None:
        """Step 4 with what the mass says of the network, P (6)-(8)."""
        n, errors = self.errors.n, self.errors
        heard = self._z[:, 0] > 0.0
        weight = np.where(heard, self._z[:, 0], 1.0)
        learned = self._z[:, 2:].reshape(self._N, n, n) / weight[:, None, None]
        G = np.where(heard[:, None, None], learned, self._own)
        number = np.where(heard, self._z[:, 1] / weight, 1.0)
        columns = errors.readings(seen)
        for host in range(self._N):
            root = informed(errors.roots[host], G[host])
            if host not in seen:
                errors.roots[host] = root
                continue
            one = seen[host]
            K = number[host] * root @ root.T @ np.linalg.solve(one.R, one.H).T
            errors.move(host, np.eye(n) - K @ one.H, root)
            errors.stack.add(host, columns[host], -K @ one.root)


def _arrived(scenario: Scenario, run: Run, gamma: int) -> Up:
    """By slot, phase and step, (N, N): 1 where what j sent reached i in time."""
    index, size, period = scenario.topology.index, len(scenario.nodes), scenario.slot_plant.period
    rows = run.log[run.log["kind"] == CODES["deliver"]]
    sent, length = rows["t"] - rows["age"], scenario.phase_length
    slot = scenario.slot_plant.slots_of(sent)
    since = sent - slot * period - rows["phase"] * length
    step = np.where(rows["phase"] == 0, 0, np.round(since / (length / gamma))).astype(int)
    up: Up = {}
    columns = (slot, rows["phase"], step, rows["node"], rows["peer"])
    for t, phase, k, node, peer in zip(*(c.tolist() for c in columns), strict=True):
        matrix = up.setdefault((t, phase, k), np.zeros((size, size)))
        matrix[index[node], index[peer]] = 1.0
    return up


class Total(NamedTuple):
    """An amount of mass: weight and information; its error is in the stack."""

    weight: float
    U: FloatArray


class RunningTotals(Rule):
    """Clocks: the weight of each node, the total it ever sent to each hearer, the last totals it
    heard.
    """

    def __init__(
        self, scenario: Scenario, errors: Errors, rounds: Mapping[float, Sequence[int]]
    ) -> None:
        super().__init__(scenario, errors, rounds)
        if errors.follows:
            raise TheoryError("the exact errors are known for filters that have the plant's A")
        plant, n = scenario.truth, errors.n
        self._A, self._rounds = plant.A, rounds
        self._rate = max(0.0, -float(np.linalg.eigvals(plant.A).real.min()))
        self._weights = [1.0] * errors.hosts
        self._totals: dict[Hashable, Total] = {}
        self._number: dict[tuple[int, int], int] = {}
        self._receivers = [0] * errors.hosts
        for sender, _ in scenario.topology.directions:
            self._receivers[scenario.topology.index[sender]] += 1
        for host in range(errors.hosts):
            self._put(("sent", host), Total(0.0, np.zeros((n, n))), np.zeros((n, 0)))

    def _put(self, name: Hashable, total: Total, form: FloatArray) -> None:
        self._totals[name] = total
        self.errors.stack.put(name, form)

    def passed(self, gap: float, columns: slice | None, noise: FloatArray | None) -> None:
        """Totals come to refer to now; the plant's noise is in the inputs ``columns``."""
        if gap <= 0.0 or columns is None or noise is None:
            return
        inverse = np.asarray(scipy.linalg.expm(-gap * self._A))
        fading = math.exp(-2.0 * self._rate * gap)
        for name, total in self._totals.items():
            U = fading * (inverse.T @ total.U @ inverse)
            self._totals[name] = Total(total.weight, U)
            if U.any():
                self.errors.stack.put(name, fading * inverse.T @ self.errors.stack.form(name))
                self.errors.stack.add(name, columns, -U @ noise)

    def sense(self, time: float, seen: Observed) -> None:
        """A sample counts N / w times; then nodes whose turn it is give their shares."""
        columns, number = self.errors.readings(seen), self.errors.hosts
        for host, one in seen.items():
            counted = one._replace(R=one.R * (self._weights[host] / number))
            self.errors.update(host, counted, columns[host])
        for host in self._rounds.get(time, ()):
            self._offer(host)

    def _offer(self, host: int) -> None:
        """The node's mass is ``(w / N) (P^-1, P^-1 xhat)``, with the error ``-(w / N) P^-1 e``."""
        count, name, stack = self._receivers[host], ("sent", host), self.errors.stack
        if count == 0:
            return
        weight, share = self._weights[host], 1.0 / (count + 1)
        inverse = np.linalg.inv(self.errors.roots[host])
        U = (share * weight / self.errors.hosts) * (inverse.T @ inverse)
        before = self._totals[name]
        sent = Total(before.weight + share * weight, before.U + U)
        self._put(name, sent, stack.form(name) - U @ stack.form(host))
        self._weights[host] = weight - count * (sent.weight - before.weight)

    def send(self, messages: Sequence[Sent]) -> None:
        """What will arrive is kept: a total as it was when it was sent."""
        for message in messages:
            name = ("sent", message.sender)
            self._put(message, self._totals[name], self.errors.stack.form(name))

    def arrive(self, time: float, messages: Sequence[Sent]) -> None:
        """A hearer gains what a total grew by; an older one brings nothing."""
        for host in sorted({message.receiver for message in messages}):
            mine = [m for m in messages if m.receiver == host]
            self._gain(host, sorted(mine, key=lambda m: (m.sender, m.number)))
        for message in messages:
            del self._totals[message]
        self.errors.stack.drop(messages)

    def _gain(self, host: int, messages: Sequence[Sent]) -> None:
        errors, n = self.errors, self.errors.n
        weight, U, form = 0.0, np.zeros((n, n)), np.zeros((n, 1))
        for message in messages:
            link, heard = (message.sender, host), ("heard", message.sender, host)
            if message.number <= self._number.get(link, -1):
                continue
            self._number[link] = message.number
            total, news = self._totals[message], errors.stack.form(message)
            last = self._totals.get(heard, Total(0.0, np.zeros((n, n))))
            before = errors.stack.form(heard) if heard in errors.stack else 0.0 * news
            weight, U = weight + total.weight - last.weight, U + total.U - last.U
            form = form + news - before
            self._put(heard, total, news)
        if not weight > 0.0:
            return
        after = self._weights[host] + weight
        share = errors.hosts / after
        scaled = np.sqrt(after / self._weights[host]) * errors.roots[host]
        root = informed(scaled, share * U)
        gain = share * root @ root.T
        errors.stack.put(host, (np.eye(n) - gain @ U) @ errors.stack.form(host) - gain @ form)
        errors.roots[host] = root
        self._weights[host] = after


def _rounds(scenario: Scenario, run: Run) -> dict[float, list[int]]:
    """The places of nodes that began a broadcast, by time."""
    found: dict[float, list[int]] = {}
    rows = run.log[run.log["kind"] == CODES["transmit"]]
    for time, node in zip(rows["t"].tolist(), rows["node"].tolist(), strict=True):
        found.setdefault(time, []).append(scenario.topology.index[node])
    return found


def rule(scenario: Scenario, errors: Errors, run: Run, messages: Sequence[Sent]) -> Rule:
    """The moves of this filter along the messages of a run; raises TheoryError where the errors in
    slots are not known.
    """
    if not scenario.slotted:
        return RunningTotals(scenario, errors, _rounds(scenario, run))
    known_sums(scenario, run)
    return Averages(scenario, errors, run)
