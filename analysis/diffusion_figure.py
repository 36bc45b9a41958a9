"""Tracking errors of the diffusion filter: alone, together, with everything (D Fig. 1).

    python analysis/diffusion_figure.py --out diffusion_figure.png --runs 500

Points with 95 % intervals are squared errors of simulated runs, as in the paper (which has 500: an
hour on two cores). Lines are the mean square of the error given the regressors, exact, in the mean
over the first few of these runs: its spread from run to run is far smaller. All filters show
predictions and meet the same parameters, noises and regressors.
"""

import argparse
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

import netkf
from netkf.theory import error_covariance

FILE = Path(__file__).parent.parent / "scenarios" / "diffusion_regression.toml"
TIMES = [1.0, *(100.0 * k for k in range(1, 21))]
START = {"mean": [0.0] * 3, "cov": np.eye(3).tolist()}
MODEL = {"model": {"Q": (0.1 * np.eye(3)).tolist(), "R": [[0.1]]}}
COMPLETE = {"kind": "complete", "nodes": 3}
WAYS = {
    "non-cooperative": {"filter.weights": np.eye(3).tolist()},
    "cooperative": {},
    "centralised": {
        "network.graph": COMPLETE,
        "filter": {"kind": "intermittent", **START, **MODEL},
    },
}


def one_run(replica, exact_runs, times):
    """Squared errors (ways, T, N) of one replica; exact ones and traces of P for the first few."""
    squared, exact, traces = [], [], []
    for changes in WAYS.values():
        scenario = netkf.load(FILE, {"probe": times, "horizon": times[-1], **changes})
        run = netkf.simulate(scenario, replica=replica)
        squared.append((run.error**2).sum(axis=2))
        traces.append(np.trace(run.P, axis1=2, axis2=3))
        if replica < exact_runs:
            # Mean squares, not variances: the filters start at (0, 0, 0), the truth at (1, 1, 1).
            start = scenario.replace({"plant.cov": np.ones((3, 3)).tolist()})
            exact.append(np.trace(error_covariance(start, run), axis1=2, axis2=3))
    return np.array(squared), np.array(exact), np.array(traces)


def draw(path, times, squared, exact):
    """The two panels of the figure, from (runs, ways, T, N)."""
    with mpl.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(10.5, 4.2), layout="constrained")
        axes = figure.subplots(1, 2)
        panels = (["non-cooperative"], ["cooperative", "centralised"])
        for ax, names in zip(axes, panels, strict=True):
            for name in names:
                way = list(WAYS).index(name)
                nodes = range(3) if name != "centralised" else [0]
                for i in nodes:
                    label = f"{name}, sensor {i + 1}" if len(nodes) > 1 else name
                    colour = f"C{i}" if len(nodes) > 1 else "#222222"
                    mean, spread = squared[:, way, :, i].mean(0), squared[:, way, :, i].std(0)
                    shift = times + 8.0 * (i - 1)
                    error = 1.96 * spread / np.sqrt(len(squared))
                    ax.errorbar(shift, mean, error, fmt=".", ms=3, lw=0.7, color=colour)
                    ax.plot(times, exact[:, way, :, i].mean(0), lw=1.3, color=colour, label=label)
            ax.set(xlabel="k", ylabel="mean squared error", ylim=(0.0, None))
            ax.legend(frameon=False, fontsize=8)
        figure.savefig(path, dpi=130)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("diffusion_figure.png"))
    parser.add_argument("--runs", type=int, default=60)
    parser.add_argument("--exact", type=int, default=12, help="runs with exact mean squares")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--slots", type=int, default=2000, help="of each run, at least 300")
    options = parser.parse_args(arguments)
    times = [t for t in TIMES if t <= options.slots]
    with ProcessPoolExecutor(options.workers) as pool:
        job = partial(one_run, exact_runs=options.exact, times=times)
        each = pool.map if options.workers > 1 else map
        runs = list(each(job, range(options.runs)))
    squared, traces = (np.array([run[k] for run in runs]) for k in (0, 2))
    exact = np.array([run[1] for run in runs[: options.exact]])
    draw(options.out, np.array(times), squared, exact)
    print("mean squared error of each sensor: exact given the regressors, then simulated")
    for k in (1, len(times) - 1):
        rows = (np.round(values[:, 0, k].mean(axis=0), 2) for values in (exact, squared))
        print(f"non-cooperative at k = {times[k]:g}:", *rows)
    for way, name in list(enumerate(WAYS))[1:]:
        rows = [values[:, way, 2:].mean(axis=(0, 1)) for values in (exact, squared)]
        error = exact[:, way, 2:].mean(axis=1).std(axis=0).max() / np.sqrt(len(exact))
        print(f"{name}, k >= 200:", *(np.round(row, 3) for row in rows), end=" ")
        print(f"(exact +- {error:.3f}), trace of P {traces[:, way, 2:].mean():.2f}")
    print("as in the paper: alone every sensor's error grows, together all three stay bounded;")
    print("not said there: alone it grows linearly for ever; the network costs about a fifth more")
    print("than the centralised filter; P overstates the errors by half.")
    print(f"written to {options.out}")
    return squared, exact, traces


if __name__ == "__main__":
    main()
