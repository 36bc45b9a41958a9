"""Rows of commands: their processor time beside that of ``python -c "import numpy, pandas"``."""

import os
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

from tests.benchmarks.table import Row, Side
from tests.conftest import SCENARIOS

LAB = str(SCENARIOS / "intel_lab.toml")
# Bytecode is kept as where netkf is installed; one thread, so that none waits in a loop.
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1"}
ENVIRONMENT.pop("PYTHONDONTWRITEBYTECODE", None)


def call(*words):
    """Run Python with these words; returns the exit status."""
    return subprocess.run(
        [sys.executable, *words], env=ENVIRONMENT, capture_output=True, check=False
    ).returncode


def beside_imports(words, status=0, run=False):
    """A command, and the import of numpy and pandas. OUT stands for a new folder, and RUN for that
    of a ``run`` of the lab.
    """
    folder = tempfile.TemporaryDirectory()
    root = Path(folder.name)
    if run:
        assert call("-m", "netkf", "run", LAB, "--no-plot", "--out", str(root / "run")) == 0

    def mine(_):
        out = {"OUT": tempfile.mkdtemp(dir=folder.name), "RUN": str(root / "run")}
        assert call("-m", "netkf", *(out.get(word, word) for word in words)) == status

    return Side(mine), Side(lambda _: call("-c", "import numpy, pandas"))


def row(name, limit, *words, **rest):
    """A row of a command that takes at most ``limit`` times as long as the imports."""
    return Row(f"command: {name}", "call", partial(beside_imports, words, **rest), limit, True)


LIMIT = {"intel_lab": 6.0}  # 870,000 events
FILES = sorted(SCENARIOS.glob("*.toml"))
COMMANDS = [
    *(row(f"run {f.stem}", LIMIT.get(f.stem, 4.0), "run", str(f), "--out", "OUT") for f in FILES),
    *(
        row(f"run --no-plot {f.stem}", 2.4, "run", str(f), "--no-plot", "--out", "OUT")
        for f in FILES
    ),
    row("why, the lab", 10.0, "why", "RUN", run=True),
    row("plot, the lab", 10.0, "plot", "RUN", "--out", "OUT", run=True),
    row("refused: no such file", 0.4, "run", "nowhere.toml", status=2),
    row("refused: no such key", 0.4, "run", LAB, "--set", "horizn=1", status=2),
    row("refused: no such option", 0.4, "run", LAB, "--pictures", status=2),
]
