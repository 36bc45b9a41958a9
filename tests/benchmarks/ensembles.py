"""What an ensemble costs beside its simulations: ``python -m tests.benchmarks.ensembles``.

Prints the share of the processor time that 1000 short runs spend outside the engine, in one
process, and how much faster two processes do 200 runs of the ring; asserts no seconds.
"""

import time

import netkf
from netkf.engines.processes.engine import ProcessesEngine
from tests.conftest import SCENARIOS


def outside(scenario, runs):
    """Share of processor time that is not spent in the engine."""
    plain, inside = ProcessesEngine.run, 0.0

    def timed(*arguments):
        nonlocal inside
        began = time.process_time()
        try:
            return plain(*arguments)
        finally:
            inside += time.process_time() - began

    netkf.monte_carlo(scenario, 10, workers=1)
    ProcessesEngine.run = timed
    began = time.process_time()
    netkf.monte_carlo(scenario, runs, workers=1)
    ProcessesEngine.run = plain
    return 1.0 - inside / (time.process_time() - began)


def seconds(scenario, runs, workers):
    """Wall time, with worker processes that start anew."""
    began = time.perf_counter()
    netkf.monte_carlo(scenario, runs, workers=workers)
    return time.perf_counter() - began


if __name__ == "__main__":
    ring = netkf.load(SCENARIOS / "poisson_ring.toml")
    share = outside(ring.replace({"horizon": 2.0}), 1000)
    print(f"outside the engine: {100.0 * share:.1f} % of the time of 1000 short runs")
    ratio = seconds(ring, 200, 1) / seconds(ring, 200, 2)
    print(f"two processes are {ratio:.2f} times as fast as one for 200 runs of the ring")
