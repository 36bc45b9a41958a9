"""Exact errors of the filter with intermittent observations along the messages of a run."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence

from netkf.scenario.scenario import Scenario
from netkf.theory.common.error_rules import ErrorRule, SentMessage
from netkf.theory.common.observations import EstimatorObservations
from netkf.theory.common.stacked_errors import StackedErrors
from netkf.trace.run import Run


class ReadingExchangeRule(ErrorRule):
    """Updates R (15)-(18) by the node's own readings and those that it receives.

    A reading has the same noise at all nodes that use it, and a late one is used as if it had come
    in time. The replay knows all arrivals beforehand: from the time of a late reading on, the node
    keeps a second version of its estimate that uses all readings which arrive by T, the time at
    which that one arrives. At T the version replaces the node's estimate.
    """

    def __init__(
        self, scenario: Scenario, errors: StackedErrors, messages: Sequence[SentMessage]
    ) -> None:
        """Take the errors at time 0 and all ``messages`` of the run that arrived, from which it is
        known which versions an estimate needs.
        """
        super().__init__(scenario, errors)
        self._sent: dict[tuple[int, float], list[SentMessage]] = {}  # by receiver, time of sending
        first: dict[tuple[int, float], float] = {}  # earliest reading among those that arrive at T
        for m in messages:
            self._sent.setdefault((m.receiver, m.time), []).append(m)
            if m.late:
                key = (m.receiver, m.arrives)
                first[key] = min(first.get(key, m.time), m.time)
        self._branches: dict[tuple[int, float], list[float]] = {}
        for (receiver, arrives), time in sorted(first.items()):
            self._branches.setdefault((receiver, time), []).append(arrives)
        self._versions: dict[int, list[float]] = {
            estimator: [] for estimator in range(errors.estimators)
        }
        self._observations: EstimatorObservations = {}
        self._columns: Mapping[int, slice] = {}

    def sense(self, time: float, observations: EstimatorObservations) -> None:
        """Update each version of each estimate by the readings of ``time`` (seconds, or the slot)
        that arrive before its end; called by the replay before messages of this time arrive. A
        version has all readings that will have arrived by its end, late ones included.
        """
        self._observations, self._columns = observations, self.errors.reading_noises(observations)
        for estimator in range(self.errors.estimators):
            self._branch(estimator, time)
            self._update(estimator, [estimator])
            for until in self._versions[estimator]:
                sent = self._sent.get((estimator, time), [])
                senders = [m.sender for m in sent if m.arrives <= until]
                self._update(("version", estimator, until), [estimator, *senders])

    def _branch(self, estimator: int, time: float) -> None:
        """Start the versions of the estimate of node ``estimator`` that end when late readings of
        ``time`` (seconds) arrive; each is a copy of the version that ends just before it.
        """
        arrivals = self._versions[estimator]
        for until in self._branches.get((estimator, time), ()):
            # A version has all readings that arrive before its end: so far, those of the version
            # that ends just before it.
            earlier = [end for end in arrivals if end < until]
            source = ("version", estimator, max(earlier)) if earlier else estimator
            self.errors.copy(source, ("version", estimator, until), estimator)
            arrivals.append(until)
            arrivals.sort()

    def _update(self, name: Hashable, nodes: Sequence[int]) -> None:
        """Update the error ``name`` and the root of its P by the readings that the ``nodes``
        (indices) took at the present time; nodes without one are skipped.

        ``name`` is the index of an estimate, or ("version", index, T) for its version that ends at
        T. Nodes that use the same reading use the same columns of noise, hence the same noise.
        """
        for node in nodes:
            if node in self._observations:
                self.errors.update(name, self._observations[node], self._columns[node])

    def arrive(self, time: float, messages: Sequence[SentMessage]) -> None:
        """Use readings that come in time, or replace an estimate by its version that ends at
        ``time`` (seconds, or the slot), which has used the late reading as if it had come in time;
        called by the replay when messages arrive.
        """
        for estimator in {m.receiver for m in messages}:
            if time in self._versions[estimator]:
                self._versions[estimator].remove(time)
                self.errors.replace(("version", estimator, time), estimator)
            else:
                self._update(estimator, [m.sender for m in messages if m.receiver == estimator])


def error_rule(
    scenario: Scenario, errors: StackedErrors, run: Run, messages: Sequence[SentMessage]
) -> ErrorRule:
    """Return the rule by which the filter with intermittent observations uses the readings and
    messages of a run. The replay of the run, which computes its exact errors from its events, calls
    the rule at each event; it changes ``errors``, the stacked errors of all nodes.

    ``messages`` are those of the run that arrived (none in slots, where the rule gets them slot by
    slot).
    """
    return ReadingExchangeRule(scenario, errors, messages)
