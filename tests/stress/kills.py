"""Kill commands at random moments, and look at what their directories hold after ``--resume``.

    python -m tests.stress.kills --trials 100 [--seed 1] [--only SUBSTRING]

Every trial starts a command in a session of its own and kills it (SIGKILL), or all of its processes
at once, or kills it and then the command that resumes it. It fails unless all processes of the
session end within LIMIT seconds and ``--resume`` gives the same files to the bit as a run that was
left alone: nothing lost, doubled, merged or left behind. Linux only; a trial takes about 5 s.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import sys
import tempfile
import time
from pathlib import Path

from tests.stress.interrupts import RING, begin, finish, session

LIMIT = 5.0
"""Seconds in which workers notice that their parent is dead."""
EARLIEST = 0.5
"""Seconds after which Python itself has started."""
SHORT = ["--set", "horizon=2.0"]
COMMANDS = {
    **{
        f"run --workers={workers} --trace={trace}": [
            *("run", RING, *SHORT, "--runs=80"),
            *(f"--workers={workers}", f"--trace={trace}"),
        ]
        for workers in (1, 2, 4)
        for trace in ("full", "first", "none")
    },
    "run (single)": ["run", RING, "--set", "horizon=2000"],
    "check": ["check", RING, *SHORT, "--runs=40", "--workers=2"],
}


def strike(command: list[str], out: Path, after: float, whole: bool) -> list[str]:
    """Start a command and kill it, or its ``whole`` session; return what was left running."""
    process = begin(command, out)
    time.sleep(after)
    if whole:
        os.killpg(process.pid, signal.SIGKILL)
    else:
        process.kill()
    process.communicate()
    until = time.monotonic() + LIMIT
    while (left := session(process.pid)) and time.monotonic() < until:
        time.sleep(0.05)
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    return [f"left processes {left}"] if left else []


def trial(name: str, seconds: float, kept: Path, draw: random.Random) -> list[str]:
    """Kill a command once or twice and finish it; return what was wrong."""
    with tempfile.TemporaryDirectory() as folder:
        out, command, wrong = Path(folder) / "out", COMMANDS[name], []
        times = [draw.uniform(EARLIEST, seconds) for _ in range(draw.choice([1, 1, 2]))]
        whole = draw.random() < 0.5
        for after in times:
            more = ["--resume"] if out.exists() else []
            wrong += strike([*command, *more], out, after, whole)
        wrong += finish(command, out, kept)
        done = " and ".join(f"{after:.2f} s" for after in times)
    print(f"  {name}: killed {'all of it ' if whole else ''}after {done}", flush=True)
    return [f"killed after {done}: {problem}" for problem in wrong]


def main() -> int:
    """Return the exit status: 1 if a trial failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="")
    options = parser.parse_args()
    names = [name for name in COMMANDS if options.only in name]
    draw, failed = random.Random(options.seed), 0
    with tempfile.TemporaryDirectory() as folder:
        seconds: dict[str, float] = {}
        for k in range(options.trials):
            name = names[k % len(names)]
            kept = Path(folder) / name
            if name not in seconds:
                began = time.monotonic()
                begin(COMMANDS[name], kept).communicate()
                seconds[name] = time.monotonic() - began
            wrong = trial(name, seconds[name], kept, draw)
            failed += bool(wrong)
            for problem in wrong:
                print(f"FAILED {name}: {problem}", flush=True)
    print(f"{options.trials} trials, {failed} failed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
