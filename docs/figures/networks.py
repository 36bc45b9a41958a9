"""Drawings of three sections of docs/gallery.md, with its code: python docs/figures/networks.py."""

from functools import partial

import numpy as np
from look import BLUE, GREEN, GREY, ORANGE, PINK, draw, options, page_code

import netkf


def simulated(scenario, runs, memory):
    """Return E |x - xhat_i|^2 of each node in the steady state and its standard error, where
    squared errors ``memory`` slots apart are independent.
    """
    ensemble = netkf.monte_carlo(scenario.replace({"horizon": 80.0}), runs, workers=1)
    late = ensemble.times >= 30.0
    each = np.array([ensemble.mean_error, ensemble.se_error])[:, late].trace(axis1=3, axis2=4)
    return each[0].mean(axis=0), each[1].mean(axis=0) * np.sqrt(memory / late.sum())


def consensus(figure, runs):
    """Errors and disagreement over the strength of the consensus term."""
    page = page_code("## The error of each node")
    N, squares = page["N"], page["squares"]
    apart = np.eye(2 * N) - np.kron(np.full((N, N), 1.0 / N), np.eye(2))
    strengths = np.append(np.linspace(0.0, 1.2, 61), [1.21, 1.22])
    found = [page["steady"](page["consensus"](e), page["K"]) for e in strengths]
    axes = figure.subplots()
    axes.plot(strengths, [squares(c).mean() for c in found], color=BLUE, label="squared error")
    around = [squares(apart @ c @ apart.T).mean() for c in found]
    axes.plot(strengths, around, color=GREEN, ls="--", label="disagreement: around the mean")
    for k, strength in enumerate((0.0, 0.4, 0.8, 1.1)):
        mean, se = simulated(page["circles"](netkf.parts.Kcf(epsilon=strength)), runs, 4)
        label = f"mean of {runs} runs, 95 %" if k == 0 else None
        at = {"yerr": 1.96 * se.mean(), "fmt": "o", "color": ORANGE, "ms": 4, "label": label}
        axes.errorbar(strength, mean.mean(), **at)
    axes.axhline(page["riccati"](total(page))[1].trace(), color=GREY)
    axes.text(0.01, 0.195, "central filter", color=GREY)
    axes.axvline(1.223, color=GREY, ls=":")
    axes.set(xlabel="epsilon", ylim=(0.0, 0.8), xlim=(0.0, 1.3))
    axes.set_title("the consensus term helps until it is too strong")
    axes.legend(loc="upper left")


def total(page):
    """Return the information of all readings of a slot."""
    return sum(h.T @ h / r for h, r in zip(page["H"], page["R"], strict=True))


def diffusion(figure, runs):
    """The mean squared deviation of each node, with and without the combination."""
    page = page_code("## Consensus on measurements")
    nodes = np.arange(page["N"])
    axes = figure.subplots()
    alone = page["squares"](page["steady"](page["D"], page["K"]))
    rows = (
        ("readings of the neighbours", alone, netkf.parts.Kcf(epsilon=0.0), "s", GREEN),
        ("combined (diffusion)", page["diffused"], netkf.parts.DiffusionKalman(), "o", BLUE),
    )
    for words, theory, algorithm, mark, color in rows:
        axes.plot(nodes, 10.0 * np.log10(theory), mark, mfc="none", color=color, label=words)
        mean, se = simulated(page["circles"](algorithm), runs, 4)
        wide = np.abs(10.0 * np.log10([1.0 - 1.96 * se / mean, 1.0 + 1.96 * se / mean]))
        axes.errorbar(nodes, 10.0 * np.log10(mean), wide, fmt=".", color=ORANGE, ms=3)
    axes.plot([], [], ".", color=ORANGE, label=f"mean of {runs} runs, 95 %")
    central = 10.0 * np.log10(page["riccati"](total(page))[1].trace())
    axes.axhline(central, color=GREY, label="central filter")
    axes.set(xlabel="node", ylabel="mean squared deviation, dB", xticks=nodes, ylim=(-8.0, -1.0))
    axes.set_title("theory, node by node: combining estimates helps all")
    axes.legend(ncols=2, loc="upper left")


def hybrid(figure, runs):
    """The mean squared error over the number of consensus steps."""
    page = page_code("The figures are drawn by")
    steps = np.array([1, 2, 3, 4, 5, 6, 8, 12, 16, 24, 32, 48, 64])
    axes = figure.subplots()
    for kind, words, color in (
        ("information", "CI", GREEN),
        ("measurements", "CM", PINK),
        ("hybrid", "HCMCI", BLUE),
    ):
        found = [page["averaged"](kind, int(L))[0] for L in steps]
        axes.plot(steps, found, "-", color=color, label=words)
        for L in (1, 6, 16) if kind != "measurements" else (6, 16):
            mean, se = simulated(page["chain"](kind, L), runs, 16)
            at = {"yerr": 1.96 * se.mean(), "fmt": "o", "color": ORANGE, "ms": 4}
            axes.errorbar(L, mean.mean(), **at)
    axes.plot([], [], "o", color=ORANGE, ms=4, label=f"mean of {runs} runs, 95 %")
    central = page["riccati"](page["measured"].sum(axis=0))[1].trace()
    axes.axhline(central, color=GREY, label="central filter")
    axes.axvline(6, color=PINK, ls=":")
    axes.text(5.8, 2.1, "no CM to the left", color=PINK, ha="right")
    axes.set(xscale="log", yscale="log", xlabel="consensus steps a slot, L", ylabel="squared error")
    axes.set(xticks=[1, 2, 4, 8, 16, 32, 64], xticklabels=[1, 2, 4, 8, 16, 32, 64])
    axes.set(yticks=[0.5, 1.0, 2.0], yticklabels=[0.5, 1, 2])
    axes.minorticks_off()
    axes.set_title("stable from one step on, or near the central filter, or both")
    axes.legend()


def main(arguments=None):
    chosen = options(__doc__, arguments, runs=400)
    for name, function in (("consensus", consensus), ("diffusion", diffusion), ("hybrid", hybrid)):
        draw(chosen.out, f"networks_{name}", partial(function, runs=chosen.runs), (6.4, 3.6))


if __name__ == "__main__":
    main()
