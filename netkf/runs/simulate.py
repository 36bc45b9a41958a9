"""Simulate a scenario once, in memory."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from netkf.core.errors import EngineError, ScenarioError
from netkf.core.fields import integer
from netkf.engines.base import Engine, Progress, silent
from netkf.engines.compiled.engine import CompiledEngine
from netkf.engines.simpy.engine import SimpyEngine
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import MemorySink, Recorder, Sink
from netkf.trace.run import Run
from netkf.trace.schema import EVENT

LOAD = "load it first: netkf.simulate(netkf.load(path))"
ENGINES = ("auto", "simpy", "compiled")


def choose_engine(name: str | Engine, scenario: Scenario, announce: bool = True) -> Engine:
    """Return the engine of a name: ``simpy`` (or ``processes``), ``compiled``, or ``auto``, that is
    ``compiled`` if that engine can run the scenario and ``simpy`` otherwise. ``announce`` says so
    where it will compile first.

    Raises EngineError for an unknown name and if the engine cannot run the scenario.
    """
    if isinstance(name, Engine):
        engine: Engine = name
    elif name in ("auto", "compiled"):
        engine = CompiledEngine()
        if name == "auto" and engine.refusal(scenario) is not None:
            engine = SimpyEngine()
    elif name in ("simpy", "processes"):
        engine = SimpyEngine()
    else:
        raise EngineError(f"engine must be one of {', '.join(ENGINES)}; got {name!r}")
    refusal = engine.refusal(scenario)
    if refusal is not None:
        raise EngineError(refusal)
    if announce and engine is not name:
        engine.announce(scenario)
    return engine


def simulate(
    scenario: Scenario,
    seed: int | None = None,
    replica: int = 0,
    engine: str | Engine = "auto",
    sinks: Sequence[Sink] = (),
    progress: Progress = silent,
) -> Run:
    """Run a scenario once and return all events and samples.

    ``seed`` defaults to the scenario's; runs of one seed differ by ``replica``. Additional
    ``sinks`` receive the same rows and samples during the run.

    Raises EngineError if no engine can run the scenario, ScenarioError for bad arguments.
    """
    if not isinstance(scenario, Scenario):
        raise ScenarioError("", "simulate takes a netkf.Scenario", scenario, LOAD)
    seed = scenario.seed if seed is None else integer(low=0)("seed", seed)
    replica = integer(low=0)("replica", replica)
    chosen = choose_engine(engine, scenario)
    memory = MemorySink()
    recorder = Recorder([memory, *sinks])
    status = chosen.run(scenario, Streams(seed, replica), recorder, progress)
    return collect(scenario, memory, recorder, seed, replica, chosen.name, status)


def collect(
    scenario: Scenario,
    memory: MemorySink,
    recorder: Recorder,
    seed: int,
    replica: int,
    engine: str,
    status: str,
) -> Run:
    """Return the Run of a finished simulation whose recorder fed ``memory``."""
    count, n = len(scenario.nodes), scenario.plant.n
    shapes = (), (n,), (count, n), (count, n, n), (count, n)
    # Empty arrays in front give the right shapes to a run without samples.
    empty = tuple(np.empty((0, *shape)) for shape in shapes)
    columns = zip(empty, *memory.samples, strict=True)
    times, x, xhat, P, error = (np.concatenate(column) for column in columns)
    return Run(
        times=times,
        nodes=scenario.nodes,
        x=x,
        xhat=xhat,
        P=P,
        error=error,
        log=np.concatenate([np.empty(0, dtype=EVENT), *memory.blocks]),
        seed=seed,
        replica=replica,
        engine=engine,
        status=status,
        fingerprint=recorder.fingerprint,
        sums=recorder.sums,
        truth_known=scenario.plant.truth_known,
        exact_errors=recorder.exact_errors,
        stats=recorder.stats,
        scenario=scenario,
    )
