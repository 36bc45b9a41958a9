"""netkf against other ways to the same results: one table of ratios.

    python -m tests.benchmarks.compiled [--runs 5] [--quick]

Every line is the median of ratios of runs made in turn on this machine, in processor time of all
threads: times of a shared machine mean little. Each pair must make the same events, so that speed
never hides a changed run. What is compiled is loaded beforehand. The compiled engine runs against

- the SimPy engine, on every scenario that both run;
- bare SimPy, a process a link, with one compiled call a tick that does the work of the loop by hand
  (here netkf is SimPy with compiled filters, as ``engine = "processes"`` gives it; also against
  itself with nothing compiled);
- a loop by hand, which replays the same ticks of 1000 nodes (flow of xhat and P over each gap,
  resets), written for the purpose in numba without a trace, sensors or delays; netkf without a
  trace, as ensembles run it, and with all its rows and their fingerprint, as a single run has them;
- the same job with filterpy or Stone Soup objects and a heap of ticks (``peers``), as a user
  without netkf would write it, who has no trace either; and with netkf's.

Below: the bound (12) against scipy's solve_ivp on the stacked system, and draws of the invariant
law of the random Riccati equation against a plain numpy loop, both a chain's step.
"""

import argparse
import importlib.util
import math
import statistics
import time
from functools import partial
from pathlib import Path

import numpy as np
import simpy

import netkf
from netkf.engines.base import silent
from netkf.engines.compiled.engine import CompiledEngine
from netkf.engines.compiled.poisson import schedule
from netkf.engines.compiled.schedule import EntityDraws
from netkf.engines.compiled.senders import senders_of
from netkf.engines.compiled.state import entity_records, filters_at_start
from netkf.engines.simpy.engine import SimpyEngine
from netkf.rng.streams import Streams
from netkf.theory.intermittent import riccati as intermittent
from netkf.trace.recorder import MemorySink, Recorder
from tests.benchmarks import peers
from tests.benchmarks.engine import scenario as thousand

SCENARIOS = Path(__file__).parents[2] / "scenarios"


def timed(call):
    began = time.process_time()
    value = call()
    return time.process_time() - began, value


def engine_run(engine, case):
    """The fingerprint of one run, and its numbers of events and ticks."""
    return recorded_run(engine, case, Recorder([MemorySink()]))


def recorded_run(engine, case, recorder):
    assert engine.run(case, Streams(case.seed), recorder, silent) == "complete"
    return recorder.fingerprint, recorder.total, recorder.count("tick")


def ticks_with_trace(case):
    return engine_run(CompiledEngine(), case)[2]


def ticks_without_trace(case):
    return recorded_run(CompiledEngine(), case, Recorder([], counted=True))[2]


def ticks_of(job, case, most):
    return job(case, peers.clocks(case, most))[0]


def by_hand(table, window, ends, weights, xhat, P, now):
    """Flow both ends to each tick and reset who got a message; returns the number of ticks."""
    n = xhat.shape[1]
    E = np.empty(table.shape[1] - 1)
    X, Y = np.empty((n, n)), np.empty(n)
    for tick in range(len(window.t)):
        t, link = window.t[tick], window.entity[tick]
        for side in range(2):
            h = ends[link, side]
            gap, power, k = t - now[h], 1.0, 0
            for j in range(len(E)):
                E[j] = table[0, j]
            while gap > table[k, -1]:  # as many terms as the gap needs
                k += 1
                power *= gap
                for j in range(len(E)):
                    E[j] += power * table[k, j]
            for i in range(n):
                Y[i] = 0.0
                for j in range(n):
                    Y[i] += E[i * n + j] * xhat[h, j]
                    X[i, j] = 0.0
                    for k in range(n):
                        X[i, j] += E[i * n + k] * P[h, k, j]
            for i in range(n):
                xhat[h, i] = Y[i]
                for j in range(n):
                    P[h, i, j] = E[(n + i) * n + j]
                    for k in range(n):
                        P[h, i, j] += X[i, k] * E[j * n + k]
            now[h] = t
        i, j = ends[link]
        w_i = weights[link, 1] if window.delay[window.at[tick] + 1] == 0.0 else 0.0
        w_j = weights[link, 0] if window.delay[window.at[tick]] == 0.0 else 0.0
        for a in range(n):
            d = xhat[j, a] - xhat[i, a]
            xhat[i, a] += w_i * d
            xhat[j, a] -= w_j * d
            for b in range(n):
                d = P[j, a, b] - P[i, a, b]
                P[i, a, b] += w_i * d
                P[j, a, b] -= w_j * d
    return len(window.t)


def tables(case):
    """Ends (L, 2) and weights (L, 2) of links, xhat, P and times of nodes, the series of a gap."""
    start, (entities, ways) = filters_at_start(case), entity_records(case, senders_of(case))
    ends = np.stack([entities["sender"], entities["other"]], axis=1)
    P = start.root @ np.swapaxes(start.root, 1, 2)
    nodes = start.xhat, np.ascontiguousarray(P), np.zeros(len(P))
    return ends, ways["weight"].reshape(-1, 2).copy(), nodes, case.models[0].prediction.blind


def hand_written(case):
    """Draw the schedule as the engine does and replay it."""
    import numba

    fast = numba.njit(nogil=True, error_model="numpy")(by_hand)

    def run():
        ends, weights, nodes, series = tables(case)
        windows, ticks = schedule(case, Streams(case.seed)), 0
        while True:
            window = windows.following()
            ticks += fast(series, window, ends, weights, *nodes)
            if math.isinf(window.end):
                return ticks

    return run


def bare_simpy(case):
    """A SimPy process a link that yields at the engine's ticks, and a compiled call for each."""
    import numba

    fast = numba.njit(nogil=True, error_model="numpy")(by_hand)

    def run():
        ends, weights, nodes, series = tables(case)
        draws = EntityDraws(case, Streams(case.seed), senders_of(case))
        env, made = simpy.Environment(), 0

        def ticking(k):
            nonlocal made
            link = np.array([k])
            while draws.last[k] < math.inf:
                ticks = draws.more(link)
                for m in range(len(ticks.t)):
                    yield env.timeout(ticks.t[m] - env.now)
                    part = ticks.chosen(np.array([m]), draws.sizes)
                    made += fast(series, part.window(0.0, draws.sizes), ends, weights, *nodes)

        for k in range(draws.count):
            env.process(ticking(k))
        env.run()
        return made

    return run


def line(*cells):
    print(f"{cells[0]:34s} {cells[1]:>12} {cells[2]:>14} {cells[3]:>14} {cells[4]:>8}", flush=True)


def compared(name, runs, mine, theirs, most=math.inf):
    """One line: two calls in turn, each gives its number of events (equal unless ``theirs`` makes
    only the first ``most``). Returns the median seconds of an event of mine.
    """
    mine()  # loads what is compiled
    pairs = [(timed(mine), timed(theirs)) for _ in range(runs)]
    (made,), (others,) = ({pair[k][1] for pair in pairs} for k in (0, 1))
    assert others == min(made, most) > 0, "the same events"
    each = [(a / made, b / others) for (a, _), (b, _) in pairs]
    a, b = (statistics.median(pair[k] for pair in each) for k in (0, 1))
    ratio = statistics.median(b / a for a, b in each)
    line(name, f"{made:,}", f"{1.0 / a:,.3g}", f"{1.0 / b:,.3g}", f"{ratio:.3g}")
    return a


def engines(name, case, runs, fast):
    """An engine against SimPy with nothing compiled: the same fingerprints, too."""
    seen = set()

    def events(engine):
        fingerprint, total, ticks = engine_run(engine, case)
        seen.add((fingerprint, ticks))
        return total

    compared(name, runs, lambda: events(fast), lambda: events(SimpyEngine()))
    assert len(seen) == 1, "the same events"


def by_others(name, case, runs, most):
    """The first ``most`` ticks with objects of other packages, for each of them installed."""
    for package, words, job in (
        ("filterpy", "filterpy", peers.filterpy_job),
        ("stonesoup", "Stone Soup", peers.stone_soup_job),
    ):
        if importlib.util.find_spec(package) is None:
            print(f"{words} is not installed (pip install {package}): left out")
            continue
        theirs = partial(ticks_of, job, case, most)
        compared(f"{words}, {name}", runs, partial(ticks_without_trace, case), theirs, most)
        compared("  netkf with its trace", runs, partial(ticks_with_trace, case), theirs, most)


def bound(case, constants, runs):
    """The bound over some time constants, and its cost in evaluations of the right-hand side."""
    lasts = peers.time_constant(case)
    times = np.linspace(0.0, constants * lasts, 41)
    found = {}

    def netkfs():
        found["netkf"] = netkf.theory.covariance_bound(case, times)
        return len(times)

    def stacked():
        found["system"] = peers.StackedBound(case)
        found["scipy"] = found["system"].solved(times)
        return len(times)

    seconds = len(times) * compared("bound (12) by solve_ivp, n = 4", runs, netkfs, stacked)
    error = np.abs(found["netkf"] - found["scipy"]).max() / np.abs(found["netkf"]).max()
    assert error < 1e-6, "the same bound"
    system, y = found["system"], found["netkf"][-1].reshape(-1)
    evaluations = system.evaluations
    once = statistics.median(timed(lambda: system.slope(0.0, y))[0] for _ in range(100))
    cost = seconds / once / constants
    print(
        f"  {len(case.nodes)} nodes, {constants} time constants of {lasts:.2f} s (of the slowest"
        f" mode at the steady state);\n  netkf takes the time of {cost:.0f} evaluations of the"
        f" right-hand side in a time constant, {cost / lasts:.0f} in a second;"
        f"\n  solve_ivp makes {evaluations / constants:.0f} in a time constant"
    )


def invariant(samples, runs):
    """Steps of chains: those that invariant_samples takes, and as many of a plain loop."""
    F, Q, H, R = peers.random_system()
    random = np.random.default_rng(1)
    words, roots = random.random((200, 64)) < 0.7, np.broadcast_to(np.eye(4), (200, 4, 4))
    plain = intermittent.advance

    def mine():
        taken = 0

        def counted(starts, some, *others):
            nonlocal taken
            taken += some.size
            return plain(starts, some, *others)

        intermittent.advance = counted
        try:
            netkf.theory.invariant_samples(F, Q, H, R, 0.7, samples, 1)
        finally:
            intermittent.advance = plain
        return taken

    def theirs():
        return len(peers.plain_chains(roots, words, F, Q, H, R)) * words.shape[1]

    compared("invariant law by a numpy loop", runs, mine, theirs, words.size)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="short horizons, small networks")
    options = parser.parse_args()
    runs, share = options.runs, 0.2 if options.quick else 1.0
    line("against", "events", "netkf/s", "theirs/s", "ratio")
    for file in sorted(SCENARIOS.glob("*.toml")):
        case = netkf.load(file)
        if CompiledEngine().refusal(case) is None:
            horizon = max(case.horizon * share, float(np.max(case.probe)))
            case = case.replace({"horizon": horizon})
            engines(f"SimPy, {file.stem}", case, runs, CompiledEngine())
    big = thousand()
    short = big.replace({"horizon": max(4.0 * share, 1.0), "probe": 1.0})
    engines("SimPy, 1000 nodes, 4000 links", short, runs, CompiledEngine())
    fifty = peers.planar(50, 5.0).replace({"horizon": 40.0 * share, "probe": 4.0 * share})
    mixed = SimpyEngine(compiled=True)
    engines("SimPy, its filters compiled, n = 4", fifty, runs, mixed)
    blind = fifty.replace({"sensors": []})
    compared(
        "bare SimPy, a call a tick", runs, lambda: engine_run(mixed, blind)[2], bare_simpy(blind)
    )
    long = big.replace({"horizon": 40.0 * share, "probe": 40.0 * share})
    hand = hand_written(long)
    hand()
    compared("a loop by hand, 1000 nodes", runs, partial(ticks_without_trace, long), hand)
    compared("  netkf with its trace", runs, partial(ticks_with_trace, long), hand)
    most = 400 if options.quick else 2000
    by_others("n = 2, 2 sensors", long, runs, most)
    four = peers.planar(1000).replace({"horizon": 40.0 * share, "probe": 40.0 * share})
    by_others("n = 4, 334 sensors", four, runs, most)
    bound(peers.planar(200 if options.quick else 1000), 2 if options.quick else 10, runs)
    invariant(2000 if options.quick else 20_000, runs)


if __name__ == "__main__":
    main()
