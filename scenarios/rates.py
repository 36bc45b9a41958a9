"""How often must links tick? Errors and covariances of the Poisson ring against the link rate.

python scenarios/rates.py
"""

from pathlib import Path

import netkf

RING = Path(__file__).with_name("poisson_ring.toml")


def main(rates=(0.5, 1.0, 2.0, 5.0, 10.0), runs=20):
    """Return a table with a row for each rate: the worst node against bound and central filter."""
    scenario = netkf.load(RING)
    table = netkf.sweep(scenario, {"network.activation.rate": list(rates)}, runs=runs, workers=1)
    table["below bound"] = table["mean_trace"] < table["bound"]
    columns = ["network.activation.rate", "worst_rms", "worst_rms_se", "mean_trace", "bound"]
    return table[[*columns, "below bound", "central", "sent"]]


if __name__ == "__main__":
    print(main().to_string(index=False))
