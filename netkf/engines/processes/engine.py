"""The reference engine: SimPy processes for sensors, link clocks and samples."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Any

import numpy as np
import simpy

from netkf.core import compiling
from netkf.core.arrays import FloatArray
from netkf.core.streams import Streams
from netkf.engines.base import Engine, Progress, Rank, broken
from netkf.engines.compiled.engine import CompiledEngine
from netkf.engines.compiled.flow import Desk, FlowRun, Source, replay_for
from netkf.engines.processes.hosts import Host, make_hosts
from netkf.engines.processes.links import LinkProcess
from netkf.engines.processes.slots import SlotProcess
from netkf.engines.processes.ticking import TickingLinks
from netkf.engines.processes.timeline import Timeline
from netkf.plants.paths import DiffusionPath
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import NAN, Recorder
from netkf.trace.schema import CODES

SENSE, DIVERGED = CODES["sense"], CODES["diverged"]
Processes = list[Generator[simpy.Event, Any, None]]


class DivergedError(Exception):
    """A covariance or an estimate is no longer finite."""


@dataclass
class ProcessesEngine(Engine):
    """Runs every scenario. ``arrange`` may reorder the processes before they start; nothing that
    happens depends on it. ``compiled``: built-in filters in continuous time are compiled, and what
    the clocks of their links do reaches them in blocks.
    """

    arrange: Callable[[Processes], Processes] = list
    compiled: bool = False
    name = "processes"

    def refusal(self, scenario: Scenario) -> str | None:
        """None: this engine defines what a scenario means."""
        return None

    def announce(self, scenario: Scenario) -> None:
        """That filters are compiled, where their code is not kept from before."""
        if self._compiles(scenario):
            compiling.announce(replay_for(scenario))

    def _compiles(self, scenario: Scenario) -> bool:
        return self.compiled and not scenario.slotted and CompiledEngine().refusal(scenario) is None

    def run(
        self, scenario: Scenario, streams: Streams, recorder: Recorder, progress: Progress
    ) -> str:
        """Simulate up to the horizon; returns complete or diverged."""
        if self._compiles(scenario):
            source = Source(scenario, streams, TickingLinks(scenario, streams))
            with np.errstate(over="ignore", invalid="ignore"):
                run = FlowRun(scenario, Desk(scenario), source, recorder, progress)
                return run.to_the_end()
        timeline = Timeline()
        make = _in_slots if scenario.slotted else _in_continuous_time
        processes = make(scenario, streams, timeline, recorder, progress)
        for process in self.arrange(processes):
            timeline.process(process)
        with np.errstate(over="ignore", invalid="ignore"):  # growth to infinity is reported
            try:
                timeline.run()
            except DivergedError:
                return "diverged"
            finally:
                recorder.flush()
        return "complete"


def _in_continuous_time(
    scenario: Scenario,
    streams: Streams,
    timeline: Timeline,
    recorder: Recorder,
    progress: Progress,
) -> Processes:
    truth = scenario.truth.path(
        streams.generator("plant"), streams.generator("probe"), scenario.times
    )
    hosts = make_hosts(scenario, streams, timeline, recorder, truth)
    processes: Processes = [_sampling(timeline, scenario, truth, hosts, recorder, progress)]
    processes += _sensing(timeline, scenario, truth, hosts, recorder)
    if scenario.filter.algorithm.talks:
        processes += [
            LinkProcess(scenario, streams, timeline, recorder, hosts, link, k).ticking()
            for k, link in enumerate(scenario.topology.links)
        ]
    return processes


def _in_slots(
    scenario: Scenario,
    streams: Streams,
    timeline: Timeline,
    recorder: Recorder,
    progress: Progress,
) -> Processes:
    def sampled(time: float, x: FloatArray, xhat: FloatArray, P: FloatArray) -> None:
        _record(scenario, recorder, progress, time, x, xhat, P)

    return [SlotProcess(scenario, streams, timeline, recorder, sampled).running()]


def _sensing(
    timeline: Timeline,
    scenario: Scenario,
    truth: DiffusionPath,
    hosts: dict[int, Host],
    recorder: Recorder,
) -> Processes:
    def sense(node: int, entity: int) -> Generator[simpy.Event, Any, None]:
        host, k = hosts[node], 1
        while (time := truth.grid(k)) < scenario.horizon:
            yield timeline.at(time, Rank.SENSE, entity)
            recorder.append((time, SENSE, node, -1, -1, -1, NAN))
            host.advance(time)
            k += 1

    return [sense(node, scenario.topology.index[node]) for node in scenario.sensing]


def _sampling(
    timeline: Timeline,
    scenario: Scenario,
    truth: DiffusionPath,
    hosts: dict[int, Host],
    recorder: Recorder,
    progress: Progress,
) -> Generator[simpy.Event, Any, None]:
    for time in scenario.times.tolist():
        yield timeline.at(time, Rank.PROBE, 0)
        x = truth.state(time)
        estimates = [hosts[node].estimate(time) for node in scenario.nodes]
        xhat = np.array([estimate for estimate, _ in estimates])
        P = np.array([cov for _, cov in estimates])
        _record(scenario, recorder, progress, time, x, xhat, P)


def _record(
    scenario: Scenario,
    recorder: Recorder,
    progress: Progress,
    time: float,
    x: FloatArray,
    xhat: FloatArray,
    P: FloatArray,
) -> None:
    recorder.sample(time, x, xhat, P, x - xhat)
    recorder.flush_if_full()
    progress(time)
    nodes = broken(scenario, xhat, P)
    for node in nodes:
        recorder.append((time, DIVERGED, node, -1, -1, -1, NAN))
    if nodes:
        raise DivergedError
