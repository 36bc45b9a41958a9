"""Drawing of docs/papers/diffusion.md: python docs/figures/diffusion.py [--runs 200]."""

import numpy as np
from look import BLUE, GREEN, GREY, ORANGE, SCENARIOS, draw, options

import netkf

FILE = SCENARIOS / "diffusion_regression.toml"
TIMES = [1.0, *(50.0 * k for k in range(1, 13))]
ALONE = {"filter.weights": np.eye(3).tolist()}
STYLES = ((BLUE, "-"), (ORANGE, "--"), (GREEN, "-."))


def tracking(figure, runs):
    """D Fig. 1: the mean square error of each sensor, alone and together."""
    panels = ((ALONE, "each sensor alone"), ({}, "with its neighbours"))
    for axes, (changes, title) in zip(figure.subplots(1, 2), panels, strict=True):
        scenario = netkf.load(FILE, {"probe": TIMES, "horizon": TIMES[-1], **changes})
        ensemble = netkf.monte_carlo(scenario, runs=runs, workers=1)
        squares = np.trace(ensemble.mean_error, axis1=2, axis2=3)
        claimed = np.trace(ensemble.mean_P, axis1=2, axis2=3)
        for i, (colour, style) in enumerate(STYLES):
            axes.plot(TIMES, squares[:, i], color=colour, ls=style, label=f"sensor {i + 1}")
        axes.plot(TIMES, claimed.mean(axis=1), color=GREY, lw=1.0, label="mean trace of P")
        axes.set(xlabel="k", ylabel="mean square error", title=f"{title}, {runs} runs")
        axes.set_ylim(0.0, None)
        axes.legend()
        late = np.array(TIMES) >= 200
        print(f"{title}: mean square error {squares[late].mean():.2f} from k = 200 on,", end=" ")
        print(f"at k = {TIMES[-1]:g}: {squares[-1].mean():.1f}")


def main(arguments=None):
    chosen = options(__doc__, arguments, runs=200)
    runs = chosen.runs
    draw(chosen.out, "diffusion_tracking", lambda figure: tracking(figure, runs), (8.6, 3.3))


if __name__ == "__main__":
    main()
