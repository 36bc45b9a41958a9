"""Drawings of docs/papers/push_sum.md: python docs/figures/push_sum.py."""

import numpy as np
from look import BLUE, GREEN, GREY, ORANGE, PINK, SCENARIOS, draw, options

import netkf
from netkf import theory

PLANAR = netkf.load(SCENARIOS / "push_sum_planar.toml")
CENTRAL = float(theory.central_covariance(PLANAR).trace())
LOSS, GAMMA, DELTA = "network.channel.loss.delivery", "filter.gamma", "filter.delta"
STYLES = ((PINK, ":"), (GREY, (0, (5, 1, 1, 1))), (ORANGE, "-."), (GREEN, "--"), (BLUE, "-"))


def cost(changes, gamma):
    """Mean-square error over that of the central filter, exact; nan where it is infinite."""
    scenario = PLANAR.replace({GAMMA: gamma, **changes})
    if theory.push_sum_radius(scenario) >= 1.0:
        return np.nan
    covariances = theory.push_sum_error_covariance(scenario)
    return float(np.trace(covariances, axis1=1, axis2=2).mean()) / CENTRAL


def errors(figure, gains):
    """P Fig. 4, exactly: what few averaging steps and failing links cost; and the gain delta."""
    left, right = figure.subplots(1, 2)
    gammas = range(1, 7)
    for delivery, (colour, style) in zip((0.5, 0.6, 0.7, 0.8, 1.0), STYLES, strict=True):
        ratios = [cost({LOSS: delivery}, gamma) for gamma in gammas]
        left.plot(gammas, ratios, color=colour, ls=style, marker=".", label=f"p = {delivery:g}")
        print(f"p = {delivery:g}:", *(f"{ratio:.3f}" for ratio in ratios))
    left.set(xlabel="averaging steps gamma", ylabel="mean square error / central", yscale="log")
    left.set(title="gain 1/4.01", yticks=[1, 1.5, 2, 4, 8], yticklabels=["1", "1.5", "2", "4", "8"])
    left.minorticks_off()
    left.legend()
    radius = theory.consensus_gain_bound(PLANAR).radius
    deltas = np.linspace(radius / 2 + 0.02, 8.0, gains)
    for gamma, colour, style in ((1, ORANGE, "-."), (2, BLUE, "-"), (3, GREEN, "--")):
        ratios = [cost({DELTA: float(delta)}, gamma) for delta in deltas]
        right.plot(deltas, ratios, color=colour, ls=style, label=f"gamma = {gamma}")
    for at, words in ((radius / 2, "rho(L)/2"), (4.0, "max nu"), (radius, "rho(L)")):
        right.axvline(at, color=GREY, lw=0.8, ls=":")
        right.text(at, 10.6, words, color=GREY, ha="center", fontsize=8)
    right.set(xlabel="delta", ylim=(1.0, 10.5), xlim=(3.2, 8.0))
    right.set_title("p = 0.7", pad=14)
    right.legend(loc=(0.33, 0.62))


def main(arguments=None):
    chosen = options(__doc__, arguments, gains=40)
    draw(chosen.out, "push_sum_errors", lambda figure: errors(figure, chosen.gains), (8.6, 3.4))


if __name__ == "__main__":
    main()
