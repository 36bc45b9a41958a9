"""When was which node worst, and why? Find the largest covariance of a run and explain it.

python scenarios/worst_moment.py
"""

from pathlib import Path

import numpy as np

import netkf

RING = Path(__file__).with_name("poisson_ring.toml")


def main(seed=1, replays=200):
    """Return the explanation of the largest trace of P after the first third of a run."""
    run = netkf.simulate(netkf.load(RING), seed=seed)
    traces = run.P.trace(axis1=2, axis2=3)
    traces[: len(run.times) // 3] = 0.0
    k, node = np.unravel_index(traces.argmax(), traces.shape)
    return netkf.why(run, run.nodes[node], run.times[k], replays=replays)


if __name__ == "__main__":
    print(main())
