"""Reference cases, computed independently of netkf in 60-digit arithmetic (numbers in hybrid.json).

Node indices are 0-based; V is the noise intensity of the sensors; ``events`` are ticks (t, i, j).
"""

import json
from pathlib import Path

from netkf.scenario.reading import from_table

FOLDER = Path(__file__).parent


def hybrid_cases():
    return json.loads((FOLDER / "hybrid.json").read_text())["cases"]


def hybrid_scenario(case, folder, recorded):
    """The scenario of a case, with its recorded ticks or with Poisson clocks of its rates."""
    given = case["input"]
    rows = [f"{t!r},{int(i)},{int(j)}" for t, i, j in given["events"]]
    (folder / "ticks.csv").write_text("t,node,peer\n" + "\n".join(rows) + "\n")
    rates = [[i, j, r] for (i, j), r in zip(given["edges"], given["rates"], strict=True)]
    clock = {"kind": "poisson", "rates": rates}
    if recorded:
        clock = {"kind": "recorded", "path": "ticks.csv"}
    sensors = [
        {"nodes": [k], "H": H, "R": V}
        for k, (H, V) in enumerate(zip(given["H"], given["V"], strict=True))
    ]
    table = {
        "format": 1,
        "name": case["name"],
        "horizon": max(given["times"]) + 0.5,
        "probe": given["times"],
        "plant": {"kind": "diffusion", "A": given["A"], "B": given["B"], "cov": given["P0"][0]},
        "sensors": sensors,
        "network": {"graph": {"kind": "edges", "edges": given["edges"]}, "activation": clock},
        "filter": {"kind": "hybrid", "epsilon": given["eps"], "cov": given["P0"]},
    }
    return from_table(table, folder)
