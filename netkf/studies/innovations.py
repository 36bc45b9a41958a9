"""Innovations of the nodes' own samples under clocks, from the states at the events before them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray, block_diagonal
from netkf.plants.transitions import Transitions
from netkf.rng.streams import Streams
from netkf.scenario.sampling import sample_times
from netkf.scenario.scenario import Scenario
from netkf.trace.nees import BLUR, ROUNDING
from netkf.trace.run import Run

MAX_INSTANTS = 60
"""Instants of samples of a run, evenly spread, whose innovations are judged."""


class JudgedBlock(NamedTuple):
    """A block as one node estimates it: ``node`` (index), name of the ``block`` and whose it is,
    as pose@3, its ``entries`` in the state of the node, and in that of the plant, (n,).

    Without several blocks of ``[[plants]]`` a node has one, with all states and without a name.
    """

    node: int
    block: str
    entries: np.ndarray
    states: np.ndarray


def readings_of_block(scenario: Scenario, block: JudgedBlock) -> tuple[Any, ...]:
    """Return the node's sensors that read a block, and nothing that it does not estimate."""
    placed = scenario.placed_sensors.get(scenario.nodes[block.node], ())
    if not block.block or not scenario.is_linear:
        return placed
    view = np.arange(scenario.plant.n)[scenario.view(block.node)]
    supports = [(sensor, scenario.support(sensor)) for sensor in placed]
    # What drives its blocks from outside is not in its errors.
    outside, plant = np.setdiff1d(np.arange(scenario.plant.n), view), scenario.plant
    moves = [piece.F if scenario.slotted else piece.A for piece in plant.pieces]
    if any(M[np.ix_(view, outside)].any() for M in moves):
        return ()
    return tuple(
        sensor
        for sensor, support in supports
        if np.isin(support, view).all() and np.isin(block.states, support).any()
    )


def has_clocked_innovations(scenario: Scenario) -> bool:
    """Return True if innovations under clocks follow from states at events: of samples alone, and
    of a linear plant that does not change and whose matrices filters know.
    """
    if scenario.slotted or not scenario.is_linear or scenario.increment_sensors:
        return False
    plant: Any = scenario.plant
    if len(plant.changes) or scenario.misses_input or not scenario.is_random:
        return False
    known = all(map(np.array_equal, scenario.belief, (plant.A, plant.Q)))
    return known and bool(scenario.sampled_sensors)


def times_for_innovations(scenario: Scenario, run: Run) -> FloatArray:
    """Return the times (T,) of samples of a ``run``, those of some of its readings, and of the last
    event before these of each node.
    """
    chosen = _chosen_instants(scenario, run)
    before = [events[np.searchsorted(events, chosen) - 1] for events in _events(scenario, run)]
    every = np.unique(np.concatenate([scenario.times, chosen, *before]))
    return every[every <= scenario.horizon]


def _chosen_instants(scenario: Scenario, run: Run) -> FloatArray:
    times = sample_times(scenario, Streams(run.seed, run.replica)).values()
    every = np.unique(np.concatenate([np.empty(0), *times]))
    every = every[(every > 0.0) & (every < scenario.horizon)]
    chosen: FloatArray = every[np.unique(np.linspace(0, len(every) - 1, MAX_INSTANTS).astype(int))]
    return chosen


def _events(scenario: Scenario, run: Run) -> list[FloatArray]:
    """Return for each node the increasing times of its events, and 0."""
    t, node = run.log["t"], run.log["node"]
    pooled = scenario.node_filter.timing.pooled
    return [
        np.unique(np.append(t if pooled else t[(node == i) | (run.log["peer"] == i)], 0.0))
        for i in scenario.nodes
    ]


class ClockedInnovations:
    """The innovations of a ``run`` with samples at ``times_for_innovations``; ``sigma`` (T, N, n,
    n) is E[e e'] of its samples, None if it is unknown.
    """

    def __init__(self, scenario: Scenario, run: Run, sigma: FloatArray | None) -> None:
        self._scenario, self._run, self._sigma = scenario, run, sigma
        plant: Any = scenario.plant
        self._moves = Transitions(plant.A, plant.B)
        self._chosen, self._events = _chosen_instants(scenario, run), _events(scenario, run)
        response = scenario.believed_response if scenario.knows_input else None
        # States without the known response to the input.
        self._x = run.x if response is None else run.x - response.states(run.times)

    def of_block(self, block: JudgedBlock, blurred: np.ndarray) -> Iterator[tuple[float, float]]:
        """Yield NIS of the samples of a block and its expected value (nan: unknown), but for those
        whose prediction begins at a sample of the run (T,) that is ``blurred``.
        """
        scenario, run, events = self._scenario, self._run, self._events[block.node]
        readings = self._readings(block)
        for time in self._chosen.tolist():
            now = int(np.searchsorted(run.times, time))
            last = int(np.searchsorted(run.times, events[np.searchsorted(events, time) - 1]))
            if time not in readings or now >= len(run.times) or blurred[last]:
                continue
            view, own = scenario.view(block.node), scenario.is_estimated[block.node]
            (F,), (root,) = self._moves.laws(np.array([time - run.times[last]]))
            noise = self._x[now] - F @ self._x[last]
            F, Q = F[view][:, view], (root @ root.T)[view][:, view]
            e = np.zeros(scenario.plant.n)
            e[view] = F @ run.error[last, block.node, own] + noise[view]
            square = np.ix_(own, own)
            P = F @ run.P[last, block.node][square] @ F.T + Q
            if ROUNDING * abs(self._x[last]).max() * BLUR > np.sqrt(np.diag(P).min()):
                continue
            parts = [(*reading(e), R, true) for reading, R, true in readings[time]]
            y, H = (np.concatenate([part[k] for part in parts]) for k in range(2))
            H = H[:, view]
            S = H @ P @ H.T + block_diagonal([part[2] for part in parts])
            expected = np.nan
            if self._sigma is not None:
                Sigma = F @ self._sigma[last, block.node][square] @ F.T + Q
                law = H @ Sigma @ H.T + block_diagonal([part[3] for part in parts])
                expected = float(np.trace(np.linalg.solve(S, law)))
            yield float(y @ np.linalg.solve(S, y)), expected

    def _readings(self, block: JudgedBlock) -> dict[float, list[Any]]:
        """Return by time of the samples of a block a function of the state, which gives y (p,) and
        H (p, n), and the R that filters believe and that of the readings.
        """
        scenario, run, found = self._scenario, self._run, dict[float, list[Any]]()
        streams, node = Streams(run.seed, run.replica), run.nodes[block.node]
        times = sample_times(scenario, streams)
        for placed in readings_of_block(scenario, block):
            samples = scenario.sample_path(streams, node, placed)
            R, true = (scenario.noise_covariance(placed.entry, believed=b) for b in (True, False))
            for k, time in enumerate(times[node, placed.ordinal].tolist()):
                y, H = samples.reading(k, np.zeros(scenario.plant.n))

                def reading(x: FloatArray, noise: Any = y, H: Any = H) -> tuple[Any, Any]:
                    return H @ x + noise, H

                found.setdefault(time, []).append((reading, R, true))
        return found
