"""Push-sum rounds and hybrid filters in continuous time, on the same truth, samples and network.

    python analysis/push_sum_continuous.py --runs 40

Prints errors, NEES and transmissions of three filters in scenarios/push_sum_continuous.toml, at
several rates of the nodes' clocks, beside the filter with all samples and the one with no
neighbours, and at which rates push-sum is better than each of the others. It takes some minutes.
"""

import argparse
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np

import netkf

FILE = Path(__file__).parent.parent / "scenarios" / "push_sum_continuous.toml"
RATES = [0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0]
PUSH_SUM = "push-sum"
FILTERS = {
    PUSH_SUM: {"kind": "push-sum"},
    "hybrid": {"kind": "hybrid", "epsilon": 0.25},
    "covariance intersection": {"kind": "covariance-intersection", "epsilon": 0.25},
}
LIMITS = {"all samples": {"kind": "central"}, "no neighbours": {"kind": "local"}}


def one_run(case, replica):
    """Of one replica of (rate, filter): mean square error over nodes and samples after time 0, mean
    NEES, transmissions a node and second, truth (T, n).
    """
    rate, algorithm = case
    changes = {"network.activation.rate": rate, "filter": algorithm}
    scenario = netkf.load(FILE, changes)
    run = netkf.simulate(scenario, replica=replica)
    error, P = run.error[1:], run.P[1:]
    nees = np.einsum("tni,tni->tn", error, np.linalg.solve(P, error[..., None])[..., 0])
    count = (run.events.kind == "transmit").sum() / len(run.nodes) / scenario.horizon
    return (error**2).sum(axis=2).mean(), nees.mean(), count, run.x


def several(each, runs, rate, algorithm):
    """Mean square errors (runs,), NEES (runs,), transmissions, truths, of all replicas."""
    done = each(partial(one_run, (rate, algorithm)), range(runs))
    squared, nees, counts, truths = zip(*done, strict=True)
    return np.array(squared), np.array(nees), np.mean(counts), np.array(truths)


def line(name, squared, nees, count):
    """A row of the table: RMS error and mean NEES, each with its standard error."""
    root, share = np.sqrt(squared.mean()), 1.0 / np.sqrt(len(squared))
    spread = squared.std(ddof=1) * share / (2.0 * root)
    print(f"{name:>34} {root:7.3f} +-{spread:5.3f} {nees.mean():7.2f}", end="")
    print(f" +-{nees.std(ddof=1) * share:5.2f} {count:8.2f}", flush=True)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--rates", type=float, nargs="+", default=RATES, help="rounds a second")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args(arguments)
    better = {name: [] for name in FILTERS if name != PUSH_SUM}
    print(f"{'':>34} {'RMS error':>14} {'NEES, n = 2':>15} {'rounds/s':>8}")
    nees = {}
    with ProcessPoolExecutor(options.workers) as pool:
        each = pool.map if options.workers > 1 else map
        truths = None
        for name, algorithm in LIMITS.items():
            *numbers, truths = several(each, options.runs, RATES[0], algorithm)
            line(name, *numbers)
        for rate in options.rates:
            squared = {}
            for name, algorithm in FILTERS.items():
                *numbers, met = several(each, options.runs, rate, algorithm)
                assert np.array_equal(met, truths), "the truth may not depend on the network"
                line(f"{name}, {rate:g} rounds/s", *numbers)
                squared[name], nees[name, rate] = numbers[:2]
            for name, rows in better.items():
                gain = squared[name] - squared[PUSH_SUM]
                rows.append((rate, gain.mean(), gain.std(ddof=1) / np.sqrt(options.runs)))
    for name, rows in better.items():
        sure = [f"{rate:g}" for rate, gain, spread in rows if gain > 2.0 * spread]
        worse = [f"{rate:g}" for rate, gain, spread in rows if gain < -2.0 * spread]
        print(f"push-sum against {name}, run by run, beyond two standard errors of the difference:")
        print(
            f"better at {', '.join(sure) or 'no'} rounds/s, worse at {', '.join(worse) or 'none'}"
        )
    return better, nees


if __name__ == "__main__":
    main()
