"""Innovations of the nodes' own samples under clocks, from the states at the events before them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray, block_diagonal
from netkf.network.node_clocks import node_time
from netkf.plants.transitions import Transitions
from netkf.rng.streams import Streams
from netkf.scenario.sampling import sample_times
from netkf.scenario.scenario import Scenario
from netkf.trace.nees import BLUR, ROUNDING
from netkf.trace.run import Run

MAX_INSTANTS = 40
"""Instants of samples of each node in a run, evenly spread, whose innovations are judged."""
MAX_ENTRIES = 25_000_000
"""Entries of covariances at these and at the events before: large networks have fewer instants."""


class JudgedBlock(NamedTuple):
    """A block as one node estimates it: ``node`` (index), name of the ``block`` and whose it is,
    as pose@3, its ``entries`` in the state of the node, and in that of the plant, (n,).

    Without several blocks of ``[[plants]]`` a node has one, with all states and without a name.
    """

    node: int
    block: str
    entries: np.ndarray
    states: np.ndarray


Row = tuple[FloatArray, ...]
"""Of a reading H (p, n), the noise (p,), the R that filters believe, and that of the noise."""


def nis_of(
    readings: Sequence[Row], view: Any, predicted: tuple[FloatArray, FloatArray, Any]
) -> tuple[float, float]:
    """Return NIS of ``readings`` and its expected value, by error, P and E[e e'] ``predicted``."""
    parts, (e, P, Sigma) = list(zip(*readings, strict=True)), predicted
    H, (believed, R) = np.concatenate(parts[0])[:, view], map(block_diagonal, parts[2:])
    # The innovation: sensors read the error in place of the state.
    v, S, expected = H @ e + np.concatenate(parts[1]), H @ P @ H.T + believed, np.nan
    if Sigma is not None:
        expected = float(np.trace(np.linalg.solve(S, H @ Sigma @ H.T + R)))
    return float(v @ np.linalg.solve(S, v)), expected


def has_linear_innovations(scenario: Scenario) -> bool:
    """Return True if errors alone give innovations: readings are linear, and used as they are."""
    linear = scenario.plant.linear and scenario.has_linear_sensors
    return linear and not scenario.faults and scenario.filter.gate is None


def readings_of_block(scenario: Scenario, block: JudgedBlock) -> tuple[Any, ...]:
    """Return the node's sensors that read a block, and nothing that it does not estimate."""
    placed = scenario.placed_sensors.get(scenario.nodes[block.node], ())
    if not block.block or not has_linear_innovations(scenario):
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
    """Return True if innovations under clocks follow from states at events."""
    plant: Any = scenario.plant
    if scenario.slotted or not has_linear_innovations(scenario) or scenario.increment_sensors:
        return False
    if len(plant.changes) or scenario.misses_input or not scenario.is_random:
        return False
    if scenario.has_mistimed_models:
        return False
    known = all(map(np.array_equal, scenario.belief, (plant.A, plant.Q)))
    return known and bool(scenario.sampled_sensors)


class ClockedInnovations:
    """The innovations of the run of ``scenario`` that has the ``log`` and the samples ``streams``:
    ``run`` is the same one, with samples at ``times``; ``sigma`` (T, N, n, n): E[e e'] or None.

    times : the samples of ``scenario``, and for each node instants of its sensors and its last
            events before these
    """

    run: Run
    sigma: FloatArray | None

    def __init__(self, scenario: Scenario, log: np.ndarray, streams: Streams) -> None:
        plant: Any = scenario.plant
        self._scenario, self._streams = scenario, streams
        self._moves, self._sampled = Transitions(plant.A, plant.B), sample_times(scenario, streams)
        samples = dict[int, list[FloatArray]]()
        for (node, _), times in self._sampled.items():
            samples.setdefault(node, []).append(times)
        pooled, entries = scenario.node_filter.timing.pooled, len(scenario.nodes) * plant.n**2
        count = min(MAX_INSTANTS, MAX_ENTRIES // (2 * max(1, len(samples)) * entries))
        # By node (2, K), the chosen instants and the last events before them.
        self._instants = dict[int, FloatArray]()
        for node, of_sensors in samples.items():
            every = np.unique(np.concatenate(of_sensors))
            every = every[(every > 0.0) & (every < scenario.horizon)]
            number = np.linspace(0, len(every) - 1, count if len(every) else 0)
            chosen = every[np.unique(number.astype(int))]
            is_own = pooled | (log["node"] == node) | (log["peer"] == node)
            events = np.unique(np.append(log["t"][is_own], 0.0))
            before = events[np.searchsorted(events, chosen) - 1]
            self._instants[node] = np.stack([chosen, before])
        parts = [pairs.ravel() for pairs in self._instants.values()]
        self.times = np.unique(np.concatenate([scenario.times, *parts]))

    def of_block(self, block: JudgedBlock, blurred: np.ndarray) -> Iterator[tuple[float, float]]:
        """Yield NIS of a block and its expected value, without ``blurred`` predictions (T,)."""
        scenario, run, i, readings = self._scenario, self.run, block.node, self._readings(block)
        x, view, own = run.x, scenario.view(i), scenario.is_estimated[i]
        if scenario.knows_input:
            x = x - scenario.believed_response.states(run.times)
        pairs = self._instants.get(scenario.nodes[i], np.empty((2, 0)))
        clock = node_time(scenario, self._streams, scenario.nodes[i])
        for time, start in pairs.T.tolist():
            now, last = np.searchsorted(run.times, [time, start]).tolist()
            if time not in readings or now >= len(run.times) or blurred[last]:
                continue
            # The node predicts over the time that passed by its clock.
            F, W = self._moves.law(clock.shows(time) - clock.shows(start))
            moved, square = (x[now] - F @ x[last])[view], np.ix_(own, own)
            F, Q = F[view][:, view], W[view][:, view]
            P = F @ run.P[last, i][square] @ F.T + Q
            if ROUNDING * abs(x[last]).max() * BLUR > np.sqrt(np.diag(P).min()):
                continue
            Sigma = None
            if self.sigma is not None and clock.pace == 1.0:
                Sigma = F @ self.sigma[last, i][square] @ F.T + Q
            e = F @ run.error[last, i, own] + moved
            yield nis_of(readings[time], view, (e, P, Sigma))

    def _readings(self, block: JudgedBlock) -> dict[float, list[Row]]:
        scenario, found = self._scenario, dict[float, list[Row]]()
        node, zero = scenario.nodes[block.node], np.zeros(scenario.plant.n)
        for placed in readings_of_block(scenario, block):
            samples = scenario.sample_path(self._streams, node, placed)
            laws = [scenario.noise_covariance(placed.entry, believed=b) for b in (True, False)]
            for k, time in enumerate(self._sampled[node, placed.ordinal].tolist()):
                noise, H = samples.reading(k, zero)
                found.setdefault(time, []).append((H, noise, *laws))
        return found
