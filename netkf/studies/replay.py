"""Replays of a run up to one instant in which chosen messages are delivered.

The scenario, the seed and all draws are those of the run. Only chosen messages differ: they are
delivered after their drawn delay, or without delay if they were late. True states and readings do
not depend on the network, so that they are the same. (With continuous readings, a message that is
newly delivered between two grid times may split the reading of that interval at another moment; its
parts are then drawn anew, given the same whole.)
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterable
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.network.channels import Channel
from netkf.network.delays import NoDelay
from netkf.network.deliveries import (
    Chosen,
    DelayUnlessWaived,
    Deliveries,
    DeliveringLoss,
    MessageKey,
)
from netkf.runs.simulate import simulate
from netkf.scenario.scenario import Scenario
from netkf.studies.information import (
    LATE,
    REFUSED,
    UNDER_WAY,
    IntArray,
    match_messages,
    message_keys,
    rows_until,
)


class Outcome(NamedTuple):
    """The state of a node at an instant.

    xhat  : (n,) estimate
    P     : (n, n) covariance, nan if the filter gives none
    error : (n,) x - xhat, nan without ground truth
    """

    xhat: FloatArray
    P: FloatArray
    error: FloatArray

    @property
    def trace(self) -> float:
        """The trace of P."""
        return float(np.trace(self.P))

    @property
    def distance(self) -> float:
        """The length of the error."""
        return float(np.linalg.norm(self.error))


class Replayer:
    """Replays a run up to ``at`` seconds for the state of ``node``; ``count`` replays were made."""

    def __init__(self, scenario: Scenario, seed: int, replica: int, node: int, at: float) -> None:
        self.scenario, self._seed, self._replica = scenario, seed, replica
        self._node, self.at, self.count = scenario.nodes.index(node), at, 0
        self._deliveries = Deliveries()
        self._short, self._full = (
            delivering(_shorten(scenario, at, to_horizon), self._deliveries)
            for to_horizon in (False, True)
        )
        self._outcomes: dict[tuple[Chosen | None, bool], Outcome] = {}

    @cached_property
    def log(self) -> IntArray:
        """The E EVENT rows (E,) of the unchanged run, up to the state at ``at``."""
        return self._replay(frozenset(), to_horizon=False)

    @cached_property
    def delayed(self) -> Chosen:
        """Messages not lost but unused because of their delay; replays deliver them at once."""
        scenario = self.scenario
        messages = match_messages(self.log, scenario.node_filter.analysis.swaps, scenario.slotted)
        unused = np.isin(messages.outcome, (LATE, REFUSED, UNDER_WAY))
        return frozenset(message_keys(messages[unused]))

    @cached_property
    def full_log(self) -> IntArray:
        """The EVENT rows (E,) of the run with all messages delivered, up to ``at``."""
        return self._replay(None, to_horizon=False)

    def outcome(self, chosen: Iterable[MessageKey] | None = (), error: bool = False) -> Outcome:
        """Return the node's state at ``at`` with the ``chosen`` messages delivered, all for None.

        Without ``error``, which may replay the whole run, x - xhat may not be that of the run.
        """
        keys = None if chosen is None else frozenset(chosen)
        # The true state between two samples of sensors depends on the later one too.
        to_horizon = error and bool(self.scenario.sampled_sensors)
        if (keys, to_horizon) not in self._outcomes:
            if keys is None and not to_horizon:
                _ = self.full_log  # this replay also keeps its log
            elif keys == frozenset() and not to_horizon:
                _ = self.log
            else:
                self._replay(keys, to_horizon)
        return self._outcomes[keys, to_horizon]

    def _replay(self, chosen: Chosen | None, to_horizon: bool) -> IntArray:
        """Simulate with ``chosen`` (None: all) messages delivered; return EVENT rows to ``at``."""
        self.count += 1
        without_delay: Chosen = frozenset()
        if chosen is None or chosen:
            without_delay = self.delayed if chosen is None else chosen & self.delayed
        # The channel models of both scenarios read these when messages are sent.
        self._deliveries.choose(chosen, without_delay)
        run = simulate(self._full if to_horizon else self._short, self._seed, self._replica)
        k, n = self._node, int(self.scenario.sizes[self._node])
        outcome = Outcome(run.xhat[-1, k, :n], run.P[-1, k, :n, :n], run.error[-1, k, :n])
        if run.times[-1] != self.at:  # it diverged before
            outcome = Outcome(*(np.full_like(part, np.nan) for part in outcome))
        self._outcomes[chosen, to_horizon] = outcome
        return rows_until(self.scenario, run.log, self.at)


def delivering(scenario: Scenario, deliveries: Deliveries) -> Scenario:
    """Return the scenario whose channel delivers what ``deliveries`` names, else as drawn."""
    network, channel_of_run = scenario.network, scenario.network.channel
    loss = DeliveringLoss(channel_of_run.loss, deliveries, channels=channel_of_run.channels)
    delay = channel_of_run.delay
    # Without delays no message is late, and the engines have a faster path.
    if not isinstance(delay, NoDelay):
        delay = DelayUnlessWaived(delay, deliveries)
    channel = Channel(loss=loss, delay=delay, symmetric=channel_of_run.symmetric)
    return _with(scenario, network=dataclasses.replace(network, channel=channel))


def _shorten(scenario: Scenario, at: float, to_horizon: bool) -> Scenario:
    """Return the scenario whose last sample is at ``at`` s; it ends there or at the horizon."""
    times = scenario.times
    # Earlier samples stay: they decide where continuous readings of an interval are split.
    probe = np.append(times[times < at], at)
    # Events at ``at`` itself, and in slots those of its slot, belong to the state: a replay ends a
    # slot, a tick or 1e-9 s later.
    grid = scenario.time_grid
    later = scenario.slot_plant.period if scenario.slotted else max(1e-9, 1.0 / grid.per_second)
    end = scenario.horizon if to_horizon else min(scenario.horizon, grid.instant(at + later))
    return _with(scenario, probe=probe, horizon=end)


def _with(scenario: Scenario, **changes: Any) -> Scenario:
    changed = copy.copy(scenario)  # without derived values
    for name, value in changes.items():
        object.__setattr__(changed, name, value)
    return changed
