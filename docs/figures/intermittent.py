"""Drawings of docs/papers/intermittent.md: python docs/figures/intermittent.py."""

import numpy as np
from look import BLUE, GREEN, GREY, ORANGE, PINK, draw, options

from netkf import theory

SCALAR = ([[2.0**0.5]], [[1.0]], [[1.0]], [[1.0]])
DEPTH = 10


def sets(figure):
    """R Fig. 1: the points of the support in S_0, S_1, and S_0 to S_2, and the law on them."""
    points = np.sort(theory.support(*SCALAR, DEPTH)[:, 0, 0])
    laws = [(g, theory.scalar_law(*SCALAR, g), c) for g, c in ((0.6, BLUE), (0.9, ORANGE))]
    axes = figure.subplots(2, 3, sharex="col", height_ratios=(1, 3))
    panels = (("the set S_0", 2.40, 3.01), ("the set S_1", 5.80, 7.03), ("S_0 to S_2", 2.0, 15.5))
    for (rug, curve), (title, low, high) in zip(axes.T, panels, strict=True):
        shown = points[(points > low) & (points < high)]
        x, y = np.repeat(shown, 3), np.tile([0.0, 1.0, np.nan], len(shown))
        rug.plot(x, y, color="#222222", lw=0.3)
        rug.set(yticks=[], title=title, xlim=(low, high))
        rug.spines["left"].set_visible(False)
        x = np.linspace(low, high, 600)
        for k, (g, law, colour) in enumerate(laws):
            curve.plot(x, law.cdf(x), color=colour, ls=("-", "--")[k], label=f"delivery {g:g}")
        curve.set(xlabel="P", xlim=(low, high))
    axes[1, 0].set_ylabel("share of P below")
    axes[1, 2].legend(loc="lower right")
    for n, (low, high) in enumerate(((2.41, 3.01), (5.82, 7.01), (12.6, 15.01))):
        mass = float(np.diff(laws[0][1].cdf([low, high]))[0])
        print(f"mass of S_{n} at 0.6: {mass:.6f}, g (1 - g)^n = {0.6 * 0.4**n:.6f}")


def means(figure):
    """Quantiles exist at every delivery probability, the mean only above the critical one."""
    deliveries = np.linspace(0.2, 0.99, 80)
    axes = figure.subplots()
    laws = [theory.scalar_law(*SCALAR, float(g)) for g in deliveries]
    for level, style, colour in ((0.5, "-", BLUE), (0.9, "--", GREEN), (0.99, "-.", PINK)):
        quantiles = [float(law.quantile(level)) for law in laws]
        axes.plot(deliveries, quantiles, ls=style, color=colour, label=f"quantile {level:g}")
    above = deliveries > 0.505
    finite = [float(law.mean()) for law, keep in zip(laws, above, strict=True) if keep]
    axes.plot(deliveries[above], finite, color=ORANGE, lw=2.0, label="mean")
    axes.axvline(0.5, color=GREY, ls=":")
    axes.text(0.495, 2.4, "no mean to the left", color=GREY, ha="right")
    axes.set(yscale="log", xlabel="delivery probability", ylabel="P", ylim=(2.0, 1e4))
    axes.set_title("the invariant law: quantiles and mean")
    axes.legend()
    for g in (0.6, 0.75, 0.9):
        print(f"mean of P at {g:g}: {float(theory.scalar_law(*SCALAR, g).mean()):.6f}")


def main(arguments=None):
    folder = options(__doc__, arguments).out
    draw(folder, "intermittent_sets", sets, (8.6, 3.4))
    draw(folder, "intermittent_means", means, (6.4, 3.2))


if __name__ == "__main__":
    main()
