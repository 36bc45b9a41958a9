"""Temperatures of a library at motes whose readings no filter was given, beside two plain rules.

    python analysis/ulb_library.py              # errors at the held-out motes: a table
    python analysis/ulb_library.py --prepare    # write the scenario's tables, print its parameters
    python analysis/ulb_library.py --offsets    # a state for each mote, whose noise is fitted

The raw record is scenarios/data/ulb_library/readings.csv and heard.csv.gz. Each mote broadcasts
with its reading, once a minute; the message reached those motes whose report in the next minute
names the sender. Where a reading is missing but somebody names its mote, the mote broadcast at its
usual second of that minute. Readings of the held-out motes are in a table that no filter sees, and
in no parameter.

Errors are of the second hour, because the first one gave the parameters. What is estimated is the
temperature that all motes share, so a mote differs from it by an offset. With the offset that the
held-out mote's first reading shows to the mean of the others, the filters and the second rule have
the same knowledge of that mote.
"""

import argparse
import re
import shutil
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
import scipy.linalg
from scipy.optimize import minimize

import netkf

SCENARIOS = Path(__file__).parent.parent / "scenarios"
FILE, DATA = SCENARIOS / "ulb_library.toml", SCENARIOS / "data" / "ulb_library"
HELD_OUT = [5, 10, 15]
MINUTE, HOUR, EARLY = 60.0, 3600.0, 10.0  # a minute's reports begin up to 10 s before it
MINUTES = 120
FILTERS = {
    "diffusion, the scenario's": {},
    "covariance intersection": {
        "filter": {"kind": "covariance-intersection", "epsilon": 1.0 / 18.0}
    },
    "hybrid": {"filter": {"kind": "hybrid", "epsilon": 1.0 / 18.0}},
    "push-sum": {"filter": {"kind": "push-sum"}},
    "neighbours' readings": {
        "network.activation": {"kind": "readings"},
        "filter": {"kind": "intermittent"},
    },
    "all readings": {"filter": {"kind": "central"}},
}

# As likely as any for the readings that filters are given: what --offsets prints.
MOTES = """
[[plants]]
name = "rate"
kind = "unknown"
A    = [[-8.04e-4]]
B    = [[1.51e-6]]
mean = [0.0]
cov  = [[2.5e-7]]

[[plants]]
name     = "mote"
nodes    = [1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20]
kind     = "unknown"
A        = [[0.0]]
B        = [[1.149e-3]]
mean     = [22.0]
cov      = [[0.077]]
coupling = [{ from = "rate", A = [[1.0]] }]

"""


def raw():
    """Readings (t, node, y0, minute) of the first two hours, and which (sender, receiver, minute of
    the broadcast) were reported.
    """
    readings = pd.read_csv(DATA / "readings.csv").iloc[:, :3]
    readings.columns = ["t", "node", "y0"]
    readings["minute"] = (readings.t // MINUTE).astype(int)
    reports = pd.read_csv(DATA / "heard.csv.gz")
    minute = ((reports.t_s + EARLY) // MINUTE).astype(int) - 1
    heard = set(zip(reports.sender, reports.receiver, minute, strict=True))
    return readings[readings.minute < MINUTES], heard


def prepare(folder):
    """Write the six tables of the scenario into a folder and print the parameters of its model."""
    readings, heard = raw()
    held_out = readings[readings.node.isin(HELD_OUT)]
    first = held_out.groupby("node").head(1)
    for name, rows in (("held_out", held_out), ("first", first)):
        rows[["t", "node", "y0"]].to_csv(folder / f"{name}.csv", index=False)
    given = readings[~readings.node.isin(HELD_OUT)]
    given[["t", "node", "y0"]].to_csv(folder / "temperatures.csv", index=False)
    nodes = sorted(readings.node.unique())
    pairs = sorted({(sender, receiver) for sender, receiver, _ in heard})
    pd.DataFrame(pairs, columns=["sender", "receiver"]).to_csv(folder / "pairs.csv", index=False)
    times = readings.pivot(index="minute", columns="node", values="t")
    usual = (times.sub(MINUTE * times.index, axis=0)).median()
    named = {(sender, minute) for sender, _, minute in heard}
    ticks, missed = [], []
    for node in nodes:
        to = [receiver for sender, receiver in pairs if sender == node]
        sent = [m for m in range(MINUTES) if times[node].notna().get(m) or (node, m) in named]
        for message, m in enumerate(sent):
            read = times[node].get(m, np.nan)
            ticks.append((round(usual[node] + MINUTE * m if np.isnan(read) else read, 3), node))
            missed += [(node, to_, message, 0) for to_ in to if (node, to_, m) not in heard]
    pd.DataFrame(sorted(ticks), columns=["t", "node"]).to_csv(
        folder / "broadcasts.csv", index=False
    )
    columns = ["sender", "receiver", "message", "delivered"]
    pd.DataFrame(missed, columns=columns).to_csv(folder / "missed.csv", index=False)
    print(f"{len(given)} readings given, {len(ticks)} broadcasts, {len(pairs)} pairs", end=", ")
    print(f"{len(missed)} messages that were not heard or not reported")
    parameters(given[given.t < HOUR])


def parameters(given):
    """Print R, and the likeliest model of the motes' mean over the first hour."""
    table = given.pivot(index="minute", columns="node", values="y0")
    table = table.interpolate(limit_direction="both")
    mean = table.mean(axis=1)
    around = table.sub(mean, axis=0).to_numpy()
    guess, values = np.log([1e3, 1e-5, 0.01]), mean.to_numpy()
    found = minimize(_surprise, guess, args=(values,), method="Nelder-Mead")
    tau, sigma, noise = np.exp(found.x)
    print(f"start {mean.iloc[0]:.2f} C, variance of a mote around it {around[0].var(ddof=1):.3f}")
    print(
        f"R = {np.mean(around**2):.3f}, the mean square of a mote's distance from the mean of all"
    )
    print(
        f"rate with tau = {tau:.0f} s, sigma = {sigma:.3g} C/s^1.5; the mean's noise {noise:.2g} C"
    )


def _surprise(logarithms, means):
    """Minus the log-likelihood of a value a minute: noise, and a temperature whose rate decays."""
    tau, sigma, noise = np.exp(logarithms)
    A, Q = np.array([[0.0, 1.0], [0.0, -1.0 / tau]]), np.diag([0.0, sigma**2])
    moved = scipy.linalg.expm(MINUTE * np.block([[-A, Q], [np.zeros((2, 2)), A.T]]))
    F = moved[2:, 2:].T
    x, P, total = np.array([means[0], 0.0]), np.diag([(10.0 * noise) ** 2, 5e-4**2]), 0.0
    for value in means:
        spread, gap = P[0, 0] + noise**2, value - x[0]
        total += 0.5 * (np.log(spread) + gap**2 / spread)
        K = P[:, 0] / spread
        x, P = F @ (x + K * gap), F @ (P - np.outer(K, P[0])) @ F.T + F @ moved[:2, 2:]
    return total


def errors():
    """Print the RMS error at each held-out mote over the second hour; return those over all of
    these motes, of filters with the first offset.
    """
    readings, heard = raw()
    table = readings.pivot(index="minute", columns="node", values="y0")
    others = table.drop(columns=HELD_OUT).ffill().mean(axis=1)
    first = {node: table[node].iloc[0] - others.iloc[0] for node in HELD_OUT}
    columns = "".join(f" mote {n:2d}" for n in HELD_OUT)
    print(f"{'RMS error in C over the second hour':>38}{columns}     all")
    plain = {
        "last value heard": {n: last_heard(readings, heard, n) for n in HELD_OUT},
        "mean of the others": dict.fromkeys(HELD_OUT, others),
        "mean + first offset": {n: others + first[n] for n in HELD_OUT},
    }
    found = {name: line(name, guesses, table) for name, guesses in plain.items()}
    for name, changes in FILTERS.items():
        run = netkf.simulate(netkf.load(FILE, {"probe": MINUTE, **changes}))
        # The sample at the end of a minute has all that the other rules have of that minute.
        shared = {n: pd.Series(run.xhat[1:, run.nodes.index(n), 0]) for n in HELD_OUT}
        line(name, shared, table)
        late = {n: shared[n] + first[n] for n in HELD_OUT}
        found[name] = line(name + " + first offset", late, table)
    return found


def with_offsets(folder):
    """Return the scenario, written into a folder with its tables, with MOTES in place of its plant
    and with the first readings of all motes.
    """
    before, rest = FILE.read_text().split("[plant]\n")
    sensors, network = rest[rest.index("[[sensors]]") :].split("[network]")
    for name in ("H", "R"):
        sensors = re.sub(rf"^{name} .*$", "", sensors, flags=re.MULTILINE)
    sensors = re.sub(
        r"^nodes", 'of = "mote"\nH = [[1.0]]\nR = [[8.62e-5]]\nnodes', sensors, flags=re.M
    )
    held = sensors[sensors.rindex("[[sensors]]") :]
    first = held.replace("held_out.csv", "first.csv").replace("= true", "= false")
    shutil.copytree(DATA, folder / "data" / "ulb_library")
    (folder / FILE.name).write_text(f"{before}{MOTES}{sensors}{first}[network]{network}")
    return netkf.load(folder / FILE.name)


def offsets(fit=True):
    """Give each mote a temperature of its own, which follows the rate that all share and walks at
    random; fit the three variances, unless ``fit`` is False, and print the RMS errors at the
    held-out motes over the second hour, whose first readings filters are given; return these.
    """
    with tempfile.TemporaryDirectory() as folder:
        scenario = with_offsets(Path(folder))
        if fit:
            alone = scenario.replace({"sensors.2.held_out": True})
            found = netkf.fit_noise(alone)
            print(found.table.to_string(index=False))
            print(f"log-likelihood {found.log_likelihood:.1f}, of the scenario", end=" ")
            print(f"{netkf.log_likelihood(netkf.load(FILE)):.1f}")
        errors = {}
        for name, changes in {
            "diffusion": {},
            "all readings": {"filter": {"kind": "central"}},
        }.items():
            run = netkf.simulate(scenario.replace({"probe": MINUTE, **changes}))
            readings = raw()[0].pivot(index="minute", columns="node", values="y0")
            blocks = {n: run.block("mote", n) for n in HELD_OUT}
            estimates = {n: pd.Series(block.xhat[1:, 0]) for n, block in blocks.items()}
            errors[name] = line(f"{name}, an offset for each mote", estimates, readings)
            claimed = np.sqrt(np.mean([block.P[60:, 0, 0] for block in blocks.values()]))
            print(f"{'claims':>38}{'':24} {claimed:7.3f}")
    return errors


def last_heard(readings, heard, receiver):
    """By minute, the last reading that a mote heard from another one that filters are given."""
    rows = readings[~readings.node.isin(HELD_OUT)].sort_values("t")
    got = [(s, receiver, m) in heard for s, m in zip(rows.node, rows.minute, strict=True)]
    return rows[got].groupby("minute").y0.last().reindex(range(MINUTES)).ffill()


def line(name, guesses, table):
    """Print a row of the table, of guesses by mote and minute; return its last number."""
    late = table[table.index >= HOUR / MINUTE]
    squares = [((late[n] - guesses[n]) ** 2).mean() for n in HELD_OUT]
    numbers = np.sqrt([*squares, np.mean(squares)])
    print(f"{name:>38}" + "".join(f" {number:7.3f}" for number in numbers), flush=True)
    return numbers[-1]


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--prepare", action="store_true", help="write the tables, no simulation")
    parser.add_argument("--offsets", action="store_true", help="a state for each mote, fitted")
    parser.add_argument("--folder", type=Path, default=DATA, help="of the tables that are written")
    options = parser.parse_args(arguments)
    if options.prepare:
        return prepare(options.folder)
    return offsets() if options.offsets else errors()


if __name__ == "__main__":
    main()
