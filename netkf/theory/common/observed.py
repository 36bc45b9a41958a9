"""What the nodes of a scenario read: increments, and samples by slot or time, as H, R and the root
of the true R. The H of random regressors and recorded ones are those of the run.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.rng.streams import Streams
from netkf.scenario.sampling import (
    increment_sensors,
    sample_path,
    sample_times,
    sampled_sensors,
)
from netkf.scenario.scenario import Placed, Scenario
from netkf.theory.numerics.moves import Seen, together
from netkf.trace.run import Run

Observed = dict[int, Seen]
"""By the place of the node."""


def hosts_of(scenario: Scenario) -> list[tuple[int, ...]]:
    """The nodes whose readings each filter uses: one filter for all where they are pooled."""
    if scenario.filter.algorithm.pooled:
        return [scenario.nodes]
    return [(node,) for node in scenario.nodes]


def _seen(scenario: Scenario, place: Placed, H: FloatArray) -> Seen:
    R, true = (scenario.noise(place.entry, believed) for believed in (True, False))
    return Seen(H, R, np.asarray(np.linalg.cholesky(true), dtype=np.float64))


def increments(scenario: Scenario) -> list[Seen]:
    """Of each host, p may be 0."""
    placed, n = increment_sensors(scenario), scenario.plant.n
    found = []
    for nodes in hosts_of(scenario):
        places = [place for node in nodes for place in placed.get(node, ())]
        sensors = [_seen(scenario, p, scenario.sensors[p.entry].H) for p in places]
        found.append(together(sensors, n))
    return found


def _here(scenario: Scenario, rows: list[tuple[Placed, FloatArray]]) -> list[Seen]:
    """Without sensors that have no reading now."""
    return [_seen(scenario, place, H) for place, H in rows if len(H)]


def in_slots(scenario: Scenario, run: Run) -> Callable[[int], Observed]:
    """The readings of a slot, by host; slots must be asked for in their order."""
    streams, n = Streams(run.seed, run.replica), scenario.plant.n
    hosts = [
        [
            (place, scenario.slot_path(streams, node, place))
            for node in nodes
            for place in scenario.placed.get(node, ())
        ]
        for nodes in hosts_of(scenario)
    ]

    def seen(slot: int) -> Observed:
        return {
            host: together(_here(scenario, [(p, path.matrix(slot)) for p, path in paths]), n)
            for host, paths in enumerate(hosts)
            if paths
        }

    return seen


def sampled(scenario: Scenario, run: Run) -> dict[float, Observed]:
    """The samples of a run in continuous time, by their time and host; those of one node or one
    pooled filter at one instant are one reading.
    """
    streams, n = Streams(run.seed, run.replica), scenario.plant.n
    by_node = sampled_sensors(scenario)
    times = sample_times(scenario, streams)
    found: dict[float, dict[int, list[Seen]]] = {}
    for host, nodes in enumerate(hosts_of(scenario)):
        for node in nodes:
            for place in by_node.get(node, ()):
                sensor = scenario.sensors[place.entry]
                path = sample_path(scenario, streams, node, place) if sensor.varying else None
                for k, time in enumerate(times[node, place.ordinal].tolist()):
                    H = path.reading(k, np.zeros(n))[1] if path is not None else sensor.H
                    here = found.setdefault(time, {})
                    here.setdefault(host, []).append(_seen(scenario, place, H))
    return {
        time: {host: together(readings, n) for host, readings in here.items()}
        for time, here in found.items()
    }
