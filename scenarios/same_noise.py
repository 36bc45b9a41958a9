"""Which filter is best here? All meet the same truth, the same readings and the same losses.

python scenarios/same_noise.py
"""

from pathlib import Path

import netkf
from netkf.parts import Central, CovarianceIntersection, Hybrid, Local

RING = Path(__file__).with_name("poisson_ring.toml")


def main(epsilon=0.3, runs=20):
    """Return the comparison: a row of its ``table`` for each filter, against the first one."""
    filters = [Hybrid(epsilon), CovarianceIntersection(epsilon), Local(), Central()]
    return netkf.compare_filters(netkf.load(RING), filters, runs=runs, workers=1)


if __name__ == "__main__":
    print(main().table.to_string())
