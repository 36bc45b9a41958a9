"""A network in Python, with a user-defined class: messages fade with the distance of two nodes.

python scenarios/fading.py
"""

import math
from dataclasses import dataclass

import pandas as pd

import netkf
from netkf.parts import (
    Channel,
    Diffusion,
    Geometric,
    Hybrid,
    LinearSensor,
    Loss,
    Poisson,
    positive,
    setting,
)


@dataclass(frozen=True, eq=False)
class Fading(Loss):
    """A message arrives with probability ``exp(-(distance / reach)^2)``."""

    reach: float = setting(positive)
    places: tuple = ()

    def delivery_probability(self, sent):
        """Return the probability for the distance of the link."""
        (a, b), (c, d) = (self.places[node] for node in sent.link)
        return math.exp(-((math.hypot(a - c, b - d) / self.reach) ** 2))


def network(reach, nodes=12):
    """Return a scenario of nodes at random places of the unit square, two of them with a sensor."""
    graph = Geometric(nodes=nodes, radius=0.5, seed=2, connected=True)
    places = graph.build(0).positions
    loss = Fading(reach, places=tuple(places[k] for k in range(nodes)))
    return netkf.Scenario(
        name="fading",
        horizon=15.0,
        probe=0.5,
        plant=Diffusion(A=[[0.0, 1.0], [-1.0, -0.1]], B=[[0.0], [1.0]]),
        sensors=[LinearSensor(nodes=[0, nodes - 1], H=[[1.0, 0.0]], R=[[0.1]])],
        network=netkf.Network(graph, activation=Poisson(rate=2.0), channel=Channel(loss=loss)),
        filter=netkf.Filtering(Hybrid(0.08)),
    )


def main(reaches=(0.1, 0.2, 0.4, 0.8), seed=1):
    """Return a table with a row for each reach: messages delivered, and the mean trace of P."""
    rows = []
    for reach in reaches:
        run = netkf.simulate(network(reach), seed=seed)
        delivered = run.count("deliver") / run.count("send")
        late = run.P[len(run.times) // 2 :].trace(axis1=2, axis2=3)
        rows.append({"reach": reach, "delivered": delivered, "trace P": late.mean()})
    return pd.DataFrame(rows)


if __name__ == "__main__":
    print(main().to_string(index=False))
