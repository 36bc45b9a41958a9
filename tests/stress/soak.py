"""Random commands, one after the other in one process, whose memory must stay bounded.

    python -m tests.stress.soak --minutes 60 [--seed 1]

Scenarios of ``scenarios/`` with short horizons and random settings go through every command, now
and then with malformed ones between them; directories that are kept are drawn, explained, compared
and reported on. It fails for a traceback, a status other than 0, 1 or 2, a folder that holds
something but results, or if the memory of the process grows by more than GROWTH after the first
third of the time, and at least WARM_UP commands, in which kernels are compiled or loaded and caches
fill: 10 minutes are the least that says something.
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
from tests.stress.endings import complaints, unfinished

GROWTH = 64 << 20
"""Bytes by which the memory may grow after the first third."""
SCENARIOS = ("poisson_ring", "blind_unstable", "delayed_links", "gossip_ring", "push_sum_planar")
SHORT = {"gossip_ring": 30.0, "push_sum_planar": 30.0}
WARM_UP = 60
"""Commands after which every kernel has been needed once."""
KEPT = ("one", "many")
"""Directories that stay, for the commands that read them."""
FIGURES = ("overview", "error", "quantiles", "network", "nees", "nis", "whiteness", "age", "links")
MALFORMED = 0.2
READING = 0.3
"""Shares of commands that are malformed, and of the others that read directories."""


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
        "compare-filters": ["--filters", "hybrid,local", "--runs", "4", *alone],
    }
    if name in SHORT:  # in slots other filters can be compared
        commands["compare-filters"][1] = "gossip,local"
    command = draw.choice(list(commands))
    return [command.strip(), *short, *commands[command]]


def draw_reading(draw: random.Random) -> list[str]:
    """Return a command line that reads directories which are kept."""
    directory = draw.choice(KEPT)
    return draw.choice(
        [
            ["plot", directory, "--figure", draw.choice(FIGURES), "--out", "out"],
            ["report", directory, "--out", "out/page.html"],
            ["why", directory, "--replays", "5"],
            ["compare", *KEPT],
            ["schema"],
            ["new", "lab", "--folder", "out"],
        ]
    )


def keep_directories() -> None:
    """Make the directories of KEPT in the current folder."""
    short = ["poisson_ring.toml", "--set", "horizon=4.0", "--no-plot", "--trace", "full"]
    for name, more in zip(KEPT, ([], ["--runs", "5", "--workers", "1"]), strict=True):
        status, _, err = malformed.attempt(["run", *short, *more, "--out", name])
        assert status == 0, err


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
    if draw.random() < READING:
        (folder / "out").mkdir()
        words = draw_reading(draw)
    status, out, err = malformed.attempt(words)
    wrong = complaints(status, err, out, allowed=(0, 1, 2)) + unfinished(folder)
    return status, words, "; ".join(wrong) or None


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
        keep_directories()
        while (spent := time.monotonic() - began) < seconds:
            if settled is None and spent > seconds / 3.0 and sum(statuses.values()) >= WARM_UP:
                settled = resident()
                print(f"memory {settled >> 20} MiB after {spent:.0f} s", flush=True)
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
