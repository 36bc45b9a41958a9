"""Scenarios with the push-sum filter: reference systems and P section 5."""

from pathlib import Path

import numpy as np

from netkf.scenario.reading import from_table

SENSING = {4: [[1.0, 0.0, 0.0, 0.0]], 9: [[0.0, 1.0, 0.0, 0.0]]}
T1 = "1-4 2-6 3-6 1-7 5-7 6-7 2-8 5-8 4-8 1-9 2-9 3-9 5-9 1-10 3-10 5-10 8-10"
T1 = [[int(end) - 1 for end in link.split("-")] for link in T1.split()]
RHO_T1 = 6.680027651837369


def scenario(edges, F, Q, H, R, gamma, delta, delivery, nodes=None, **more):
    """``H`` and ``R`` by node; ``more`` goes to the filter but for ``symmetric``."""
    symmetric = more.pop("symmetric", True)
    table = {
        "format": 1,
        "name": "push-sum",
        "horizon": 10.0,
        "probe": 1.0,
        "plant": {"kind": "linear", "F": F, "Q": Q, "period": 1.0},
        "sensors": [{"nodes": [k], "H": H[k], "R": R[k]} for k in H],
        "network": {
            "graph": {"kind": "edges", "edges": edges},
            "activation": {"kind": "broadcast"},
            "channel": {
                "loss": {"kind": "bernoulli", "delivery": delivery},
                "symmetric": symmetric,
            },
        },
        "filter": {"kind": "push-sum", "gamma": gamma, "delta": delta, **more},
    }
    if nodes is not None:
        table["network"]["graph"]["nodes"] = nodes
    return from_table(table, Path.cwd())


def of_case(case, gamma, delivery, **more):
    """A system of ``mean_square_tables`` or ``bounds``."""
    H = {k: C for k, C in enumerate(case["C"]) if C}
    R = {k: case["R"][k] for k in H}
    return scenario(
        case["edges"], case["A"], case["Q"], H, R, gamma, case["delta"], delivery, **more
    )


def planar(gamma, delivery, delta=4.01, lower_right=0.25, edges=T1, **more):
    """P section 5 with tau = 0.25; its Q has ``lower_right`` I_2 in the lower right corner."""
    tau, one, none = 0.25, np.eye(2), np.zeros((2, 2))
    F = np.block([[one, tau * one], [none, one]])
    cross = 0.5 * tau**2 * one
    Q = 0.05**2 * np.block([[tau**3 / 3.0 * one, cross], [cross, lower_right * one]])
    R = {k: [[0.1**2]] for k in SENSING}
    return scenario(edges, F.tolist(), Q.tolist(), SENSING, R, gamma, delta, delivery, **more)
