"""What an event costs as the network grows, and how long a run takes to start.

    python -m tests.benchmarks.scale [--events 1000000] [--links 100 1000 10000] [--plot FILE]
    python -m tests.benchmarks.scale --nodes 10000 100000
    python -m tests.benchmarks.scale --limits

Hybrid filters on regular graphs of degree 8, the compiled engine, every row to Parquet. A line a
size: seconds until the first event (draws of all links, tables of all nodes), nanoseconds an event
from then on, bytes a row, and the peak memory of the process so far, by the operating system.

``--nodes``: ``netkf run`` on so many nodes of degree 4 instead, everything it does included;
processor time and peak memory of the command, after a first one that compiles, and what its summary
says about the bound. ``--limits``: other commands likewise, beside their limits.
"""

import argparse
import json
import os
import re
import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from netkf.engines.compiled.engine import CompiledEngine
from netkf.rng.streams import Streams
from netkf.runs.parquet_files import ParquetSink
from netkf.scenario.writing import as_table, to_toml
from netkf.trace.recorder import Recorder
from tests.benchmarks.cases import SCENARIOS, hybrid, load

ROWS_A_TICK = 6.4
WEIGHT = ("filter.epsilon=0.2",)
MEMORY = 2048.0
"""MiB that a command may take."""


def scenario(links, events):
    graph = {"kind": "regular", "nodes": links // 4, "degree": 8, "seed": 1, "connected": False}
    rate = 2.0
    horizon = events / (ROWS_A_TICK * rate * links)
    changes = {"network.graph": graph, "filter.epsilon": 0.1, "horizon": horizon, "probe": horizon}
    # A plant that stays bounded by itself: most nodes are far from both sensors.
    changes["plant.A"] = [[0.0, 1.0], [-1.0, -0.1]]
    return load("poisson_ring").replace({**changes, "network.activation.rate": rate})


def measured(case):
    """Seconds until time 0 is shown, nanoseconds an event, events, bytes a row."""
    started = []
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        sink = ParquetSink(Path(folder), case)
        recorder = Recorder([sink])

        def progress(now):
            started.append(time.perf_counter())

        CompiledEngine().run(case, Streams(case.seed), recorder, progress)
        sink.close()
        ended = time.perf_counter()
        size = (Path(folder) / "events.parquet").stat().st_size
    events = recorder.total
    assert recorder.count("send") == 2 * recorder.count("tick") > 0, "both ends send"
    return started[0] - began, 1e9 * (ended - started[0]) / events, events, size / events


def command(words, folder):
    """Seconds of processor time, peak MiB and exit status of ``netkf`` with these words."""
    quiet = [(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)]
    words = [sys.executable, "-m", "netkf", *words]
    os.chdir(folder)
    child = os.posix_spawn(sys.executable, words, os.environ, file_actions=quiet)
    _, status, usage = os.wait4(child, 0)  # of this child alone
    seconds, peak = usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024
    return seconds, peak, os.waitstatus_to_exitcode(status)


def runs(nodes, folder):
    """``netkf run`` on so many nodes over 2 s: its time and memory, and its summary."""
    out = Path(folder) / f"nodes-{nodes}"
    # The weights at a node must sum to less than 1.
    settings = ["horizon=2.0", "probe=1.0", "filter.epsilon=0.2"]
    words = ["run", *of("poisson_ring", nodes, *settings), "--out", str(out), "--no-plot"]
    seconds, peak, status = command(words, folder)
    assert status == 0, f"netkf run ended with {status}"
    summary = json.loads((out / "summary.json").read_text())
    assert len(summary["nodes"]) == nodes
    return seconds, peak, summary


def commands(sizes):
    with tempfile.TemporaryDirectory() as folder:
        runs(6, folder)
        found = [(nodes, *runs(nodes, folder)) for nodes in sizes]
    print(f"{'nodes':>8} {'CPU, s':>8} {'MiB':>6}  mean trace / bound")
    for nodes, seconds, peak, summary in found:
        ratio = summary["overall"]["ratio"]
        bound = summary["bound"] if ratio is None else f"{ratio:.4f}"
        print(f"{nodes:8,} {seconds:8.1f} {peak:6.0f}  {bound}")


def of(name, nodes, *settings):
    """A scenario on a regular graph of so many nodes of degree 4, with other settings."""
    graph = f'network.graph={{kind="regular", nodes={nodes}, degree=4, seed=1}}'
    sets = (word for setting in (graph, *settings) for word in ("--set", setting))
    return [str(SCENARIOS / f"{name}.toml"), *sets]


def large_state(folder, n=32):
    """poisson_ring with a stable plant of n states, two of which each sensor sees."""
    random, eye = np.random.default_rng(1), np.eye(n)
    A, H = 0.2 * random.standard_normal((n, n)) - eye, random.standard_normal((2, n))
    plant = {"kind": "diffusion", "A": A.tolist(), "B": eye.tolist(), "cov": eye.tolist()}
    sensors = [{"nodes": [0, 3], "H": H.tolist(), "R": [[0.25, 0.0], [0.0, 0.25]]}]
    filter_ = {"kind": "hybrid", "epsilon": 0.3}
    case = load("poisson_ring").replace({"plant": plant, "sensors": sensors, "filter": filter_})
    (Path(folder) / "large.toml").write_text(to_toml(as_table(case)))


def with_sensors(folder, nodes=10_000):
    """poisson_ring's filters on a graph in which every third node has a sensor."""
    sensors = [{"nodes": list(range(0, nodes, 3)), "H": [[1.0, 0.0]], "R": [[0.25]]}]
    case = hybrid(nodes, sensors=sensors)
    (Path(folder) / "sensors.toml").write_text(to_toml(as_table(case)))


def limits():
    """A line for each command that has a limit: processor time and memory, after a first run on few
    nodes, which compiles.
    """
    push_sum = "filter.delta=5.0", "horizon=2.0", "probe=1.0"
    rows = [
        ("theory, hybrid, 10,000 nodes", ["theory", "sensors.toml"], 30.0),
        ("the same, without steady state", ["theory", *of("poisson_ring", 10_000, *WEIGHT)], 30.0),
        ("theory, hybrid, n = 32", ["theory", "large.toml"], 5.0),
        ("check, hybrid, 1000 nodes", ["check", *of("poisson_ring", 1000, *WEIGHT)], 5.0),
        ("run, push-sum, 100,000 nodes", ["run", *of("push_sum_planar", 100_000, *push_sum)], 30.0),
        (
            "check, push-sum, 10,000 nodes",
            ["check", *of("push_sum_planar", 10_000, *push_sum)],
            30.0,
        ),
    ]
    print(f"{'':32s} {'CPU, s':>8} {'limit':>6} {'MiB':>6} {'limit':>6}")
    with tempfile.TemporaryDirectory() as folder:
        large_state(folder)
        with_sensors(folder)
        for name, words, most in rows:
            command([re.sub("nodes=[0-9]+", "nodes=20", word) for word in words], folder)
            seconds, peak, status = command(words, folder)
            missed = "" if seconds <= most and peak <= MEMORY and status in (0, 1) else "  MISSED"
            print(
                f"{name:32s} {seconds:8.1f} {most:6g} {peak:6.0f} {MEMORY:6g}{missed}", flush=True
            )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--events", type=int, default=1_000_000)
    parser.add_argument("--links", type=int, nargs="+", default=[100, 1000, 10_000, 100_000])
    parser.add_argument("--plot", type=Path, help="a picture of cost against size")
    parser.add_argument("--nodes", type=int, nargs="+", help="run the command line")
    parser.add_argument("--limits", action="store_true", help="commands that have limits")
    options = parser.parse_args()
    if options.limits:
        limits()
        return
    if options.nodes:
        commands(options.nodes)
        return
    measured(scenario(100, 1000))  # loads what is compiled
    print(
        f"{'links':>8} {'events':>12} {'start, s':>9} {'ns/event':>9} {'bytes/row':>10} {'MiB':>6}"
    )
    costs = []
    for links in options.links:
        start, cost, events, size = measured(scenario(links, options.events))
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        costs.append(cost)
        print(f"{links:8,} {events:12,} {start:9.2f} {cost:9.0f} {size:10.1f} {peak:6.0f}")
    if options.plot:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(5.0, 3.5), layout="constrained")
        axes = figure.subplots()
        axes.loglog(options.links, costs, "o-")
        axes.set(
            xlabel="links", ylabel="nanoseconds an event", ylim=(min(costs) / 4, 4 * max(costs))
        )
        figure.savefig(options.plot)


if __name__ == "__main__":
    main()
