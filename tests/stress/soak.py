"""Random commands, one after the other in one process, whose memory must stay bounded.

    python -m tests.stress.soak --minutes 60 [--seed 1]

Scenarios of ``scenarios/`` with short horizons and random settings go through every command, now
and then with malformed ones between them. It fails for a traceback, a status other than 0, 1 or 2,
a folder that holds something but results, or if the memory of the process grows by more than GROWTH
after the first third of the time, in which caches fill and kernels are compiled or loaded.
"""

from __future__ import annotations

import argparse
import gc
import os
import random
import shutil
import sys
import tempfile
import time
from pathlib import Path

from tests.scenario import malformed

GROWTH = 64 << 20
"""Bytes by which the memory may grow after the first third."""
SCENARIOS = ("poisson_ring", "blind_unstable", "delayed_links", "gossip_ring", "push_sum_planar")
SHORT = {"gossip_ring": 30.0, "push_sum_planar": 30.0}
MALFORMED = 0.2
"""Share of commands that are malformed."""


def draw_command(draw: random.Random) -> list[str]:
    """Return a command line on a scenario that is right, with a short horizon."""
    name = draw.choice(SCENARIOS)
    short = [f"{name}.toml", "--set", f"horizon={SHORT.get(name, draw.choice([1.0, 2.0, 4.0]))}"]
    if name not in SHORT:
        loss = f"{{kind = 'bernoulli', delivery = {draw.uniform(0.3, 1.0):.3f}}}"
        short += ["--set", "probe=0.5", "--set", f"network.channel.loss={loss}"]
    seed = ["--seed", str(draw.randrange(1000))]
    alone = ["--workers", "1"]
    commands = {
        "run": [*seed, "--no-plot", "--out", "out"],
        "run ": [*seed, "--runs", str(draw.randrange(2, 40)), *alone, "--no-plot", "--out", "out"],
        "theory": [],
        "check": [*seed, "--runs", "10", *alone],
        "consistency": [*seed, "--runs", "10", *alone],
        "sweep": ["--vary", "seed=1:3:3", *alone, "--no-plot", "--out", "out"],
    }
    command = draw.choice(list(commands))
    return [command.strip(), *short, *commands[command]]


def resident() -> int:
    """Return the resident memory of this process in bytes."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def step(draw: random.Random, folder: Path) -> tuple[int, list[str], str | None]:
    """Run a command in ``folder``; return its status, its words and what was wrong, if anything."""
    if draw.random() < MALFORMED:
        case = malformed.draw(draw.randrange(1 << 30))
        malformed.write(case, folder)
        ended = malformed.separately(case, folder)
        return ended.status, case.arguments, malformed.complaint(ended, folder)
    shutil.rmtree(folder / "out", ignore_errors=True)
    words = draw_command(draw)
    status, _, err = malformed.attempt(words)
    wrong = "traceback" if "Traceback" in err else None
    if status not in (0, 1, 2) or (status == 2 and err.count("netkf: ") != 1):
        wrong = f"status {status}: {err[-300:]!r}"
    if any(path.suffix == ".part" for path in folder.rglob("*")):
        wrong = "left .part files"
    return status, words, wrong


def main() -> int:
    """Return the exit status: 1 if something was wrong."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    draw, began, seconds = random.Random(options.seed), time.monotonic(), 60.0 * options.minutes
    statuses: dict[int, int] = {}
    failed, settled = 0, None
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        malformed.prepare(folder)
        os.chdir(folder)
        while (spent := time.monotonic() - began) < seconds:
            if settled is None and spent > seconds / 3.0:
                settled = resident()
            status, words, wrong = step(draw, folder)
            statuses[status] = statuses.get(status, 0) + 1
            if wrong is not None:
                failed += 1
                print(f"FAILED {' '.join(words)[:200]!r}: {wrong}", flush=True)
        os.chdir("/")
    grown, total = resident() - (settled or resident()), sum(statuses.values())
    print(f"{total} commands, {failed} wrong, by exit status: {dict(sorted(statuses.items()))}")
    print(f"memory {resident() >> 20} MiB, {grown / 2**20:+.0f} MiB after the first third")
    return 1 if failed or grown > GROWTH else 0


if __name__ == "__main__":
    sys.exit(main())
