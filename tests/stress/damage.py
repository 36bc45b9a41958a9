"""Damage run directories at random, and look at what the commands that read them say.

    python -m tests.stress.damage --cases 400 [--seed 1]

Bytes are flipped, inserted, cut and swapped between files; values of JSON documents are replaced by
others of every kind, some with control characters, with the digests as they were or made right
again; columns of Parquet tables are renamed, retyped, emptied and repeated. Each case runs one of
``compare``, ``plot``, ``report``, ``why``, ``netkf.open``, ``run --resume`` (one run and many) and
``check --resume`` in this process. It fails unless the status is 0, 1 or 2, status 2 prints one
line, nothing prints a traceback or a control character, a page executes nothing of a file, and
results of status 0 after --resume are those of a run that was left alone.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import random
import shutil
import signal
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from netkf.cli.main import main as netkf
from netkf.core.errors import ScenarioError
from netkf.core.printable import printable
from netkf.ensembles import block_files
from netkf.ensembles.stored import StoredEnsemble
from netkf.runs.documents import file_digests, write_sealed
from netkf.studies.opening import open as open_result
from tests.stress.endings import complaints, contents

RING = str(Path(__file__).parents[2] / "scenarios" / "poisson_ring.toml")
SHORT = ["--set", "horizon=1.0", "--no-plot"]
MANY = [*SHORT, "--runs", "6", "--trace", "full", "--workers", "1"]
SCRIPT = "<script>stranger()</script>"
HOSTILE = SCRIPT + "x\x1b[31m\x9b2J\u202e\u2066\n\r\x00y"
VALUES: list[Any] = [
    None, True, 0, -1, 3, 2**70, 10**400, 1e308, -0.0, 1e-320, "", "1", HOSTILE, "x" * 100_000,
    [], {}, [None], {"a": None}, [[[[]]]], "complete", "diverged", "interrupted",
]  # fmt: skip
SWEEP = ["--vary", "filter.epsilon=0.1,0.3", "--runs", "2", "--workers", "1"]
TEXTS = [
    "",
    "null",
    "[]",
    "{",
    '{"a":' * 50_000,
    "[" * 50_000,
    "NaN",
    "9" * 9_999,
    "\ufeff{}",
    "\0",
]
LIMIT = 20.0
"""Seconds of processor time."""


def prepare(folder: Path) -> dict[str, tuple[Path, list[str]]]:
    """Make the directories; return each with the command that reads it."""
    commands: dict[str, tuple[Path, list[str]]] = {}
    netkf(["run", RING, *MANY, "--out", str(folder / "many")])
    netkf(["run", RING, *MANY, "--seed", "2", "--out", str(folder / "other")])
    netkf(["run", RING, *SHORT, "--out", str(folder / "one")])
    with contextlib.suppress(KeyboardInterrupt):
        stop_in_the_middle(folder / "cut")
    gossip = str(Path(RING).with_name("gossip_ring.toml"))
    check = ["check", gossip, "--runs", "10", "--workers", "1", "--no-plot"]
    assert netkf([*check, "--out", str(folder / "verdict")]) < 2
    commands["many"] = folder / "many", ["run", RING, *MANY, "--resume", "--out"]
    commands["cut"] = folder / "cut", ["run", RING, *MANY, "--resume", "--out"]
    commands["one"] = folder / "one", ["run", RING, *SHORT, "--resume", "--out"]
    more = ["check", gossip, "--runs", "12", "--workers", "1", "--no-plot"]
    commands["verdict"] = folder / "verdict", [*more, "--resume", "--out"]
    netkf(["sweep", RING, *SHORT, *SWEEP, "--out", str(folder / "sweep")])
    netkf(["run", RING, *SHORT, "--trace", "none", "--out", str(folder / "none")])
    drawn = ["--figure", "error,network,nees", "--out", str(folder / "drawn")]
    page = ["--out", str(folder / "page.html")]
    for name in ("one", "many", "cut", "sweep"):
        commands[f"open {name}"] = folder / name, ["open"]
        commands[f"report {name}"] = folder / name, ["report", *page]
    for name in ("one", "many", "cut"):
        commands[f"plot {name}"] = folder / name, ["plot", *drawn]
        commands[f"why {name}"] = folder / name, ["why", "--replays", "3"]
    commands["plot sweep"] = folder / "sweep", ["plot", "--out", str(folder / "drawn")]
    commands["open none"] = folder / "none", ["open"]
    commands["why at many"] = folder / "many", ["why", "--node=2", "--at=0.5", "--replays=3"]
    commands["report verdict"] = folder / "verdict", ["report", *page]
    commands["report two"] = folder / "one", ["report", *page, str(folder / "one")]
    commands["compare many"] = folder / "many", ["compare", str(folder / "other")]
    commands["compare one"] = folder / "one", ["compare", str(folder / "one")]
    return commands


def stop_in_the_middle(out: Path) -> None:
    """Leave an ensemble with half of its blocks."""
    from netkf.ensembles.directory import EnsembleOptions, runs_to_directory
    from netkf.ensembles.pools import PoolOptions
    from netkf.scenario.reading import load

    def stop(done: int, wanted: int) -> None:
        if done >= wanted // 2:
            raise KeyboardInterrupt

    scenario = load(RING, {"horizon": 1.0})
    runs_to_directory(
        scenario, 6, out, EnsembleOptions(trace="full", pool=PoolOptions(1)), progress=stop
    )


def damage(folder: Path, draw: random.Random) -> str:
    """Change one file of a directory; return what was done."""
    names = sorted(path for path in folder.rglob("*") if path.is_file())
    path = draw.choice(names)
    ways = [flip, cut, insert, swap, remove, replace_text]
    if path.suffix == ".json":
        ways = [change_json] * 8 + ways
    if path.suffix == ".parquet":
        ways = [change_table] * 6 + ways
    if path.suffix == ".npz":
        ways = [change_arrays] * 3 + ways
    way = draw.choice(ways)
    detail = None
    with contextlib.suppress(Exception):  # an earlier change has left nothing to change
        detail = way(path, draw)
    return f"{way.__name__} {path.relative_to(folder)} {detail or ''}"


def flip(path: Path, draw: random.Random) -> None:
    found = bytearray(path.read_bytes())
    for _ in range(draw.choice([1, 1, 10])):
        found[draw.randrange(len(found))] ^= 1 << draw.randrange(8)
    path.write_bytes(found)


def cut(path: Path, draw: random.Random) -> None:
    found = path.read_bytes()
    path.write_bytes(found[: draw.randrange(len(found))])


def insert(path: Path, draw: random.Random) -> None:
    found, at = path.read_bytes(), 0
    at = draw.randrange(len(found))
    path.write_bytes(found[:at] + draw.randbytes(draw.choice([1, 8, 1000])) + found[at:])


def swap(path: Path, draw: random.Random) -> str:
    other = draw.choice([p for p in sorted(path.parents[0].iterdir()) if p.is_file()])
    contents = other.read_bytes()
    path.write_bytes(contents)
    return other.name


def remove(path: Path, draw: random.Random) -> None:
    path.unlink()
    if draw.random() < 0.3:
        path.mkdir()


def replace_text(path: Path, draw: random.Random) -> None:
    path.write_text(draw.choice(TEXTS), encoding="utf-8")


def reseal(path: Path) -> None:
    """Make the digests of the directory right again."""
    folder = path.parent
    for name in ("manifest.json", "verdict.json"):
        with contextlib.suppress(OSError, ValueError, AttributeError, TypeError):
            found = json.loads((folder / name).read_text())
            found.pop("sha256", None)
            if "files" in found:
                found["files"] = file_digests(folder, found["files"])
            write_sealed(folder / name, found)


def change_json(path: Path, draw: random.Random) -> str:
    document = json.loads(path.read_text())
    places: list[tuple[Any, Any]] = []

    def collect(value: Any) -> None:
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, inner in list(items):
            places.append((value, key))
            if isinstance(inner, (dict, list)):
                collect(inner)

    collect(document)
    table, key = draw.choice(places)
    value = draw.choice(VALUES)
    if draw.random() < 0.2:
        del table[key]
    else:
        table[key] = value
    path.write_text(json.dumps(document))
    sealed = draw.random() < 0.7
    if sealed:
        reseal(path)
    return f"{key} = {value!r:.40} {'sealed' if sealed else ''}"


def change_table(path: Path, draw: random.Random) -> str:
    table = pd.read_parquet(path)
    column = draw.choice(list(table.columns))
    how = draw.choice(["drop", "text", "null", "rename", "none", "object", "inf", "repeat", "bool"])
    if how == "drop":
        table = table.drop(columns=column)
    elif how == "text":
        table[column] = HOSTILE
    elif how == "null":
        table[column] = table[column].astype("Float64").where(table.index % 3 > 0)
    elif how == "rename":
        table = table.rename(columns={column: HOSTILE})
    elif how == "none":
        table = table.iloc[:0]
    elif how == "object":
        table[column] = [[1, 2]] * len(table)
    elif how == "inf":
        table[column] = np.inf
    elif how == "repeat":
        table = pd.concat([table] * 3)
    else:
        table[column] = True
    table.to_parquet(path, index=False)
    reseal(path)
    return f"{column} {how}"


def change_arrays(path: Path, draw: random.Random) -> str:
    with np.load(path, allow_pickle=True) as found:
        arrays = {name: found[name] for name in found.files}
    name = draw.choice(list(arrays))
    how = draw.choice(
        [np.zeros(0), np.array("x"), np.array(None), np.ones((3, 3)), np.array(1e300)]
    )
    arrays[name] = how
    made = io.BytesIO()
    np.savez(made, **arrays)
    contents = made.getvalue()
    if path.parent.name == "blocks":
        buffer = io.BytesIO(contents)
        contents += block_files.MARK + block_files.digest_of(buffer, len(contents))
    path.write_bytes(contents)
    reseal(path)
    return name


def run(command: list[str]) -> tuple[Any, str, str]:
    """Run a command in this process; return its status and what it printed."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status: Any = (open_directory if command[0] == "open" else netkf)(command)
        except BaseException as error:
            status = repr(error)
    return status, out.getvalue(), err.getvalue()


def open_directory(command: list[str]) -> int:
    """Read a directory back from Python; return 2 if it is refused, as a command does."""
    try:
        found = open_result(command[1])
        if isinstance(found, StoredEnsemble):
            found.replica(0)
        print(printable(repr(found)))
    except ScenarioError as error:
        print(f"netkf: {error}", file=sys.stderr)
        return 2
    return 0


def look(status: Any, out: str, err: str, seconds: float) -> list[str]:
    """Return what is wrong with how a command ended."""
    slow = [f"took {seconds:.1f} s"] if seconds > LIMIT else []
    return complaints(status, err, out, allowed=(0, 1, 2)) + slow


def main() -> int:
    """Return the exit status: 1 if a case failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=400)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="commands with this in their names")
    options = parser.parse_args()
    failed, statuses = 0, {}
    with tempfile.TemporaryDirectory() as top, contextlib.redirect_stdout(sys.stdout):
        folder = Path(top) / "made"
        folder.mkdir()
        with contextlib.redirect_stdout(io.StringIO()):
            commands = prepare(folder)
        for k in range(options.cases):
            draw = random.Random(options.seed * 1_000_000 + k)
            name = draw.choice([name for name in commands if options.only in name])
            source, command = commands[name]
            copy = Path(top) / "copy"
            shutil.copytree(source, copy)
            what = [damage(copy, draw) for _ in range(draw.choice([1, 1, 1, 2]))]
            forged = any(word in str(what) for word in ("sealed", "change_table", "change_arrays"))
            began = time.process_time()
            status, out, err = run([*command, str(copy)])
            wrong = look(status, out, err, time.process_time() - began)
            whole = folder / ("many" if name == "cut" else name.split()[-1])
            page = folder / "page.html"
            if page.exists() and SCRIPT in page.read_text(encoding="utf-8"):
                wrong.append("a script of a file is on the page")
            resumed = status == 0 and name in ("cut", "many", "one") and not forged
            if resumed and contents(copy) != contents(whole):
                wrong.append("other files")
            statuses[name, status] = statuses.get((name, status), 0) + 1
            failed += bool(wrong)
            for problem in wrong:
                print(f"FAILED case {k}, {name}, {what}: {problem}", flush=True)
            shutil.rmtree(copy)
    print(statuses)
    print(f"{options.cases} cases, {failed} failed; threads: {threading.active_count()}")
    return 1 if failed else 0


if __name__ == "__main__":
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    sys.exit(main())
