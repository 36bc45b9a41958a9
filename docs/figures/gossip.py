"""Drawing of docs/papers/gossip.md: python docs/figures/gossip.py."""

import numpy as np
from look import BLUE, GREEN, GREY, ORANGE, PINK, SCENARIOS, draw, options

import netkf
from netkf import theory

PAIR = {  # one node sees the scalar state, the other one is blind; they swap half of the time
    "plant": {"kind": "linear", "F": [[2.0**0.5]], "Q": [[1.0]], "period": 1.0},
    "sensors": [{"nodes": [0], "H": [[1.0]], "R": [[1.0]]}],
    "network.graph": {"kind": "edges", "edges": [[0, 1]]},
    "network.activation": {"kind": "matching", "protocol": "one-edge", "lazy": 0.5},
}
STYLES = ((BLUE, "-"), (ORANGE, "--"), (GREEN, "-."), (PINK, ":"), (GREY, (0, (5, 1, 1, 1))))


def laws(figure, samples):
    """The law of the trace of P at each sensor and at a random one, in the steady state."""
    ring = netkf.load(SCENARIOS / "gossip_ring.toml")
    panels = ((ring.replace(PAIR), "one node sees, one is blind"), (ring, "gossip_ring"))
    for axes, (scenario, title) in zip(figure.subplots(1, 2), panels, strict=True):
        drawn = theory.switched_samples(scenario, samples, 1)
        trace = np.trace(drawn.P, axis1=1, axis2=2)
        for node, (colour, style) in zip(scenario.nodes, STYLES, strict=False):
            distribution(axes, trace[drawn.node == node], f"node {node}", color=colour, ls=style)
        distribution(axes, trace, "random node", color="#222222", lw=2.2, alpha=0.6)
        axes.set(xscale="log", xlabel="trace of P", ylabel="share below", title=title)
        axes.set_xlim(trace.min() * 0.9, np.quantile(trace, 0.99))
        axes.legend()
    pair = theory.switched_samples(panels[0][0], samples, 1)
    for node in (0, 1):
        P = pair.P[pair.node == node, 0, 0]
        print(f"node {node}: P from {P.min():.2f} to {P.max():.3g}")


def distribution(axes, values, label, **style):
    """The empirical distribution function."""
    share = np.arange(1, len(values) + 1) / len(values)
    axes.step(np.sort(values)[::4], share[::4], where="post", label=label, **style)


def main(arguments=None):
    chosen = options(__doc__, arguments, samples=4000)
    draw(chosen.out, "gossip_laws", lambda figure: laws(figure, chosen.samples), (8.6, 3.3))


if __name__ == "__main__":
    main()
