"""Replay of a run's events on stacked errors.

One driver for clocks and one for slots, over the same operations on errors
(theory/common/stacked_errors.py) and the same rules of filters (theory/common/error_rules.py).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from netkf.algorithms.registry import overridden
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, square_root
from netkf.scenario.scenario import Scenario
from netkf.theory.common.arrivals import with_last_exchanges
from netkf.theory.common.columns import ErrorColumns, SlotColumns, has_columns
from netkf.theory.common.error_rules import ErrorRule, SentMessage
from netkf.theory.common.evidence import NONLINEAR
from netkf.theory.common.observations import (
    EstimatorObservations,
    nodes_by_estimator,
    slot_observations,
    timed_observations,
)
from netkf.theory.common.papers import paper_module
from netkf.theory.common.stacked_errors import ErrorPropagator, StackedErrors
from netkf.theory.numerics.prediction import Prediction
from netkf.trace.run import Run
from netkf.trace.schema import CODES


def replay_covariances(scenario: Scenario, run: Run, about_mean: bool = True) -> FloatArray:
    """Return the exact joint error covariance (T, M n, M n) of M estimators at ``run.times``, given
    the events of the run (ticks, losses, delays): the run is replayed on the errors alone. Unless
    ``about_mean``, they are second moments: filters may start elsewhere than the plant.

    An estimator is a node's filter, or (M = 1) the pooled one that all nodes share. Raises
    TheoryError for a filter whose equations are not known here.
    """
    errors, replay = _begin_replay(scenario, run)
    # The generator stops at each sample, when the errors have their values of that time.
    joint = errors.covariance if about_mean else errors.second_moments
    covariances = [joint() for _ in replay]
    size = errors.estimators * errors.n
    return np.array(covariances).reshape(-1, size, size)


class ErrorLaw(NamedTuple):
    """The Gaussian law of the errors of M estimators at T times given the events of a run.

    ``mean`` (T M n,) and ``covariance`` (T M n, T M n) of all errors together, ``P`` (T, M, n, n).
    """

    mean: FloatArray
    covariance: FloatArray
    P: FloatArray


def replay_law(scenario: Scenario, run: Run) -> ErrorLaw:
    """Return the joint Gaussian law of the errors of M estimators at all T ``run.times``, of which
    there must be some: mean (T M n,), covariance (T M n, T M n), and P (T, M, n, n) by the filter's
    equations.

    Raises TheoryError for a filter whose equations are not known here.
    """
    (errors, replay), P = _begin_replay(scenario, run), []
    for _ in replay:
        errors.keep()
        P.append(errors.covariances())
    return ErrorLaw(*errors.law(), np.array(P))


def _begin_replay(
    scenario: Scenario, run: Run
) -> tuple[ErrorColumns | StackedErrors, Iterator[None]]:
    """Return the errors at time 0 of all estimators of a scenario (the filters of its nodes, or one
    pooled filter), and the replay of a run on them, which stops at each of ``run.times``; raises
    TheoryError for a filter whose equations are not known here.
    """
    if not scenario.is_linear:
        raise TheoryError(NONLINEAR)
    if scenario.slotted:
        run = with_last_exchanges(scenario, run)
        if has_columns(scenario):
            columns = SlotColumns(scenario, run)
            return columns, columns.replay()
    require_known_filter(scenario)
    errors = StackedErrors(scenario, len(nodes_by_estimator(scenario)))
    replay = _replay_slots if scenario.slotted else _replay_instants
    return errors, replay(scenario, run, errors)


def require_known_filter(scenario: Scenario) -> None:
    """Raise TheoryError if the equations of the scenario's filter are not known here."""
    algorithm = scenario.filter.algorithm
    name = type(algorithm).__name__
    if not scenario.is_linear:
        raise TheoryError(NONLINEAR)
    if not scenario.node_filter.combination:
        raise TheoryError(f"no exact error covariance for {name}")
    overridden_names = overridden(algorithm)
    if overridden_names:
        raise TheoryError(
            f"the exact error covariance is not known: {name} defines {overridden_names[0]} itself"
        )


def delivered_messages(scenario: Scenario, run: Run) -> list[SentMessage]:
    """Return all messages of a run that arrived and were used, in the order of their arrival."""
    index, log = scenario.topology.index, run.log
    sends = log[log["kind"] == CODES["send"]]
    # A message is known by its sender, receiver and number; `deliver` rows name the receiver first.
    sent_at = dict(
        zip(
            zip(*(sends[c].tolist() for c in ("node", "peer", "message")), strict=True),
            sends["t"].tolist(),
            strict=True,
        )
    )
    rows = log[log["kind"] == CODES["deliver"]]
    messages = []
    for t, node, peer, message in zip(
        *(rows[c].tolist() for c in ("t", "node", "peer", "message")), strict=True
    ):
        sent = sent_at.get((peer, node, message), t)
        messages.append(SentMessage(index[peer], index[node], message, sent, t))
    return messages


def _replay_instants(scenario: Scenario, run: Run, errors: StackedErrors) -> Iterator[None]:
    """Apply the events of a run in continuous time to the stacked ``errors``, which it changes;
    yield at each of ``run.times``, so that the caller can read the errors then.
    """
    messages = delivered_messages(scenario, run)
    rule = _make_rule(scenario, errors, run, messages)
    propagator = ErrorPropagator(scenario, errors)
    samples = timed_observations(scenario, run)
    leaving = _group_by_time(messages, SentMessage._fields.index("time"))
    arriving = _group_by_time(messages, SentMessage._fields.index("arrives"))
    instants = iter(sorted({*samples, *leaving, *arriving, *rule.times}))
    following = next(instants, np.inf)
    for time in run.times.tolist():
        while following <= time:
            rule.elapse(*propagator.advance(following))
            # At one instant nodes sample before they send, and send before they receive.
            rule.sense(following, samples.get(following, {}))
            rule.send(leaving.get(following, ()))
            if following in arriving:
                rule.arrive(following, arriving[following])
            following = next(instants, np.inf)
        rule.elapse(*propagator.advance(time))
        yield


def _exchanged_messages(scenario: Scenario, run: Run) -> dict[tuple[int, int], list[SentMessage]]:
    """Return the messages that arrived in time, by slot and number of the exchange in it, both
    0-based; their times are slots.
    """
    rows, index = run.log[run.log["kind"] == CODES["deliver"]], scenario.topology.index
    slots = scenario.slot_plant.slots_of(rows["t"])
    messages: dict[tuple[int, int], list[SentMessage]] = {}
    columns = (slots, *(rows[c] for c in ("phase", "node", "peer", "message")))
    for slot, phase, node, peer, message in zip(*(c.tolist() for c in columns), strict=True):
        # Within a slot the order of phases decides, and not the time of arrival.
        sent = SentMessage(index[peer], index[node], message, slot, slot)
        messages.setdefault((slot, max(phase, 0)), []).append(sent)
    return messages


def _group_by_time(messages: list[SentMessage], column: int) -> dict[float, list[SentMessage]]:
    """Return the messages by the time in their field number ``column``: that at which they were
    sent or that at which they arrive (seconds).
    """
    groups: dict[float, list[SentMessage]] = {}
    for message in messages:
        groups.setdefault(message[column], []).append(message)
    return groups


def _make_rule(
    scenario: Scenario, errors: StackedErrors, run: Run, messages: list[SentMessage]
) -> ErrorRule:
    """Return the rule by which the filter of the scenario changes the stacked ``errors`` at
    readings and messages: that of its paper, or that of filters without messages.
    """
    if not scenario.node_filter.paper:
        return ErrorRule(scenario, errors)
    rule: ErrorRule = paper_module(scenario, "errors").error_rule(scenario, errors, run, messages)
    return rule


def _replay_slots(scenario: Scenario, run: Run, errors: StackedErrors) -> Iterator[None]:
    """Apply the events of a run in slots to the stacked ``errors``, which it changes; yield at each
    of ``run.times``, so that the caller can read the errors then.

    A sample shows the state before its slot for filters that predict, else the state after it.
    """
    phases, plant = scenario.node_filter.schedule or (), scenario.slot_plant
    F, Q = scenario.slot_belief
    # In slots all predictions are the same: x+ = F x + w, e+ = F_f e + (F - F_f) x + w.
    noise = square_root(plant.Q)
    prediction = Prediction(plant.F, F, plant.F - F, noise, noise, square_root(Q))
    rule = _make_rule(scenario, errors, run, [])  # it gets the messages slot by slot
    observe = slot_observations(scenario, run)
    arrivals = _exchanged_messages(scenario, run) if rule.takes_messages else {}
    processed = 0
    for until in plant.slots_of(run.times).tolist():
        while processed < until:
            slot = processed if scenario.node_filter.predicts else processed + 1
            _replay_slot(rule, prediction, phases, slot, observe(slot), arrivals)
            processed += 1
        yield


def _replay_slot(
    rule: ErrorRule,
    prediction: Prediction,
    phases: tuple[str, ...],
    slot: int,
    observations: EstimatorObservations,
    arrivals: dict[tuple[int, int], list[SentMessage]],
) -> None:
    """Apply one ``slot`` to the errors of ``rule``, which changes them: the ``phases`` ("predict",
    "sense" and one or more "exchange") in the filter's order.

    ``observations`` are the readings of the slot, ``arrivals`` the messages that arrived in time,
    by slot and number of the exchange (0-based) within it.
    """
    exchange = 0
    for phase in phases:
        if phase == "predict":
            rule.errors.predict(prediction)
        elif phase == "sense":
            rule.sense(slot, observations)
        else:
            rule.exchange(slot, exchange, arrivals.get((slot, exchange), []))
            exchange += 1
