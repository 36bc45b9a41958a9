"""Malformed command lines and scenario files, drawn from a seed, and what netkf makes of them.

``python -m tests.scenario.malformed --count 5000 --seed 1`` runs that many, each in a process of
its own with limits of time and memory, and prints those that do not end with status 0, 1, 2 or 130,
say more than one line when they are refused, or take too much; some 20 minutes on one core.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import functools
import gzip
import io
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

from tests.conftest import SCENARIOS, scenario_files
from tests.stress.endings import complaints

LONG = 50_000
SECONDS = 120
MEMORY = 3 << 30
KINDS = (
    *("diffusion", "linear", "recorded", "unknown", "regressor", "cycle", "path", "complete"),
    *("star", "grid", "regular", "erdos-renyi", "geometric", "edges", "csv", "poisson", "renewal"),
    *("periodic", "matching", "broadcast", "readings", "none", "bernoulli", "per-link", "constant"),
    *("gilbert-elliott", "exponential", "uniform", "lognormal", "hybrid", "gossip", "push-sum"),
    *("intermittent", "central", "local", "covariance-intersection", "evil:P", "json:JSONDecoder"),
    *(
        ":",
        "a:b:c",
        "os:system",
        "netkf.parts:Hybrid",
        "../evil:P",
        "netkf.__main__:main",
        "Hybrid",
    ),
)
NUMBERS = (
    *(
        0,
        1,
        -1,
        2,
        3,
        7,
        10,
        1000,
        10**6,
        10**7,
        10**9,
        10**12,
        10**18,
        2**53,
        2**63,
        2**64,
        10**400,
    ),
    *(
        0.0,
        -0.0,
        0.5,
        1.0,
        -1.0,
        1e-9,
        1e-12,
        1e-300,
        5e-324,
        1e9,
        1e15,
        1e30,
        1e31,
        1e300,
        1.8e308,
    ),
    *(float("nan"), float("inf"), -float("inf"), 1.0 + 1e-12, 0.1, 1e-3, 1e3),
)
TEXTS = (
    *("", " ", "x", "\n", "\x1b[31mred\x1b[0m", "\u202egnp", "\x00", "é", "\U0001f40d", "a" * LONG),
    *(
        "../../etc/passwd",
        "/etc/passwd",
        ".",
        "/dev/zero",
        "%s%n",
        "{0}",
        "nan",
        "true",
        "1",
        "[",
        "'",
    ),
)
DOCUMENTS = (
    "a" + ".b" * LONG + " = 1\n",
    "[a" + ".b" * LONG + "]\n",
    "a = " + "[" * LONG + "]" * LONG,
    "a = " + "{b = " * 300 + "1" + "}" * 300,
    "[[a]]\n" * LONG,
    "a = 0x" + "f" * LONG,
    "a = 1" + "0" * LONG,
    'a = "' + "x" * 10**6 + '"',
    "name = [" + "1," * 10**6 + "]",
    "x" * 10**6 + " = 1",
    "\n" * 10**6,
    "\x00" * 1000,
    "",
)


FILTERS: tuple[dict[str, Any], ...] = (
    {"kind": "hcmci", "steps": 2, "consensus": "information", "novelty_weight": 3.0},
    {"kind": "icf", "steps": 2},
    {"kind": "kcf", "epsilon": 0.1, "share_readings": False},
    {"kind": "diffusion-kalman", "weights": "metropolis"},
    {"kind": "one-bit"},
    {"kind": "track-fusion", "rule": "ci", "minimise": "trace"},
    {"kind": "track-fusion", "rule": "ici", "minimise": "determinant"},
    {"kind": "track-fusion", "rule": "cross-covariance"},
    {"kind": "belief-propagation", "steps": 2, "memory": "slot"},
    {"kind": "consensus-innovations"},
    {"kind": "event-triggered", "trigger": "consensus", "thresholds": [1.0, 1.0]},
    {
        **{"kind": "event-triggered", "trigger": "stochastic", "Y": [[1.0]]},
        "inner": {"kind": "intermittent"},
    },
    {"kind": "constant-gain", "gain": [[0.1], [0.1], [0.1], [0.1]]},
)
"""Filters to compare with, with their keys; seeds that are odd put them into scenarios."""


class Case(NamedTuple):
    """A command line without ``netkf``, the text of its file if it is not one of scenarios/, and
    the content of the table that it names.
    """

    arguments: list[str]
    text: str | None
    table: bytes | None = None


class Ended(NamedTuple):
    """Exit status, what was printed, and the seconds and bytes that it took."""

    status: int
    out: str
    err: str
    seconds: float
    memory: int


def draw(seed: int) -> Case:
    """Return the case of a seed."""
    rng = random.Random(seed)
    if seed % 5 == 4:
        return draw_table(rng)
    if seed % 2:
        return draw_comparison(rng)
    base = rng.choice(scenario_files())
    text: str | None = None
    settings: list[str] = []
    kind = rng.random()
    if kind < 0.2:
        table = copy.deepcopy(_tables(base))
        for _ in range(rng.choice((1, 2, 3))):
            scale(table, rng)
        text = to_toml(table)
    elif kind < 0.5:
        table = copy.deepcopy(_tables(base))
        for _ in range(rng.choice((1, 1, 1, 2, 3))):
            mutate(table, rng)
        text = to_toml(table)
    elif kind < 0.65:
        text = mangled(base.read_text(), rng)
    elif kind < 0.7:
        text = rng.choice(DOCUMENTS)
    if text is None or rng.random() < 0.2:
        settings = [setting(base, rng) for _ in range(rng.choice((1, 1, 2)))]
    file = base.name if text is None else "case.toml"
    return Case(command(file, settings, base, rng), text)


def draw_comparison(rng: random.Random) -> Case:
    """Return a case with a filter to compare with, often with sensors that are not linear."""
    bases = [file for file in sorted(SCENARIOS.glob("*/*.toml")) if ".csv" not in file.read_text()]
    table = copy.deepcopy(_tables(rng.choice(bases)))
    chosen = table["filter"] = {**rng.choice(FILTERS)}
    keys = [key for key in chosen if key != "kind"]
    if keys and rng.random() < 0.6:
        key = rng.choice(keys)
        chosen[key] = rng.choice((*NUMBERS, chosen[key], anything(rng)))
    if rng.random() < 0.5:
        sensor = rng.choice(table["sensors"])
        sensor["kind"] = rng.choice(("range", "bearing", "range-bearing"))
        sensor.pop("H", None)
        numbers = [rng.choice(NUMBERS) for _ in range(rng.randrange(4))]
        values = (numbers, [numbers], [[x, 1.0] for x in numbers], [[1.0, 0.0], [0.0, 1.0]])
        odd = rng.choice((*values, anything(rng)))
        sensor[rng.choice(("states", "positions", "R", "nodes"))] = odd
    elif rng.random() < 0.5:
        mutate(table, rng)
    short = ["--set", "horizon=4.0", "--set", "probe=1.0"]
    kinds = ",".join(rng.choice(FILTERS)["kind"] for _ in "ab")
    more = {
        "theory": ["--json"],
        "run": [*short, "--no-plot", "--out", "out"],
        "check": [*short, "--runs", "10", "--workers", "1"],
        "compare-filters": [
            *(*short, "--runs", "2", "--workers", "1"),
            *("--filters", rng.choice((_toml(anything(rng)), kinds, kinds))),
        ],
    }
    name = rng.choice(("theory", "run", "run", "check", "compare-filters"))
    return Case([name, "case.toml", *more[name]], to_toml(table))


ENTRIES = (
    *(
        "",
        "nan",
        "inf",
        "-1",
        "0",
        "1e400",
        "1e31",
        "0x1",
        "1_0",
        "\x00",
        "é",
        "#",
        '"',
        "'",
        "1,5",
    ),
    *("1;5", "2009-07-22T15:10:04Z", "2009-07-22", "2009-07-22T15:10:60", "15:10", "9" * 400),
    *("1e999999999", "-1e-999999999", "1.5.2", "+", "1 2", "٣", "a" * LONG, "1248275404.538"),
)
STAMPS = (0, 1, -1, 1e9, 1.5, "1", "2009-07-22T15:10:04.5Z", "x", "nan", "1e99999999", 1e300, True)


def draw_table(rng: random.Random) -> Case:
    """Return a case with a table of readings as people have them, most with a mistake."""
    kind = rng.choice(("recorded", "recorded", "range", "bearing", "range-bearing"))
    p = rng.choice((1, 2)) if kind == "recorded" else 1 + (kind == "range-bearing")
    noises = ([], [f"R{k}" for k in range(p)], [f"R{i}{j}" for i in range(p) for j in range(i, p)])
    names = ["t", "node", *(f"y{k}" for k in range(p)), *rng.choice(noises)]
    names += rng.choice(([], [], ["to"], ["phi0", "phi1"], ["y7"]))
    rows = [
        [
            str(0.5 * rng.randrange(9)),
            str(rng.randrange(3)),
            *(str(rng.random()) for _ in names[2:]),
        ]
        for _ in range(rng.choice((0, 1, 5, 20)))
    ]
    for _ in range(rng.choice((0, 1, 1, 2))):
        row = rng.choice([names, *rows])
        row[rng.randrange(len(row))] = rng.choice((*ENTRIES, *names))
    if rng.random() < 0.2 and rows:
        rng.choice(rows).append("1")
    sign = rng.choice(",;\t|")
    lines = [sign.join(row) for row in (names, *rows)]
    if rng.random() < 0.3:
        lines.insert(rng.randrange(len(lines) + 1), "# t,node,y0")
    text = rng.choice(("\n", "\r\n", "\r")).join(lines)
    text = mangled(text, rng) if rng.random() < 0.2 else text
    encoding = rng.choice(("utf-8", "utf-8", "utf-8", "utf-8-sig", "utf-16", "latin-1"))
    content = text.encode(encoding, "replace")
    content = gzip.compress(content) if rng.random() < 0.2 else content
    content = content[: rng.randrange(len(content) + 1)] if rng.random() < 0.1 else content
    slots = {"F": [[1.0, 0.1], [0.0, 0.9]], "Q": [[0.1, 0.0], [0.0, 0.1]], "period": 0.5}
    clocks = {"A": [[0.0, 1.0], [0.0, 0.0]], "B": [[0.0], [1.0]]}
    sensor: dict[str, Any] = {"kind": kind, "path": "table.csv"}
    sensor["R"] = [[0.2 * (i == j) for j in range(p)] for i in range(p)]
    sensor |= {"H": [[1.0, 0.5], [0.0, 1.0]][:p]} if kind == "recorded" else {}
    if rng.random() < 0.3:
        del sensor["R"]
    in_slots = rng.random() < 0.5
    table = {
        **{"format": 1, "name": "table", "horizon": 4.0, "probe": 0.5},
        "plant": {"kind": "unknown", **(slots if in_slots else clocks)},
        "sensors": [sensor],
        "network": {
            "graph": {"kind": "grid", "rows": 1, "columns": 3},
            "activation": {"kind": "broadcast" if in_slots else "readings"},
        },
        "filter": {"kind": rng.choice(("central", "local", "intermittent", "diffusion"))},
    }
    if rng.random() < 0.4:
        key = rng.choice(("origin", "origin", "unit", "zone"))
        units = ("s", "ms", "ns", "h", 1)
        table["time"] = {key: rng.choice(units if key == "unit" else STAMPS)}
    name = rng.choice(("theory", "run", "run"))
    more = {"theory": ["--json"], "run": ["--no-plot", "--out", "out"]}
    return Case([name, "case.toml", *more[name]], to_toml(table), content)


@functools.cache
def _tables(file: Path) -> dict[str, Any]:
    return tomllib.loads(file.read_text())


def command(file: str, settings: list[str], base: Path, rng: random.Random) -> list[str]:
    """Return a command line; most are ``theory``, whose errors are those of all."""
    sets = [word for one in settings for word in ("--set", one)]
    name = rng.choices(("theory", "run", "sweep", "size", "consistency"), (80, 10, 4, 3, 3))[0]
    short = ["--set", "horizon=1.0"] if rng.random() < 0.5 else []
    value = _toml(anything(rng))
    path = rng.choice(paths(_tables(base)))
    more = {
        "theory": ["--json"] if rng.random() < 0.3 else [],
        "run": [*short, "--no-plot", "--out", "out", *odd_option(rng)],
        "sweep": ["--vary", f"{path}={value},{_toml(anything(rng))}", *short, "--no-plot"],
        "size": ["--vary", f"{path}={value}:{_toml(anything(rng))}", "--target", "worst_rms<=1"],
        "consistency": [*short, "--runs", rng.choice(("1", "2", "0", "x"))],
    }
    return [name, file, *sets, *more[name]]


def odd_option(rng: random.Random) -> list[str]:
    """Return an option of ``run`` with a value that may be refused."""
    numbers = ("0", "1", "-1", "1e3", "9" * 12, "9" * 5000, "x", "", "\n", "0x1", "²")
    name = rng.choice(
        ("--seed", "--workers", "--replica", "--trace", "--engine", "--what\n", "--runs")
    )
    value = rng.choice(numbers)
    return [name, "1" if name == "--runs" and value.isdecimal() else value]


def setting(base: Path, rng: random.Random) -> str:
    """Return a text for ``--set``."""
    path = rng.choice(paths(_tables(base)))
    odd = (
        ".",
        "a" + ".b" * LONG,
        path + ".x",
        path + "[0]",
        path + ".0",
        "x" * LONG,
        "",
        "\n",
        "=",
    )
    key = path if rng.random() < 0.85 else rng.choice(odd)
    value = _toml(anything(rng)) if rng.random() < 0.85 else rng.choice(TEXTS)
    return f"{key}={value}".replace("\x00", "")  # a command line has none


def paths(value: Any, prefix: str = "") -> list[str]:
    """Return the paths of all keys of a table."""
    if isinstance(value, dict):
        parts = [(key, entry) for key, entry in value.items()]
    elif isinstance(value, list) and any(isinstance(entry, dict) for entry in value):
        parts = [(str(k), entry) for k, entry in enumerate(value)]
    else:
        return []
    found = []
    for key, entry in parts:
        found += [f"{prefix}{key}", *paths(entry, f"{prefix}{key}.")]
    return found


def anything(rng: random.Random, depth: int = 0) -> Any:
    """Return a value of any type, often an extreme one."""
    kind = rng.randrange((8, 7, 7, 4)[depth])
    if kind < 2:
        return rng.choice(NUMBERS)
    if kind == 2:
        return rng.choice(TEXTS)
    if kind == 3:
        return rng.choice((*KINDS, True, False))
    if kind == 4:
        length = rng.choice((0, 1, 2, 3, 3, 20))
        return [anything(rng, depth + 1) for _ in range(length)]
    if kind == 5:
        rows, columns = rng.randrange(1, 5), rng.randrange(1, 5)
        return [[rng.choice(NUMBERS) for _ in range(columns)] for _ in range(rows)]
    if kind == 6:
        keys = ("kind", "nodes", "radius", "rate", "p", "seconds", "mean", "period", "path", "rows")
        return {"kind": rng.choice(KINDS)} | {
            key: anything(rng, depth + 1) for key in rng.sample(keys, rng.randrange(4))
        }
    return rng.choice((nest(LONG), nest(40), [1] * LONG, ["x"] * 1000, [[0.0] * 300] * 300))


def nest(depth: int) -> Any:
    """Return lists within lists; the deepest ones are cut to what can be written."""
    value: Any = 1
    for _ in range(min(depth, 400)):
        value = [value]
    return value


def mutate(table: dict[str, Any], rng: random.Random) -> None:
    """Change a table at one place: a value, a key less, a key more, a value of elsewhere."""
    path = rng.choice(paths(table)).split(".")
    node: Any = table
    for key in path[:-1]:
        node = node[int(key)] if isinstance(node, list) else node[key]
    last: Any = int(path[-1]) if isinstance(node, list) else path[-1]
    kind = rng.randrange(10)
    if kind == 0:
        del node[last]
    elif kind == 1 and isinstance(node, dict):
        node[rng.choice((*TEXTS, "kind", "nodes", "path", "seed", "mean"))] = anything(rng)
    elif kind == 2:
        node[last] = copy.deepcopy(rng.choice(list(table.values())))
    elif kind == 3:
        node[last] = [copy.deepcopy(node[last])] * rng.choice((1, 2, 1000))
    elif kind == 4 and isinstance(node[last], list):
        node[last] = perturbed(node[last], rng)
    elif kind in (5, 6) and isinstance(node[last], (int, float)):
        node[last] = node[last] * rng.choice((-1, 0, 2, 0.5, 1e-3, 10, 1e3, 1e6, 1e-12, 1e12))
    elif kind == 7 and isinstance(node[last], (int, float)):
        node[last] = rng.choice(NUMBERS)
    else:
        node[last] = anything(rng)


def scale(table: dict[str, Any], rng: random.Random) -> None:
    """Multiply one number of a table, which often leaves a scenario that can be run."""
    factor = rng.choice((0.0, -1.0, 1e-12, 1e-6, 1e-3, 0.5, 2.0, 10.0, 1e3, 1e6, 1e12, 1e20))
    leaves = [path for path in paths(table) if isinstance(_at(table, path), (int, float, list))]
    path = rng.choice(leaves).split(".")
    node, value = _at(table, ".".join(path[:-1])), _at(table, ".".join(path))
    node[int(path[-1]) if isinstance(node, list) else path[-1]] = _scaled(value, factor)


def _at(table: Any, path: str) -> Any:
    for key in path.split(".") if path else ():
        table = table[int(key)] if isinstance(table, list) else table[key]
    return table


def _scaled(value: Any, factor: float) -> Any:
    if isinstance(value, list):
        return [_scaled(entry, factor) for entry in value]
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return value
    return int(value * factor) if isinstance(value, int) else value * factor


def perturbed(value: list[Any], rng: random.Random) -> list[Any]:
    """Return a list with one entry changed, at any depth."""
    value = list(value)
    if not value:
        return [anything(rng)]
    k = rng.randrange(len(value))
    inside = value[k]
    value[k] = perturbed(inside, rng) if isinstance(inside, list) else rng.choice(NUMBERS)
    return value


def mangled(text: str, rng: random.Random) -> str:
    """Return a text with characters removed, doubled, swapped or replaced."""
    for _ in range(rng.randrange(1, 6)):
        first = rng.randrange(len(text))
        last = min(len(text), first + rng.choice((1, 1, 2, 5, 50)))
        kind = rng.randrange(4)
        if kind == 0:
            text = text[:first] + text[last:]
        elif kind == 1:
            text = text[:last] + text[first:]
        elif kind == 2:
            text = text[:first] + rng.choice("\"'[]{}=.,#\n\t\x00\x1b\u2028é9e-+_") + text[last:]
        else:
            other = rng.randrange(len(text))
            text = text[:other] + text[first:last] + text[other:]
        text = text or " "
    return text


def to_toml(table: dict[str, Any]) -> str:
    """Return tables as TOML, whatever they hold."""
    return "\n".join(f"{_key(key)} = {_toml(value)}" for key, value in table.items()) + "\n"


def _key(key: str) -> str:
    plain = key.isascii() and key.replace("_", "a").replace("-", "a").isalnum()
    return key if plain else _text(key)


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_key(k)} = {_toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return repr(value)


def _text(value: str) -> str:
    plain = "".join(c if c.isprintable() and c not in '"\\' else f"\\U{ord(c):08x}" for c in value)
    return f'"{plain}"'


def prepare(folder: Path) -> None:
    """Fill a folder with the scenarios and their data, and a module that must not be imported."""
    shutil.copytree(SCENARIOS, folder, dirs_exist_ok=True)
    (folder / "evil.py").write_text("open('ran', 'w').close()\n")


def write(case: Case, folder: Path) -> None:
    """Write the file of a case."""
    shutil.rmtree(folder / "out", ignore_errors=True)
    shutil.rmtree(folder / "runs", ignore_errors=True)
    if case.text is not None:
        (folder / "case.toml").write_bytes(case.text.encode("utf-8", "surrogatepass"))
    if case.table is not None:
        (folder / "table.csv").write_bytes(case.table)


def attempt(arguments: list[str]) -> tuple[int, str, str]:
    """Run a command in this process; returns its status and what it printed."""
    from netkf.cli.main import main

    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = main(arguments)
        except SystemExit as stop:
            status = stop.code if isinstance(stop.code, int) else 3
    return status, out.getvalue(), err.getvalue()


def separately(case: Case, folder: Path) -> Ended:
    """Run a case in a process that is forked from this one, with limits of time and memory."""
    write(case, folder)
    began = time.monotonic()
    pid = os.fork()
    if pid == 0:
        _child(case.arguments, folder)
    status = 0
    while time.monotonic() - began < SECONDS:
        done, status, usage = os.wait4(pid, os.WNOHANG)
        if done:
            break
        time.sleep(0.005)
    else:
        os.kill(pid, signal.SIGKILL)
        _, status, usage = os.wait4(pid, 0)
    said = [(folder / f"{name}.txt").read_text(errors="replace") for name in ("out", "err")]
    seconds = usage.ru_utime + usage.ru_stime
    return Ended(os.waitstatus_to_exitcode(status), *said, seconds, usage.ru_maxrss * 1024)


def _child(arguments: list[str], folder: Path) -> None:
    status = 99
    try:
        os.chdir(folder)
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        for name, stream in (("out", 1), ("err", 2)):
            os.dup2(os.open(f"{name}.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC), stream)
        status, out, err = attempt(arguments)
        os.write(1, out.encode("utf-8", "backslashreplace"))
        os.write(2, err.encode("utf-8", "backslashreplace"))
    finally:
        os._exit(status)


def complaint(ended: Ended, folder: Path) -> str | None:
    """Return what is wrong with how a case ended, None if nothing."""
    wrong, refused = complaints(ended.status, ended.err, ended.out), ended.status == 2
    if wrong:
        return "; ".join(wrong)
    if refused and (ended.err.count("\n") != 1 or ended.out):
        return "not one line"
    if (folder / "ran").exists():
        return "a stranger's module was executed"
    if refused and ended.seconds > 3.0:
        return f"refused after {ended.seconds:.1f} s"
    if ended.memory > 1 << 30:
        return f"{ended.memory >> 20} MiB"
    return None


def main() -> int:
    """Run cases and print those that end in a wrong way."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--count", type=int, default=5000)
    parser.add_argument("--seed", type=int, default=1, help="the first case")
    options = parser.parse_args()

    statuses: dict[int, int] = {}
    wrong = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        prepare(folder)
        for seed in range(options.seed, options.seed + options.count):
            case = draw(seed)
            ended = separately(case, folder)
            statuses[ended.status] = statuses.get(ended.status, 0) + 1
            found = complaint(ended, folder)
            if found is not None:
                wrong += 1
                words = " ".join(case.arguments)[:200]
                print(f"{seed}: {found}: {words!r}: {ended.err[-300:]!r}", flush=True)
    print(f"{options.count} cases, {wrong} wrong, by exit status: {dict(sorted(statuses.items()))}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
