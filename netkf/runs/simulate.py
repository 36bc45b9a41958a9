"""Simulate a scenario once, in memory."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from netkf.core.errors import EngineError, ScenarioError
from netkf.core.fields import integer
from netkf.core.printable import shorten
from netkf.engines.base import Engine, Progress, silent
from netkf.engines.compiled.engine import CompiledEngine
from netkf.linalg.plain import is_plain
from netkf.rng.streams import Streams
from netkf.runs.failures import explain_failures
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import MemorySink, Recorder, Sink
from netkf.trace.run import Run
from netkf.trace.schema import join_rows

ENGINES = ("auto", "simpy", "compiled")


def choose_engine(
    name_or_engine: str | Engine, scenario: Scenario, announce: bool = True
) -> Engine:
    """Return the engine by name or itself: ``simpy`` (``processes``), ``compiled``, or ``auto``,
    compiled if possible; with ``announce`` it says so if it compiles first. Raises EngineError.
    """
    if isinstance(name_or_engine, Engine):
        engine: Engine = name_or_engine
    elif str(name_or_engine) not in (*ENGINES, "processes"):
        raise EngineError(
            f"engine must be one of {', '.join(ENGINES)}; got {shorten(repr(name_or_engine))}"
        )
    elif name_or_engine in ("auto", "compiled"):
        engine = CompiledEngine()
        if name_or_engine == "auto" and (is_plain() or engine.refusal(scenario) is not None):
            engine = _simpy_engine()
    else:
        engine = _simpy_engine()
    refusal = engine.refusal(scenario)
    if refusal is not None:
        raise EngineError(refusal)
    if announce and engine is not name_or_engine:
        engine.announce(scenario)
    return engine


def _simpy_engine() -> Engine:
    from netkf.engines.simpy.engine import SimpyEngine

    return SimpyEngine()


def require_scenario(value: object, function: str, rest: str = "", first: str = "") -> None:
    """Raise ScenarioError unless ``value`` is a scenario; the remedy is a call of ``function``
    with the arguments ``first`` before it and the ``rest`` after it.
    """
    if not isinstance(value, Scenario):
        remedy = f"load it first: netkf.{function}({first}netkf.load(path){rest})"
        raise ScenarioError("", f"{function} takes a netkf.Scenario", value, remedy)


@np.errstate(under="ignore")
def simulate(
    scenario: Scenario,
    seed: int | None = None,
    replica: int = 0,
    engine: str | Engine = "auto",
    sinks: Sequence[Sink] = (),
    progress: Progress = silent,
) -> Run:
    """Simulate a scenario once and return the run with all events and samples.

    ``seed`` is that of the scenario if None; runs with the same seed differ by ``replica``.
    Additional ``sinks`` receive the same events and samples during the run.

    Raises EngineError if no engine can run the scenario or a user's class fails, ScenarioError for
    bad arguments.
    """
    require_scenario(scenario, "simulate")
    seed = scenario.seed if seed is None else integer(low=0)("seed", seed)
    replica = integer(low=0)("replica", replica)
    memory = MemorySink()
    recorder = Recorder([memory, *sinks])
    with explain_failures(scenario):
        chosen_engine = choose_engine(engine, scenario)
        status = chosen_engine.run(scenario, Streams(seed, replica), recorder, progress)
    return collect_run(scenario, memory, recorder, seed, replica, chosen_engine.name, status)


def collect_run(
    scenario: Scenario,
    memory: MemorySink,
    recorder: Recorder,
    seed: int,
    replica: int,
    engine: str,
    status: str,
) -> Run:
    """Return the Run of number ``replica`` of ``seed`` whose ``recorder`` wrote to ``memory``."""
    count, width = len(scenario.nodes), scenario.width
    shapes = (), (scenario.plant.n,), (count, width), (count, width, width), (count, width)
    # Concatenated with empty arrays, the arrays of a run without samples have the right shapes.
    columns = zip(tuple(np.empty((0, *shape)) for shape in shapes), *memory.samples, strict=True)
    times, x, xhat, P, error = (np.concatenate(column) for column in columns)
    return Run(
        times=times,
        nodes=scenario.nodes,
        x=x,
        xhat=xhat,
        P=P,
        error=error,
        log=join_rows(memory.blocks),
        seed=seed,
        replica=replica,
        engine=engine,
        status=status,
        sums=recorder.sums,
        truth_known=scenario.plant.truth_known,
        exact_errors=recorder.exact_errors,
        stats=recorder.stats,
        scenario=scenario,
    )
