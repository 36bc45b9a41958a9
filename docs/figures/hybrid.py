"""Drawings of docs/papers/hybrid.md: python docs/figures/hybrid.py [--runs 1000]."""

import numpy as np
from look import BLUE, GREEN, GREY, ORANGE, PINK, SCENARIOS, draw, options

import netkf
from netkf import theory


def gap(figure, runs):
    """Theorem 2: the bound, the mean of P over many runs, and the errors."""
    scenario = netkf.load(SCENARIOS / "poisson_ring.toml")
    ensemble = netkf.monte_carlo(scenario, runs=runs, workers=1)
    bound = np.trace(theory.covariance_bound(scenario, ensemble.times), axis1=2, axis2=3)
    mean_P = np.trace(ensemble.mean_P, axis1=2, axis2=3)
    errors = np.trace(ensemble.mean_error, axis1=2, axis2=3)
    left, right = figure.subplots(1, 2)
    for node, words, colour in ((0, "with a sensor", BLUE), (1, "without", ORANGE)):
        i = ensemble.nodes.index(node)
        left.plot(ensemble.times, bound[:, i], "--", color=colour, label=f"node {node}, bound")
        left.plot(ensemble.times, mean_P[:, i], color=colour, label=f"mean of P, {words}")
        left.plot(ensemble.times, errors[:, i], ":", color=colour, label="mean square error")
        # Standard errors of the diagonal, added: no less than that of the trace.
        error = np.trace(ensemble.se_P, axis1=2, axis2=3)[1:, i] / bound[1:, i]
        share = 1.0 - mean_P[1:, i] / bound[1:, i]
        right.plot(ensemble.times[1:], 100 * share, color=colour, label=words)
        low, high = 100 * (share - 2 * error), 100 * (share + 2 * error)
        right.fill_between(ensemble.times[1:], low, high, color=colour, alpha=0.2, lw=0)
    left.set(xlabel="time (s)", ylabel="trace", title="Theorem 2: E[P] stays below the bound")
    left.set_ylim(0.0, 13.0)
    left.legend(ncols=2, loc="upper left")
    right.axhline(0.0, color=GREY, lw=0.8)
    right.legend()
    right.set(xlabel="time (s)", ylabel="gap (%)", title=f"the gap, {runs} runs, 2 standard errors")
    last = ensemble.times > 10.0
    print("gap of Theorem 2 after 10 s, mean over time, node 0 and 1:", end=" ")
    print(*(f"{100 * (1 - mean_P[last, i] / bound[last, i]).mean():.1f} %" for i in (0, 1)))


def slope(figure, count):
    """Theorem 3: the distance of the steady bound from S falls as one over the rate."""
    scenario = netkf.load(SCENARIOS / "poisson_ring.toml")
    rates = np.logspace(0, 4, count)
    S = theory.limit_covariance(scenario)
    steady = [
        theory.steady_covariance_bound(scenario.replace({"network.activation.rate": float(rate)}))
        for rate in rates
    ]
    distance = [max(np.linalg.norm(P - S) for P in bound) for bound in steady]
    left, right = figure.subplots(1, 2)
    left.loglog(rates, distance, color=BLUE, label="largest distance of a node")
    left.loglog(rates, distance[-1] * rates[-1] / rates, "--", color=GREY, label="slope -1")
    left.set(xlabel="rate of the links (1/s)", ylabel="Frobenius norm")
    left.set_title("Theorem 3: distance of the steady bound from S")
    left.legend()
    traces = np.array([np.trace(bound, axis1=1, axis2=2).max() for bound in steady])
    right.semilogx(rates, traces, color=BLUE, label="steady bound, worst node")
    for P, words, style, colour in (
        (S, "S of (13)", "--", BLUE),
        (theory.true_limit_covariance(scenario), "limit of the true errors", "-.", ORANGE),
        (theory.central_covariance(scenario), "central filter", ":", GREEN),
    ):
        right.axhline(np.trace(P), ls=style, color=colour, label=words)
    right.set(xlabel="rate of the links (1/s)", ylabel="trace", ylim=(0.0, 10.0))
    right.set_title("what faster links come to")
    right.legend()
    fall = np.polyfit(np.log(rates[-8:]), np.log(distance[-8:]), 1)[0]
    print(f"slope of Theorem 3 at the fast end: {fall:.4f}")


def thresholds(figure, count):
    """The four rates of a scalar blind node, and the steady bound above the third."""
    scenario = netkf.load(SCENARIOS / "threshold.toml")
    a, pi = 0.5, 0.5
    rows = (
        (2 * a / (pi * (2 - pi)), "mean square error finite", GREEN),
        (-2 * a / np.log(1 - pi), "P bounded in probability", BLUE),
        (2 * a / pi, "E[P] and the bound finite", ORANGE),
        (4 * a / (pi * (2 - pi)), "variance of P finite", PINK),
    )
    axes = figure.subplots()
    rates = np.linspace(2.03, 8.0, 5 * count - 5)
    steady = [
        theory.steady_covariance_bound(scenario.replace({"network.activation.rate": float(rate)}))
        for rate in rates
    ]
    axes.plot(rates, [P[1, 0, 0] for P in steady], color="#222222", lw=1.6)
    axes.set(yscale="log", ylim=(0.8, 100.0), xlim=(1.0, 8.0))
    axes.set(xlabel="rate of the link (1/s)", ylabel="steady bound of the blind node")
    for k, (rate, words, colour) in enumerate(rows):
        axes.axvline(rate, color=colour, ls=("--", "-.", "-", ":")[k])
        axes.annotate(
            f"{words}: above {rate:.3f}",
            (rate, 75.0 * 0.5**k),
            xytext=(3.2, 75.0 * 0.5**k),
            color=colour,
            va="center",
            arrowprops={"arrowstyle": "-", "color": colour, "lw": 0.6},
        )
    axes.set_title("one blind node, growth 0.5, weight 0.5")
    found = theory.link_rate_threshold(scenario).rate
    print(f"threshold of the bound by link_rate_threshold: {found:.6f}, closed form {2 * a / pi:g}")


def main(arguments=None):
    chosen = options(__doc__, arguments, runs=1000, rates=25)
    draw(chosen.out, "hybrid_gap", lambda figure: gap(figure, chosen.runs), (8.6, 3.2))
    draw(chosen.out, "hybrid_slope", lambda figure: slope(figure, chosen.rates), (8.6, 3.2))
    draw(
        chosen.out, "hybrid_thresholds", lambda figure: thresholds(figure, chosen.rates), (6.4, 3.2)
    )


if __name__ == "__main__":
    main()
