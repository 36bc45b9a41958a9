"""The compiled engine against the SimPy engine, a loop written by hand, and filterpy objects.

    python -m tests.benchmarks.compiled [--runs 3] [--quick]

Every line is a ratio of runs made in turn on this machine, the least of several: times of a shared
machine mean little. Each engine must make the same events, so that speed never hides a changed run.
The loop by hand replays the same ticks of 1000 nodes (flow of xhat and P over each gap, resets),
written for the purpose in numba without a trace, sensors or delays; the job with filterpy is the
same with one KalmanFilter a node and a heap of ticks, as a user without netkf would write it.
"""

import argparse
import heapq
import math
import time
from pathlib import Path

import numpy as np

import netkf
from netkf.core.streams import Streams
from netkf.engines.base import silent
from netkf.engines.compiled.engine import CompiledEngine
from netkf.engines.compiled.schedule import Schedule
from netkf.engines.compiled.tables import host_tables, link_tables
from netkf.engines.processes.engine import ProcessesEngine
from netkf.trace.recorder import MemorySink, Recorder
from tests.benchmarks.engine import scenario as thousand

SCENARIOS = Path(__file__).parents[2] / "scenarios"


def timed(call):
    began = time.perf_counter()
    value = call()
    return time.perf_counter() - began, value


def engine_run(engine, case):
    """The fingerprint of one run, and its numbers of events and ticks."""
    recorder = Recorder([MemorySink()])
    assert engine.run(case, Streams(case.seed), recorder, silent) == "complete"
    return recorder.fingerprint, recorder.total, recorder.count("tick")


def by_hand(table, window, ends, weights, xhat, P, now):
    """Flow both ends to each tick and reset who got a message; returns the number of ticks."""
    n = xhat.shape[1]
    E = np.empty(table.shape[1])
    X, Y = np.empty((n, n)), np.empty((n, n))
    for tick in range(len(window.t)):
        t, link = window.t[tick], window.link[tick]
        for side in range(2):
            h = ends[link, side]
            gap, power = t - now[h], 1.0
            for j in range(len(E)):
                E[j] = table[0, j]
            for k in range(1, table.shape[0]):
                power *= gap
                for j in range(len(E)):
                    E[j] += power * table[k, j]
            for i in range(n):  # transposed, so that the solution has columns of P'
                for j in range(n):
                    a, b = E[i * 2 * n + j], E[(n + i) * 2 * n + j]
                    for k in range(n):
                        a += E[i * 2 * n + n + k] * P[h, k, j]
                        b += E[(n + i) * 2 * n + n + k] * P[h, k, j]
                    X[j, i], Y[j, i] = a, b
            for k in range(n):
                best = k
                for i in range(k + 1, n):
                    if abs(X[i, k]) > abs(X[best, k]):
                        best = i
                for j in range(n):
                    X[k, j], X[best, j] = X[best, j], X[k, j]
                    Y[k, j], Y[best, j] = Y[best, j], Y[k, j]
                for i in range(k + 1, n):
                    f = X[i, k] / X[k, k]
                    for j in range(k, n):
                        X[i, j] -= f * X[k, j]
                    for j in range(n):
                        Y[i, j] -= f * Y[k, j]
            for i in range(n - 1, -1, -1):
                for j in range(n):
                    for k in range(i + 1, n):
                        Y[i, j] -= X[i, k] * Y[k, j]
                    Y[i, j] /= X[i, i]
            for i in range(n):
                X[0, i] = 0.0
                for j in range(n):
                    P[h, i, j] = 0.5 * (Y[i, j] + Y[j, i])
                    X[0, i] += E[4 * n * n + i * n + j] * xhat[h, j]
            for i in range(n):
                xhat[h, i] = X[0, i]
            now[h] = t
        i, j = ends[link]
        w_i = weights[link, 1] if window.delay[tick, 1] == 0.0 else 0.0
        w_j = weights[link, 0] if window.delay[tick, 0] == 0.0 else 0.0
        for a in range(n):
            d = xhat[j, a] - xhat[i, a]
            xhat[i, a] += w_i * d
            xhat[j, a] -= w_j * d
            for b in range(n):
                d = P[j, a, b] - P[i, a, b]
                P[i, a, b] += w_i * d
                P[j, a, b] -= w_j * d
    return len(window.t)


def hand_written(case):
    """Draw the schedule as the engine does and replay it."""
    import numba

    fast = numba.njit(nogil=True, error_model="numpy")(by_hand)

    def run():
        hosts, models = host_tables(case)
        links, schedule = link_tables(case), Schedule(case, Streams(case.seed))
        series, ticks = models.series[-1], 0
        while True:
            window = schedule.following()
            ticks += fast(series, window, links.ends, links.weight, hosts.xhat, hosts.P, hosts.now)
            if math.isinf(window.end):
                return ticks

    return run


def filterpy_job(case, most):
    """The first ``most`` ticks with one KalmanFilter a node; None where filterpy is missing."""
    try:
        from filterpy.kalman import KalmanFilter
    except ImportError:
        return None
    from scipy.linalg import expm

    n, truth = case.plant.n, case.truth
    epsilon = case.filter.algorithm.epsilon

    def discrete(gap):
        M = expm(np.block([[-truth.A, truth.Q], [np.zeros((n, n)), truth.A.T]]) * gap)
        F = M[n:, n:].T
        return F, F @ M[:n, n:]

    def run():
        random = np.random.default_rng(1)
        rate = case.network.activation.rate
        nodes, now = {}, dict.fromkeys(case.nodes, 0.0)
        for node in case.nodes:
            nodes[node] = KalmanFilter(dim_x=n, dim_z=1)
            nodes[node].P = np.array(case.truth.start_cov)
        heap = [(random.exponential(1.0 / rate), link) for link in case.topology.links]
        heapq.heapify(heap)
        for _ in range(most):
            t, (i, j) = heap[0]
            for h in (i, j):
                F, Q = discrete(t - now[h])
                nodes[h].predict(F=F, Q=Q)
                now[h] = t
            if random.random() < case.network.channel.loss.delivery:
                a, b = nodes[i], nodes[j]
                mean, cov = epsilon * (b.x - a.x), epsilon * (b.P - a.P)
                a.x, a.P, b.x, b.P = a.x + mean, a.P + cov, b.x - mean, b.P - cov
            heapq.heapreplace(heap, (t + random.exponential(1.0 / rate), (i, j)))
        return most

    return run


def least(call, runs):
    """The least seconds of several runs, and what they all returned."""
    found = [timed(call) for _ in range(runs)]
    assert len({repr(value) for _, value in found}) == 1
    return min(seconds for seconds, _ in found), found[0][1]


def line(*cells):
    print(f"{cells[0]:34s} {cells[1]:>12} {cells[2]:>14} {cells[3]:>14} {cells[4]:>8}")


def engines(name, case, runs):
    """One line: the two engines in turn."""
    fast, slow = CompiledEngine(), ProcessesEngine()
    engine_run(fast, case)
    pairs = [
        (timed(lambda: engine_run(fast, case)), timed(lambda: engine_run(slow, case)))
        for _ in range(runs)
    ]
    assert len({value for pair in pairs for _, value in pair}) == 1, "the same events"
    events = pairs[0][0][1][1]
    a, b = (min(pair[k][0] for pair in pairs) for k in range(2))
    line(name, f"{events:,}", f"{events / a:,.0f}", f"{events / b:,.0f}", f"{b / a:.1f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--quick", action="store_true", help="short horizons")
    options = parser.parse_args()
    share = 0.2 if options.quick else 1.0
    line("scenario", "events", "compiled/s", "SimPy/s", "ratio")
    for file in sorted(SCENARIOS.glob("*.toml")):
        case = netkf.load(file)
        if CompiledEngine().refusal(case) is None:
            horizon = max(case.horizon * share, float(np.max(case.probe)))
            engines(file.stem, case.replace({"horizon": horizon}), options.runs)
    big = thousand()
    engines("1000 nodes, 4000 links", big, options.runs)
    long = big.replace({"horizon": 40.0 * share, "probe": 40.0 * share})
    print()
    line("1000 nodes, 4000 links", "ticks", "ticks/s", "compiled/s", "ratio")
    run = hand_written(long)
    run()
    hand, ticks = least(run, options.runs)
    mine, (*_, made) = least(lambda: engine_run(CompiledEngine(), long), options.runs)
    assert made == ticks, "the same ticks"
    cells = f"{ticks / hand:,.0f}", f"{ticks / mine:,.0f}", f"{mine / hand:.2f}"
    line("loop by hand, slower by", f"{ticks:,}", *cells)
    job = filterpy_job(big, 2000)
    if job is None:
        print("filterpy is not installed (pip install filterpy): that comparison is left out")
    else:
        theirs, done = least(job, options.runs)
        ratio = (theirs / done) / (mine / ticks)
        cells = f"{done / theirs:,.0f}", f"{ticks / mine:,.0f}", f"{ratio:,.0f}"
        line("filterpy and heapq, faster by", f"{done:,}", *cells)


if __name__ == "__main__":
    main()
