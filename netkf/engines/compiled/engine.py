"""The compiled engine: schedules drawn before a run, and compiled loops that simulate."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from netkf.algorithms.filter import compiled_kernels
from netkf.core.fields import Component
from netkf.engines.base import Engine, Progress
from netkf.engines.compiled.batches import flow_batches, quick_runs
from netkf.engines.compiled.flow import FlowRun, Source, Workspace
from netkf.engines.compiled.gates import ungated_readings
from netkf.engines.compiled.outcomes import unknown_outcomes
from netkf.engines.compiled.own_sensors import is_own, reads_in_python
from netkf.engines.compiled.quantiser import unquantised_messages
from netkf.engines.compiled.slot_pairs import blocks_refusal
from netkf.engines.compiled.slot_run import run_slots, slot_batches, with_ends
from netkf.engines.compiled.slot_setup import slot_setup
from netkf.linalg import compiling
from netkf.linalg.plain import announce_plain, has_numba, is_plain
from netkf.plants.curves import NonlinearDiffusion
from netkf.plants.diffusion import Diffusion
from netkf.plants.linear import LinearPlant
from netkf.plants.maps import NonlinearPlant
from netkf.plants.recorded import RecordedDiffusion, RecordedPlant, UnknownDiffusion, UnknownPlant
from netkf.plants.states import StackedStates
from netkf.rng.streams import Streams
from netkf.scenario.registry import name_of
from netkf.scenario.scenario import Scenario
from netkf.trace.batch import RunBatch
from netkf.trace.recorder import Recorder

PLANTS = (
    *(Diffusion, NonlinearDiffusion, RecordedDiffusion, UnknownDiffusion),
    *(LinearPlant, NonlinearPlant, RecordedPlant, UnknownPlant),
)


@dataclass(frozen=True)
class CompiledEngine(Engine):
    """Runs all built-in plants, linear sensors and filters. Clocks, losses, delays and sensors that
    take samples or read in slots may be a user's own; filters if they are kernels.
    """

    name = "compiled"

    def refusal(self, scenario: Scenario) -> str | None:
        """Return why this engine cannot run the scenario, with the remedy; None if it can."""
        remedy = 'use engine="simpy", or "auto", which chooses'
        if not has_numba():
            absent = 'engine "compiled" needs numba, which is not installed'
            return f"{absent}; install it (pip install numba), or {remedy}"
        if scenario.views is not None and (rule := blocks_refusal(scenario)) is not None:
            return f'engine "compiled" cannot run {rule}; {remedy}'
        # ``type`` and not ``isinstance``: kernels do not know what a derived class changes.
        unknown: list[tuple[str, Component]] = []
        if type(scenario.plant) not in PLANTS:
            unknown.append(("plant", scenario.plant))
        unknown += [
            ("sensor", sensor)
            for sensor in scenario.sensors
            if is_own(sensor) and not reads_in_python(sensor, scenario.slotted)
        ]
        if unknown:
            family, part = unknown[0]
            return f'engine "compiled" cannot run the {family} {name_of(family, part)!r}; {remedy}'
        rule = ""
        if (unquantised := unquantised_messages(scenario)) is not None:
            rule = unquantised
        elif (ungated := ungated_readings(scenario)) is not None:
            rule = f"a gate on {ungated}"
        elif scenario.node_filter.timing.randomised and any(
            sensor.varying and sensor.record is not None for sensor in scenario.sensors
        ):
            # Kernels weigh news by the rows and the R of all readings of a node.
            rule = "a random trigger on recorded readings whose rows or R differ"
        elif scenario.has_mistimed_increments:
            rule = "sensors that give increments at nodes whose clocks are wrong"
        elif scenario.has_mistimed_models:
            rule = "nodes with wrong clocks that know inputs or changes of a linear plant"
        elif (outcomes := unknown_outcomes(scenario)) is not None:
            rule = outcomes
        if rule:
            return f'engine "compiled" cannot run {rule}; {remedy}'
        if compiled_kernels(scenario.node_filter, not scenario.slotted) is None:
            name = name_of("filter", scenario.filter.algorithm)
            return (
                f'engine "compiled" has no code for the filter {name!r}, whose methods are plain '
                f"Python; {remedy}, or write them as kernels (netkf.kernels)"
            )
        return None

    def announce(self, scenario: Scenario) -> None:
        """Say on stderr that code is compiled, unless it is cached from an earlier run."""
        if is_plain():
            announce_plain()
        else:
            compiling.announce()

    def run(
        self, scenario: Scenario, streams: Streams, recorder: Recorder, progress: Progress
    ) -> str:
        """Simulate a scenario, see ``Engine.run``."""
        with np.errstate(over="ignore", invalid="ignore"):  # growth to infinity is reported
            if scenario.slotted:
                return run_slots(scenario, streams, recorder, progress)
            workspace, draws = Workspace(scenario), Source(scenario, streams)
            return FlowRun(scenario, workspace, draws, recorder, progress).to_the_end()

    def together(self, scenario: Scenario) -> int:
        """Return the number of runs that take little longer together than one."""
        if not scenario.slotted:
            return quick_runs(scenario)
        return slot_setup(scenario).quick_runs() if slot_setup(scenario).side_by_side else 1

    def run_many(
        self, scenario: Scenario, seed: int, replicas: range, fingerprint: bool = False
    ) -> Iterator[RunBatch]:
        """Yield the runs of ``replicas``, many in each batch, see ``Engine.run_many``."""
        alone = partial(super().run_many, scenario, seed)
        is_mixed = isinstance(scenario.plant.record, StackedStates)
        if not scenario.slotted and not is_mixed:
            yield from flow_batches(scenario, seed, replicas, fingerprint)
        elif is_mixed or not slot_setup(scenario).side_by_side:
            yield from alone(replicas, fingerprint)
        else:
            # A run that diverges is repeated alone, since a batch goes on to the end.
            for batch in slot_batches(scenario, seed, replicas, fingerprint):
                yield with_ends(batch, alone)
