"""The drawing of docs/benchmarks.md: python docs/figures/benchmarks.py."""

import csv
import math

import matplotlib as mpl
from look import BLUE, GREY, HERE, ORANGE, draw, options

COLUMNS = 4


def read_rows():
    """Dates of the measurements, and by row pairs (measurement, ratio) with the last limit."""
    with (HERE / "benchmarks.csv").open(newline="", encoding="utf-8") as file:
        entries = list(csv.DictReader(file))
    keys = [(entry["date"], entry["commit"], entry["machine"]) for entry in entries]
    order = {key: k for k, key in enumerate(dict.fromkeys(keys))}
    rows = {}
    for key, entry in zip(keys, entries, strict=True):
        pairs, _ = rows.get(entry["row"], ([], ""))
        rows[entry["row"]] = [*pairs, (order[key], float(entry["ratio"]))], entry["limit"]
    return [date for date, *_ in order], rows


def history(figure):
    """A panel for each row of the table: ratios over commits, with today's limit."""
    dates, rows = read_rows()
    shape = math.ceil(len(rows) / COLUMNS), COLUMNS
    panels = figure.subplots(*shape, sharex=True, squeeze=False).ravel()
    days = [k for k, date in enumerate(dates) if date not in dates[:k]]
    for panel, (name, (pairs, limit)) in zip(panels, rows.items(), strict=False):
        at, ratios = zip(*pairs, strict=True)
        bound = float(limit[3:] or ratios[-1])
        holds = ratios[-1] <= bound if limit.startswith("<=") else ratios[-1] >= bound
        panel.plot(at, ratios, ".-", color=BLUE if holds else ORANGE, ms=4, lw=1.0)
        if limit:
            panel.axhline(bound, color=GREY, ls=":", lw=1.0)
        panel.set(
            ylim=(min(*ratios, bound) / 1.3, max(*ratios, bound) * 1.3),
            xlim=(-0.5, len(dates) - 0.5),
            yscale="log",
        )
        panel.set_yticks([ratios[-1]], [f"{ratios[-1]:.3g}"])
        panel.minorticks_off()
        panel.set_xticks(days, [dates[k][5:] for k in days], fontsize=7)
        other, _, job = name.partition(": ")
        panel.set_title(f"{other}{limit and f', limit {limit}'}\n{job}", fontsize=7)
    for panel in panels[len(rows) :]:
        panel.axis("off")


def main(arguments=None):
    chosen = options(__doc__, arguments)
    mpl.rcParams["svg.fonttype"] = "none"  # letters as paths would be most of the file
    draw(chosen.out, "benchmarks_history", history, (9.6, 12.5))


if __name__ == "__main__":
    main()
