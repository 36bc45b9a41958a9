"""The errors of the filter with intermittent observations along the messages of a run."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence

from netkf.scenario.scenario import Scenario
from netkf.theory.common.observed import Observed
from netkf.theory.common.rules import Rule, Sent
from netkf.theory.common.stacked_errors import Errors
from netkf.trace.run import Run


class Readings(Rule):
    """R (15)-(18): messages are readings, and the noise of a reading is the same at all who use it.

    A late reading is used as if it had come in time. All arrivals are known here beforehand, so a
    node whose late readings come at T keeps, from the first of their times on, a version of its
    estimate that uses all that will have arrived by T; at T it becomes the node's.
    """

    def __init__(self, scenario: Scenario, errors: Errors, messages: Sequence[Sent]) -> None:
        super().__init__(scenario, errors)
        self._at: dict[tuple[int, float], list[Sent]] = {}
        first: dict[tuple[int, float], float] = {}
        for m in messages:
            self._at.setdefault((m.receiver, m.time), []).append(m)
            if m.late:
                key = (m.receiver, m.arrives)
                first[key] = min(first.get(key, m.time), m.time)
        self._first: dict[tuple[int, float], list[float]] = {}
        for (receiver, arrives), time in sorted(first.items()):
            self._first.setdefault((receiver, time), []).append(arrives)
        self._versions: dict[int, list[float]] = {host: [] for host in range(errors.hosts)}
        self._seen: Observed = {}
        self._columns: Mapping[int, slice] = {}

    def sense(self, time: float, seen: Observed) -> None:
        """Every version takes what it will have."""
        self._seen, self._columns = seen, self.errors.readings(seen)
        for host in range(self.errors.hosts):
            self._branch(host, time)
            self._use(host, [host])
            for until in self._versions[host]:
                heard = self._at.get((host, time), [])
                senders = [m.sender for m in heard if m.arrives <= until]
                self._use(("version", host, until), [host, *senders])

    def _branch(self, host: int, time: float) -> None:
        live = self._versions[host]
        for until in self._first.get((host, time), ()):
            before = [t for t in live if t < until]
            source = ("version", host, max(before)) if before else host
            self.errors.copy(source, ("version", host, until), host)
            live.append(until)
            live.sort()

    def _use(self, name: Hashable, nodes: Sequence[int]) -> None:
        for node in nodes:
            if node in self._seen:
                self.errors.update(name, self._seen[node], self._columns[node])

    def arrive(self, time: float, messages: Sequence[Sent]) -> None:
        """What comes in time is used as it comes."""
        for host in {m.receiver for m in messages}:
            if time in self._versions[host]:
                self._versions[host].remove(time)
                self.errors.replace(("version", host, time), host)
            else:
                self._use(host, [m.sender for m in messages if m.receiver == host])


def rule(scenario: Scenario, errors: Errors, run: Run, messages: Sequence[Sent]) -> Rule:
    """The moves of this filter along the messages of a run."""
    return Readings(scenario, errors, messages)
