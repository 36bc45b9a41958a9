"""Drawing of docs/howto/blocks.md: python docs/figures/ieee14.py [--runs 20]."""

from functools import partial

import numpy as np
import pandas as pd
from look import BLUE, GREEN, GREY, ORANGE, PINK, SCENARIOS, draw, options

import netkf

AREAS = {1: (1, 2, 5), 2: (3, 4, 7, 8), 3: (6, 11, 12, 13), 4: (9, 10, 14)}
COLOURS = {1: BLUE, 2: ORANGE, 3: GREEN, 4: PINK}
PLACES = {
    **{1: (0.0, 2.0), 2: (1.0, 0.6), 3: (3.2, 0.0), 4: (3.0, 1.4), 5: (1.6, 1.8)},
    **{6: (1.7, 3.2), 7: (3.8, 2.0), 8: (4.6, 1.7), 9: (3.8, 2.9), 10: (3.2, 3.5)},
    **{11: (2.5, 3.8), 12: (1.0, 4.5), 13: (2.0, 4.7), 14: (3.4, 4.5)},
}


def grid(axes):
    """The buses, coloured by area, and the branches."""
    branches = pd.read_csv(SCENARIOS / "data" / "ieee14" / "branches.csv", comment="#")
    area = {bus: node for node, buses in AREAS.items() for bus in buses}
    for i, j in branches[["from", "to"]].to_numpy().tolist():
        style = "-" if area[i] == area[j] else ":"
        axes.plot(*np.transpose([PLACES[i], PLACES[j]]), style, color=GREY, lw=1.2, zorder=1)
    for bus, place in PLACES.items():
        axes.scatter(*place, s=170, color=COLOURS[area[bus]], zorder=2)
        axes.annotate(str(bus), place, color="white", ha="center", va="center", fontsize=7)
    axes.set_axis_off()
    axes.set_title("14 buses in four areas, dotted across borders")


def angles(axes, runs):
    """Errors of the angles of all areas, each by its own node, and what the filters claim."""
    scenario = netkf.load(SCENARIOS / "blocks" / "ieee14_areas.toml")
    filters = {
        "own": ({"kind": "partition", "estimates": "own"}, BLUE),
        "own and neighbours": ({"kind": "partition", "estimates": "own+neighbours"}, GREEN),
        "central": ({"kind": "central", "estimates": "own"}, ORANGE),
    }
    for name, (settings, colour) in filters.items():
        chosen = scenario.replace({"filter": settings})
        ensemble = netkf.monte_carlo(chosen, runs, workers=1)
        seen, claimed = (
            sum(
                matrices[:, k, : len(buses), : len(buses)].trace(axis1=1, axis2=2)
                for k, buses in enumerate(AREAS.values())
            )
            for matrices in (ensemble.mean_error, ensemble.mean_P)
        )
        axes.plot(ensemble.times, np.sqrt(seen / 14), ".", ms=3, color=colour)
        axes.plot(ensemble.times, np.sqrt(claimed / 14), color=colour, label=name)
    axes.set(xlabel="simulated seconds", ylabel="angle, rad", ylim=(0.0, 0.02))
    axes.set_title(f"claimed, and the error of {runs} runs (dots)")
    axes.legend()


def drawing(figure, runs):
    left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.3))
    grid(left)
    angles(right, runs)


def main(arguments=None):
    chosen = options(__doc__, arguments, runs=20)
    draw(chosen.out, "ieee14_areas", partial(drawing, runs=chosen.runs), (7.2, 3.2))


if __name__ == "__main__":
    main()
