"""The events of a run replayed on stacked errors: one driver for clocks and one for slots, over the
same moves (theory/stacked_errors.py) and the same rules of filters (theory/rules.py).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from netkf.algorithms.registry import overridden
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, square_root
from netkf.scenario.scenario import Scenario
from netkf.theory.common.observed import Observed, hosts_of, in_slots, sampled
from netkf.theory.common.papers import paper_module
from netkf.theory.common.rules import Rule, Sent
from netkf.theory.common.stacked_errors import Clock, Errors
from netkf.theory.numerics.gaps import Gap
from netkf.trace.run import Run
from netkf.trace.schema import CODES


def replay(scenario: Scenario, run: Run) -> tuple[FloatArray, FloatArray]:
    """(T, M n, M n): covariance of the errors of M hosts at ``run.times``, M = 1 where all nodes
    share one filter; and (T, M, n, n), their P.
    """
    errors_known(scenario)
    errors = Errors(scenario, len(hosts_of(scenario)))
    if scenario.slotted:
        moments = _slots(scenario, run, errors)
    else:
        moments = _instants(scenario, run, errors)
    pairs = [(errors.covariance(), errors.covariances()) for _ in moments]
    if not pairs:
        n = errors.n
        return np.empty((0, errors.hosts * n, errors.hosts * n)), np.empty((0, errors.hosts, n, n))
    return np.array([whole for whole, _ in pairs]), np.array([P for _, P in pairs])


def errors_known(scenario: Scenario) -> None:
    """Raise TheoryError where the equations of the filter are not known here."""
    algorithm = scenario.filter.algorithm
    name = type(algorithm).__name__
    if not scenario.hosted.combination:
        raise TheoryError(f"no exact error covariance for {name}")
    own = overridden(algorithm)
    if own:
        raise TheoryError(
            f"the exact error covariance is not known: {name} defines {own[0]} itself"
        )


def delivered(scenario: Scenario, run: Run) -> list[Sent]:
    """All messages of a run that arrived to be used, in the order of their arrival."""
    index, log = scenario.topology.index, run.log
    sends = log[log["kind"] == CODES["send"]]
    times = dict(
        zip(
            zip(*(sends[c].tolist() for c in ("node", "peer", "message")), strict=True),
            sends["t"].tolist(),
            strict=True,
        )
    )
    rows = log[log["kind"] == CODES["deliver"]]
    found = []
    for t, node, peer, message in zip(
        *(rows[c].tolist() for c in ("t", "node", "peer", "message")), strict=True
    ):
        sent = times.get((peer, node, message), t)
        found.append(Sent(index[peer], index[node], message, sent, t))
    return found


def _instants(scenario: Scenario, run: Run, errors: Errors) -> Iterator[None]:
    """Stops where the run was sampled."""
    messages = delivered(scenario, run)
    rule, clock = _rule(scenario, errors, run, messages), Clock(scenario, errors)
    samples = sampled(scenario, run)
    leaving, coming = _by_time(messages, 3), _by_time(messages, 4)
    happens = iter(sorted({*samples, *leaving, *coming, *rule.times}))
    following = next(happens, np.inf)
    for time in run.times.tolist():
        while following <= time:
            rule.passed(*clock.advance(following))
            rule.sense(following, samples.get(following, {}))
            rule.send(leaving.get(following, ()))
            if following in coming:
                rule.arrive(following, coming[following])
            following = next(happens, np.inf)
        rule.passed(*clock.advance(time))
        yield


def _exchanged(scenario: Scenario, run: Run) -> dict[tuple[int, int], list[Sent]]:
    """By slot and exchange, the messages that were in time."""
    rows, index = run.log[run.log["kind"] == CODES["deliver"]], scenario.topology.index
    slots = scenario.slot_plant.slots_of(rows["t"])
    found: dict[tuple[int, int], list[Sent]] = {}
    columns = (slots, *(rows[c] for c in ("phase", "node", "peer", "message")))
    for slot, phase, node, peer, message in zip(*(c.tolist() for c in columns), strict=True):
        sent = Sent(index[peer], index[node], message, slot, slot)
        found.setdefault((slot, max(phase, 0)), []).append(sent)
    return found


def _by_time(messages: list[Sent], column: int) -> dict[float, list[Sent]]:
    found: dict[float, list[Sent]] = {}
    for message in messages:
        found.setdefault(message[column], []).append(message)
    return found


def _rule(scenario: Scenario, errors: Errors, run: Run, messages: list[Sent]) -> Rule:
    if not scenario.hosted.paper:
        return Rule(scenario, errors)
    made: Rule = paper_module(scenario, "errors").rule(scenario, errors, run, messages)
    return made


def _slots(scenario: Scenario, run: Run, errors: Errors) -> Iterator[None]:
    """Stops where the run was sampled: before a slot, or after it for filters whose samples are
    filtered.
    """
    phases, plant = scenario.hosted.schedule or (), scenario.slot_plant
    F, Q = scenario.slot_belief
    noise = square_root(plant.Q)
    gap = Gap(plant.F, F, plant.F - F, noise, noise, square_root(Q))
    rule = _rule(scenario, errors, run, [])
    readings, arrivals = in_slots(scenario, run), _exchanged(scenario, run)
    slot = 0
    for until in np.round(run.times / plant.period).astype(int).tolist():
        while slot < until:
            at = slot if scenario.hosted.predicts else slot + 1
            _slot(rule, gap, phases, at, readings(at), arrivals)
            slot += 1
        yield


def _slot(
    rule: Rule,
    gap: Gap,
    phases: tuple[str, ...],
    slot: int,
    seen: Observed,
    arrivals: dict[tuple[int, int], list[Sent]],
) -> None:
    exchange = 0
    for phase in phases:
        if phase == "predict":
            rule.errors.predict(gap)
        elif phase == "sense":
            rule.sense(slot, seen)
        else:
            rule.exchange(slot, exchange, arrivals.get((slot, exchange), []))
            exchange += 1
