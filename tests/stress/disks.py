"""Let the disk be full after random numbers of bytes, and look at what commands leave.

    python -m tests.stress.disks --cases 60 [--seed 1] [--only SUBSTRING]

Each case runs a command that writes a directory, in a process forked from this one, where files may
grow to a random size only (RLIMIT_FSIZE), or, as root, on a file system of a random size (tmpfs).
It fails unless the command ends with status 2 and one line that says so (or with status 0 and the
files of a run that was left alone, but for a picture that a note names), leaves no unfinished file,
and can be given again: with ``--resume`` where there is one, and into the same place where nothing
is left.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.conftest import SCENARIOS
from tests.stress.damage import run
from tests.stress.endings import complaints, contents, unfinished

RING = ["poisson_ring.toml", "--set", "horizon=2.0"]
ALONE = ["--workers", "1"]
MANY = ["--runs", "12", "--trace", "full", *ALONE]
RESUMED = ("run", "run many", "check")
COMMANDS = {
    "run": ["run", *RING, "--out", "out/made"],
    "run many": ["run", *RING, *MANY, "--out", "out/made"],
    "check": ["check", *RING, "--runs", "10", *ALONE, "--out", "out/made"],
    "sweep": ["sweep", *RING, "--vary", "seed=1,2", *ALONE, "--out", "out/made"],
    "compare-filters": [
        *("compare-filters", *RING, "--filters", "hybrid,local", "--runs", "4"),
        *(*ALONE, "--out", "out/made"),
    ],
    "plot": ["plot", "one", "--figure", "error,age", "--out", "out/made"],
    "report": ["report", "one", "--out", "out/page.html"],
    "why": ["why", "one", "--replays", "3", "--out", "out/made"],
    "new": ["new", "lab", "--folder", "out"],
}


@contextlib.contextmanager
def small_disk(folder: Path, size: int) -> Iterator[None]:
    """Mount a file system of ``size`` bytes at a folder."""
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "x", str(folder)], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def attempt(command: list[str], limit: int | None) -> tuple[int, str]:
    """Run a command in a process of its own; return its status and standard error."""
    with tempfile.TemporaryFile("w+") as printed:
        pid = os.fork()
        if pid == 0:
            status = 99
            with contextlib.suppress(BaseException):
                before = resource.getrlimit(resource.RLIMIT_FSIZE)
                if limit is not None:
                    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
                status, _, err = run(command)
                resource.setrlimit(resource.RLIMIT_FSIZE, before)
                os.write(printed.fileno(), err.encode()[-4000:])
            os._exit(status if isinstance(status, int) else 98)
        status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        printed.seek(0)
        return status, printed.read()


def look(status: int, err: str, out: Path) -> list[str]:
    """Return what is wrong with how a command ended on a full disk."""
    wrong = complaints(status, err, allowed=(0, 2)) + unfinished(out)
    if status == 2 and "cannot " not in err:
        wrong.append(f"printed {err[-400:]!r}")
    return wrong


def again(name: str, out: Path, status: int) -> list[str]:
    """Give the command again without a limit; return what is wrong with how that ends."""
    more = []
    if (out / "made" / "verdict.json").exists():
        return []  # written last: the verdict is there
    if name in RESUMED and (out / "made").exists():
        more = ["--resume"]
    elif status == 2 and name not in ("new", "plot", "report"):
        # What these left is for the user to look at: they begin in a new directory only.
        shutil.rmtree(out / "made", ignore_errors=True)
    elif status == 0:
        return []
    second, err = attempt([*COMMANDS[name], *more], None)
    return [] if second in (0, 1) else [f"again: status {second}, printed {err[-400:]!r}"]


def without_pictures(files: dict[str, bytes]) -> dict[str, Any]:
    """Return the contents of all files but pictures, and manifests without their digests."""
    kept: dict[str, Any] = {k: found for k, found in files.items() if not k.endswith(".png")}
    for name in [name for name in kept if name.endswith("manifest.json")]:
        manifest = kept[name] = json.loads(kept[name])
        manifest.pop("sha256")
        manifest.get("files", {}).pop("run.png", None)
    return kept


def case(name: str, whole: dict[str, bytes], draw: random.Random, folder: Path) -> list[str]:
    """Run a command on a disk that is full at some time; return what was wrong."""
    out, largest = Path("out"), max(map(len, whole.values()))
    total = sum(map(len, whole.values()))
    mounted = os.geteuid() == 0 and draw.random() < 0.5
    wrong: list[str] = []
    if mounted:
        size = 4096 * draw.randrange(1, max(3, int(1.2 * total) // 4096))
        with small_disk(out, size):
            status, err = attempt(COMMANDS[name], None)
            wrong += look(status, err, out)
            shutil.copytree(out, folder / "copy")
        shutil.rmtree(out)
        shutil.move(folder / "copy", out)
        done = f"{size} bytes in all"
    else:
        out.mkdir()
        limit = draw.randrange(0, max(2, int(1.1 * largest)))
        status, err = attempt(COMMANDS[name], limit)
        wrong += look(status, err, out)
        done = f"{limit} bytes a file"
    wrong += again(name, out, status)
    found = contents(out)
    if "note: no picture" in err:  # it decides nothing, and is not drawn again
        whole, found = without_pictures(whole), without_pictures(found)
    if name not in ("report", "why") and found != whole:
        wrong.append("other files at the end")
    shutil.rmtree(out)
    print(f"  {name}, {done}: status {status}", flush=True)
    return [f"{done}: {problem}" for problem in wrong]


def main() -> int:
    """Return the exit status: 1 if a case failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--cases", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="")
    options = parser.parse_args()
    names = [name for name in COMMANDS if options.only in name]
    draw, failed = random.Random(options.seed), 0
    with tempfile.TemporaryDirectory() as top:
        folder = Path(top)
        os.chdir(folder)
        shutil.copy(SCENARIOS / "poisson_ring.toml", folder)
        assert run(["run", *RING, "--no-plot", "--out", "one"])[0] == 0
        whole: dict[str, dict[str, bytes]] = {}
        for k in range(options.cases):
            name = names[k % len(names)]
            if name not in whole:
                (folder / "out").mkdir()
                status, _, err = run(COMMANDS[name])
                assert status in (0, 1), err
                whole[name] = contents(folder / "out")
                shutil.rmtree(folder / "out")
            wrong = case(name, whole[name], draw, folder)
            failed += bool(wrong)
            for problem in wrong:
                print(f"FAILED {name}: {problem}", flush=True)
        os.chdir("/")
    print(f"{options.cases} cases, {failed} failed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
