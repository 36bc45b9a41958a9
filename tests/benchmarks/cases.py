"""The scenarios of the benchmarks."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

import netkf
from netkf.kernels import kernel
from netkf.parts import KernelLoss, probability, setting

SCENARIOS = Path(__file__).parents[2] / "scenarios"


def load(name):
    return netkf.load(SCENARIOS / f"{name}.toml")


def regular(nodes, degree=4):
    return {"kind": "regular", "nodes": nodes, "degree": degree, "seed": 1, "connected": True}


def hybrid(nodes, horizon=10.0, degree=4, **changes):
    """poisson_ring's plant (n = 2) and its two sensors on a random graph."""
    whole = {
        "network.graph": regular(nodes, degree),
        "filter.epsilon": 0.8 / degree,
        "horizon": horizon,
        "probe": horizon / 2.0,
    }
    return load("poisson_ring").replace({**whole, **changes})


def planar(nodes, horizon=10.0, degree=4):
    """Two independent axes of that plant (n = 4); as there every third node has a sensor, of both
    positions.
    """
    A, B = (np.kron(np.eye(2), M).tolist() for M in ([[0.0, 1.0], [-1.0, 0.1]], [[0.0], [1.0]]))
    H, R = np.kron(np.eye(2), [[1.0, 0.0]]).tolist(), [[0.25, 0.0], [0.0, 0.25]]
    eye = np.eye(4).tolist()
    changes = {
        "plant": {"kind": "diffusion", "A": A, "B": B, "mean": [0.0] * 4, "cov": eye},
        "sensors": [{"nodes": list(range(0, nodes, 3)), "H": H, "R": R}],
        "filter.cov": eye,
    }
    return hybrid(nodes, horizon, degree, **changes)


BURSTS = {"kind": "gilbert-elliott", "mean_loss": 0.3, "mean_burst": 4.0}
LATTICE = {"kind": "periodic", "period": 0.5, "phase": "random", "jitter": 0.1}
ERLANG = {"kind": "renewal", "distribution": "gamma", "shape": 3.0, "mean": 0.5}
"""Losses and clocks, in the mean those of poisson_ring."""


def ring(loss=None, clock=None, **changes):
    """poisson_ring with other losses, clocks or anything else."""
    if loss is not None:
        changes["network.channel.loss"] = loss
    if clock is not None:
        changes["network.activation"] = clock
    return load("poisson_ring").replace(changes)


def radio(nodes):
    """intel_lab_radio on a random graph, two sensors of each axis for 30 nodes."""
    load_radio = load("intel_lab_radio")
    sensors = [
        {
            "nodes": list(range(k, nodes, 15)),
            "H": [H],
            "R": [[1.0]],
            "sampling": {"kind": "periodic", "period": 0.2, "phase": "random", "jitter": 0.02},
        }
        for k, H in ((0, [1.0, 0.0, 0.0, 0.0]), (7, [0.0, 0.0, 1.0, 0.0]))
    ]
    graph = regular(nodes, 10)
    channel = {"network.channel.loss": {"kind": "bernoulli", "delivery": 0.5}}
    return load_radio.replace(
        {"network.graph": graph, "sensors": sensors, "horizon": 10.0, **channel}
    )


def gossip(nodes):
    """gossip_ring with sensors in turn on a random graph."""
    sensors = [
        {"nodes": list(range(k, nodes, 5)), "H": [H], "R": [[R]]}
        for k, H, R in (
            (0, [1.0, 0.0, 0.0, 0.0], 1.0),
            (2, [0.0, 0.0, 1.0, 0.0], 0.5),
            (3, [1.0, 0.0, 0.0, 0.0], 1.0),
            (4, [0.0, 0.0, 1.0, 0.0], 0.5),
        )
    ]
    return load("gossip_ring").replace({"network.graph": regular(nodes), "sensors": sensors})


def push_sum(nodes):
    """push_sum_planar on a random graph, a tenth of the nodes see each coordinate."""
    sensors = [
        {"nodes": list(range(k, nodes, 10)), "H": [H], "R": [[0.01]]}
        for k, H in ((4, [1.0, 0.0, 0.0, 0.0]), (9, [0.0, 1.0, 0.0, 0.0]))
    ]
    changes = {"network.graph": regular(nodes), "sensors": sensors, "filter.delta": 5.0}
    return load("push_sum_planar").replace(changes)


def push_sum_long():
    """push_sum_planar with the averaging steps that P's Theorem 5 certifies, 40 slots."""
    return load("push_sum_planar").replace({"filter.gamma": 881, "horizon": 10.0})


def diffusion(nodes=20, m=5):
    """Node i excites component i modulo m, by a first-order process; m unknowns, 500 slots."""
    eye = np.eye(m)
    sensors = [
        {
            "nodes": list(range(k, nodes, m)),
            "kind": "regressor",
            "A": [[0.5]],
            "B": [[1.0]],
            "C": eye[:, [k]].tolist(),
            "start": [1.0],
            "xi_cov": [[0.09]],
            "R": [[0.09]],
        }
        for k in range(m)
    ]
    plant = {"kind": "linear", "F": eye.tolist(), "Q": (0.09 * eye).tolist(), "period": 1.0}
    model = {"Q": (0.1 * eye).tolist(), "R": [[0.1]]}
    return load("diffusion_regression").replace(
        {
            "plant": plant,
            "sensors": sensors,
            "network.graph": regular(nodes),
            "filter": {"kind": "diffusion", "cov": eye.tolist(), "model": model},
            "horizon": 500.0,
            "probe": 50.0,
        }
    )


def central():
    """One filter with both sensors of push_sum_planar, shown in each of 200 slots."""
    return load("push_sum_planar").replace({"filter": {"kind": "central"}, "horizon": 50.0})


def push_sum_with(**channel):
    """push_sum_planar, 40 s, whose channel has other losses or delays: tables of messages."""
    short = load("push_sum_planar").replace({"horizon": 40.0})
    return short.replace({f"network.channel.{key}": value for key, value in channel.items()})


@kernel
def even(_message, settings, _t, out):
    out[0] = settings[0]


@dataclass(frozen=True, eq=False)
class Even(KernelLoss):
    """Bernoulli losses as a user writes them."""

    law = even

    delivery: float = setting(probability)


BY_KERNEL = {"kind": f"{__name__}:Even", "delivery": 0.7}
SHARED = {"kind": "shared", "delivery": 0.7, "share": 0.3}
LATE = {"kind": "uniform", "low": 0.0, "high": 0.05}
