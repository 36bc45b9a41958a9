"""The SimPy engine against a bare SimPy loop with the same timeouts and the same numerical calls.

    python -m tests.benchmarks.engine [--pairs 5]

poisson_ring with 1000 nodes and 4000 links. The numerical calls of one run (flow, measure, absorb,
with their arguments) are recorded tick by tick; the bare loop is one process a link that yields as
many timeouts as the engine had events and makes those calls, and nothing else. Both run in turn;
the ratio of their speeds is taken pair by pair, so that a machine that slows down slows both.
"""

import argparse
import statistics
import time
from pathlib import Path

import simpy

import netkf
from netkf.algorithms.hybrid import Hybrid
from netkf.engines.base import silent
from netkf.engines.simpy.engine import SimpyEngine
from netkf.rng.streams import Streams
from netkf.trace.recorder import MemorySink, Recorder

RING = Path(__file__).parents[2] / "scenarios" / "poisson_ring.toml"


def scenario():
    graph = {"kind": "regular", "nodes": 1000, "degree": 8, "seed": 1, "connected": True}
    return netkf.load(RING).replace(
        {"network.graph": graph, "filter.epsilon": 0.1, "horizon": 4.0, "probe": 1.0}
    )


def engine_run(case):
    """Seconds inside the engine, started processes included, and the number of events."""
    recorder = Recorder([MemorySink()])
    began = time.perf_counter()
    status = SimpyEngine().run(case, Streams(case.seed), recorder, silent)
    seconds = time.perf_counter() - began
    assert status == "complete"
    return seconds, recorder.total


def recorded_calls(case):
    """Numerical calls in the order of a run: (bound method, arguments)."""
    calls = []

    def spy(name):
        original = getattr(Hybrid, name)

        def method(self, *arguments):
            calls.append((original, (self, *arguments)))
            return original(self, *arguments)

        return original, method

    originals = {}
    for name in ("flow", "measure", "absorb"):
        originals[name], method = spy(name)
        setattr(Hybrid, name, method)
    try:
        engine_run(case)
    finally:
        for name, original in originals.items():
            setattr(Hybrid, name, original)
    return calls


def bare_run(case, calls, timeouts):
    """Seconds of the bare loop: 4000 processes share the timeouts and the calls evenly."""
    env = simpy.Environment()
    workers = len(case.topology.links)
    done = iter(calls)
    per_wake, made = len(calls) / timeouts, 0.0

    def worker(k):
        nonlocal made
        gap = case.horizon / (timeouts / workers)
        yield env.timeout(gap * k / workers)
        while env.now < case.horizon:
            made += per_wake
            while made >= 1.0:
                made -= 1.0
                call = next(done, None)
                if call is None:
                    return
                call[0](*call[1])
            yield env.timeout(gap)

    began = time.perf_counter()
    for k in range(workers):
        env.process(worker(k))
    env.run()
    seconds = time.perf_counter() - began
    assert sum(1 for _ in done) <= workers, "the bare loop must make all calls"
    return seconds


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pairs", type=int, default=5)
    pairs = parser.parse_args().pairs
    case = scenario()
    _, events = engine_run(case)
    calls = recorded_calls(case)
    log = netkf.simulate(case).events
    # One SimPy event a tick, a reading and a reset; a message without delay needs none of its own.
    timeouts = int(log.kind.isin(["tick", "sense", "absorb"]).sum())
    ratios = []
    print(f"{events:,} events, {timeouts:,} timeouts, {len(calls):,} numerical calls")
    print("engine, events/s   bare loop, events/s   ratio")
    for _ in range(pairs):
        mine, again = engine_run(case)
        assert again == events
        bare = bare_run(case, calls, timeouts)
        ratios.append(bare / mine)
        print(f"{events / mine:16,.0f}   {events / bare:19,.0f}   {ratios[-1]:5.2f}")
    print(f"median ratio {statistics.median(ratios):.2f} (at least 0.5 wanted)")


if __name__ == "__main__":
    main()
