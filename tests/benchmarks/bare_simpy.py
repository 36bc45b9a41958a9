"""A bare SimPy loop with the timeouts and the numerical calls of a run of the SimPy engine.

The calls of the filter's methods in one run are recorded with their arguments; the bare loop is a
process a link that yields as many timeouts as the engine had events and makes those calls, and
nothing else.
"""

import simpy

import netkf
from netkf.algorithms.filter import Filter
from netkf.engines.base import silent
from netkf.engines.simpy.engine import SimpyEngine
from netkf.rng.streams import Streams
from netkf.trace.recorder import MemorySink, Recorder

METHODS = ("predict", "update", "emit", "absorb")


def engine_run(case):
    """One run with its trace in memory."""
    recorder = Recorder([MemorySink()])
    assert SimpyEngine().run(case, Streams(case.seed), recorder, silent) == "complete"


def recorded_calls(case):
    """Calls in the order of a run, (function, arguments), and the number of timeouts: one a tick, a
    reading and a reset, since a message without delay needs none of its own.
    """
    kind, calls = type(case.filter.algorithm), []

    def spy(name):
        plain = getattr(kind, name)

        def method(*arguments):
            calls.append((plain, arguments))
            return plain(*arguments)

        return method

    own = {name: vars(kind).get(name) for name in METHODS if hasattr(Filter, name)}
    for name in own:
        setattr(kind, name, spy(name))
    try:
        engine_run(case)
    finally:
        for name, method in own.items():
            if method is None:
                delattr(kind, name)
            else:
                setattr(kind, name, method)
    kinds = netkf.simulate(case).events.kind
    return calls, int(kinds.isin(["tick", "sense", "absorb"]).sum())


def bare_run(case, calls, timeouts):
    """A process a link; all share the timeouts and the calls evenly."""
    env, workers = simpy.Environment(), len(case.topology.links)
    left, share = iter(calls), len(calls) / timeouts
    gap, due = case.horizon / (timeouts / workers), 0.0

    def worker(k):
        nonlocal due
        yield env.timeout(gap * k / workers)
        while env.now < case.horizon:
            due += share
            while due >= 1.0:
                due -= 1.0
                call = next(left, None)
                if call is None:
                    return
                call[0](*call[1])
            yield env.timeout(gap)

    for k in range(workers):
        env.process(worker(k))
    env.run()
    assert sum(1 for _ in left) <= workers, "the bare loop makes all calls"
