"""P Figs. 4 and 5: what failing links and few averaging steps cost the push-sum filter.

    python analysis/push_sum_figures.py --out push_sum.png

Fig. 4: the mean-square error over nodes and time against gamma: exact curves, and simulated points
with 95 % intervals from independent runs of 450 slots, the first fifth left out as in the paper.
All filters meet the same truth, so a point is what a filter's error is beyond the centralised one's
in the same runs, added to the centralised filter's exact error.
Fig. 5: where that error is within 10 % of the centralised filter's, exactly.
"""

import argparse
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from pathlib import Path

import matplotlib as mpl
import numpy as np
import scipy.stats
from matplotlib.figure import Figure

import netkf

PLANAR = Path(__file__).parent.parent / "scenarios" / "push_sum_planar.toml"
DELIVERIES = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
GAMMAS, SIMULATED = range(1, 7), (1, 2, 3, 5)
GRID = np.round(np.arange(0.3, 1.001, 0.05), 2).tolist()
HEAVY = 0.885  # above it the sample mean has heavy tails, and its interval means little


def at(gamma, delivery, links="fresh"):
    changes = {"filter.gamma": gamma, "filter.links": links}
    return netkf.load(PLANAR, {**changes, "network.channel.loss.delivery": delivery})


def exact(cell):
    """(radius, mean-square error); the error is nan where the radius is not below 1."""
    scenario = at(*cell)
    radius = netkf.theory.push_sum_radius(scenario)
    if radius >= 1.0:
        return radius, np.nan
    covariances = netkf.theory.push_sum_error_covariance(scenario)
    return radius, float(np.trace(covariances, axis1=1, axis2=2).mean())


def simulated(cell):
    """The mean-square error of one run; local and central filters take gamma's place by name."""
    gamma, delivery, replica = cell
    scenario = at(gamma, delivery) if isinstance(gamma, int) else at(1, delivery)
    if not isinstance(gamma, int):
        scenario = scenario.replace({"filter": {"kind": gamma}})
    run = netkf.simulate(scenario.replace({"probe": 0.5}), replica=replica)
    used = run.times >= scenario.horizon / 5.0
    return float((run.error[used] ** 2).sum(axis=-1).mean())


def interval(values):
    """Mean and half width of the 95 % interval."""
    width = scipy.stats.t.ppf(0.975, len(values) - 1) * np.std(values, ddof=1)
    return np.mean(values), width / np.sqrt(len(values))


def points(runs, each, central):
    """(gamma, delivery) -> mean and half width, with the baselines under their names."""
    cells = [*product(SIMULATED, DELIVERIES), ("local", 1.0), ("central", 1.0)]
    tasks = [(*cell, replica) for cell in cells for replica in range(runs)]
    found = np.array(list(each(simulated, tasks))).reshape(len(cells), runs)
    plain = {cell: interval(values) for cell, values in zip(cells[-2:], found[-2:], strict=True)}
    beyond = found[:-2] - found[-1] + central
    return plain | {cell: interval(v) for cell, v in zip(cells, beyond, strict=False)}


def figure_4(axes, curves, measured, central):
    colours = mpl.colormaps["viridis"](np.linspace(0.05, 0.9, len(DELIVERIES)))
    for ax, closer in zip(axes, (False, True), strict=True):
        for k, (delivery, colour) in enumerate(zip(DELIVERIES, colours, strict=True)):
            curve = [curves[gamma, delivery][1] for gamma in GAMMAS]
            ax.plot(GAMMAS, curve, color=colour, lw=1.2, label=f"p = {delivery:g}")
            for gamma in SIMULATED:
                mean, half = measured[gamma, delivery]
                full = colour if curves[gamma, delivery][0] < HEAVY else "none"
                style = {"fmt": "o", "ms": 4, "color": colour, "mfc": full, "capsize": 2}
                ax.errorbar(gamma + 0.04 * (k - 2.5), mean, half, **style)
        ax.axhline(central, color="#222222", ls="--", lw=1.0, label="centralised")
        ax.set(xlabel="gamma", ylabel="mean-square error")
        if closer:
            ax.set_ylim(0.95 * central, 1.6 * central)
        else:
            ax.set(yscale="log", ylim=(0.8 * central, 1.0))  # what is unbounded is off the picture
            ax.legend(frameon=False, fontsize=8)
    axes[0].set_title("P Fig. 4: exact, and simulated (open: heavy tails)", fontsize=9)
    axes[1].set_title("closer", fontsize=9)


def figure_5(ax, curves, central):
    ratio = np.array([[curves[gamma, p][1] / central for gamma in GAMMAS] for p in GRID])
    within = np.where(np.isnan(ratio), 0.0, np.where(ratio > 1.1, 1.0, 2.0))
    colours = mpl.colors.ListedColormap(["#7f1d1d", "#e2a39b", "#cfe3f5"])
    ax.pcolormesh(GAMMAS, GRID, within, cmap=colours, vmin=0, vmax=2, shading="nearest")
    ax.set(xlabel="gamma", ylabel="delivery p")
    ax.set_title("P Fig. 5: within 10 % (blue) or not; dark: unbounded", fontsize=9)
    for gamma, column in zip(GAMMAS, within.T, strict=True):
        inside = np.array(GRID)[column == 2.0]
        words = f"from p = {inside[0]:.2f} to {inside[-1]:.2f}" if inside.size else "nowhere"
        print(f"gamma = {gamma}: within 10 % of the centralised filter {words}")


def facts(curves):
    """P section 5, one by one."""
    for gamma, delivery, words in (
        (1, 0.7, "stable"),
        (1, 0.6, "unbounded"),
        (1, 0.5, "unbounded"),
        (2, 0.5, "unbounded"),
    ):
        fresh, held = curves[gamma, delivery][0], exact((gamma, delivery, "held"))[0]
        print(
            f"gamma = {gamma}, p = {delivery:g}: {words}, says the paper; exact radius {fresh:.3f} "
            f"with fresh link draws, {held:.3f} with held ones"
        )
    Q = at(1, 0.7).plant.Q.copy()
    Q[2, 2] = Q[3, 3] = 0.05**2
    printed = netkf.theory.push_sum_radius(at(1, 0.7).replace({"plant.Q": Q}))
    print(f"gamma = 1, p = 0.7 with Q as printed: exact radius {printed:.3f}")


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("push_sum.png"))
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args(arguments)
    model = at(1, 1.0).pooled_slot_model
    ahead = netkf.theory.steady_covariance(model.F, model.Q, model.H, model.R)
    central = float(np.trace(np.linalg.inv(np.linalg.inv(ahead) + model.information)))
    cells = list(product(GAMMAS, GRID))
    with ProcessPoolExecutor(options.workers) as pool:
        each = pool.map if options.workers > 1 else map
        curves = dict(zip(cells, each(exact, cells), strict=True))
        measured = points(options.runs, each, central)
    facts(curves)
    with mpl.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(12, 4.2), layout="constrained")
        axes = figure.subplots(1, 3)
        figure_4(axes[:2], curves, measured, central)
        figure_5(axes[2], curves, central)
        figure.savefig(options.out, dpi=130)
    print(f"centralised filter: exact {central:.5f}, simulated " + shown(measured["central", 1.0]))
    print("local filter, nobody talks: simulated " + shown(measured["local", 1.0]))
    for cell in product(SIMULATED, DELIVERIES):
        radius, error = curves[cell]
        (mean, half), tails = measured[cell], " (heavy tails)" if radius >= HEAVY else ""
        off = "" if np.isnan(error) or tails else f", {(mean - error) / half:+.1f} half widths off"
        print(
            f"gamma = {cell[0]}, p = {cell[1]:g}: radius {radius:.3f}, exact {error:.4g}, "
            f"simulated {shown((mean, half))}{tails}{off}"
        )
    print(CONCLUSION)
    print(f"written to {options.out}")
    return curves, measured, central


def shown(pair):
    return f"{pair[0]:.4g} +- {pair[1]:.2g}"


CONCLUSION = """\
as in the paper: one averaging step holds with 30 % failures and not with 40 %; the error comes to
the centralised one as gamma grows; gamma <= 2 is never within 10 % of it;
not as in the paper: gamma = 2 with 50 % failures is unbounded only if one link draw is held over
the steps of a slot, with a fresh draw a step it is stable; for gamma > 1 losing no message is worse
than losing one in ten, since delta = 4.01 is below rho(L) and averaging overshoots;
not reproducible: the paper's topology is lost (the graph here is a reconstruction that agrees with
the facts above), and with its Q as printed one step with 30 % failures is unbounded."""


if __name__ == "__main__":
    main()
