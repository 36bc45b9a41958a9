"""How close is the bound of the hybrid filters? Ensembles that were kept, against H(12) and H(13).

    netkf run scenarios/poisson_ring.toml --runs 200 --out slow --set network.activation.rate=1
    netkf run scenarios/poisson_ring.toml --runs 200 --out fast --set network.activation.rate=10
    python analysis/hybrid_bound.py slow fast

Each line is a directory: its link rate, the trace of the mean of P at the worst node at the end
with its standard error, the bound on it, how much of the bound is used there, the least and the
most that a node uses on average over the second half of the time, and the limit S of infinitely
frequent resets. H Theorem 2 says that the mean stays below the bound; Theorem 3 that
the bound approaches S as one over the rate. Only public names of netkf are used.
"""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd

import netkf


def row(directory):
    """Return what a kept ensemble of hybrid filters says about the bound."""
    ensemble = netkf.open(directory)
    if not isinstance(ensemble, netkf.Ensemble):
        raise SystemExit(f"{directory}: holds no ensemble; make one with netkf run --runs")
    scenario = ensemble.scenario
    mean = np.trace(ensemble.mean_P[-1], axis1=1, axis2=2)
    # Errors of the entries of one matrix are taken as one: a bound on that of their sum.
    error = np.trace(ensemble.se_P[-1], axis1=1, axis2=2)
    late = ensemble.times >= ensemble.times[-1] / 2.0
    bounds = netkf.theory.covariance_bound(scenario, ensemble.times[late])
    bounds = np.trace(bounds, axis1=2, axis2=3)
    used = (np.trace(ensemble.mean_P[late], axis1=2, axis2=3) / bounds).mean(axis=0)
    bound = bounds[-1]
    worst = int(np.argmax(mean))
    limit = np.trace(netkf.theory.limit_covariance(scenario))
    return {
        "directory": str(directory),
        "rate": scenario.network.activation.rate,
        "runs": int(ensemble.runs[-1]),
        "worst node": ensemble.nodes[worst],
        "mean": mean[worst],
        "se": error[worst],
        "bound": bound[worst],
        "used": mean[worst] / bound[worst],
        "least": used.min(),
        "most": used.max(),
        "limit S": limit,
        "bound - S times rate": (bound[worst] - limit) * scenario.network.activation.rate,
    }


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("directories", type=Path, nargs="+", metavar="DIR")
    table = pd.DataFrame(map(row, parser.parse_args(arguments).directories))
    print(table.to_string(index=False, float_format=lambda value: f"{value:.4g}"))
    above = table[table["mean"] - 3.0 * table["se"] > table["bound"]]
    print("no mean is above its bound" if above.empty else f"above: {list(above['directory'])}")
    return table


if __name__ == "__main__":
    main()
