r"""Weak consensus of the gossip filter: the law of P at each sensor, a random sensor, a token.

    netkf run scenarios/gossip_ring.toml --runs 400 --trace full --out gossip --set horizon=60 \
        --set probe=60
    python analysis/weak_consensus.py gossip --out weak_consensus.png

G Theorem 10: the law at a uniformly random sensor is that of the stationary switched chain at every
time; every token converges to the same law. Fixed sensors do not share one law (derived; the
introduction of the paper says otherwise).
"""

import argparse
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

import netkf


def token_positions(run, slots):
    """(N,) place of each token after that many slots, from the swaps in the trace."""
    swaps = run.events[run.events.kind == "swap"]
    period = run.scenario.plant.period
    index = {node: k for k, node in enumerate(run.nodes)}
    position = np.arange(len(index))
    for slot, rows in swaps.groupby(np.floor(swaps.t / period).astype(int)):
        if slot < slots:
            came_from = np.arange(len(index))
            for node, peer in zip(rows.node, rows.peer, strict=True):
                came_from[index[node]] = index[peer]
            position = np.argsort(came_from)[position]
    return position


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("directory", type=Path, metavar="DIR", help="an ensemble with all traces")
    parser.add_argument("--out", type=Path, default=Path("weak_consensus.png"))
    options = parser.parse_args(arguments)
    ensemble = netkf.open(options.directory)
    if not isinstance(ensemble, netkf.Ensemble):
        raise SystemExit(f"{options.directory}: holds no ensemble; make one with netkf run --runs")
    scenario, slots = ensemble.scenario, round(ensemble.times[-1] / ensemble.scenario.plant.period)
    traces, tokens = [], []
    for replica in range(ensemble.runs[-1]):  # one value a replica: no correlated samples
        run = ensemble.replica(replica)
        trace = np.trace(run.P[-1], axis1=1, axis2=2)
        traces.append(trace)
        tokens.append(trace[token_positions(run, slots)])
    traces, tokens = np.array(traces), np.array(tokens)
    pick = np.random.default_rng(0).integers(traces.shape[1], size=len(traces))
    random_sensor = np.sort(traces[np.arange(len(traces)), pick])
    share = np.arange(1, len(traces) + 1) / len(traces)
    with mpl.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(11, 4.2), layout="constrained")
        for ax, values, words in zip(
            figure.subplots(1, 2, sharey=True), (traces, tokens), ("sensor", "token"), strict=True
        ):
            for k, node in enumerate(scenario.nodes):
                ax.step(np.sort(values[:, k]), share, where="post", lw=1.1, label=f"{words} {node}")
            ax.step(
                random_sensor, share, where="post", color="#222222", lw=1.8, label="random sensor"
            )
            ax.set(xscale="log", xlabel="trace of P", title=f"law at each {words}, slot {slots}")
            ax.legend(frameon=False, fontsize=8)
        figure.savefig(options.out, dpi=130)
    spread = lambda values: np.ptp(np.median(values, axis=0)) / np.median(values)  # noqa: E731
    print(
        f"spread of the medians: sensors {spread(traces):.2f}, tokens {spread(tokens):.2f} "
        f"({len(traces)} replicas, one value each)"
    )
    print("as in the paper: tokens and a random sensor share one law;")
    print("not as in its introduction: fixed sensors do not, the blind one is worst for ever.")
    print(f"written to {options.out}")
    return spread(traces), spread(tokens)


if __name__ == "__main__":
    main()
