"""What an event costs as the network grows, and how long a run takes to start.

    python -m tests.benchmarks.scale [--events 1000000] [--links 100 1000 10000] [--plot FILE]
    python -m tests.benchmarks.scale --nodes 10000 100000

Hybrid filters on regular graphs of degree 8, the compiled engine, every row to Parquet. A line a
size: seconds until the first event (draws of all links, tables of all nodes), nanoseconds an event
from then on, bytes a row, and the peak memory of the process so far, by the operating system.

``--nodes``: ``netkf run`` on so many nodes of degree 4 instead, everything it does included;
processor time and peak memory of the command, after a first one that compiles, and what its summary
says about the bound.
"""

import argparse
import json
import os
import resource
import sys
import tempfile
import time
from pathlib import Path

from netkf.engines.compiled.engine import CompiledEngine
from netkf.rng.streams import Streams
from netkf.runs.parquet_files import ParquetSink
from netkf.trace.recorder import Recorder
from tests.benchmarks.cases import SCENARIOS, load

ROWS_A_TICK = 6.4


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


def command(nodes, folder):
    """Seconds of processor time, peak MiB and the summary of ``netkf run`` over 2 s."""
    out = Path(folder) / f"nodes-{nodes}"
    graph = f'{{kind="regular", nodes={nodes}, degree=4, seed=1}}'
    # The weights at a node must sum to less than 1.
    settings = [f"network.graph={graph}", "horizon=2.0", "probe=1.0", "filter.epsilon=0.2"]
    words = [sys.executable, "-m", "netkf", "run", str(SCENARIOS / "poisson_ring.toml")]
    for setting in settings:
        words += ["--set", setting]
    words += ["--out", str(out), "--no-plot"]
    quiet = [(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)]
    child = os.posix_spawn(sys.executable, words, os.environ, file_actions=quiet)
    _, status, usage = os.wait4(child, 0)  # of this child alone
    assert status == 0, f"netkf run ended with {os.waitstatus_to_exitcode(status)}"
    summary = json.loads((out / "summary.json").read_text())
    assert len(summary["nodes"]) == nodes
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024, summary


def commands(sizes):
    with tempfile.TemporaryDirectory() as folder:
        command(6, folder)
        found = [(nodes, *command(nodes, folder)) for nodes in sizes]
    print(f"{'nodes':>8} {'CPU, s':>8} {'MiB':>6}  mean trace / bound")
    for nodes, seconds, peak, summary in found:
        ratio = summary["overall"]["ratio"]
        bound = summary["bound"] if ratio is None else f"{ratio:.4f}"
        print(f"{nodes:8,} {seconds:8.1f} {peak:6.0f}  {bound}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--events", type=int, default=1_000_000)
    parser.add_argument("--links", type=int, nargs="+", default=[100, 1000, 10_000, 100_000])
    parser.add_argument("--plot", type=Path, help="a picture of cost against size")
    parser.add_argument("--nodes", type=int, nargs="+", help="run the command line")
    options = parser.parse_args()
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
