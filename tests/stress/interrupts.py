"""Interrupt commands at random moments, from outside, and look at how they end.

    python -m tests.stress.interrupts --trials 60 [--seed 1] [--only SUBSTRING]

Every trial starts a command in a session of its own and sends SIGINT or SIGTERM to it or to its
whole process group, twice in a few trials, or kills one of its workers. It fails unless the command
ends within LIMIT seconds with status 130 and one line that says so (or is done, with the status and
the lines of one that was left alone), no process of the session is left, and ``--resume`` gives the
same files to the bit as a run that was left alone. One process at a time, Linux only; a trial takes
about 10 s.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from tests.stress.endings import COMPILING, complaints, contents, error_lines, unfinished

ROOT = Path(__file__).parents[2]
RING = str(ROOT / "scenarios" / "poisson_ring.toml")
LIMIT = 10.0
EARLIEST = 0.3
"""Seconds after which Python itself has started."""
SHORT = ["--set", "horizon=2.0"]
ONE = Path(tempfile.gettempdir()) / f"netkf-interrupts-{os.getpid()}"
"""Directory of a run, for the commands that read one."""
RUNS = [
    [f"--runs=400 --workers={workers} --trace={trace}"]
    for workers in (1, 2, 4)
    for trace in ("full", "first", "none")
]
COMMANDS = {
    **{f"run {line}": ["run", RING, *SHORT, *line.split()] for (line,) in RUNS},
    "run --runs=400 (adaptive)": ["run", RING, *SHORT, "--runs=400", "--trace=full"],
    "run (single)": ["run", RING, "--set", "horizon=10000"],
    "sweep": ["sweep", RING, *SHORT, "--vary", "filter.epsilon=0.1:0.5:9", "--runs=60",
              "--workers=2"],
    "check": ["check", RING, *SHORT, "--runs=200", "--workers=2"],
    "size": ["size", RING, *SHORT, "--vary", "network.activation.rate=0.5:20", "--target",
             "worst_rms<=0.6", "--by=simulation", "--workers=2"],
    "compare-filters": ["compare-filters", RING, *SHORT, "--filters=hybrid,local", "--runs=200",
                        "--workers=2"],
    "plot": ["plot", str(ONE)],
    "report": ["report", str(ONE)],
    "why": ["why", str(ONE), "--replays=300"],
}  # fmt: skip
SIGNALS = {
    "SIGTERM": lambda pid: os.kill(pid, signal.SIGTERM),
    "SIGINT": lambda pid: os.kill(pid, signal.SIGINT),
    "SIGTERM to the group": lambda pid: os.killpg(pid, signal.SIGTERM),
    "SIGINT to the group": lambda pid: os.killpg(pid, signal.SIGINT),
}


class Reference(NamedTuple):
    """How a command ends that is left alone: its seconds, its status, the lines that it prints on
    standard error, and its directory if it can be resumed.
    """

    seconds: float
    status: int
    lines: list[str]
    kept: Path | None


def leave_alone(name: str, folder: Path) -> Reference:
    """Run a command to its end."""
    out, began = folder / name if takes_out(name) else None, time.monotonic()
    process = begin(COMMANDS[name], out)
    _, printed = process.communicate()
    if COMPILING in printed:  # its seconds say nothing about those of the others
        if out is not None:
            shutil.rmtree(out)
        return leave_alone(name, folder)
    kept = out if name.startswith("run") else None
    return Reference(time.monotonic() - began, process.returncode, error_lines(printed), kept)


def begin(command: list[str], out: Path | None) -> subprocess.Popen[str]:
    """Start a command in a session of its own."""
    where = ["--out", str(out), "--no-plot"] if out is not None else []
    return subprocess.Popen(
        [sys.executable, "-m", "netkf", *command, *where],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        cwd=ROOT,
    )


def session(number: int) -> list[int]:
    """Return the processes of a session, dead ones left out."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(fields[3]) == number and fields[0] != "Z":
                found.append(int(entry.name))
    return found


def workers_of(process: subprocess.Popen[str]) -> list[int]:
    """Return the worker processes: children of the process that forks them."""
    found = []
    for pid in session(process.pid):
        try:
            parent = int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
            line = Path(f"/proc/{parent}/cmdline").read_bytes()
        except OSError:
            continue
        if b"forkserver" in line:
            found.append(pid)
    return found


def strike(process: subprocess.Popen[str], draw: random.Random) -> str:
    """Send a signal, or kill a worker; return what was done."""
    workers = workers_of(process)
    if workers and draw.random() < 0.25:
        os.kill(draw.choice(workers), signal.SIGKILL)
        return "killed a worker"
    name = draw.choice(list(SIGNALS))
    SIGNALS[name](process.pid)
    if draw.random() < 0.3:
        time.sleep(draw.uniform(0.0, 0.3))
        if process.poll() is None:
            SIGNALS[name](process.pid)
        name += " twice"
    return name


def trial(name: str, alone: Reference, draw: random.Random) -> list[str]:
    """Interrupt a command once; return what was wrong."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out" if takes_out(name) else None
        process, after = begin(COMMANDS[name], out), draw.uniform(EARLIEST, alone.seconds)
        time.sleep(after)
        done = strike(process, draw) if process.poll() is None else "nothing"
        killed = done == "killed a worker"
        began = time.monotonic()
        try:
            _, printed = process.communicate(timeout=300 if killed else 2 * LIMIT)
        except subprocess.TimeoutExpired:
            for pid in session(process.pid):
                os.kill(pid, signal.SIGKILL)
            process.communicate()
            return [f"{done} after {after:.2f} s: did not end"]
        seconds = time.monotonic() - began
        wrong = look(process, printed, seconds, killed, alone)
        if not takes_out(name):
            wrong += unfinished(ONE)
        if alone.kept is not None and out is not None:
            wrong += resume(name, out, alone.kept)
    print(f"  {name}: {done} after {after:.2f} s: status {process.returncode}, {seconds:.2f} s")
    return [f"{done} after {after:.2f} s: {problem}" for problem in wrong]


def look(
    process: subprocess.Popen[str], printed: str, seconds: float, killed: bool, alone: Reference
) -> list[str]:
    """Return what was wrong with how a command ended."""
    wrong = complaints(process.returncode, printed)
    if process.returncode == 130 and not killed:
        if "netkf: interrupted" not in printed:
            wrong.append(f"printed {printed!r}")
    elif (process.returncode, error_lines(printed)) != (alone.status, alone.lines):
        wrong.append(f"status {process.returncode}, printed {printed!r}")
    if seconds > LIMIT and not killed:
        wrong.append(f"took {seconds:.1f} s")
    time.sleep(0.2)
    left = session(process.pid)
    if left and (time.sleep(3.0) or session(process.pid)):
        wrong.append(f"left processes {session(process.pid)}")
        for pid in session(process.pid):
            os.kill(pid, signal.SIGKILL)
    return wrong


def resume(name: str, out: Path, kept: Path) -> list[str]:
    """Finish a run; return how its files differ from those of a run that was left alone."""
    return unfinished(out) + finish(COMMANDS[name], out, kept)


def finish(command: list[str], out: Path, kept: Path) -> list[str]:
    """Finish a run with ``--resume``; return what is wrong with how it ends and with its files."""
    process = begin([*command, "--resume"], out)
    _, printed = process.communicate(timeout=300)
    if process.returncode != 0 or printed:
        return [f"--resume: status {process.returncode}, printed {printed!r}"]
    return [] if contents(out) == contents(kept) else ["--resume: other files"]


def takes_out(name: str) -> bool:
    """Return True for commands that write a directory."""
    return name.startswith(("run", "sweep", "compare-filters"))


def main() -> int:
    """Return the exit status: 1 if a trial failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="")
    options = parser.parse_args()
    names = [name for name in COMMANDS if options.only in name]
    draw, failed = random.Random(options.seed), 0
    begin(["run", RING], ONE).communicate()
    with tempfile.TemporaryDirectory() as folder:
        known: dict[str, Reference] = {}
        for k in range(options.trials):
            name = names[k % len(names)]
            if name not in known:
                known[name] = leave_alone(name, Path(folder))
            wrong = trial(name, known[name], draw)
            failed += bool(wrong)
            for problem in wrong:
                print(f"FAILED {name}: {problem}", flush=True)
        shutil.rmtree(folder, ignore_errors=True)
    shutil.rmtree(ONE)
    print(f"{options.trials} trials, {failed} failed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
