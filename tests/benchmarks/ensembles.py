"""What an ensemble costs beside its simulations: ``python -m tests.benchmarks.ensembles``.

Prints the share of the processor time that 1000 short runs of SimPy spend outside the engine, in
one process; how much faster two processes do 200 runs of the ring by SimPy; and how much faster
compiled runs of the ring are side by side than one after the other. Asserts the same results and
no seconds.
"""

import statistics
import time

import numpy as np

import netkf
from netkf.engines.simpy.engine import SimpyEngine
from tests.conftest import SCENARIOS

TOGETHER = 4096
SIMPY = SimpyEngine()  # with nothing compiled


def outside(scenario, runs):
    """Share of processor time that is not spent in the engine."""
    plain, inside = SimpyEngine.run, 0.0

    def timed(*arguments):
        nonlocal inside
        began = time.process_time()
        try:
            return plain(*arguments)
        finally:
            inside += time.process_time() - began

    netkf.monte_carlo(scenario, 10, workers=1, engine=SIMPY)
    SimpyEngine.run = timed
    began = time.process_time()
    netkf.monte_carlo(scenario, runs, workers=1, engine=SIMPY)
    SimpyEngine.run = plain
    return 1.0 - inside / (time.process_time() - began)


def seconds(scenario, runs, workers, engine):
    """Wall time, with worker processes that start anew, and the mean of P."""
    began = time.perf_counter()
    found = netkf.monte_carlo(scenario, runs, workers=workers, engine=engine)
    return time.perf_counter() - began, found.mean_P


def one_by_one(scenario, runs):
    """Wall time of as many calls of ``netkf.simulate``, and the mean of P."""
    began, total = time.perf_counter(), 0.0
    for replica in range(runs):
        total = total + netkf.simulate(scenario, replica=replica, engine="compiled").P
    return time.perf_counter() - began, total / runs


def side_by_side(scenario):
    """Ratios of the time of runs one by one to that in one process, and in two."""
    found = {1: [], 2: []}
    one_by_one(scenario, 10)
    for _ in range(3):
        alone, P = one_by_one(scenario, TOGETHER // 8)
        _, mean = seconds(scenario, TOGETHER // 8, 1, "compiled")
        np.testing.assert_allclose(P, mean, rtol=1e-9, err_msg="the same runs")
        for workers, ratios in found.items():
            ratios.append(8.0 * alone / seconds(scenario, TOGETHER, workers, "compiled")[0])
    return [statistics.median(ratios) for ratios in found.values()]


if __name__ == "__main__":
    ring = netkf.load(SCENARIOS / "poisson_ring.toml")
    share = outside(ring.replace({"horizon": 2.0}), 1000)
    print(f"outside the engine: {100.0 * share:.1f} % of the time of 1000 short runs")
    ratio = seconds(ring, 200, 1, SIMPY)[0] / seconds(ring, 200, 2, SIMPY)[0]
    print(f"two processes are {ratio:.2f} times as fast as one for 200 runs of the ring")
    one, two = side_by_side(ring)
    print(
        f"compiled runs side by side are {one:.2f} times as fast as one after the other in one"
        f" process, {two:.2f} times in two"
    )
