"""Drawings of docs/gallery.md: python docs/figures/gallery.py."""

from functools import partial
from pathlib import Path

import networkx
import numpy as np
from look import BLUE, GREEN, GREY, ORANGE, PINK, draw, options, page_code

import netkf
from netkf import theory

SCENARIO = Path(__file__).parents[2] / "scenarios" / "intermittent_scalar.toml"
EXAMPLE = ([[1.25]], [[1.0]], [[1.0]], [[2.5]])  # F, Q, H, R
NODES = 10


def arrivals(figure, runs, points):
    """Bounds on the mean covariance over the probability of arrival, and simulated means."""
    probabilities = 0.36 + np.geomspace(0.01, 0.63, points)
    bounds = [
        theory.mean_covariance_bounds(*EXAMPLE, float(g), 800, [[1.0]]) for g in probabilities
    ]
    axes = figure.subplots()
    for name, words, style in (("upper", "upper", "-"), ("lower", "lower", "--")):
        curve = [getattr(b, name)[-1, 0, 0] for b in bounds]
        axes.plot(probabilities, curve, color=BLUE, ls=style, label=f"{words} bound of the paper")
    base = netkf.load(SCENARIO)
    for k, delivery in enumerate((0.45, 0.5, 0.6, 0.7, 0.8, 0.9)):
        mean, wide = simulated(base, delivery, runs)
        label = f"simulated mean of {runs} runs, 95 %" if k == 0 else None
        axes.errorbar(delivery, mean, 1.96 * wide, fmt="o", color=ORANGE, ms=4, label=label)
    axes.axvline(0.36, color=GREY, ls=":")
    axes.text(0.365, 1.5, "0.36: no mean to the left", color=GREY)
    axes.set(yscale="log", ylim=(1.0, 200.0), xlim=(0.3, 1.0))
    axes.set(xlabel="probability that a reading arrives", ylabel="mean of P")
    axes.set_title("the mean lies between the bounds, and both end at the critical probability")
    axes.legend()


def simulated(base, delivery, runs):
    """Return the mean of P of the node without a sensor, and its standard error."""
    scenario = base.replace(
        {
            "plant.F": [[1.25]],
            "sensors": [{"nodes": [0], "H": [[1.0]], "R": [[2.5]]}],
            "network.channel.loss.delivery": delivery,
        }
    )
    ensemble = netkf.monte_carlo(scenario, runs, workers=1)
    late = ensemble.times >= 30.0
    P, se = ensemble.mean_P[late, 1, 0, 0], ensemble.se_P[late, 1, 0, 0]
    return float(P.mean()), float(se.mean())


def averaging(figure, runs, points):
    """The squared distance from the average under randomised gossip on a cycle."""
    laplacian = networkx.laplacian_matrix(networkx.cycle_graph(NODES)).toarray().astype(float)
    values, vectors = np.linalg.eigh(laplacian)
    slowest = vectors[:, 1]
    parts = netkf.parts
    scenario = netkf.Scenario(
        name="averaging",
        horizon=20.0,
        probe=0.5,
        plant=parts.Diffusion(A=[[0.0]], B=[[0.0]], cov=[[0.0]]),
        sensors=[parts.LinearSensor([0], H=[[1.0]], R=[[1.0]])],
        network=netkf.Network(graph=parts.Cycle(NODES), activation=parts.Poisson(rate=1.0)),
        filter=netkf.Filtering(parts.Hybrid(0.5), mean=slowest[:, None].tolist()),
    )
    ensemble = netkf.monte_carlo(scenario, runs, workers=1)
    t = ensemble.times
    axes = figure.subplots()
    axes.plot(t, np.exp(-0.5 * values[1] * t), color=BLUE, label="upper bound")
    axes.plot(t, np.exp(-values[1] * t), color=BLUE, ls="--", label="lower bound")
    axes.plot(t, exact_decay(slowest, t), color=GREEN, ls="-.", label="exact")
    square = ensemble.mean_error[:, :, 0, 0].sum(axis=1)
    axes.plot(t, square, ".", color=ORANGE, ms=4, label=f"mean of {runs} runs")
    axes.set(yscale="log", xlabel="simulated seconds", ylabel="E |x - average|^2, at 0: 1")
    axes.set_title("gossip on a cycle of 10: the second eigenvalue decides")
    axes.legend()


def exact_decay(start, times):
    """Return E |x(t)|^2 for pairs of a cycle that average at the ticks of Poisson clocks."""
    n = len(start)
    swaps = []
    for i in range(n):
        d = np.zeros(n)
        d[i], d[(i + 1) % n] = 1.0, -1.0
        swaps.append(np.eye(n) - 0.5 * np.outer(d, d))
    generator = sum(np.kron(W, W) - np.eye(n * n) for W in swaps)
    values, vectors = np.linalg.eigh(generator)
    begin = vectors.T @ np.outer(start, start).ravel()
    trace = np.eye(n).ravel() @ vectors
    return np.array([trace @ (np.exp(values * t) * begin) for t in times])


def delays(figure, runs, points):
    """The mean covariance with late readings, over the delivery and the length of the buffer."""
    page = page_code("## Consensus on predictions")
    left, right = figure.subplots(1, 2)
    deliveries = 1.0 / 3.0 + np.geomspace(0.004, 2.0 / 3.0, points)
    for mean_delay, color in ((0.3, GREEN), (1.0, BLUE), (3.0, PINK)):
        found = [page["mean_late"](1.5, float(p), mean_delay) for p in deliveries]
        left.plot(deliveries, found, color=color, label=f"mean delay {mean_delay:g} s")
    left.axvline(1.0 / 3.0, color=GREY, ls=":")
    left.set(xlabel="probability that a message ever arrives", ylabel="mean of P")
    left.set(yscale="log", ylim=(0.8, 200.0), xlim=(0.3, 1.0))
    left.set_title("all delays end at one delivery, 1/3")
    left.legend()
    buffers = np.linspace(0.0, 10.0, 10 * points + 1)[1:]
    found = np.array([page["mean_late"](1.5, 0.9, 3.0, float(b)) for b in buffers])
    steps = np.isfinite(found)
    right.plot(buffers[steps], found[steps], color=PINK, label="mean delay 3 s, delivery 0.9")
    for k, buffer in enumerate((3.0, 4.0, 6.0, 8.0)):
        ensemble = netkf.monte_carlo(page["late_readings"](1.5, 0.9, 3.0, buffer), runs, workers=1)
        late = ensemble.times >= 30.0
        mean = ensemble.mean_P[late, 1, 0, 0].mean()
        se = ensemble.se_P[late, 1, 0, 0].mean() * np.sqrt(5.0 / late.sum())  # 5 s: one memory
        label = f"mean of {runs} runs, 95 %" if k == 0 else None
        right.errorbar(buffer, mean, 1.96 * se, fmt="o", color=ORANGE, ms=4, label=label)
    shortest = -3.0 * np.log(1.0 - 1.0 / 2.7)
    right.axvline(shortest, color=GREY, ls=":")
    right.text(
        shortest - 0.1, 3.1, f"no mean below {shortest:.2f} s", color=GREY, rotation=90, ha="right"
    )
    right.set(xlabel="length of the buffer, seconds", xlim=(0.0, 10.0), ylim=(3.0, 15.0))
    right.set_title("a short buffer is as good as a long one")
    right.legend()


def main(arguments=None):
    chosen = options(__doc__, arguments, runs=400, points=30)
    for function in (arrivals, averaging, delays):
        drawn = partial(function, runs=chosen.runs, points=chosen.points)
        draw(chosen.out, f"gallery_{function.__name__}", drawn, (6.4, 3.6))


if __name__ == "__main__":
    main()
